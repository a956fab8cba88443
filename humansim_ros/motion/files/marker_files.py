"""Files of labelled points in 3D: TRC and C3D."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from humansim_ros.errors import HumansimError, warn_about
from humansim_ros.files.reading import read_text
from humansim_ros.motion.files.c3d_file import C3dFile
from humansim_ros.types import Array

#: Metres of each unit.
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001}
_SPELLINGS = {"meter": "m", "decimeter": "dm", "centimeter": "cm", "millimeter": "mm"}
#: Median distance of the points of a person from their centre, metres.
_PERSON = 0.45


@dataclass(frozen=True, eq=False)
class MarkerFile:
    """Points of a file.

    Attributes:
        labels: K labels.
        points: (F, K, 3) metres, in the axes of the file; NaN where a point was not seen.
        times: (F,) seconds, as the file has them.
        lines: Line of each frame in a text file. Empty for other files.
        rate: Frames per second that the file states; NaN if it states none.
        screen_up: Axis of the file that points up or down on a screen (``x``, ``y`` or ``z``); empty if the
            file does not state it.
        segments: Origins of those segments that the file has rotations for; None if the file has no
            rotations.
    """

    labels: tuple[str, ...]
    points: Array
    times: Array
    lines: tuple[int, ...]
    rate: float
    screen_up: str = ""
    segments: MarkerFile | None = None


def label_parts(label: str) -> tuple[str, str]:
    """Person and name of a label such as ``anna:l_knee``. The person is empty for other labels."""
    person, found, name = label.rpartition(":")
    return (person, name) if found and person and name else ("", label)


def number(text: str, error: type[HumansimError], path: Path, line: int, key: str) -> float:
    """Convert a field of a file to a number. An empty field is NaN.

    Args:
        text: The field.
        error: Error class to raise.
        path, line, key: File, its line and the name of the field, for messages.

    Raises:
        HumansimError: ``error`` with path, line and key, if the text is no number.
    """
    text = text.strip()
    if not text:
        return math.nan
    try:
        return float(text)
    except ValueError:
        raise error(f"{text[:40]!r} is not a number", path=path, line=line, key=key) from None


def _unit(text: str) -> str:
    """Short name of a unit, such as ``mm`` for ``Millimetres``. An unknown unit is returned unchanged."""
    word = re.sub(r"[^a-z]", "", text.lower()).replace("metre", "meter")
    found = _SPELLINGS.get(word.removesuffix("s"), word)
    repeated = re.fullmatch(r"(mm|cm|dm|m)\1*", found)
    return repeated[1] if repeated else text


def _metres(
    units: Sequence[str], error: type[HumansimError], path: Path, line: int | None, key: str
) -> float:
    """Metres of the first known unit."""
    known = [UNITS[unit] for unit in map(_unit, units) if unit in UNITS]
    if not known:
        message = f"unknown unit {units[0][:40]!r}; known are {', '.join(UNITS)}"
        raise error(message, path=path, line=line, key=key)
    return known[0]


def read_trc_points(path: Path, error: type[HumansimError], most: int) -> MarkerFile:
    """Read a TRC file. Its fields are separated by tabs or commas. Points without a name are left out.
    ``most``: maximum size in bytes. Raises ``error``, which names the line."""
    lines = read_text(path, error, "TRC", most).splitlines()
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        raise error("not a TRC file: it must begin with PathFileType", path=path, line=1)
    mark = "\t" if "\t" in lines[3] else ","
    keys, stated = ([word.strip() for word in line.split(mark)] for line in lines[1:3])
    # fields may have two separators between them
    filled = ([word for word in words if word] for words in (keys, stated))
    choices = [dict(zip(*pair, strict=False)) for pair in ((keys, stated), filled)]
    facts = next((one for one in choices if _unit(one.get("Units", "")) in UNITS), choices[0])
    scale = _metres([facts.get("Units", "")], error, path, 3, "Units")
    names = {n: word.strip() for n, word in enumerate(lines[3].split(mark)[2:]) if word.strip()}
    if not names:
        raise error("no marker names", path=path, line=4)
    # a name stands in the first of three columns; some programs write the names without blank columns
    in_order = any(n % 3 for n in names)
    labels = {order if in_order else n // 3: word for order, (n, word) in enumerate(names.items())}
    rows, numbers = [], []
    for line, text in enumerate(lines[5:], 6):
        if not text.replace(mark, " ").strip():
            continue
        fields = text.split(mark)
        values = [number(field, error, path, line, f"column {i}") for i, field in enumerate(fields, 1)]
        while len(values) > 2 and np.isnan(values[-1]):
            values.pop()  # separators at the end of the line, or points that were not seen
        rows.append(values)
        numbers.append(line)
    lengths = sorted(map(len, rows)) or [2]
    declared = int(text) if (text := facts.get("NumMarkers", "")).isdecimal() and len(text) < 6 else 0
    named = max(labels) + 1
    most_points = max(named, declared, len(lines[4].split()) // 3, (lengths[len(lengths) // 2] - 2) // 3)
    most_points = named if in_order else most_points  # which points have no name is not known
    for line, values in zip(numbers, rows, strict=True):
        if len(values) > 2 + 3 * most_points:
            message = f"{len(values)} numbers, but {2 + 3 * most_points} for {most_points} markers"
            raise error(message, path=path, line=line)
    count = max(named, -(-(lengths[-1] - 2) // 3))
    table = np.full((len(rows), 2 + 3 * count), np.nan)
    for row, values in zip(table, rows, strict=True):
        row[: len(values)] = values
    points = scale * table[:, 2:].reshape(len(table), count, 3)
    if nameless := int(np.isfinite(np.delete(points, list(labels), axis=1)).any(axis=(0, 2)).sum()):
        warn_about(path, f"{nameless} of {count} points have no name, and are left out")
    rate = math.nan
    for key in ("DataRate", "CameraRate"):
        if facts.get(key, "").strip() and not rate > 0:
            rate = number(facts[key], error, path, 3, key)
    return MarkerFile(tuple(labels.values()), points[:, list(labels)], table[:, 1], tuple(numbers), rate)


def read_c3d_points(path: Path, error: type[HumansimError], most: int) -> MarkerFile:
    """Read the points of a C3D file, or the origins of its segments if it has no points.

    ``most``: maximum size in bytes. Raises ``error``.
    """
    file = C3dFile(path, error, most)
    (places, origins), units = file.places(), file.texts("POINT:UNITS")
    names = [re.sub("_4x4$", "", name, flags=re.IGNORECASE) for name in file.labels("ROTATION")]
    labels = file.labels("POINT") if places.shape[1] else names
    if not labels and not places.shape[1]:
        return MarkerFile((), np.zeros((0, 0, 3)), np.zeros(0), (), math.nan)
    if not labels:
        raise error("the file has no names of the points (POINT:LABELS)", path=path)
    if not file.rates:
        raise error("the rate must be positive", path=path, key="POINT:RATE")
    rate = file.rates[0]
    if not math.isclose(rate, file.rates[-1], rel_tol=1e-3):
        warn_about(path, f"rate {file.rates[-1]:g} in the header, but {rate:g} in POINT:RATE, which is used")
    if stated := [unit for unit in units if unit]:
        scale = _metres(stated, error, path, None, "POINT:UNITS")
    else:
        scale = likely_scale(places if places.size else origins, (0.001, 0.01, 1.0))
        unit = next(unit for unit, metres in UNITS.items() if metres == scale)
        warn_about(path, f"POINT:UNITS states no unit: {unit}, by the size of the person")
    scales = np.full(places.shape[1], scale)
    if len(units) == len(scales):  # what is no length, such as an angle, is left out
        scales = np.array([UNITS.get(_unit(unit), np.nan) if unit else scale for unit in units])
    screen = "".join(file.texts("POINT:Y_SCREEN")[:1]).lower().strip("+-")

    def marker_file(labels: Sequence[str], points: Array, segments: MarkerFile | None = None) -> MarkerFile:
        times = (file.first_frame + np.arange(len(points))) / rate
        labels = tuple(labels[: points.shape[1]])
        return MarkerFile(labels, points[:, : len(labels)], times, (), rate, screen, segments)

    segments = marker_file(names, scale * origins) if names else None
    if segments is not None and not places.shape[1]:
        return segments
    return marker_file(labels, scales[:, None] * places, segments)


def likely_scale(points: Array, scales: Sequence[float]) -> float:
    """Scale that gives points (F, K, 3) the usual distance from the centre of a person, metres."""
    seen = np.where(points.any(axis=-1, keepdims=True), points, np.nan)[:: max(len(points) // 100, 1)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames without points cause warnings
        away = np.nanmedian(np.linalg.norm(seen - np.nanmedian(seen, axis=1, keepdims=True), axis=-1))
    return min(scales, key=lambda scale: abs(math.log(max(away, 1e-9) * scale / _PERSON)))
