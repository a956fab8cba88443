"""Write and read serialised messages (CDR). Equal messages give equal bytes; too large ones are not read.

The serialiser of rosbags is used, not that of rclpy: rclpy leaves the padding between fields undefined, so
that equal messages may differ in some bytes. rosbags writes zeros there, and does not copy images twice.
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

#: Most fields of a point cloud that is read.
MAX_FIELDS = 64
#: Longest serialised message that is read, bytes: by type, then for all other types. rclpy needs up to 0.6 s
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

    This changes the message: sequences of numbers become NumPy arrays, and single bytes become numbers.
    ``type_name``: for example ``sensor_msgs/msg/Image``.

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
    """Find the fields of a message type that are sequences of numbers or single bytes. Returns pairs of path
    and type of the numbers; the type is None for a single byte. A path is the attribute names from the
    message down to the field."""
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
    """Yield the messages at the end of a path of attributes. If an attribute is a list, all are followed."""
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
        max_bytes: Greatest length, bytes. If None, the limit of the type.

    Raises:
        RosError: The message is too long, or the bytes are no message of this class.
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
    """Check that a serialised message is not too long to be read, and does not have too many fields.

    ``max_bytes``: greatest length, bytes. If None, the limit of the type.

    Raises:
        RosError: The message is beyond a limit.
    """
    name = name_of(kind)
    limit = _MAX_BYTES.get(name, _MAX_OTHER) if max_bytes is None else max_bytes
    if len(data) > limit:
        raise RosError(f"a message of {len(data)} bytes; at most {limit} are read")
    if name == "sensor_msgs/msg/PointCloud2" and (count := _field_count(data)) > MAX_FIELDS:
        raise RosError(f"a PointCloud2 with {count} fields; at most {MAX_FIELDS} are read")


def unpack(form: str, data: bytes, offset: int) -> tuple[Any, ...]:
    """Read numbers of a serialised message, like ``struct.unpack_from``, in the byte order of the message.

    Args:
        form: Format string of :mod:`struct` without the byte order.
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
    """Read the number of fields of a serialised PointCloud2, which follows header, height and width."""
    (frame_length,) = unpack("I", data, 12)
    end = -(-(16 + frame_length) // 4) * 4
    (count,) = unpack("I", data, end + 8)
    return count
