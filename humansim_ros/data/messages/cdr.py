"""Serialised messages: written as bytes that depend only on the content, and read within limits.

rclpy leaves the padding between fields undefined, so that two messages with the same content may differ in
some bytes. The serialiser of rosbags writes zeros, and does not copy images twice.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, cast

import numpy as np

from humansim_ros.data.bags.topics import is_defined, message_types
from humansim_ros.data.messages.types import is_made, name_of, set_unchecked
from humansim_ros.errors import RosError

#: Most fields of a point cloud.
MAX_FIELDS = 64
#: Longest serialised message that is read, bytes, by type, and for all other types. rclpy needs up to 0.6 s
#: for a megabyte of small structures, but only a millisecond for a megabyte of points or text.
_MAX_BYTES = {
    "sensor_msgs/msg/MultiDOFJointState": 192 << 10,
    "visualization_msgs/msg/Marker": 128 << 10,
    "std_msgs/msg/String": 256 << 10,
    "sensor_msgs/msg/PointCloud2": 64 << 20,
    "sensor_msgs/msg/Image": 512 << 20,
}
_MAX_OTHER = 64 << 10


def serialised(message: Any, type_name: str) -> memoryview:
    """Serialise a message as little-endian CDR, ready for a bag.

    Sequences of numbers in the message become NumPy arrays. Single bytes become numbers. ``type_name``: such
    as ``sensor_msgs/msg/Image``.

    Raises:
        BagError: rosbags is not installed.
    """
    for (*parents, attribute), dtype in _numbers(type_name):
        for owner in _parts(message, parents):
            numbers = getattr(owner, attribute)
            if dtype is not None and not isinstance(numbers, np.ndarray):
                set_unchecked(owner, attribute, np.asarray(numbers, dtype))
            elif isinstance(numbers, bytes):  # a single byte
                set_unchecked(owner, attribute, numbers[0])
    return message_types().serialize_cdr(message, type_name, little_endian=True)


@cache
def _numbers(name: str) -> list[tuple[tuple[str, ...], str | None]]:
    """Fields of a type that are sequences of numbers or a single byte: their paths, and the type of the
    numbers. A path consists of attribute names, starting at the message. A single byte has no type of
    numbers."""
    from rosbags.interfaces import Nodetype

    is_defined(name)  # this adds it to the known types
    found: list[tuple[tuple[str, ...], str | None]] = []
    for attribute, description in message_types().get_msgdef(name).fields:
        node: Any = description[0]
        single = node in (Nodetype.BASE, Nodetype.NAME)
        kind, part = description if single else cast(Any, description[1])[0]
        if kind == Nodetype.NAME:
            found += [((attribute, *path), dtype) for path, dtype in _numbers(str(part))]
        elif single and part[0] in ("byte", "octet"):
            found.append(((attribute,), None))
        elif not single and part[0] not in ("string", "wstring"):
            is_byte = part[0] in ("byte", "octet", "char")
            found.append(((attribute,), "uint8" if is_byte else str(part[0])))
    return found


def _parts(message: Any, path: Sequence[str]) -> Iterator[Any]:
    """Messages at a path of attributes. A list on the path stands for all messages in it."""
    if isinstance(message, list):
        for each in message:
            yield from _parts(each, path)
    elif path:
        yield from _parts(getattr(message, path[0]), path[1:])
    else:
        yield message


def deserialised(data: bytes, kind: Any, max_bytes: int | None = None) -> Any:
    """Read a message from its serialised form.

    Args:
        data: Serialised message.
        kind: Message class.
        max_bytes: Greatest length, the same as in :func:`check_serialised`.

    Raises:
        RosError: There are too many bytes, or they are no such message.
    """
    check_serialised(data, kind, max_bytes)
    # rosbags documents no exceptions for damaged messages
    failure = Exception if is_made(kind) else RuntimeError
    try:
        return _read(data, kind)
    except failure:
        raise RosError(f"{len(data)} bytes that are no {kind.__name__}") from None


def _read(data: bytes, kind: Any) -> Any:
    if is_made(kind):
        return message_types().deserialize_cdr(data, name_of(kind))
    from rclpy.serialization import deserialize_message

    return deserialize_message(data, kind)


def check_serialised(data: bytes, kind: Any, max_bytes: int | None = None) -> None:
    """Raise RosError if a serialised message is too long, or has too many parts, to be read.

    ``max_bytes``: greatest length. If None, the limit of the type.

    Raises:
        RosError: The message is refused.
    """
    name = name_of(kind)
    limit = _MAX_BYTES.get(name, _MAX_OTHER) if max_bytes is None else max_bytes
    if len(data) > limit:
        raise RosError(f"a message of {len(data)} bytes; at most {limit} are read")
    if name == "sensor_msgs/msg/PointCloud2" and (count := _field_count(data)) > MAX_FIELDS:
        raise RosError(f"a PointCloud2 with {count} fields; at most {MAX_FIELDS} are read")


def unpack(form: str, data: bytes, offset: int) -> tuple[Any, ...]:
    """Read numbers of a serialised message in its byte order, as ``struct.unpack_from``.

    Args:
        form: Format of :mod:`struct` without the byte order.
        data: Serialised message. Its second byte gives the byte order; contents begin at byte 4.
        offset: Position in ``data``.

    Raises:
        RosError: The message is too short.
    """
    try:
        return struct.unpack_from(("<" if data[1] & 1 else ">") + form, data, offset)
    except (struct.error, IndexError):
        raise RosError(f"a message of {len(data)} bytes ends too early") from None


def _field_count(data: bytes) -> int:
    """Number of fields of a serialised PointCloud2. It stands after header, height and width."""
    (frame_length,) = unpack("I", data, 12)
    end = -(-(16 + frame_length) // 4) * 4
    (count,) = unpack("I", data, end + 8)
    return count
