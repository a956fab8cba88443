"""Goals of hands: points, objects, joints of others, and others' hands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from humansim_ros.geometry import quaternion_to_matrix, rotate, unit_vectors
from humansim_ros.motion.pose import BODY, PALM, WITHOUT_REACH, HandGoal, SceneQuery, in_round
from humansim_ros.types import Array

#: Metres between a joint and the skin that a palm touches there.
_FLESH = 0.055
#: Two people shake hands this share of the length of an arm below their shoulders. Held hands hang at the
#: larger one.
_SHAKES, _HANGS = 0.5, 0.9
#: Share of its length to which an arm is stretched for the hand of somebody else.
_STRETCHED = 0.93
#: Up and down movements per second of a handshake.
_SHAKES_PER_SECOND = 2.2
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class PointGoal:
    """A point in ``map``, with directions in ``map``."""

    point: tuple[float, float, float]
    palm: tuple[float, float, float] | None
    fingers: tuple[float, float, float] | None

    def __call__(self, times: Array, others: SceneQuery) -> HandGoal:
        """The goal at scene times (N,)."""
        place, palm, fingers = (
            None if each is None else np.broadcast_to(np.array(each, dtype=float), (len(times), 3))
            for each in (self.point, self.palm, self.fingers)
        )
        assert place is not None
        return HandGoal(place, palm, fingers)


@dataclass(frozen=True, eq=False)
class ObjectGoal:
    """A point of an object, with directions, all in the axes of the object: metres from its origin.

    Attributes:
        own: Point and directions.
        name: Name of the object.
        size: Size of the object without keyframes: what scales it moves the point.
    """

    own: PointGoal
    name: str
    size: Array

    def __call__(self, times: Array, others: SceneQuery) -> HandGoal:
        """The goal at scene times (N,)."""
        poses = [others.object_pose(self.name, time) for time in times.tolist()]
        turns = quaternion_to_matrix(np.array([pose.rotation for pose in poses]))
        scales = np.array([pose.size for pose in poses]) / self.size
        own = self.own(times, others)
        place = np.array([pose.position for pose in poses]) + rotate(turns, scales * own.place)
        palm, fingers = (None if each is None else rotate(turns, each) for each in (own.palm, own.fingers))
        return HandGoal(place, palm, fingers)


@dataclass(frozen=True, eq=False)
class JointGoal:
    """The skin at a joint of another human, on the side of the arm that reaches for it.

    Attributes:
        name: Who reaches.
        side: The hand.
        other: The other human.
        joint: Joint of the other human.
        own: Directions of the hand.
    """

    name: str
    side: str
    other: str
    joint: str
    own: PointGoal

    def __call__(self, times: Array, others: SceneQuery) -> HandGoal:
        """The goal at scene times (N,)."""
        index = others.skeleton(self.other).joint_names.index(self.joint)
        middle = others.joints(self.other, times, BODY)[:, index, :3, 3]
        own = self.own(times, others)
        if own.palm is not None:
            return replace(own, place=middle - _FLESH * unit_vectors(own.palm))
        towards = unit_vectors(middle - _ArmAt.of(others, self.name, self.side, times).shoulder)
        return replace(own, place=middle - _FLESH * towards)


@dataclass(frozen=True)
class _ArmAt:
    """A shoulder (N, 3), the way that its body faces (N, 3), and metres from the shoulder to the palm."""

    shoulder: Array
    ahead: Array
    length: float

    @classmethod
    def of(cls, others: SceneQuery, name: str, side: str, times: Array) -> _ArmAt:
        skeleton, joints = others.skeleton(name), others.joints(name, times, WITHOUT_REACH)
        left, right = (joints[:, skeleton.bone(f"{each}_shoulder"), :3, 3] for each in "lr")
        upper, lower, hand = (skeleton.bone(f"{side[0]}_{part}") for part in ("shoulder", "elbow", "wrist"))
        lengths = skeleton.lengths
        length = others.size(name, float(times[0])) * float(
            lengths[upper] + lengths[lower] + PALM * lengths[hand]
        )
        ahead = unit_vectors(np.cross(left - right, _UP))
        return cls(left if side == "left" else right, ahead, length)


@dataclass(frozen=True, eq=False)
class MeetingGoal:
    """The hand of another human, who reaches for this one: both palms meet between both shoulders.

    The place is a function of both arms as the motions have them, and the same one for both. Hands of one
    side shake: thumbs are up. A right and a left hand hold each other: next to each other they hang, face to
    face one is on the other.

    Attributes:
        hands: This human and its hand, then the other one and its hand.
        holds: Scene times from and to which the hands hold, seconds.
        repeat: Seconds after which they meet again; infinite for once.
        shake: Metres by which they go up and down; 0 for hands that hold still.
    """

    hands: tuple[tuple[str, str], tuple[str, str]]
    holds: tuple[float, float]
    repeat: float
    shake: float

    def __call__(self, times: Array, others: SceneQuery) -> HandGoal:
        """The goal at scene times (N,)."""
        (own_side, other_side) = (side for _, side in self.hands)
        # in the order of their names, so that both find the same bits
        arms = {hand: _ArmAt.of(others, *hand, times) for hand in sorted(self.hands)}
        own, other = (arms[hand] for hand in self.hands)
        first, second = arms.values()
        line = second.shoulder - first.shoulder
        place = first.shoulder + first.length / (first.length + second.length) * line
        away = unit_vectors(other.shoulder - own.shoulder)
        beside = (first.ahead * second.ahead).sum(axis=-1) > 0
        same = own_side == other_side
        drop = np.where(beside & (not same), _HANGS, _SHAKES)
        place[:, 2] = self._height(place, drop, first, second)
        if self.shake:
            place[:, 2] += self.shake * self._shaking(times)
        if same:
            # the palm of a right hand faces left
            palm = (1.0 if own_side == "right" else -1.0) * unit_vectors(np.cross(_UP, away))
            return HandGoal(place, palm, away)
        ahead = unit_vectors(first.ahead + second.ahead)
        right = 1.0 if own_side == "right" else -1.0
        level = unit_vectors(away * (1, 1, 0))
        palm = np.where(beside[:, None], -right * ahead, right * _UP)
        return HandGoal(place, palm, np.where(beside[:, None], -_UP, level))

    def _height(self, place: Array, drop: Array, *arms: _ArmAt) -> Array:
        """Height (N,) of the place: below both shoulders as far as both arms reach."""
        heights, lowest, highest = [], [], []
        for arm in arms:
            shoulder = arm.shoulder[:, 2]
            across = np.linalg.norm((place - arm.shoulder)[:, :2], axis=-1)
            most = np.sqrt(np.maximum((_STRETCHED * arm.length) ** 2 - across**2, 0.0))
            heights.append(shoulder - drop * arm.length)
            lowest.append(shoulder - most)
            highest.append(shoulder + most)
        height = np.maximum(np.mean(heights, axis=0), np.max(lowest, axis=0))
        return np.asarray(np.minimum(height, np.min(highest, axis=0)))

    def _shaking(self, times: Array) -> Array:
        """Height (N,) of the hands over their middle height, as a share."""
        start, end = self.holds
        count = max(1, round(_SHAKES_PER_SECOND * min(end - start, 2.0)))
        own = in_round(times, start, self.repeat)
        share = np.clip((own - start) * _SHAKES_PER_SECOND / count, 0.0, 1.0)
        # it starts and ends slowly
        return np.asarray(np.sin(np.pi * share) ** 2 * np.sin(2 * np.pi * count * share))
