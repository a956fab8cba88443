"""Two people who walk, as a PoseSequence, and damaged copies of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from humansim_ros.data.evaluation.pose_sequence import PoseSequence
from humansim_ros.types import Array

NAMES = (
    *("l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist", "l_hip", "r_hip"),
    *("l_knee", "r_knee", "l_ankle", "r_ankle", "vt3", "vt3_end"),
)
#: Joints of a standing person, metres.
STANDING: Array = np.array(
    [
        *([0, 0.2, 1.4], [0, -0.2, 1.4], [0, 0.25, 1.1], [0, -0.25, 1.1], [0.1, 0.25, 0.85]),
        *([0.1, -0.25, 0.85], [0, 0.1, 0.9], [0, -0.1, 0.9], [0, 0.1, 0.5], [0, -0.1, 0.5]),
        *([0, 0.1, 0.1], [0, -0.1, 0.1], [0, 0, 1.5], [0, 0, 1.75]),
    ]
)
PERIOD = 40_000_000


def pose(person: str, seconds: float) -> Array:
    """Anna walks along x, bert 2 m beside her along y; their arms swing."""
    swing = 0.2 * np.sin(2 * np.pi * seconds)
    joints = STANDING.copy()
    joints[[4, 5], 0] += swing, -swing
    if person == "anna":
        return joints + np.array([1.2 * seconds, 0.0, 0.0])
    return joints[:, [1, 0, 2]] * [1.0, 1.0, 1.05] + [0.0, 2.0 + 1.1 * seconds, 0.0]


def walking(frames: int = 50, start: int = 1, people: tuple[str, ...] = ("anna", "bert")) -> PoseSequence:
    times = start + PERIOD * np.arange(frames, dtype=np.int64)
    return PoseSequence(
        NAMES,
        times,
        [{name: pose(name, (int(time) - 1) * 1e-9) for name in people} for time in times],
        source="truth",
    )


def changed(sequence: PoseSequence, change: Callable[[int, str, Array], Array | None]) -> PoseSequence:
    """Copy with ``change(frame, person, joints)`` for each pose; people without joints are left out."""
    people = [
        {name: new for name, joints in each.items() if (new := change(frame, name, joints)) is not None}
        for frame, each in enumerate(sequence.people)
    ]
    return replace(sequence, people=people, source="estimate")
