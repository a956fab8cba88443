"""Poses and velocities of joints at some times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.errors import MotionError
from humansim_ros.rotations import (
    multiply_quaternions,
    quaternion_to_rotation_vector,
    rotation_vector_to_quaternion,
)
from humansim_ros.types import Array

#: Half the time span of the central differences that give velocities, seconds.
VELOCITY_STEP = 1e-3


@dataclass(frozen=True)
class JointPoses:
    """Poses of J joints at N times, in ``map``.

    Attributes:
        names: J names.
        positions: (N, J, 3) metres.
        rotations: (N, J, 4) xyzw, from the rest pose of the motion with the person facing +x; at rest every
            rotation is the identity.
        linear: (N, J, 3) velocities in m/s; None if the source has none.
        angular: (N, J, 3) angular velocities in rad/s; None if the source has none.
    """

    names: tuple[str, ...]
    positions: Array
    rotations: Array
    linear: Array | None = None
    angular: Array | None = None

    def contiguous(self) -> JointPoses:
        """The same poses with contiguous arrays: sums of NumPy depend on the order in memory."""
        linear, angular = (
            None if velocity is None else np.ascontiguousarray(velocity)
            for velocity in (self.linear, self.angular)
        )
        positions, rotations = np.ascontiguousarray(self.positions), np.ascontiguousarray(self.rotations)
        return JointPoses(self.names, positions, rotations, linear, angular)

    def extrapolate(self, seconds: ArrayLike) -> JointPoses:
        """Poses (M, J) at times (M,) relative to a single pose (N = 1), at its constant velocity.

        Raises:
            MotionError: There are no velocities.
        """
        if self.linear is None or self.angular is None:
            raise MotionError("these joints have no velocities")
        steps = np.asarray(seconds, dtype=float)[:, None, None]
        positions = self.positions + self.linear * steps
        turns = rotation_vector_to_quaternion(self.angular * steps)
        return JointPoses(self.names, positions, multiply_quaternions(turns, self.rotations))


@dataclass(frozen=True, eq=False)
class Velocity:
    """Velocity of a pose: ``linear`` (3,) m/s and ``angular`` (3,) rad/s, in the axes of ``map``."""

    linear: Array
    angular: Array

    @classmethod
    def between(cls, positions: Array, rotations: Array, seconds: float) -> Velocity:
        """Mean velocity between two poses: positions (2, 3) and quaternions (2, 4), ``seconds`` apart."""
        (before, after), (rotation_before, rotation_after) = positions, rotations
        return cls(*central_difference(before, after, rotation_before, rotation_after, max(seconds, 1e-12)))

    def scaled(self, factor: float) -> Velocity:
        """Both velocities times a factor."""
        return self if factor == 1 else Velocity(self.linear * factor, self.angular * factor)


def central_difference(
    before: Array, after: Array, rotation_before: Array, rotation_after: Array, seconds: float | Array
) -> tuple[Array, Array]:
    """Velocities from two poses.

    Args:
        before: Positions (..., 3) of the first pose.
        after: Positions (..., 3) of the second pose.
        rotation_before: Quaternions (..., 4) xyzw of the first pose.
        rotation_after: Quaternions (..., 4) xyzw of the second pose.
        seconds: Time between the poses.

    Returns:
        Linear and angular velocity, (..., 3) each.
    """
    turn = multiply_quaternions(rotation_after, rotation_before * (-1, -1, -1, 1))
    return (after - before) / seconds, quaternion_to_rotation_vector(turn) / seconds
