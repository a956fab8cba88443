"""Anatomy of the fingers of a skeleton: flexion and spread from a straight hand, and bone rotations for them.

The x axis of a finger bone is its axis of flexion, and a positive rotation bends to the palm, on both sides.
A finger is straight at flexion 0: its first bone continues the line from the wrist to the knuckle, seen along
the axis of flexion, and each other bone continues the bone before it. The ball of the thumb has no straight
position: its angles count from the rest pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from humansim_ros.body.joint_names import FINGERS, finger_bones
from humansim_ros.body.skeleton import Skeleton
from humansim_ros.rotations import multiply_quaternions, rotate
from humansim_ros.types import Array, Indices

#: Names of the finger bones of both hands, the left one first.
FINGER_BONES = (*finger_bones("l"), *finger_bones("r"))
#: Number of finger bones of a hand.
PER_HAND = len(FINGERS) * 3
#: The rest pose is a relaxed hand if its fingers, without thumbs, are bent by this mean angle (degrees).
_RELAXED = 15.0


@dataclass(frozen=True)
class HandAnatomy:
    """The finger bones of a skeleton.

    Attributes:
        bones: (30,) indices of the bones, in the order of :data:`FINGER_BONES`.
        rest: (30,) flexion in the rest pose, radians.
    """

    bones: Indices
    rest: Array

    @classmethod
    def of(cls, skeleton: Skeleton) -> HandAnatomy | None:
        """Anatomy of a skeleton; None if it has not all finger bones."""
        if not set(FINGER_BONES) <= set(skeleton.names):
            return None
        bones = np.array([skeleton.bone(name) for name in FINGER_BONES])
        parents = skeleton.parents[bones]
        first = np.array([name.endswith("1") for name in FINGER_BONES])
        before = np.where(
            first[:, None], skeleton.heads[bones] - skeleton.heads[parents], skeleton.rest[parents, :3, 1]
        )
        in_bone = rotate(np.swapaxes(skeleton.rest[bones, :3, :3], -1, -2), before)
        rest = np.arctan2(-in_bone[:, 2], in_bone[:, 1])
        return cls(bones, np.where([name.endswith("thumb1") for name in FINGER_BONES], 0.0, rest))

    @property
    def is_relaxed(self) -> bool:
        """Whether the rest pose is a relaxed hand: its fingers are bent."""
        fingers = [not name[2:].startswith("thumb") for name in FINGER_BONES]
        return bool(np.degrees(self.rest[fingers]).mean() > _RELAXED)

    def rotations(self, angles: Array) -> Array:
        """Bone rotations for flexion, spread and twist.

        Args:
            angles: (..., 30, 3) radians. Flexion from a straight finger; spread from the rest pose, to the
                side of the thumb, about the normal of the palm; and twist about the bone, inwards as the
                thumb turns to meet the fingers.

        Returns:
            Quaternions (..., 30, 4) xyzw in bone space.
        """
        inwards = np.where(np.arange(2 * PER_HAND) < PER_HAND, 1.0, -1.0)
        spread = _about(2, inwards * angles[..., 1])
        flexion = _about(0, angles[..., 0])
        twist = _about(1, inwards * angles[..., 2])
        straight = _about(0, -self.rest)
        turn = multiply_quaternions(multiply_quaternions(spread, flexion), twist)
        return multiply_quaternions(np.broadcast_to(straight, turn.shape), turn)


def _about(axis: int, angles: Array) -> Array:
    """Quaternions (..., 4) xyzw of rotations about x, y or z by radians (...)."""
    out = np.zeros((*np.shape(angles), 4))
    out[..., axis], out[..., 3] = np.sin(np.asarray(angles) / 2), np.cos(np.asarray(angles) / 2)
    return out
