"""Files of labelled points in 3D: TRC and C3D."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import HumansimError, warn_about
from humansim_ros.io.files import open_file, read_text
from humansim_ros.types import Array

#: Metres of each unit.
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True, eq=False)
class MarkerFile:
    """Points of a file.

    Attributes:
        labels: K labels.
        points: (F, K, 3) metres, in the axes of the file; NaN where a point was not seen.
        times: (F,) seconds, as the file has them.
        lines: Line of each frame in a text file; nothing for others.
        rate: Frames per second that the file states; NaN if it states none.
    """

    labels: tuple[str, ...]
    points: Array
    times: Array
    lines: tuple[int, ...]
    rate: float


def label_parts(label: str) -> tuple[str, str]:
    """Person and name of a label such as ``anna:l_knee``; an empty person for others."""
    person, found, name = label.rpartition(":")
    return (person, name) if found and person and name else ("", label)


def number(text: str, error: type[HumansimError], path: Path, line: int, key: str) -> float:
    """A number of a file; NaN for an empty field.

    Args:
        text: The field.
        error: Error class to raise.
        path, line, key: File, its line and the name of the field, for messages.

    Raises:
        HumansimError: ``error`` with path, line and key, if it is no number.
    """
    text = text.strip()
    if not text:
        return math.nan
    try:
        return float(text)
    except ValueError:
        raise error(f"{text[:40]!r} is not a number", path=path, line=line, key=key) from None


def _metres(unit: str, error: type[HumansimError], path: Path, line: int | None, key: str) -> float:
    if unit not in UNITS:
        raise error(f"unknown unit {unit!r}; known are {', '.join(UNITS)}", path=path, line=line, key=key)
    return UNITS[unit]


def read_trc_points(path: Path, error: type[HumansimError], most: int) -> MarkerFile:
    """Read a TRC file, with tabs or commas between the fields.

    ``most``: maximum size in bytes. Raises ``error`` with the line.
    """
    lines = read_text(path, error, "TRC", most).splitlines()
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise error("not a TRC file: it must begin with PathFileType", path=path, line=1)
    mark = "\t" if "\t" in lines[0] else ","
    facts = dict(zip(lines[1].split(mark), lines[2].split(mark), strict=False))
    scale = _metres(facts.get("Units", "").strip(), error, path, 3, "Units")
    labels = tuple(word.strip() for word in lines[3].split(mark)[2:] if word.strip())
    if not labels:
        raise error("no marker names", path=path, line=4)
    width = 2 + 3 * len(labels)
    rows, numbers = [], []
    for line, text in enumerate(lines[5:], 6):
        if not text.replace(mark, " ").strip():
            continue
        fields = text.split(mark)
        values = [number(field, error, path, line, f"column {i}") for i, field in enumerate(fields, 1)]
        while len(values) > width and np.isnan(values[-1]):
            values.pop()  # separators at the end of the line
        values += [np.nan] * (width - len(values))
        if len(values) != width:
            message = f"{len(values)} numbers, but {width} for {len(labels)} markers"
            raise error(message, path=path, line=line)
        rows.append(values)
        numbers.append(line)
    table = np.array(rows, dtype=float).reshape(-1, width)
    rate = math.nan
    for key in ("DataRate", "CameraRate"):
        if facts.get(key, "").strip() and not rate > 0:
            rate = number(facts[key], error, path, 3, key)
    points = scale * table[:, 2:].reshape(len(table), len(labels), 3)
    return MarkerFile(labels, points, table[:, 1], tuple(numbers), rate)


def read_c3d_points(path: Path, error: type[HumansimError], most: int) -> MarkerFile:
    """Read the points of a C3D file. ``most``: maximum size in bytes. Raises ``error``."""
    try:
        import c3d
    except ImportError:
        raise error(
            "C3D files need the library c3d; install it with: pip install 'humansim_ros[evaluate]'",
            path=path,
        ) from None
    opened = open_file(path, error, "C3D", most)
    try:
        with opened as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # such as of a file without analog data
            reader: Any = c3d.Reader(file)
            last = int(reader.last_frame)  # a NumPy number of 16 bits overflows in the library
            reader.__class__ = type("Reader", (c3d.Reader,), {"last_frame": last})
            rows = np.array([row[:, :4] for _, row, _ in reader.read_frames()], float)
            # a parameter holds at most 255 labels
            parts = (reader.get(f"POINT:LABELS{number}") for number in ("", *range(2, 258)))
            labels = [word.strip() for part in parts if part is not None for word in part.string_array]
            unit, rate = reader.get_string("POINT:UNITS").strip(), float(reader.point_rate)
            first, count = reader.first_frame - 1, reader.frame_count
    except Exception as reason:  # the library documents no exceptions
        raise error(f"not a C3D file that can be read: {reason}", path=path) from None
    if len(rows) < count:
        warn_about(path, f"the file ends after {len(rows)} of {count} frames")
    rows = rows if len(rows) else np.zeros((0, len(labels), 4))
    points = np.where(rows[..., 3:] < 0, np.nan, rows[..., :3])
    scale = _metres(unit, error, path, None, "POINT:UNITS")
    if not rate > 0:
        raise error("the rate must be positive", path=path, key="POINT:RATE")
    labels = labels[: points.shape[1]]
    times = (first + np.arange(len(points))) / rate
    return MarkerFile(tuple(labels), scale * points[:, : len(labels)], times, (), rate)
