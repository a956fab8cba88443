"""Anatomy of the fingers of a skeleton: flexion and spread from a straight hand, and bone rotations for them.

The x axis of a finger bone is its axis of flexion, and a positive rotation bends to the palm, on both sides.
A finger is straight at flexion 0. Its first bone then continues the line from the wrist to the knuckle, seen
along the axis of flexion, and each other bone continues the previous bone. The ball of the thumb has no
straight position, so its angles are measured from the rest pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from humansim_ros.geometry import multiply_quaternions, rotate, unit_vectors
from humansim_ros.motion.body.skeleton import FINGERS, Skeleton, finger_bones
from humansim_ros.types import Array, Indices

#: Names of the finger bones of both hands, the left one first.
FINGER_BONES = (*finger_bones("l"), *finger_bones("r"))
#: Number of finger bones of a hand.
PER_HAND = len(FINGERS) * 3
#: The rest pose is a relaxed hand if its fingers (without thumbs) are bent by more than this mean angle,
#: degrees.
_RELAXED = 15.0
#: A finger is bent enough to define a plane if the sum of the sines of its bends is above this.
_BENT = 0.35
#: Slope of the line of the knuckles, since the knuckle of the little finger is nearer to the wrist.
_SLANT = 0.17
_IS_THUMB = np.array([name[2:].startswith("thumb") for name in FINGER_BONES])


@dataclass(frozen=True)
class HandAnatomy:
    """The finger bones of a skeleton, in the order of :data:`FINGER_BONES`.

    ``bones``: (30,) indices in the skeleton, -1 for a missing bone. ``rest``: (30,) flexion in the rest pose,
    radians, 0 for a missing bone.
    """

    bones: Indices
    rest: Array

    @classmethod
    def of(cls, skeleton: Skeleton) -> HandAnatomy | None:
        """Anatomy of a skeleton; None if the skeleton has no finger bones."""
        number = {name: bone for bone, name in enumerate(skeleton.names)}
        bones = np.array([number.get(name, -1) for name in FINGER_BONES])
        if (bones < 0).all():
            return None
        parents = skeleton.parents[bones]
        first = np.array([name.endswith("1") for name in FINGER_BONES])
        before = np.where(
            first[:, None], skeleton.heads[bones] - skeleton.heads[parents], skeleton.rest[parents, :3, 1]
        )
        in_bone = rotate(np.swapaxes(skeleton.rest[bones, :3, :3], -1, -2), before)
        rest = np.arctan2(-in_bone[:, 2], in_bone[:, 1])
        return cls(bones, np.where((_IS_THUMB & first) | (bones < 0), 0.0, rest))

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """(30,) whether the skeleton has each bone."""
        return np.asarray(self.bones >= 0)

    @property
    def is_relaxed(self) -> bool:
        """Whether the rest pose is a relaxed hand: its fingers are bent."""
        fingers = self.rest[self.present & ~_IS_THUMB]
        return len(fingers) > 0 and bool(np.degrees(fingers).mean() > _RELAXED)

    def rotations(self, angles: Array) -> Array:
        """Quaternions (..., 30, 4) xyzw in bone space, for flexion, spread and twist (..., 30, 3) in radians.

        Flexion is measured from a straight finger. Spread is measured from the rest pose, about the normal of
        the palm, positive towards the thumb. Twist is about the bone, positive inwards, as the thumb turns to
        meet the fingers.
        """
        inwards = np.where(np.arange(2 * PER_HAND) < PER_HAND, 1.0, -1.0)
        spread = _about(2, inwards * angles[..., 1])
        flexion = _about(0, angles[..., 0])
        twist = _about(1, inwards * angles[..., 2])
        straight = _about(0, -self.rest)
        turn = multiply_quaternions(multiply_quaternions(spread, flexion), twist)
        return multiply_quaternions(np.broadcast_to(straight, turn.shape), turn)


def finger_hinges(side: str, bones: Mapping[str, tuple[Array, Array]], wrist: Array) -> dict[str, Array]:
    """Axes about which the finger bones of a hand flex to the palm.

    The palm lies between the wrist and the knuckles. If only one finger besides the thumb is known, the base
    of the thumb shows the side of the palm. If none is known, the thumb's side is forwards, as in a T or A
    pose. A finger that is bent at rest flexes in the plane of its bend.

    Args:
        side: l or r.
        bones: Head and tail of each finger bone, (3,) each in body space. Any of :data:`FINGER_BONES`.
        wrist: (3,) head of the bone of the hand.

    Returns:
        By bone: unit vector (3,), the x axis of the bone.
    """
    chains = {
        finger: [bones[name] for number in (1, 2, 3) if (name := f"{side}_{finger}{number}") in bones]
        for finger in FINGERS
    }
    thumb, *fingers = (np.array(list(chain.from_iterable(each))) for each in chains.values())
    out, known = (1.0 if side == "l" else -1.0), [joints for joints in fingers if len(joints)]
    knuckles = np.array([joints[0] for joints in known or [thumb]])
    along = unit_vectors(knuckles.mean(axis=0) - wrist)
    if len(knuckles) > 1:
        across = knuckles[-1] - knuckles[0]
    elif known and len(thumb):
        across = knuckles[0] - thumb[0]
    else:
        across = np.array([0.0, 0.0, -1.0])
    palm = out * np.cross(_beside(across, along), along)
    own = [_axis_of_finger(joints, palm) for joints in fingers]
    if known and len(known) < len(fingers):  # few knuckles do not show how the palm is tilted
        axis = np.sum([axis for axis, joints in zip(own, fingers, strict=True) if len(joints)], axis=0)
        across = out * axis
        palm = out * np.cross(_beside(across, along), along)
    # the thumb bends across the palm
    across = unit_vectors(_beside(across, along) - _SLANT * along)
    of_thumb = _axis_of_chord(thumb, 0.5 * palm + across)
    axes = dict(zip(FINGERS, (of_thumb, *own), strict=True))
    return {name: axes[name[2:-1]] for name in bones}


def _beside(across: Array, along: Array) -> Array:
    """Unit vector (3,) of the part of ``across`` at right angles to the unit vector ``along``."""
    return unit_vectors(across - (across @ along) * along)


def _axis_of_chord(joints: Array, goal: Array) -> Array:
    """Axis (3,) about which a finger with joints (N, 3) turns to ``goal``. Zero if there are no joints."""
    return unit_vectors(np.cross(joints[-1] - joints[0], goal)) if len(joints) else np.zeros(3)


def _axis_of_finger(joints: Array, palm: Array) -> Array:
    """Axis (3,) of flexion of a finger, from its bends. If it is nearly straight, it flexes towards the palm.
    ``joints``: (2 S, 3) heads and tails of its S segments."""
    axis = _axis_of_chord(joints, palm)
    if not len(joints):
        return axis
    segments = unit_vectors(joints[1::2] - joints[::2])
    bend = np.cross(segments[:-1], segments[1:]).sum(axis=0)
    towards = float(unit_vectors(bend) @ axis)
    if np.linalg.norm(bend) < _BENT or abs(towards) < 0.5:
        return axis
    return np.asarray(np.sign(towards) * unit_vectors(bend))


def _about(axis: int, angles: Array) -> Array:
    """Quaternions (..., 4) xyzw of rotations about x, y or z by radians (...)."""
    out = np.zeros((*np.shape(angles), 4))
    out[..., axis], out[..., 3] = np.sin(np.asarray(angles) / 2), np.cos(np.asarray(angles) / 2)
    return out
