"""Stamps, frames and headers."""

from __future__ import annotations

import struct

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

WORLD_FRAME = "map"
#: Largest accepted coordinate in metres, and velocity in m/s or rad/s. Larger values are faults.
MAX_COORDINATE = 1e6


def optical_frame(camera: str) -> str:
    """Optical frame of a camera: z forward, x right, y down (REP-103)."""
    return f"{camera}_optical_frame"


def to_time(nanoseconds: int) -> Time:
    """Message of a stamp."""
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return Time(sec=seconds, nanosec=rest)


def to_nanoseconds(stamp: Time) -> int:
    """Stamp of a message."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def serialised_stamp(data: bytes) -> int:
    """Stamp in nanoseconds of a serialised message that begins with a header."""
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)  # after four bytes about the encoding
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def header(stamp: int, frame: str) -> Header:
    """Header with a stamp in nanoseconds."""
    return Header(stamp=to_time(stamp), frame_id=frame)
