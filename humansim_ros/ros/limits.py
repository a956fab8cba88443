"""Limits of sizes of messages from the network."""

from __future__ import annotations

import struct
from typing import Any

from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image, MultiDOFJointState, PointCloud2
from std_msgs.msg import String
from visualization_msgs.msg import Marker

from humansim_ros.errors import RosError

#: Most joints of a motion, and most characters of a joint's name.
MAX_JOINTS, MAX_NAME = 1024, 256
#: Most fields of a point cloud.
MAX_FIELDS = 64

#: Most elements of a sequence in a request: of parameters to set, each of which is checked alone, and others.
_MAX_PARAMETERS, _MAX_REQUESTED = 300, 1000

#: Bytes of the longest serialised message that is read, by type, and of all other types. rclpy needs up to
#: 0.6 s for a megabyte of small structures, but only a millisecond for a megabyte of points or text.
_MAX_BYTES = {
    MultiDOFJointState: 192 << 10,
    Marker: 128 << 10,
    String: 256 << 10,
    PointCloud2: 64 << 20,
    Image: 512 << 20,
}
_MAX_OTHER = 64 << 10


def check_serialised(data: bytes, message_type: Any, max_bytes: int | None = None) -> None:
    """Raise RosError for a serialised message that is too long, or has too many parts, to be read.

    ``max_bytes``: of the longest message of its topic; that of the type if None.
    """
    limit = _MAX_BYTES.get(message_type, _MAX_OTHER) if max_bytes is None else max_bytes
    if len(data) > limit:
        raise RosError(f"a message of {len(data)} bytes; at most {limit} are read")
    if message_type is PointCloud2 and (count := _field_count(data)) > MAX_FIELDS:
        raise RosError(f"a PointCloud2 with {count} fields; at most {MAX_FIELDS} are read")


def check_request(request: Any) -> None:
    """Raise RosError for a service request that rclpy cannot read, or not in a short time."""
    for name in request.get_fields_and_field_types():
        value = getattr(request, name)
        limit = _MAX_PARAMETERS if name == "parameters" else _MAX_REQUESTED
        if isinstance(value, list) and len(value) > limit:
            raise RosError(f"{len(value)} {name}; at most {limit} are read in one request")
    for parameter in getattr(request, "parameters", ()):
        if parameter.value.type not in {each.value for each in Parameter.Type}:
            raise RosError(f"{parameter.value.type} is no type of a parameter")


def deserialised(data: bytes, message_type: Any, max_bytes: int | None = None) -> Any:
    """Message of some type from its serialised form. Raises RosError if it is too long
    (:func:`check_serialised`), or is not one.
    """
    check_serialised(data, message_type, max_bytes)
    try:
        return deserialize_message(data, message_type)
    except RuntimeError:  # RMWError
        raise RosError(f"{len(data)} bytes that are no {message_type.__name__}") from None


def unpack(form: str, data: bytes, offset: int) -> tuple[int, ...]:
    """Integers of a serialised message in its byte order, as ``struct.unpack_from``. Raises RosError at its
    end.

    Args:
        form: Format of :mod:`struct` without the byte order.
        data: Serialised message. Its second byte gives the byte order; contents begin at byte 4.
        offset: Position in ``data``.
    """
    try:
        return struct.unpack_from(("<" if data[1] & 1 else ">") + form, data, offset)
    except (struct.error, IndexError):
        raise RosError(f"a message of {len(data)} bytes ends too early") from None


def _field_count(data: bytes) -> int:
    """Number of fields of a serialised PointCloud2: after header, height and width."""
    (frame_length,) = unpack("I", data, 12)
    end = -(-(16 + frame_length) // 4) * 4
    (count,) = unpack("I", data, end + 8)
    return count
