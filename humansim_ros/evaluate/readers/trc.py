"""Marker trajectories in TRC, as Pose2Sim and OpenSim write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.readers.numbers import MAX_BYTES, nanoseconds, number, split_name
from humansim_ros.evaluate.readers.options import ReadOptions
from humansim_ros.evaluate.tracks import PoseSequence, SequenceBuilder
from humansim_ros.io.files import read_text

#: Metres of each unit.
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001}


def read_trc(path: Path, options: ReadOptions) -> PoseSequence:
    """Read a TRC file; times count from the start of the truth, positions are converted to metres.

    A marker ``anna:l_knee`` is of person anna; others are of the person after whom the file is named.
    Raises EvaluationError.
    """
    lines = read_text(path, EvaluationError, "TRC", MAX_BYTES).splitlines()
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise EvaluationError("not a TRC file: it must begin with PathFileType", path=path, line=1)
    facts = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    unit = facts.get("Units", "").strip()
    if unit not in UNITS:
        known = ", ".join(UNITS)
        raise EvaluationError(f"unknown unit {unit!r}; known are {known}", path=path, line=3, key="Units")
    markers = [split_name(word.strip(), path) for word in lines[3].split("\t")[2:] if word.strip()]
    if not markers:
        raise EvaluationError("no marker names", path=path, line=4)
    people: dict[str, list[int]] = {}
    for index, (person, _) in enumerate(markers):
        people.setdefault(person, []).append(index)
    builder = SequenceBuilder(str(path))
    for line, text in enumerate(lines[5:], 6):
        fields = text.split("\t")
        if not text.strip():
            continue
        values = [number(field, path, line, f"column {i}") for i, field in enumerate(fields[:2], 1)]
        values += [number(field, path, line, f"column {i}") for i, field in enumerate(fields[2:], 3)]
        while len(values) > 2 + 3 * len(markers) and np.isnan(values[-1]):
            values.pop()  # separators at the end of the line
        values += [np.nan] * (2 + 3 * len(markers) - len(values))
        if len(values) != 2 + 3 * len(markers):
            raise EvaluationError(
                f"{len(values)} numbers, but {2 + 3 * len(markers)} for {len(markers)} markers",
                path=path,
                line=line,
            )
        time = options.start + nanoseconds(values[1], path, line, "Time")
        positions = UNITS[unit] * np.array(values[2:]).reshape(-1, 3)
        for person, indices in people.items():
            names = tuple(markers[i][1] for i in indices)
            builder.add(time, person, names, positions[indices])
    return builder.build()
