"""Motion formats. Their names, suffixes and other data are rows of config/motion_formats.json."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from humansim_ros.files.reading import read_table


@dataclass(frozen=True)
class MotionFormat:
    """A format of motion files.

    Attributes:
        name: Short name, which selects the reader.
        title: Name for people.
        suffixes: Lower-case suffixes of its files.
        part: What a name after ``#`` selects in a file, such as ``animation``. Empty if nothing can be
            selected.
        also: What else a file with these suffixes may be, such as ``human``. Empty if nothing.
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
    """Say what a file with an unsupported suffix is, and what to do. None for other suffixes."""
    suffix = Path(file).suffix.lower()
    for row in _TABLE["unread"]:
        if suffix in row["suffixes"]:
            return f"{row['name']} ({suffix}), which is not read as a motion: {row['advice']}"
    return None


def motion_format(file: str | os.PathLike[str]) -> MotionFormat | None:
    """Format of a file by suffix; None for an unknown suffix."""
    suffix = Path(file).suffix.lower()
    return next((known for known in MOTION_FORMATS if suffix in known.suffixes), None)


def split_motion_name(name: str | os.PathLike[str]) -> tuple[str, str | None]:
    """Split ``figure.glb#Walk`` or ``all.zip/walk.bvh`` into file and part. The part may be None."""
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
