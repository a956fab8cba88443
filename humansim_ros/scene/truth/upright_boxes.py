"""Upright boxes of bodies in ``map``, as benchmarks of 3D detection use them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from humansim_ros.geometry import heading_of_hips, turn_about_z
from humansim_ros.types import Array, Float32Array


@dataclass(frozen=True)
class UprightBox:
    """An upright box: its height is along z of ``map``.

    Attributes:
        center: Centre (3,) in ``map``, metres.
        size: Length from back to front, width from side to side, and height (3,), metres.
        yaw: Angle of the direction ahead, radians from x to y.
    """

    center: Array
    size: Array
    yaw: float

    @property
    def bottom(self) -> Array:
        """Middle (3,) of the lower side in ``map``, metres."""
        return self.center - (0.0, 0.0, self.size[2] / 2)

    @property
    def quaternion(self) -> Array:
        """Rotation (4,) xyzw from the axes of the box (ahead, left, up) to ``map``."""
        return turn_about_z(self.yaw)


def upright_box(vertices: Array | Float32Array, joint_names: Sequence[str], positions: Array) -> UprightBox:
    """Compute the smallest upright box of a body that is aligned with the direction that the hips face.
    ``vertices``: (V, 3) in ``map``, metres. ``joint_names``: names of J joints, with ``l_hip`` and ``r_hip``.
    ``positions``: (J, 3) of the joints in ``map``, metres."""
    left, right = (positions[joint_names.index(name)] for name in ("l_hip", "r_hip"))
    yaw = heading_of_hips(left - right)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    turned = vertices @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    return UprightBox(turn.T @ ((low + high) / 2), high - low, yaw)
