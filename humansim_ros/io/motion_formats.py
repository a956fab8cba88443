"""Motion formats: their names, suffixes and parts are rows of config/motion_formats.json."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from humansim_ros.io.assets import read_table


@dataclass(frozen=True)
class MotionFormat:
    """A format of motion files.

    Attributes:
        name: Short name, by which readers are found.
        title: Name for people.
        suffixes: Lower-case suffixes of its files.
        part: What a name after ``#`` chooses in a file, such as ``animation``; empty if nothing.
        also: What else files of these suffixes may be, such as ``human``; empty if nothing.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    part: str = ""
    also: str = ""


_TABLE = read_table("motion_formats")
#: All formats. A file with another suffix is read as BVH.
MOTION_FORMATS = tuple(MotionFormat(**{**row, "suffixes": tuple(row["suffixes"])}) for row in _TABLE["read"])
#: Suffixes of all formats.
MOTION_SUFFIXES = tuple(suffix for known in MOTION_FORMATS for suffix in known.suffixes)
#: Names of all formats, for messages and help.
MOTION_TITLES = ", ".join(known.title for known in MOTION_FORMATS)


def unread_format(file: str | os.PathLike[str]) -> str | None:
    """What a file is that is not read, and what to do, by its suffix; None for other suffixes."""
    suffix = Path(file).suffix.lower()
    for row in _TABLE["unread"]:
        if suffix in row["suffixes"]:
            return f"{row['name']} ({suffix}), which is not read as a motion: {row['advice']}"
    return None


def motion_format(file: str | os.PathLike[str]) -> MotionFormat | None:
    """Format of a file by its suffix; None for other suffixes."""
    suffix = Path(file).suffix.lower()
    return next((known for known in MOTION_FORMATS if suffix in known.suffixes), None)


def split_motion_name(name: str | os.PathLike[str]) -> tuple[str, str | None]:
    """File and part of a name such as ``figure.glb#Walk`` or ``all.zip/walk.bvh``; None without a part."""
    text = os.fspath(name)
    file, mark, part = text.rpartition("#")
    known = motion_format(file) if mark else None
    if known is not None and known.part:
        return file, part
    for slash in re.finditer(r"(?<=\.zip)/", text, re.IGNORECASE):
        with suppress(OSError, ValueError):  # an impossible name
            if not Path(text[: slash.start()]).is_dir():
                return text[: slash.start()], text[slash.end() :]
    return text, None
