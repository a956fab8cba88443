"""Poses in CSV: one joint a row, or one person a row."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.readers.numbers import MAX_BYTES, nanoseconds, number
from humansim_ros.evaluate.readers.options import ReadOptions
from humansim_ros.evaluate.tracks import PoseSequence, SequenceBuilder
from humansim_ros.io.files import read_text

_AXIS = re.compile(r"(.+?)[_ .:]?([xyz])", re.IGNORECASE)
_HELP = (
    "the first line must name the columns: time (seconds), stamp (nanoseconds) or frame; person, if there "
    "are several; then joint, x, y, z, or three columns of each joint, such as l_knee_x, l_knee_y, l_knee_z"
)


def read_csv(path: Path, options: ReadOptions) -> PoseSequence:
    """Read a CSV file with a line of column names; see docs/evaluation.md. Raises EvaluationError."""
    text = read_text(path, EvaluationError, "CSV", MAX_BYTES)
    sample = text[: text.find("\n") + 1] or text
    separator = max(",;\t", key=sample.count)
    try:
        return _read(csv.reader(io.StringIO(text), delimiter=separator), path, options)
    except csv.Error as reason:
        raise EvaluationError(f"not valid CSV: {reason}", path=path) from None


def _read(rows: Any, path: Path, options: ReadOptions) -> PoseSequence:
    header = [word.strip() for word in next(rows)]
    columns = {word.lower(): index for index, word in enumerate(header)}
    clock = next((word for word in ("time", "stamp", "frame") if word in columns), None)
    by_joint = {"joint", "x", "y", "z"} <= columns.keys()
    joints = {} if by_joint else _joint_columns(header)
    if clock is None or not (by_joint or joints):
        raise EvaluationError(_HELP, path=path, line=1)
    if clock == "frame" and not options.period:
        raise EvaluationError("frame numbers need a truth with more than one frame", path=path, line=1)
    poses: dict[tuple[int, str], tuple[list[str], list[list[float]], float | None]] = {}
    for row in rows:
        line = rows.line_num
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(header):
            raise EvaluationError(f"{len(row)} fields, but {len(header)} column names", path=path, line=line)
        time = _time(row[columns[clock]], clock, options, path, line)
        person = row[columns["person"]].strip() if "person" in columns else "1"
        score = number(row[columns["score"]], path, line, "score") if "score" in columns else None
        names, positions, _ = poses.setdefault((time, person), ([], [], score))
        given = {row[columns["joint"]].strip(): [columns[a] for a in "xyz"]} if by_joint else joints
        for name, places in given.items():
            if name in names:
                raise EvaluationError(
                    f"joint {name!r} of person {person!r} is given twice for one time", path=path, line=line
                )
            names.append(name)
            positions.append([number(row[place], path, line, header[place]) for place in places])
    builder = SequenceBuilder(str(path))
    for (time, person), (names, positions, score) in poses.items():
        builder.add(time, person, tuple(names), np.array(positions), score)
    return builder.build()


def _time(text: str, clock: str, options: ReadOptions, path: Path, line: int) -> int:
    if clock == "stamp" and text.strip().lstrip("-").isdecimal():
        return nanoseconds(int(text) * 1e-9, path, line, clock) and int(text)
    value = number(text, path, line, clock)
    if clock == "stamp":
        return nanoseconds(value * 1e-9, path, line, clock)
    if clock == "frame":
        return options.start + nanoseconds(value * options.period * 1e-9, path, line, clock)
    return nanoseconds(value, path, line, clock)


def _joint_columns(header: Sequence[str]) -> dict[str, list[int]]:
    """Columns of x, y, z by joint; only joints with all three."""
    found: dict[str, dict[str, int]] = {}
    for index, word in enumerate(header):
        if (match := _AXIS.fullmatch(word)) and word.lower() not in ("x", "y", "z"):
            found.setdefault(match[1], {})[match[2].lower()] = index
    return {name: [axes[a] for a in "xyz"] for name, axes in found.items() if len(axes) == 3}
