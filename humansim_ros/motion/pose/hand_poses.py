"""Poses of hands with fingers that no motion drives: by name, by keys over time, and by raised arms.

The x axis of a finger bone is its axis of flexion, and a positive rotation bends to the palm, on both sides.
A finger is straight at flexion 0. Its first bone then continues the line from the wrist to the knuckle, seen
along the axis of flexion, and each other bone continues the previous bone. The ball of the thumb has no
straight position, so its angles are measured from the rest pose. Between two poses the angles of the joints
change linearly, so that a finger bends and never passes through the palm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MotionError
from humansim_ros.files.reading import read_table
from humansim_ros.geometry import (
    AROUND,
    VELOCITY_STEP,
    central_difference,
    multiply_quaternions,
    quaternion_to_matrix,
    rotate,
    smooth_step,
    unit_vectors,
)
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.motion.body.skeleton import FINGERS, Skeleton, finger_bones
from humansim_ros.types import Array, Indices

if TYPE_CHECKING:
    from humansim_ros.motion.matching.joint_tables import JointMatch
    from humansim_ros.motion.pose.world_motion import WorldMotion

HandPoseName = Literal[
    "relaxed", "fist", "point", "flat", "grip", "wave", "one", "two", "three", "four", "five"
]
HandSide = Literal["left", "right", "both"]
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
class HandKey:
    """A pose that a hand takes at ``time``, seconds of the motion file, and keeps until the next key.

    Attributes:
        blend: Seconds of the file, after ``time``, over which the hand changes from the pose before to this
            pose.
        over_motion: Whether the key also moves fingers that the motion moves.
    """

    pose: HandPoseName
    time: float = 0.0
    side: HandSide = "both"
    blend: float = 0.3
    over_motion: bool = False


#: Hand poses for built-in motions in which hands hold something or lie on the floor.
BUILT_IN_HANDS: Mapping[str, tuple[HandKey, ...]] = {
    "pick_up": (
        HandKey("relaxed", 0.0, "right"),
        HandKey("grip", 2.2, "right", 0.5),
        HandKey("relaxed", 5.2, "right", 0.6),
    ),
    "phone": (HandKey("grip", 0.0, "right"),),
    "write": (HandKey("grip", 0.0, "right"),),
    "eat": (HandKey("grip", 0.0, "right"),),
    "crawl": (HandKey("flat"),),
}


#: Angles (15, 3) of each pose, degrees: flexion, spread and twist of the joints. The first finger is the
#: index finger, the fifth is the thumb. The fingers of a fist bend as far as possible without sinking into
#: the palm of any built-in human.
HAND_POSES: Mapping[str, Array] = {
    name: np.concatenate([np.array(hand[finger], dtype=float) for finger in FINGERS])
    for name, hand in read_table("hand_poses").items()
}
assert tuple(HAND_POSES) == get_args(HandPoseName)
#: Heights of the wrist above the shoulder, as shares of the length of the arm: the hand begins to open at the
#: first height, and is fully open at the second.
_OPENS, _OPEN = 0.1, 0.4
#: Prefix of the names of the joints that carry poses of hands in joint poses.
HAND_JOINT = "hand_pose/"
HAND_JOINTS = frozenset(HAND_JOINT + bone for bone in FINGER_BONES)


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


def hand_angles(name: str, anatomy: HandAnatomy) -> Array:
    """Angles (15, 3) of a named pose, radians. If the rest pose of the body has a relaxed hand, this is the
    pose ``relaxed``."""
    angles = np.radians(HAND_POSES[name])
    if name == "relaxed" and anatomy.is_relaxed:
        left, right = anatomy.rest.reshape(2, PER_HAND)
        angles[:, 0] = np.where(anatomy.present[:PER_HAND], left, right)
    return angles


@dataclass(frozen=True)
class ReachingHand:
    """Pose of a hand while it reaches for something. ``shares``: function that returns, for scene times (N,),
    how far (N,) the hand has changed to this pose, 0 to 1."""

    side: Literal["left", "right"]
    pose: HandPoseName
    shares: Callable[[Array], Array]


@dataclass(frozen=True)
class HandKeys:
    """Keys of the hands of a human over its motion.

    Before its first key, a hand is relaxed. If the motion loops, the hand has the pose of its last key there.
    Raises MotionError if a time is outside the motion.
    """

    keys: tuple[HandKey, ...]
    anatomy: HandAnatomy
    motion: WorldMotion
    driven: frozenset[str] = frozenset()
    reaching: tuple[ReachingHand, ...] = ()

    @classmethod
    def of(
        cls, keys: Sequence[HandKey], skeleton: Skeleton, motion: WorldMotion, match: JointMatch
    ) -> HandKeys | None:
        """Make keys for a skeleton. Returns None if there are no keys, or if they move no finger.

        Args:
            keys, motion: The keys, in any order, and the motion that they belong to.
            skeleton, match: The skeleton, and the joints of the motion that drive its bones.
        """
        anatomy = HandAnatomy.of(skeleton)
        if not keys or anatomy is None:
            return None
        hands = cls(tuple(sorted(keys, key=lambda key: key.time)), anatomy, motion, _driven(match))
        return hands if hands.bones else None

    def __post_init__(self) -> None:
        start, end = self.motion.start, self.motion.start + self.motion.cycle_length
        for key in self.keys:
            if not start <= key.time <= end:
                raise MotionError(
                    f"the hand key at {key.time:g} s is outside the part of the motion that plays, "
                    f"{start:g} to {end:g} s of the file",
                    path=self.motion.motion.path,
                )

    @cached_property
    def bones(self) -> tuple[int, ...]:
        """Numbers, in :data:`FINGER_BONES`, of the bones that the keys move."""
        of = {side: self._of_side(side) for side in "lr"}
        over = [side for side, keys in of.items() if any(key.over_motion for key in keys)]
        return tuple(
            number
            for number, bone in enumerate(FINGER_BONES)
            if self.anatomy.present[number] and of[bone[0]] and (bone not in self.driven or bone[0] in over)
        )

    def _of_side(self, side: str) -> list[HandKey]:
        return [key for key in self.keys if key.side[0] in (side, "b")]

    def angles(self, times: Array) -> Array:
        """Angles (N, 30, 3), radians, of the finger bones at times (N,) of a cycle, seconds of the file."""
        sides = [self._side_angles(self._of_side(side), times) for side in "lr"]
        return np.concatenate(sides, axis=1)

    def _side_angles(self, keys: Sequence[HandKey], times: Array) -> Array:
        last = keys[-1].pose if keys and self.motion.loop != "none" else "relaxed"
        out = np.tile(hand_angles(last, self.anatomy), (len(times), 1, 1))
        for key in keys:
            share = np.where(times >= key.time, 1.0, 0.0)
            if key.blend > 0:
                share = smooth_step((times - key.time) / key.blend)
            out += share[:, None, None] * (hand_angles(key.pose, self.anatomy) - out)
        return out

    def reaching_for(self, reaching: Sequence[ReachingHand]) -> HandKeys:
        """Add poses of hands while they reach. A hand without keys is relaxed at other times."""
        sides = sorted({each.side for each in reaching if not self._of_side(each.side[0])})
        relaxed = (HandKey("relaxed", self.motion.start, side) for side in sides)
        return replace(self, keys=(*relaxed, *self.keys), reaching=tuple(reaching))

    def add(self, poses: JointPoses, seconds: float, file_offset: float, delay: float = 0.0) -> JointPoses:
        """Add joints to poses (N = 1) of a motion at a time: one for each finger bone of the poses of hands.

        The rotation of such a joint is the rotation of the bone. Its position is that of the first joint.

        Args:
            poses, seconds: Joint poses of the motion, and their time, seconds.
            file_offset: Seconds of the file that are added to the time of the motion.
            delay: Seconds by which the time of the motion is ahead of scene time.
        """
        times = seconds + AROUND
        phases = self.motion.phases(times, file_offset)
        # a new cycle began between the times
        if np.ptp(phases) > 3 * VELOCITY_STEP * max(self.motion.speed, 1.0):
            phases[:] = phases[1]
        angles = self.angles(phases)
        for each in self.reaching:
            hand = angles[:, :PER_HAND] if each.side == "left" else angles[:, PER_HAND:]
            hand += each.shares(times - delay)[:, None, None] * (hand_angles(each.pose, self.anatomy) - hand)
        turns = self.anatomy.rotations(angles)[:, list(self.bones)]
        names = [HAND_JOINT + FINGER_BONES[number] for number in self.bones]
        return poses.with_joints(names, turns[1], central_difference(turns, turns)[1])


def _driven(match: JointMatch) -> frozenset[str]:
    """Finger bones that joints drive."""
    return frozenset(bone for bone in FINGER_BONES if bone in match.parallel or bone in match.extra)


@dataclass(frozen=True)
class FreeFingers:
    """Moves the finger bones of a skeleton that no joint drives.

    A hand takes given rotations, if there are any. Any other hand is relaxed, and opens with fingers apart
    while its arm is raised. ``free``: (30,) whether each bone is free: no joint drives a bone of its finger.
    """

    skeleton: Skeleton
    anatomy: HandAnatomy
    free: NDArray[np.bool_]

    @classmethod
    def of(cls, skeleton: Skeleton, match: JointMatch) -> FreeFingers | None:
        """Find the free fingers of a skeleton. None if the skeleton has no fingers."""
        anatomy = HandAnatomy.of(skeleton)
        if anatomy is None:
            return None
        # if one bone of a finger is driven, the whole finger counts as driven
        fingers = {bone[:-1] for bone in _driven(match)}
        return cls(skeleton, anatomy, np.array([bone[:-1] not in fingers for bone in FINGER_BONES]))

    def move(self, rotations: Array, heads: Array, hands: Mapping[str, Array]) -> None:
        """Set rotations (N, B, 3, 3) and heads (N, B, 3), z up, of free fingers, and of bones in ``hands``:
        bone -> rotation (N, 4) xyzw in bone space. Bones in the rest pose do not change."""
        turns: Array | None = None
        moved = np.zeros(len(FINGER_BONES), dtype=bool)
        opened = self._opened(heads)
        opened[:, [any(bone[0] == side for bone in hands) for side in "lr"]] = 0.0
        if opened.any() or not self.anatomy.is_relaxed:
            relaxed, wave = (np.tile(hand_angles(name, self.anatomy), (2, 1)) for name in ("relaxed", "wave"))
            share = np.repeat(opened, PER_HAND, axis=1)[..., None]
            turns = self.anatomy.rotations(relaxed + share * (wave - relaxed))
            moved = self.free & ((share[..., 0] > 0).any(0) | np.array(not self.anatomy.is_relaxed))
        if hands:
            turns = np.zeros((len(rotations), len(FINGER_BONES), 4)) if turns is None else turns
            for bone, turn in hands.items():
                turns[:, FINGER_BONES.index(bone)], moved[FINGER_BONES.index(bone)] = turn, True
        moved &= self.anatomy.present
        if turns is None or not moved.any():
            return
        local = self.skeleton.rest_in_parent
        for level in self._levels:
            rows = level[moved[level]]
            bones = self.anatomy.bones[rows]
            parents = self.skeleton.parents[bones]
            turn = quaternion_to_matrix(turns[:, rows])
            rotations[:, bones] = rotations[:, parents] @ local[bones, :3, :3] @ turn
            bones = self.anatomy.bones[level]
            parents = self.skeleton.parents[bones]
            heads[:, bones] = heads[:, parents] + rotate(rotations[:, parents], local[bones, :3, 3])
        fingers = np.asarray(moved.reshape(-1, 3).any(axis=1))
        for number, finger in self._followers:
            if fingers[finger]:
                parent = self.skeleton.parents[number]
                rotations[:, number] = rotations[:, parent] @ local[number, :3, :3]
                heads[:, number] = heads[:, parent] + rotate(rotations[:, parent], local[number, :3, 3])

    @cached_property
    def _levels(self) -> tuple[Indices, ...]:
        """Numbers in :data:`FINGER_BONES` of the first, second and third bones of the fingers."""
        levels = (np.arange(first, len(FINGER_BONES), 3) for first in range(3))
        return tuple(level[self.anatomy.present[level]] for level in levels)

    @cached_property
    def _followers(self) -> tuple[tuple[int, int], ...]:
        """Further bones that a finger carries, such as tips, each with the number of the finger."""
        finger_of = {int(bone): number // 3 for number, bone in enumerate(self.anatomy.bones) if bone >= 0}
        fingers = set(finger_of)
        for bone, parent in enumerate(self.skeleton.parents.tolist()):
            if parent in finger_of:
                finger_of.setdefault(bone, finger_of[parent])
        return tuple((bone, finger_of[bone]) for bone in sorted(finger_of.keys() - fingers))

    @cached_property
    def _arms(self) -> tuple[list[int], list[int], Array]:
        """Shoulders, wrists, and lengths (2,) of the arms."""
        shoulders, elbows, wrists = (
            [self.skeleton.bone(f"{side}_{part}") for side in "lr"] for part in ("shoulder", "elbow", "wrist")
        )
        return shoulders, wrists, self.skeleton.lengths[shoulders] + self.skeleton.lengths[elbows]

    def _opened(self, heads: Array) -> Array:
        """How far both hands are open (N, 2), 0 to 1, since their arms are raised."""
        shoulders, wrists, lengths = self._arms
        raised = (heads[:, wrists, 2] - heads[:, shoulders, 2]) / lengths
        return smooth_step((raised - _OPENS) / (_OPEN - _OPENS))
