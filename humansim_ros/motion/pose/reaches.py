"""Hands that reach for something and stay there, as corrections of the arms of a motion. Goals of reaches may
ask a scene where its humans, objects and cameras are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Literal

import numpy as np

from humansim_ros.geometry import (
    AROUND,
    cross_products,
    matrix_to_quaternion,
    perpendicular,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
    rotate,
    rotation_vector_to_matrix,
    unit_vectors,
)
from humansim_ros.motion.body.kinematics import JointPoses, Motion
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.motion.files.keyframes import KeyframeSpace
from humansim_ros.motion.pose.contacts import Leg, two_bone
from humansim_ros.motion.pose.hand_poses import HandAnatomy, ReachingHand
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.types import Array


class PoseStage(IntEnum):
    """Steps that make the pose of a human, in this order (docs/data_model.md)."""

    MOTION, FLOOR, ARMS, SPACE, FINGERS, HEAD, EYES, FACE, CLOTH = range(9)


#: Stages for joints without the rotations of fingers, head and eyes.
BODY = frozenset({PoseStage.MOTION, PoseStage.FLOOR, PoseStage.ARMS, PoseStage.SPACE})
#: The same stages, but with the arms of the motion: no reaches.
WITHOUT_REACH = BODY - {PoseStage.ARMS}
#: Place of the palm between wrist and finger tips, and height of its skin over the line between them, as
#: shares of the length of a hand. The height is between the hollow (0.02) and the balls (0.12) of the palms
#: of built-in humans.
PALM, _THICK = 0.45, 0.05
#: For a given direction of the palm, the fingers turn up by this amount. With 0, they are along the forearm.
_FINGERS_UP = 0.3
#: If the hand turns about the forearm, the forearm takes this share of the turn (pronation).
_PRONATION = 0.75
#: The elbow swings out by this share of the same turn, about the line from shoulder to wrist.
_SWIVEL = 0.4
#: Most steps of the wrist solver. It stops before if the axes of the hand change by less than the tolerance.
#: Each step leaves less than a third of the error.
_STEPS, _FOUND = 16, 1e-7
#: Number of passes for bodies with limbs that do not turn exactly as the limbs of the motion, because of
#: joint limits or because bones take only the swing.
_REFINED = 5


@dataclass(frozen=True)
class HandGoal:
    """Goal of a hand at N times, in ``map``.

    Attributes:
        place: Points that the skin of the palm touches, (N, 3).
        palm: Directions that the palm faces, (N, 3). If None, the palm turns with the forearm.
        fingers: Directions of the fingers, (N, 3), perpendicular to ``palm``. If None, the fingers are along
            the forearm, or up if the palm allows it.
    """

    place: Array
    palm: Array | None = None
    fingers: Array | None = None

    def in_space(self, space: KeyframeSpace) -> HandGoal:
        """Convert the goal to the space that keyframes move."""
        back = np.swapaxes(space.rotation, -1, -2)
        place = rotate(back, self.place - space.position) / space.size[:, None]
        palm, fingers = (None if line is None else rotate(back, line) for line in (self.palm, self.fingers))
        return HandGoal(place, palm, fingers)


#: Function that returns the goal of a hand at scene times (N,). It may ask the second argument where other
#: things are: the ``World`` of a scene.
GoalAt = Callable[[Array, Any], HandGoal]


@dataclass(frozen=True)
class Reach:
    """A hand that goes to a goal, stays there, and goes back.

    Attributes:
        side: The hand.
        start: Scene time at which the hand leaves the pose of the motion, seconds. A hand that is always at
            its goal starts at -infinity, with a blend of 0.
        end: Scene time at which the hand is back, seconds. If infinite, the hand never goes back.
        blend: Seconds of the way to the goal, and of the way back.
        goal: The goal over scene time.
        repeat: Seconds after which the reach begins again. If infinite, the reach happens once.
        key: Key in the human's section of the scene file that asks for this reach.
    """

    side: Literal["left", "right"]
    start: float
    end: float
    blend: float
    goal: GoalAt
    repeat: float = np.inf
    key: str = ""

    @property
    def last(self) -> float:
        """Scene time of the end of the last round, seconds."""
        return self.end if self.repeat == np.inf else np.inf

    def shares(self, times: Array) -> Array:
        """How far (N,) the hand is on its way to the goal, 0 to 1, with minimum jerk [Flash, Hogan 1985]."""
        times = in_round(times, self.start, self.repeat)
        if self.blend == 0:
            return np.where((times >= self.start) & (times <= self.end), 1.0, 0.0)
        return _smoothest((times - self.start) / self.blend) * _smoothest((self.end - times) / self.blend)

    def holds(self, times: Array) -> Array:
        """Return the times at which the hand is at its goal."""
        own = in_round(times, self.start, self.repeat)
        return times[(own >= self.start + self.blend) & (own <= self.end - self.blend)]


def in_round(times: Array, start: float, repeat: float) -> Array:
    """Convert times (N,) to the first round of an event at ``start`` and every ``repeat`` seconds after."""
    if not np.isfinite(repeat):
        return times
    return np.where(times < start, times, start + (times - start) % repeat)


def _smoothest(share: Array) -> Array:
    u = np.clip(share, 0.0, 1.0)
    return np.asarray(u**3 * (10 - 15 * u + 6 * u**2))


@dataclass(frozen=True)
class Palm:
    """A palm in the axes of the bone of its hand.

    Attributes:
        bones: Indices of the bones of upper arm, forearm and hand.
        point: Middle of the skin of the palm, (3,) metres.
        normal: Direction that the palm faces, (3,).
    """

    bones: tuple[int, int, int]
    point: Array
    normal: Array

    @classmethod
    def of(cls, skeleton: Skeleton, side: str) -> Palm:
        """The palm on a side, ``left`` or ``right``."""
        upper, lower, hand = (skeleton.bone(f"{side[0]}_{part}") for part in ("shoulder", "elbow", "wrist"))
        axes, along = skeleton.rest[hand, :3, :3], np.array([0.0, 1.0, 0.0])
        normal = -along  # in a T pose, palms face down
        anatomy = HandAnatomy.of(skeleton)
        if anatomy is not None:
            own = np.array_split(anatomy.bones, 2)[side == "right"][3:]
            fingers = own[own >= 0]
            if len(fingers):  # a finger bends about its x axis towards the palm
                bends = np.cross(skeleton.rest[fingers, :3, 0], axes[:, 1])
                normal = bends.mean(axis=0)
        normal = unit_vectors(perpendicular(axes.T @ normal, along))
        length = float(skeleton.lengths[hand])
        return cls((upper, lower, hand), length * (PALM * along + _THICK * normal), normal)

    def points(self, posed: Array, size: Array | float = 1.0) -> Array:
        """Points (N, 3) of the palm. ``posed``: bones (N, B, 4, 4). ``size``: size of the body, (N, 1)."""
        frames = posed[:, self.bones[2]]
        return np.asarray(frames[:, :3, 3] + size * rotate(frames[:, :3, :3], self.point))


@dataclass(frozen=True)
class ReachingArm:
    """An arm of a human: joints of the motion that move it, and its palm."""

    joints: Leg
    palm: Palm

    def solve(self, posed: Array, goal: HandGoal, shares: Array) -> tuple[Array, Array, Array]:
        """Rotations (N, 3, 3) of upper arm, forearm and hand that bring the palm to a goal.

        ``posed``: bone frames (N, B, 4, 4) without the reach. ``goal``: its place is already interpolated on
        the way to the touched thing. ``shares``: (N,) share of the turn that the hand makes.
        """
        shoulder, elbow, wrist = (posed[:, bone, :3, 3] for bone in self.palm.bones)
        before = posed[:, self.palm.bones[2], :3, :3]
        hand = before
        for _ in range(_STEPS):
            upper, fore = two_bone(shoulder, elbow, wrist, goal.place - rotate(hand, self.palm.point))
            follows, last = fore @ before, hand
            hand = follows
            if goal.palm is not None or goal.fingers is not None:
                turn = _rotation_vectors(self._turned(follows, goal) @ np.swapaxes(follows, -1, -2))
                hand = rotation_vector_to_matrix(shares[:, None] * turn) @ follows
            if np.abs(hand - last).max() < _FOUND:
                break
        to_wrist = unit_vectors(rotate(upper, elbow - shoulder) + rotate(fore, wrist - elbow))
        swivel = rotation_vector_to_matrix(_SWIVEL * self._roll(hand, fore, before, wrist - elbow) * to_wrist)
        upper, fore = swivel @ upper, swivel @ fore
        roll = self._roll(hand, fore, before, wrist - elbow)
        pronation = rotation_vector_to_matrix(_PRONATION * roll * unit_vectors(rotate(fore, wrist - elbow)))
        return upper, pronation @ fore, hand @ np.swapaxes(before, -1, -2)

    @staticmethod
    def _roll(hand: Array, fore: Array, before: Array, forearm: Array) -> Array:
        """Angle (N, 1), radians, by which a hand turns about its forearm."""
        turn = _rotation_vectors(hand @ np.swapaxes(fore @ before, -1, -2))
        return np.asarray((turn * unit_vectors(rotate(fore, forearm))).sum(axis=-1, keepdims=True))

    def _turned(self, hand: Array, goal: HandGoal) -> Array:
        """Rotations (N, 3, 3) of the hand at its goal. Where the goal has no direction for palm or fingers,
        they stay as near as possible to ``hand``, the rotations before."""
        fingers = hand[..., 1] if goal.fingers is None else unit_vectors(goal.fingers)
        if goal.palm is None:
            normal = unit_vectors(perpendicular(rotate(hand, self.palm.normal), fingers))
        else:
            normal = unit_vectors(goal.palm)
            up = 0.0 if goal.fingers is not None else _FINGERS_UP
            fingers = unit_vectors(perpendicular(fingers + up * np.array([0.0, 0.0, 1.0]), normal))
        own = np.array([0.0, 1.0, 0.0])
        axes = np.stack([own, self.palm.normal, cross_products(own, self.palm.normal)], axis=-1)
        return np.stack([fingers, normal, cross_products(fingers, normal)], axis=-1) @ axes.T


def _rotation_vectors(rotations: Array) -> Array:
    return quaternion_to_rotation_vector(matrix_to_quaternion(rotations))


@dataclass(frozen=True)
class Reaches:
    """All reaches of a human. They correct the poses of its motion, and depend on the time only.

    Attributes:
        reaches: The reaches. Reaches of the same hand do not overlap.
        motion, retargeter: Motion of a file, and its retargeting onto a skeleton.
        poses: Poses of the hands while they reach.
    """

    reaches: tuple[Reach, ...]
    motion: Motion
    retargeter: Retargeter
    poses: tuple[ReachingHand, ...] = ()

    def __post_init__(self) -> None:
        assert self.arms  # an arm without a wrist is an error now, not later while the motion plays

    @cached_property
    def arms(self) -> dict[str, ReachingArm]:
        """Arms that reach, by side. Raises MotionError if the motion has no joints of an arm."""
        roles, skeleton = self.retargeter.match.roles, self.retargeter.skeleton
        return {
            side: ReachingArm(Leg.arm(side.capitalize(), self.motion, roles), Palm.of(skeleton, side))
            for side in sorted({reach.side for reach in self.reaches})
        }

    def apply(
        self, poses: JointPoses, times: Array, others: Any, space: KeyframeSpace | None = None
    ) -> JointPoses:
        """Correct poses. The result has no velocities. If no hand reaches, the poses do not change.

        Args:
            poses, times: Poses of the motion at N scene times (N,), seconds.
            others: Tells where humans and objects are.
            space: Space of the motion that keyframes move, or None.
        """
        active = [(reach, reach.shares(times)) for reach in self.reaches]
        active = [(reach, shares) for reach, shares in active if shares.any()]
        if not active:
            return poses
        posed = self.retargeter.pose(poses)
        positions, rotations = np.array(poses.positions), quaternion_to_matrix(poses.rotations)
        solved = []
        for reach, shares in active:
            rows = np.flatnonzero(shares)
            arm, goal = self.arms[reach.side], reach.goal(times[rows], others)
            if space is not None:
                part = KeyframeSpace(space.position[rows], space.rotation[rows], space.size[rows])
                goal = goal.in_space(part)
            start = arm.palm.points(posed[rows])
            place = start + shares[rows, None] * (goal.place - start)
            solved.append((arm, rows, replace(goal, place=place), shares[rows]))
        for number in range(_REFINED if self.retargeter.clamp or self.retargeter.mode == "thesis" else 1):
            if number:  # the body did not turn its hand or its limbs as the motion does
                now = JointPoses(poses.names, positions, matrix_to_quaternion(rotations))
                posed = self.retargeter.pose(now)
                solved = [
                    (arm, rows, HandGoal(goal.place), np.ones(len(rows))) for arm, rows, goal, _ in solved
                ]
            for arm, rows, goal, shares in solved:
                moved, turned = positions[rows], rotations[rows]
                arm.joints.turn(moved, turned, *arm.solve(posed[rows], goal, shares))
                positions[rows], rotations[rows] = moved, turned
        return JointPoses(poses.names, positions, matrix_to_quaternion(rotations))

    def apply_at(
        self,
        poses: JointPoses,
        seconds: float,
        others: Any,
        space: Callable[[Array], KeyframeSpace | None],
    ) -> JointPoses:
        """Correct a pose (N = 1) with velocities, at a scene time.

        Args:
            poses, seconds: Pose of the motion with velocities, and scene time.
            others: Tells where humans and objects are.
            space: Returns the space of the motion that keyframes move at times (N,), or None.
        """
        times = seconds + AROUND
        if not any(reach.shares(times).any() for reach in self.reaches):
            return poses
        three = self.apply(poses.extrapolate(AROUND), times, others, space(times))
        return JointPoses.with_velocities(poses.names, three.positions[:, None], three.rotations[:, None])
