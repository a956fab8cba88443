"""Feet that stand: found in a motion, measured for sliding, and pinned to the floor by two-bone inverse
kinematics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.errors import MotionError
from humansim_ros.motion.joint_poses import JointPoses
from humansim_ros.motion.kinematics import Motion
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.motion.soles import sole_points
from humansim_ros.motion.world_motion import WorldMotion
from humansim_ros.rotations import matrix_to_quaternion, quaternion_to_matrix, rotate, unit_vectors
from humansim_ros.types import Array

#: A toe or heel stands if it is lower than this (metres) and slower than this (m/s) over the floor.
_LOW, _SLOW = 0.05, 0.35
#: No foot is faster than this, m/s.
_FASTEST = 20.0
#: Stances and gaps between them that are shorter than this (seconds) are noise.
_SHORTEST_STANCE, _SHORTEST_GAP = 0.10, 0.06
#: Seconds of the rounds before and after that are looked at, so that a stance over the end of a loop is one.
_MARGIN = 2.0
#: Farthest that a foot is moved (metres): what slides farther does not stand.
_FARTHEST = 0.25
#: How gradually the weight goes from heel to toe: metres between their heights.
_SOFT = 0.01
#: A leg is not pulled straighter than this part of its length, unless it was.
_STRAIGHTEST = 0.9995
#: A leg whose ankle is nearer to its hip than this part of its length is left as it is.
_FOLDED = 0.25
#: The body comes down by at most so many metres, over so many seconds.
_DEEPEST, _DROP_TIME = 0.15, 0.12
_SIDES = (("Left", "l"), ("Right", "r"))


@dataclass(frozen=True)
class Stance:
    """A time that a foot stands. ``foot``: 0 left, 1 right; ``first``, ``last``: indices of samples."""

    foot: int
    first: int
    last: int


def find_stances(skeleton: Skeleton, posed: Array, times: Array) -> list[Stance]:
    """When which foot stands, from posed bone frames (N, B, 4, 4) in ``map`` at evenly spaced times (N,)."""
    if len(times) < 2:
        return []
    stands, _ = _standing(sole_points(skeleton, posed), times)
    return [Stance(foot, first, last) for foot in (0, 1) for first, last in _runs(stands[:, foot])]


def slides(skeleton: Skeleton, posed: Array, stances: Sequence[Stance]) -> Array:
    """Metres (S,) that the part of the sole that stands goes over the floor in each stance."""
    points = sole_points(skeleton, posed)
    steps = [_contact_steps(points[:, foot], _bearing(points[:, foot]))[:, :2] for foot in (0, 1)]
    lengths = [np.linalg.norm(way, axis=-1) for way in steps]
    return np.array([lengths[stance.foot][stance.first : stance.last].sum() for stance in stances])


@dataclass(frozen=True)
class FootContacts:
    """Corrections of a motion's feet that keep them where they stand; a pure function of time.

    ``shifts`` (M, 2, 3): metres in ``map``, for the left and right ankle, at ``phases`` (M,) seconds of
    motion since the start of a round. ``drops`` (M,): metres that the whole body comes down so that legs
    reach. :meth:`apply` moves the joints of the source's legs so that the
    retargeted foot moves by that much, with its orientation as it was.
    """

    motion: Motion
    retargeter: Retargeter
    phases: Array
    shifts: Array
    drops: Array

    @classmethod
    def detect(cls, world: WorldMotion, retargeter: Retargeter) -> FootContacts:
        """Find stances of the retargeted feet in a round of a motion, and what keeps each at its place.

        In a stance, the part of the sole that stands (heel, toe or both) goes nowhere, and is on the floor;
        between stances the correction fades from one to the next.
        """
        plain = replace(world, correction=None, speed=1.0)
        length = plain.cycle_length
        count = max(2, round(length / max(world.motion.frame_time, 1 / 120)) + 1)
        phases = np.asarray(np.linspace(0.0, length, count), dtype=float)
        step = phases[1]
        margin = 0
        if plain.loop != "none" and step > 0:
            margin = min(count - 1, int(_MARGIN / step))
        # a round with an end of the one before and a start of the one after (the first round has no blend)
        before = np.arange(-margin, count + margin) * step + (length if margin else 0.0)
        contacts = cls(world.motion, retargeter, phases, np.zeros((count, 2, 3)), np.zeros(count))
        assert contacts._legs  # a leg without ankle is refused now, not while it plays
        if step == 0:
            return contacts
        points, hips, ankles = _in_batches(plain, retargeter, before)
        stands, bears = _standing(points, before)
        shifts = _shifts(points, stands, bears)
        drops = _drops(retargeter.skeleton, hips, ankles + shifts, stands, step)
        round_ = slice(margin, margin + count)
        shifts = shifts[round_]
        if margin:
            shifts = shifts @ plain.cycle_rotations(np.ones(1))[0]  # back into the first round
        return replace(contacts, shifts=shifts, drops=drops[round_])

    def apply(self, poses: JointPoses, phases: Array, turns: Array) -> JointPoses:
        """The poses with their feet where they should be; see :class:`PoseCorrection`."""
        shift = np.array(
            [[np.interp(phases, self.phases, way) for way in foot.T] for foot in self.shifts.swapaxes(0, 1)]
        ).transpose(2, 0, 1)
        drop = np.interp(phases, self.phases, self.drops)[:, None] * [0.0, 0.0, 1.0]
        lowered = poses.positions - drop[:, None] / self.retargeter.scale
        shift = shift @ np.swapaxes(turns, -1, -2) + drop[:, None]
        return self._moved(replace(poses, positions=lowered), shift)

    def _moved(self, poses: JointPoses, shift: Array) -> JointPoses:
        """Joints with the ankles of the retargeted body moved by ``shift`` (N, 2, 3), metres in ``map``."""
        skeleton = self.retargeter.skeleton
        posed = self.retargeter.pose(poses)
        old, turns = poses.positions, quaternion_to_matrix(poses.rotations)
        new = np.array(old)
        for foot, leg in enumerate(self._legs):
            hip, knee, ankle = (
                posed[:, skeleton.bone(f"{_SIDES[foot][1]}_{part}"), :3, 3]
                for part in ("hip", "knee", "ankle")
            )
            thigh, shin = two_bone(hip, knee, ankle, ankle + shift[:, foot] * _may_move(hip, knee, ankle))
            # the source's leg turns as the skeleton's does; its foot keeps its orientation
            at_knee = old[:, leg.hip] + rotate(thigh, old[:, leg.knee] - old[:, leg.hip])
            at_ankle = at_knee + rotate(shin, old[:, leg.ankle] - old[:, leg.knee])
            still = np.broadcast_to(np.eye(3), thigh.shape)
            for joints, before, after, turn in (
                (leg.thigh, old[:, leg.hip], old[:, leg.hip], thigh),
                (leg.shin, old[:, leg.knee], at_knee, shin),
                (leg.foot, old[:, leg.ankle], at_ankle, still),
            ):
                arms = old[:, joints] - before[:, None]
                new[:, joints] = after[:, None] + arms @ np.swapaxes(turn, -1, -2)
                turns[:, joints] = turn[:, None] @ turns[:, joints]
        return JointPoses(poses.names, new, matrix_to_quaternion(turns))

    @cached_property
    def _legs(self) -> tuple[_Leg, _Leg]:
        left, right = (_Leg.of(side, self.motion, self.retargeter.match.roles) for side, _ in _SIDES)
        return left, right


@dataclass(frozen=True)
class _Leg:
    """Joints of a leg: its three main ones, and all that go with thigh, shin and foot."""

    hip: int
    knee: int
    ankle: int
    thigh: list[int]
    shin: list[int]
    foot: list[int]

    @classmethod
    def of(cls, side: str, motion: Motion, roles: Mapping[str, int]) -> _Leg:
        if (ankle := roles.get(f"{side}Ankle")) is None:
            raise MotionError("feet cannot be pinned: the joint table knows no ankles", path=motion.path)
        main = (roles[f"{side}Hip"], roles[f"{side}Knee"], ankle)
        part = {joint: number for number, joint in enumerate(main)}
        for joint, parent in enumerate(motion.parents):  # parents come first
            if joint not in part and int(parent) in part:
                part[joint] = part[int(parent)]
        thigh, shin, foot = ([j for j, number in part.items() if number == k] for k in range(3))
        return cls(*main, thigh, shin, foot)


def two_bone(hip: Array, knee: Array, ankle: Array, goal: Array) -> tuple[Array, Array]:
    """Turns (N, 3, 3) of thigh and shin that bring the ankle to a goal; all points (N, 3).

    The leg keeps the plane it bends in, turned by the shortest way with the line from hip to ankle. A goal
    out of reach is reached for.
    """
    thigh, shin = np.linalg.norm(knee - hip, axis=-1), np.linalg.norm(ankle - knee, axis=-1)
    before, after = unit_vectors(ankle - hip), unit_vectors(goal - hip)
    reach = np.linalg.norm(ankle - hip, axis=-1)
    longest = np.maximum(reach, _STRAIGHTEST * (thigh + shin))
    distance = np.clip(np.linalg.norm(goal - hip, axis=-1), 1.001 * np.abs(thigh - shin) + 1e-9, longest)
    bend = _across(knee - hip, before)
    flat = np.linalg.norm(bend, axis=-1, keepdims=True) < 1e-9
    bend = unit_vectors(np.where(flat, _across(np.array([1.0, 0.1, 0.0]), before), bend))
    bent = rotate(_shortest(before, after), bend)
    along = (thigh**2 - shin**2 + distance**2) / (2 * distance)
    aside = np.sqrt(np.maximum(thigh**2 - along**2, 0.0))
    new_knee = hip + along[:, None] * after + aside[:, None] * bent
    new_ankle = hip + distance[:, None] * after
    old_normal, new_normal = (
        np.asarray(np.cross(line, side), dtype=float) for line, side in ((before, bend), (after, bent))
    )
    return (
        _frame(new_knee - hip, new_normal) @ np.swapaxes(_frame(knee - hip, old_normal), -1, -2),
        _frame(new_ankle - new_knee, new_normal) @ np.swapaxes(_frame(ankle - knee, old_normal), -1, -2),
    )


def _may_move(hip: Array, knee: Array, ankle: Array) -> Array:
    """How much of a correction a leg takes (N, 1): none where it is folded so much that the knee would swing
    far.
    """
    leg = np.linalg.norm(knee - hip, axis=-1) + np.linalg.norm(ankle - knee, axis=-1)
    part = (np.linalg.norm(ankle - hip, axis=-1) / leg - _FOLDED) / _FOLDED
    part = np.clip(part, 0.0, 1.0)[:, None]
    return np.asarray(part * part * (3 - 2 * part))


def _across(vectors: Array, along: Array) -> Array:
    """What of vectors (N, 3) is perpendicular to unit vectors (N, 3)."""
    return np.asarray(vectors - (vectors * along).sum(-1, keepdims=True) * along)


def _shortest(a: Array, b: Array) -> Array:
    """Shortest rotations (N, 3, 3) from unit vectors a to b (N, 3), not opposite ones."""
    v, c = np.cross(a, b), (a * b).sum(-1)
    cross = np.zeros((len(a), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = v
    cross[:, [1, 2, 0], [2, 0, 1]] = -v
    return np.asarray(np.eye(3) + cross + cross @ cross / np.maximum(1 + c, 1e-9)[:, None, None])


def _frame(along: Array, normal: Array) -> Array:
    """Rotations (N, 3, 3) with their first axis along a bone and their second on its hinge."""
    x = unit_vectors(along)
    return np.stack([x, normal, np.cross(x, normal)], axis=-1)


def _in_batches(
    motion: WorldMotion, retargeter: Retargeter, times: Array, size: int = 1000
) -> tuple[Array, Array, Array]:
    """Sole points (N, 2, 2, 3), hips and ankles (N, 2, 3) of the retargeted body."""
    skeleton = retargeter.skeleton
    joints = [[skeleton.bone(f"{side}_{part}") for _, side in _SIDES] for part in ("hip", "ankle")]
    points, hips, ankles = [], [], []
    for first in range(0, len(times), size):
        posed = retargeter.pose(motion.sample(times[first : first + size]))
        points.append(sole_points(skeleton, posed))
        hips.append(posed[:, joints[0]][..., :3, 3])
        ankles.append(posed[:, joints[1]][..., :3, 3])
    return np.concatenate(points), np.concatenate(hips), np.concatenate(ankles)


def _drops(skeleton: Skeleton, hips: Array, goals: Array, stands: NDArray[np.bool_], step: float) -> Array:
    """How far the body must come down (N,) so that standing legs reach their goals (N, 2, 3); smooth."""
    needed: Array = np.zeros(len(hips))
    for foot, (_, side) in enumerate(_SIDES):
        longest = _STRAIGHTEST * float(
            skeleton.lengths[[skeleton.bone(f"{side}_hip"), skeleton.bone(f"{side}_knee")]].sum()
        )
        way = hips[:, foot] - goals[:, foot]
        height = np.sqrt(np.maximum(longest**2 - (way[:, :2] ** 2).sum(-1), 0.0))
        needed = np.maximum(needed, np.where(stands[:, foot], way[:, 2] - height, 0.0))
    needed = np.minimum(needed, _DEEPEST)
    width = 2 * max(1, round(_DROP_TIME / step / 2)) + 1
    for _ in range(2):
        # the mean of maxima over the same window is never below what is needed
        needed = uniform_filter1d(maximum_filter1d(needed, width, mode="nearest"), width, mode="nearest")
    return np.asarray(needed)


def _standing(points: Array, times: Array) -> tuple[NDArray[np.bool_], Array]:
    """Whether each foot stands (N, 2), and how much toe and heel bear (N, 2, 2), from points (N, 2, 2, 3)."""
    speed = np.linalg.norm(np.gradient(points[..., :2], times, axis=0), axis=-1)
    height = points[..., 2]
    stands = ((height < _LOW) & (speed < _SLOW)).any(-1)
    step = times[1] - times[0]
    for foot in (0, 1):
        stands[:, foot] = ~_without_short_runs(~stands[:, foot], _SHORTEST_GAP / step)
        # where a loop jumps back, nobody stands
        stands[:, foot] &= (speed[:, foot] < _FASTEST).all(-1)
        stands[:, foot] = _without_short_runs(stands[:, foot], _SHORTEST_STANCE / step)
    return stands, _bearing(points)


def _bearing(points: Array) -> Array:
    """How much of a foot's weight toe and heel bear (..., 2), from their places (..., 2, 3)."""
    height = points[..., 2]
    bears = np.exp(-(height - height.min(-1, keepdims=True)) / _SOFT)
    return np.asarray(bears / bears.sum(-1, keepdims=True))


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(int))
    return list(zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1, strict=True))


def _without_short_runs(flags: NDArray[np.bool_], shortest: float) -> NDArray[np.bool_]:
    """Flags with runs of True shorter than so many samples cleared, but for those at the ends."""
    out = flags.copy()
    for first, last in _runs(flags):
        if last - first + 1 < shortest and first > 0 and last < len(flags) - 1:
            out[first : last + 1] = False
    return out


def _contact_steps(points: Array, bears: Array) -> Array:
    """How far the part of one foot's sole that bears it goes from sample to sample (N - 1, 3)."""
    share = (bears[1:] + bears[:-1]) / 2
    return np.asarray((np.diff(points, axis=0) * share[..., None]).sum(-2))


def _shifts(points: Array, stands: NDArray[np.bool_], bears: Array) -> Array:
    """What to move each foot by (N, 2, 3) so that it stays where it stands."""
    out = np.zeros((len(points), 2, 3))
    for foot in (0, 1):
        height = (points[:, foot, :, 2] * bears[:, foot]).sum(-1)
        steps = _contact_steps(points[:, foot], bears[:, foot])
        runs = _runs(stands[:, foot])
        for first, last in runs:
            way = np.concatenate([np.zeros((1, 2)), np.cumsum(steps[first:last, :2], axis=0)])
            out[first : last + 1, foot, :2] = way.mean(0) - way
            out[first : last + 1, foot, 2] = -height[first : last + 1]
        if not runs:
            continue
        out[: runs[0][0], foot] = out[runs[0][0], foot]
        out[runs[-1][1] :, foot] = out[runs[-1][1], foot]
        for (_, left), (right, _) in pairwise(runs):
            part = np.linspace(0.0, 1.0, right - left + 1)[:, None]
            part = part * part * (3 - 2 * part)
            out[left : right + 1, foot] = (1 - part) * out[left, foot] + part * out[right, foot]
        # a foot in the air stays above the floor
        out[:, foot, 2] = np.maximum(out[:, foot, 2], -points[:, foot, :, 2].min(-1))
    size = np.linalg.norm(out, axis=-1, keepdims=True)
    return np.asarray(out * np.minimum(1.0, _FARTHEST / np.maximum(size, 1e-12)))
