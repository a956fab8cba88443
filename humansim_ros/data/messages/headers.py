"""Stamps, names of coordinate frames, and headers of messages."""

from __future__ import annotations

import re

from humansim_ros.data.messages.cdr import unpack
from humansim_ros.data.messages.types import Header, Time, TimeReference
from humansim_ros.errors import RosError

WORLD_FRAME = "map"
#: Topic of transforms that change over time, and topic of transforms that never change.
TF_TOPIC, TF_STATIC_TOPIC = "tf", "tf_static"
_SECOND = 1_000_000_000
_FRAME_NUMBER = re.compile(r"frame ([0-9]{1,15})")


def optical_frame(camera: str) -> str:
    """Default name of the optical frame of a camera: z forward, x right, y down (REP-103)."""
    return f"{camera}_optical_frame"


def depth_optical_frame(optical: str) -> str:
    """Name of the optical frame of a depth sensor. ``optical``: name of the optical frame of its camera."""
    return f"{optical.removesuffix('_optical_frame')}_depth_optical_frame"


def to_time(nanoseconds: int) -> Time:
    """Convert nanoseconds to the stamp of a message."""
    seconds, rest = divmod(nanoseconds, _SECOND)
    return Time(sec=seconds, nanosec=rest)


def to_nanoseconds(stamp: Time) -> int:
    """Convert the stamp of a message to nanoseconds. Raises RosError if the stamp is before 1970, or its
    field ``nanosec`` is a second or more."""
    return _nanoseconds(stamp.sec, stamp.nanosec)


def serialised_stamp(data: bytes) -> int:
    """Stamp in nanoseconds of a serialised message that begins with a header.

    Raises:
        RosError: The message is too short, or its stamp is not valid.
    """
    return _nanoseconds(*unpack("iI", data, 4))


def _nanoseconds(seconds: int, nanoseconds: int) -> int:
    if seconds < 0 or nanoseconds >= _SECOND:
        raise RosError(f"a stamp of {seconds} s and {nanoseconds} ns is not valid")
    return int(seconds) * _SECOND + int(nanoseconds)


def header(stamp: int, frame: str) -> Header:
    """Build the header of a message. ``stamp``: nanoseconds. ``frame``: name of the coordinate frame."""
    return Header(stamp=to_time(stamp), frame_id=frame)


def scene_time_message(scene_time: int, stamp: int, index: int | None = None) -> TimeReference:
    """Build ``scene_time``: the scene time of a frame. ``scene_time`` and ``stamp``: nanoseconds. ``index``:
    number of the frame; None if unknown."""
    source = "scene" if index is None else f"frame {index}"
    return TimeReference(header=header(stamp, WORLD_FRAME), time_ref=to_time(scene_time), source=source)


def read_scene_time(message: TimeReference) -> int:
    """Read the nanoseconds of a ``scene_time`` message. Raises RosError if they are not valid."""
    return to_nanoseconds(message.time_ref)


def read_frame_number(message: TimeReference) -> int | None:
    """Read the number of the frame in a ``scene_time`` message; None if absent."""
    found = _FRAME_NUMBER.fullmatch(message.source)
    return int(found[1]) if found else None
