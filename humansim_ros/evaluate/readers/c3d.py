"""Marker trajectories in C3D, through ezc3d or c3d."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.readers.numbers import MAX_BYTES, split_name
from humansim_ros.evaluate.readers.options import ReadOptions
from humansim_ros.evaluate.readers.trc import UNITS
from humansim_ros.evaluate.tracks import PoseSequence, SequenceBuilder
from humansim_ros.io.files import open_file
from humansim_ros.types import Array


def read_c3d(path: Path, options: ReadOptions) -> PoseSequence:
    """Read the points of a C3D file; times count from the start of the truth, positions become metres.

    A label ``anna:l_knee`` is of person anna; others are of the person after whom the file is named.
    Raises EvaluationError.
    """
    open_file(path, EvaluationError, "C3D", MAX_BYTES).close()
    labels, unit, rate, first, points = _points(path)
    if unit not in UNITS:
        raise EvaluationError(
            f"unknown unit {unit!r}; known are {', '.join(UNITS)}", path=path, key="POINT:UNITS"
        )
    if not rate > 0:
        raise EvaluationError("the rate must be positive", path=path, key="POINT:RATE")
    markers = [split_name(label, path) for label in labels]
    people: dict[str, list[int]] = {}
    for index, (person, _) in enumerate(markers):
        people.setdefault(person, []).append(index)
    builder = SequenceBuilder(str(path))
    for frame, positions in enumerate(points * UNITS[unit], first):
        for person, indices in people.items():
            names = tuple(markers[i][1] for i in indices)
            builder.add(options.start + round(frame * 1e9 / rate), person, names, positions[indices])
    return builder.build()


def _points(path: Path) -> tuple[list[str], str, float, int, Array]:
    """Labels (K), unit, frames per second, number of the first frame from 0, and points (F, K, 3)."""
    try:
        import ezc3d
    except ImportError:
        raise EvaluationError(
            "C3D files need the library ezc3d; install it with: pip install 'humansim_ros[evaluate]'",
            path=path,
        ) from None
    try:
        file: Any = ezc3d.c3d(str(path))
        facts = file["parameters"]["POINT"]
        points = np.transpose(np.asarray(file["data"]["points"], dtype=float)[:3], (2, 1, 0))
        labels = [str(label) for label in facts["LABELS"]["value"]][: points.shape[1]]
        unit, rate = str(facts["UNITS"]["value"][0]), float(facts["RATE"]["value"][0])
        first = int(file["header"]["points"]["first_frame"])
    except Exception as reason:  # the library documents no exceptions
        raise EvaluationError(f"not a C3D file that can be read: {reason}", path=path) from None
    return labels, unit, rate, first, points
