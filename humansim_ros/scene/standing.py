"""Where a person is, for programs that know no joints: a point on the floor and a heading."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from humansim_ros.scene.actor import HumanState
from humansim_ros.types import Array

#: Joints from which the heading follows.
HIPS = ("l_hip", "r_hip")


class Standing(NamedTuple):
    """Place of a person in ``map``.

    Attributes:
        position: Point on the floor below the middle of the hips, (3,) metres.
        yaw: Direction that the hips face, radians from x to y.
        linear: Velocity of the point, (3,) m/s; None if it is unknown.
        yaw_rate: Velocity of the heading, rad/s; None if it is unknown.
    """

    position: Array
    yaw: float
    linear: Array | None
    yaw_rate: float | None


def standing(state: HumanState) -> Standing:
    """Return the place of a person."""
    left, right = (state.joint_names.index(name) for name in HIPS)
    middle = (state.positions[left] + state.positions[right]) / 2
    across = state.positions[left] - state.positions[right]
    position = np.array([*middle[:2], 0.0])
    linear = yaw_rate = None
    if state.linear is not None:
        speed = (state.linear[left] + state.linear[right]) / 2
        turning = state.linear[left] - state.linear[right]
        linear = np.array([*speed[:2], 0.0])
        # of the angle of a vector (x, y): (x y' - y x') / (x² + y²)
        length = across[:2] @ across[:2]
        yaw_rate = float((across[0] * turning[1] - across[1] * turning[0]) / length) if length > 0 else 0.0
    return Standing(position, _yaw(across), linear, yaw_rate)


def _yaw(across: Array) -> float:
    """Heading of hips. ``across``: vector (3,) from the right one to the left one."""
    return float(np.arctan2(-across[0], across[1]))
