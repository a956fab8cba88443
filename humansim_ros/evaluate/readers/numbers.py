"""Text of numbers in files of poses."""

from __future__ import annotations

import math
import os
from pathlib import Path

from humansim_ros.errors import EvaluationError

#: Greatest size of a file of poses: as text, an hour of ten people at 30 Hz.
MAX_BYTES = 1 << 31
#: Seconds beyond which a time cannot be a stamp in 64 bits.
_MAX_SECONDS = 9e9


def number(text: str, path: str | os.PathLike[str], line: int, key: str) -> float:
    """A number of a file; NaN for an empty field.

    Args:
        text: The field.
        path: File, for messages.
        line: Line of the file.
        key: Name of the field.

    Raises:
        EvaluationError: It is no number; with path, line and key.
    """
    text = text.strip()
    if not text:
        return math.nan
    try:
        return float(text)
    except ValueError:
        raise EvaluationError(f"{text[:40]!r} is not a number", path=path, line=line, key=key) from None


def nanoseconds(value: float, path: str | os.PathLike[str], line: int, key: str) -> int:
    """A time as nanoseconds.

    Args:
        value: Seconds.
        path: File, for messages.
        line: Line of the file.
        key: Name of the field.

    Raises:
        EvaluationError: It is not finite, or beyond all stamps; with path, line and key.
    """
    if not abs(value) < _MAX_SECONDS:
        raise EvaluationError(f"{value:g} s is no time", path=path, line=line, key=key)
    return round(value * 1e9)


def split_name(label: str, path: Path) -> tuple[str, str]:
    """Person and joint of a label such as ``anna:l_knee``; the person is that of the file's name without."""
    person, found, joint = label.rpartition(":")
    return (person, joint) if found and person and joint else (path.stem, label)
