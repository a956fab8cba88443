"""Contacts with the floor: stances, and corrections that keep feet in place or put skin on the floor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MotionError
from humansim_ros.geometry import (
    cross_products,
    lengths_of,
    matrix_to_quaternion,
    perpendicular,
    quaternion_to_matrix,
    rotate,
    shortest_rotations,
    smooth_step,
    unit_vectors,
)
from humansim_ros.motion.body.kinematics import JointPoses, Motion
from humansim_ros.motion.body.skeleton import Skeleton, sole_points
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import PoseCorrection, WorldMotion
from humansim_ros.types import Array

#: A toe or heel is on the floor if its height (metres) and its horizontal speed (m/s) are lower than these
#: values.
_CONTACT_HEIGHT, _CONTACT_SPEED = 0.05, 0.35
#: A foot that is faster than this (m/s) jumps from one cycle of a loop to the next.
_MAX_SPEED = 20.0
#: Stances and gaps between stances that are shorter (seconds) are noise.
_MIN_STANCE, _MIN_GAP = 0.10, 0.06
#: The load moves from toe to heel, or back, over this difference of their heights, metres.
_LOAD_SOFTNESS = 0.01


@dataclass(frozen=True)
class Stance:
    """A stance of a foot (0 left, 1 right) from sample ``first`` to sample ``last``."""

    foot: int
    first: int
    last: int


def find_stances(skeleton: Skeleton, posed: Array, times: Array) -> list[Stance]:
    """Find the periods in which each foot stands on the floor. ``posed``: frames (N, B, 4, 4) of the bones in
    ``map``. ``times``: evenly spaced (N,), seconds."""
    if len(times) < 2:
        return []
    standing = standing_feet(sole_points(skeleton, posed), times)
    return [Stance(foot, first, last) for foot in (0, 1) for first, last in true_runs(standing[:, foot])]


def slide_distances(skeleton: Skeleton, posed: Array, stances: Sequence[Stance]) -> Array:
    """Distance (S,) in metres that the loaded part of the sole slides over the floor in each stance."""
    points = sole_points(skeleton, posed)
    steps = [contact_steps(points[:, foot], sole_loads(points[:, foot]))[:, :2] for foot in (0, 1)]
    lengths = [np.linalg.norm(step, axis=-1) for step in steps]
    return np.array([lengths[stance.foot][stance.first : stance.last].sum() for stance in stances])


def standing_feet(points: Array, times: Array) -> NDArray[np.bool_]:
    """Whether each foot stands (N, 2), from sole points (N, 2, 2, 3) at times (N,)."""
    speed = np.linalg.norm(np.gradient(points[..., :2], times, axis=0), axis=-1)
    standing = ((points[..., 2] < _CONTACT_HEIGHT) & (speed < _CONTACT_SPEED)).any(-1)
    step = times[1] - times[0]
    for foot in (0, 1):
        standing[:, foot] = ~_without_short_runs(~standing[:, foot], _MIN_GAP / step)
        # a foot does not stand while a loop jumps to its start
        standing[:, foot] &= (speed[:, foot] < _MAX_SPEED).all(-1)
        standing[:, foot] = _without_short_runs(standing[:, foot], _MIN_STANCE / step)
    return np.asarray(standing)


def sole_loads(points: Array) -> Array:
    """Share of the load on toe and heel (..., 2), from their positions (..., 2, 3)."""
    height = points[..., 2]
    loads = np.exp(-(height - height.min(-1, keepdims=True)) / _LOAD_SOFTNESS)
    return np.asarray(loads / loads.sum(-1, keepdims=True))


def contact_steps(points: Array, loads: Array) -> Array:
    """Movement (N - 1, 3) of the loaded part of a sole between samples. ``points``: (N, 2, 3) toe and heel.
    ``loads``: (N, 2) from :func:`sole_loads`."""
    share = (loads[1:] + loads[:-1]) / 2
    return np.asarray((np.diff(points, axis=0) * share[..., None]).sum(-2))


def true_runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(int))
    return list(zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1, strict=True))


def _without_short_runs(flags: NDArray[np.bool_], shortest: float) -> NDArray[np.bool_]:
    """Remove runs of True that are shorter than ``shortest`` samples. Runs at both ends stay."""
    out = flags.copy()
    for first, last in true_runs(flags):
        if last - first + 1 < shortest and first > 0 and last < len(flags) - 1:
            out[first : last + 1] = False
    return out


#: A correction may straighten a leg to this share of its full length. A leg that was straighter stays so.
STRAIGHTEST = 0.9995
#: A leg is not corrected if its ankle is nearer to the hip than this share of the length of the leg.
_FOLDED = 0.25


def two_bone(hip: Array, knee: Array, ankle: Array, goal: Array) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) of thigh and shin that bring the ankle to a goal, or as near as the leg can reach.

    The leg bends in a plane. This plane turns with the line from hip to ankle, by the shortest rotation.

    Args:
        hip, knee, ankle: Positions (N, 3); or those of shoulder, elbow and wrist.
        goal: Target positions of the ankle (N, 3).
    """
    upper, lower, line = knee - hip, ankle - knee, ankle - hip
    thigh, shin, reach, way = (lengths_of(each) for each in (upper, lower, line, goal - hip))
    before, after = unit_vectors(line), unit_vectors(goal - hip)
    longest = np.maximum(reach, STRAIGHTEST * (thigh + shin))
    distance = np.minimum(np.maximum(way, 1.001 * np.abs(thigh - shin) + 1e-9), longest)
    bend = perpendicular(upper, before)
    straight = lengths_of(bend)[:, None] < 1e-9
    if straight.any():
        bend = np.where(straight, perpendicular(np.array([1.0, 0.1, 0.0]), before), bend)
    bend = unit_vectors(bend)
    new_bend = rotate(shortest_rotations(before, after), bend)
    along = (thigh**2 - shin**2 + distance**2) / (2 * distance)
    across = np.sqrt(np.maximum(thigh**2 - along**2, 0.0))
    new_knee = hip + along[:, None] * after + across[:, None] * new_bend
    new_ankle = hip + distance[:, None] * after
    normal, new_normal = cross_products(before, bend), cross_products(after, new_bend)
    return (
        _bone_frame(new_knee - hip, new_normal) @ np.swapaxes(_bone_frame(upper, normal), -1, -2),
        _bone_frame(new_ankle - new_knee, new_normal) @ np.swapaxes(_bone_frame(lower, normal), -1, -2),
    )


def correction_share(hip: Array, knee: Array, ankle: Array) -> Array:
    """Share (N, 1) of a correction that a leg takes: 0 for a folded leg, since its knee would swing far."""
    leg = np.linalg.norm(knee - hip, axis=-1) + np.linalg.norm(ankle - knee, axis=-1)
    share = (np.linalg.norm(ankle - hip, axis=-1) / leg - _FOLDED) / _FOLDED
    return smooth_step(share)[:, None]


def _bone_frame(along: Array, normal: Array) -> Array:
    """Rotations (N, 3, 3) with the first axis along a bone and the second along the axis of its hinge."""
    out = np.empty((*along.shape, 3))
    out[..., 0] = unit_vectors(along)
    out[..., 1] = normal
    out[..., 2] = cross_products(out[..., 0], normal)
    return out


#: Seconds that are added before and after a cycle, so that a stance across the end of a loop is one stance.
_MARGIN = 2.0
#: Largest correction of a foot, metres. A foot that slides farther is not standing.
_MAX_SHIFT = 0.25
#: Largest distance by which the body is lowered (metres), and the time over which this is smoothed (seconds).
_MAX_DROP, _DROP_TIME = 0.15, 0.12
_SIDES = (("Left", "l"), ("Right", "r"))
#: Number of poses of the legs that are computed at once.
_BATCH = 1000


@dataclass(frozen=True)
class FootContacts(PoseCorrection):
    """Corrections that keep the feet of a motion in place. They depend only on the time in the cycle.

    :meth:`apply` moves the legs of the motion, and the retargeted feet follow. Feet keep their orientation.

    Attributes:
        motion: Motion of a file.
        retargeter: Retargeting of the motion onto a skeleton.
        phases: (M,) seconds of the file since the start of a cycle, at which there are corrections.
        shifts: (M, 2, 3) metres in ``map`` by which the left and the right ankle move.
        drops: (M,) metres by which the body is lowered so that the legs can reach the corrected feet.
    """

    motion: Motion
    retargeter: Retargeter
    phases: Array
    shifts: Array
    drops: Array

    @classmethod
    def detect(cls, world: WorldMotion, retargeter: Retargeter) -> FootContacts:
        """Detect the stances in a cycle of a motion, and compute the corrections.

        In a stance, the loaded part of the sole (heel, toe or both) is on the floor and does not move.
        Between two stances, the correction fades from the first one to the second.

        Raises:
            MotionError: The joint match has no ankles.
        """
        plain = replace(world, correction=None, speed=1.0)
        length, phases = plain.cycle_length, _phases(plain, 1 / 120)
        count, step = len(phases), phases[1]
        margin = 0
        if plain.loop != "none" and step > 0:
            margin = min(count - 1, int(_MARGIN / step))
        # a cycle, with the end of the cycle before and the start of the next one. The first cycle has no
        # blend
        times = np.arange(-margin, count + margin) * step + (length if margin else 0.0)
        contacts = cls(world.motion, retargeter, phases, np.zeros((count, 2, 3)), np.zeros(count))
        assert contacts._legs  # a leg without an ankle is an error now, not later while the motion plays
        if step == 0:
            return contacts
        points, hips, ankles = _posed_legs(plain, retargeter, times)
        standing = standing_feet(points, times)
        shifts = _shifts(points, standing)
        drops = _drops(retargeter.skeleton, hips, ankles + shifts, standing, step)
        cycle = slice(margin, margin + count)
        shifts = shifts[cycle]
        if margin:
            shifts = shifts @ plain.cycle_rotations(np.ones(1))[0]  # rotated back into the first cycle
        return replace(contacts, shifts=shifts, drops=drops[cycle])

    def apply(self, poses: JointPoses, phases: Array, cycle_rotations: Array) -> JointPoses:
        shift = np.array(
            [[np.interp(phases, self.phases, axis) for axis in foot.T] for foot in self.shifts.swapaxes(0, 1)]
        ).transpose(2, 0, 1)
        drop = np.interp(phases, self.phases, self.drops)[:, None] * [0.0, 0.0, 1.0]
        lowered = poses.positions - drop[:, None] / self.retargeter.scale
        shift = shift @ np.swapaxes(cycle_rotations, -1, -2) + drop[:, None]
        return self._move_ankles(replace(poses, positions=lowered), shift)

    def _move_ankles(self, poses: JointPoses, shift: Array) -> JointPoses:
        """Move joints, so that the ankles of the retargeted body move by ``shift`` (N, 2, 3) in ``map``."""
        skeleton = self.retargeter.skeleton
        posed = self.retargeter.pose(poses)
        new, rotations = np.array(poses.positions), quaternion_to_matrix(poses.rotations)
        for foot, leg in enumerate(self._legs):
            hip, knee, ankle = (
                posed[:, skeleton.bone(f"{_SIDES[foot][1]}_{part}"), :3, 3]
                for part in ("hip", "knee", "ankle")
            )
            goal = ankle + shift[:, foot] * correction_share(hip, knee, ankle)
            thigh, shin = two_bone(hip, knee, ankle, goal)
            # the leg of the motion rotates as the leg of the skeleton does. The foot keeps its orientation
            leg.turn(new, rotations, thigh, shin)
        return JointPoses(poses.names, new, matrix_to_quaternion(rotations))

    @cached_property
    def _legs(self) -> tuple[Leg, Leg]:
        left, right = (Leg.of(side, self.motion, self.retargeter.match.roles) for side, _ in _SIDES)
        return left, right


@dataclass(frozen=True)
class Leg:
    """Joints of a leg of a motion: hip, knee and ankle, and the joints that move with thigh, shin and foot.
    An arm has shoulder, elbow and wrist, upper arm, forearm and hand instead."""

    hip: int
    knee: int
    ankle: int
    thigh: list[int]
    shin: list[int]
    foot: list[int]

    @classmethod
    def of(cls, side: str, motion: Motion, roles: Mapping[str, int]) -> Leg:
        """Find the leg on a side, ``Left`` or ``Right``. Raises MotionError if its ankle is unknown."""
        if (ankle := roles.get(f"{side}Ankle")) is None:
            raise MotionError("feet cannot be pinned: the joint table knows no ankles", path=motion.path)
        return cls._of(motion, roles[f"{side}Hip"], roles[f"{side}Knee"], ankle)

    @classmethod
    def arm(cls, side: str, motion: Motion, roles: Mapping[str, int]) -> Leg:
        """Find the arm on a side, ``Left`` or ``Right``. Raises MotionError if one joint is unknown."""
        shoulder, elbow, wrist = (roles.get(f"{side}{part}") for part in ("Shoulder", "Elbow", "Wrist"))
        if shoulder is None or elbow is None or wrist is None:
            raise MotionError("hands cannot reach: the joint table knows no wrists", path=motion.path)
        return cls._of(motion, shoulder, elbow, wrist)

    @classmethod
    def _of(cls, motion: Motion, hip: int, knee: int, ankle: int) -> Leg:
        part = {joint: number for number, joint in enumerate((hip, knee, ankle))}
        for joint, parent in enumerate(motion.parents):  # parents come before their children
            if joint not in part and int(parent) in part:
                part[joint] = part[int(parent)]
        thigh, shin, foot = ([j for j, number in part.items() if number == k] for k in range(3))
        return cls(hip, knee, ankle, thigh, shin, foot)

    def stretch(self, positions: Array, thigh: Array, shin: Array) -> None:
        """Set the lengths (N,) of thigh and shin in joint positions (N, J, 3), metres, in place."""
        for joints, start, end, length in (
            ([*self.shin, *self.foot], self.hip, self.knee, thigh),
            (self.foot, self.knee, self.ankle, shin),
        ):
            line = positions[:, end] - positions[:, start]
            longer = length / np.maximum(np.linalg.norm(line, axis=-1), 1e-9) - 1
            positions[:, joints] += (longer[:, None] * line)[:, None]

    def turn(
        self, positions: Array, rotations: Array, thigh: Array, shin: Array, foot: Array | None = None
    ) -> None:
        """Turn the leg about hip, knee and ankle, in place.

        Args:
            positions, rotations: Positions (N, J, 3) and rotations (N, J, 3, 3) of the joints.
            thigh, shin: Rotations of thigh and shin, (N, 3, 3).
            foot: Rotations of the foot, (N, 3, 3). If None, the foot keeps its orientation.
        """
        hip, knee, ankle = (positions[:, joint].copy() for joint in (self.hip, self.knee, self.ankle))
        new_knee = hip + rotate(thigh, knee - hip)
        new_ankle = new_knee + rotate(shin, ankle - knee)
        for joints, before, after, rotation in (
            (self.thigh, hip, hip, thigh),
            (self.shin, knee, new_knee, shin),
            (self.foot, ankle, new_ankle, np.broadcast_to(np.eye(3), thigh.shape) if foot is None else foot),
        ):
            offsets = positions[:, joints] - before[:, None]
            positions[:, joints] = after[:, None] + offsets @ np.swapaxes(rotation, -1, -2)
            rotations[:, joints] = rotation[:, None] @ rotations[:, joints]


#: Built-in motions in which the body touches the floor with other parts than the soles.
ON_SKIN = frozenset({"lie", "fall", "crawl"})
#: Seconds between the times for which the height of the body is computed, and seconds over which heights are
#: smoothed.
_SKIN_STEP, _SETTLED = 1 / 30, 0.1
#: Skin that is farther from the bone of a thigh or shin than this share of its length does not count. The
#: same is true for surfaces below ``_CROTCH`` (metres below the hips) that follow both legs: they are hems of
#: skirts and coats, which hang and do not lie on the floor.
_SKIN = (("hip", 0.3), ("knee", 0.2))
_CROTCH = 0.1


@dataclass(frozen=True)
class SkinContact(PoseCorrection):
    """Heights that put the lowest skin of a body on the floor. They depend only on the time in the cycle.

    Attributes:
        phases: (M,) seconds of the file since the start of a cycle, at which there are heights.
        rises: (M,) metres by which the motion is raised.
        before: Correction that is applied before this one. None if there is none.
    """

    phases: Array
    rises: Array
    before: PoseCorrection | None = None

    @classmethod
    def of(cls, world: WorldMotion, retargeter: Retargeter, lowest: Callable[[Array], Array]) -> SkinContact:
        """Find the heights over one cycle of a motion. ``lowest``: function of poses (N, B, 4, 4) that
        returns the height (N,) of the lowest skin point, metres."""
        plain = replace(world, speed=1.0)
        length, phases = plain.cycle_length, _phases(plain, _SKIN_STEP)
        heights = lowest(retargeter.pose(plain.sample(np.minimum(phases, length * (1 - 1e-9)))))
        around: Literal["wrap", "nearest"] = "nearest" if world.loop == "none" else "wrap"
        width = 2 * round(_SETTLED / max(phases[1], 1e-6) / 2) + 1
        if width < len(phases):
            heights[:-1] = scipy.ndimage.uniform_filter1d(heights[:-1], width, mode=around)
            heights[-1] = heights[0] if around == "wrap" else heights[-1]
        return cls(phases, -heights / retargeter.scale, world.correction)

    def apply(self, poses: JointPoses, phases: Array, cycle_rotations: Array) -> JointPoses:
        if self.before is not None:
            poses = self.before.apply(poses, phases, cycle_rotations)
        rises = np.interp(phases, self.phases, self.rises)[:, None, None] * np.array([0.0, 0.0, 1.0])
        return replace(poses, positions=poses.positions + rises)


def skin_on_floor(skeleton: Skeleton, vertices: Array, weights: csr_matrix) -> NDArray[np.bool_]:
    """Find the vertices (V,) that can lie on a floor: all except wide hems of skirts and coats.

    Args:
        skeleton: The skeleton.
        vertices: Skin and clothes at rest in body space, (V, 3) metres.
        weights: Weights of the bones, (V, B).
    """
    main, kept = np.asarray(weights.argmax(axis=1)).ravel(), np.ones(len(vertices), dtype=bool)
    both = np.ones(len(vertices), dtype=bool)
    for side in "lr":
        bones = [skeleton.bone(f"{side}_{part}") for part, _ in _SKIN]
        both &= np.asarray(weights[:, bones].sum(axis=1)).ravel() > 0.05
        for bone, (_, share) in zip(bones, _SKIN, strict=True):
            own = np.flatnonzero(main == bone)
            along = unit_vectors(skeleton.tails[bone] - skeleton.heads[bone])
            offsets = vertices[own] - skeleton.heads[bone]
            places = np.clip(offsets @ along, 0.0, skeleton.lengths[bone])
            distances = np.linalg.norm(offsets - places[:, None] * along, axis=1)
            kept[own] = distances <= share * skeleton.lengths[bone]
    low = vertices[:, 1] < skeleton.heads[skeleton.bone("l_hip"), 1] - _CROTCH
    return kept & ~(both & low)


def _phases(world: WorldMotion, step: float) -> Array:
    """Evenly spaced phases (M,) over a cycle. Their distance is a frame of the file or ``step`` seconds,
    whichever is longer."""
    count = max(2, round(world.cycle_length / max(world.motion.frame_time, step)) + 1)
    return np.asarray(np.linspace(0.0, world.cycle_length, count), dtype=float)


def _posed_legs(motion: WorldMotion, retargeter: Retargeter, times: Array) -> tuple[Array, Array, Array]:
    """Sole points (N, 2, 2, 3), hips and ankles (N, 2, 3) of the retargeted body."""
    skeleton = retargeter.skeleton
    joints = [[skeleton.bone(f"{side}_{part}") for _, side in _SIDES] for part in ("hip", "ankle")]
    points, hips, ankles = [], [], []
    for first in range(0, len(times), _BATCH):
        posed = retargeter.pose(motion.sample(times[first : first + _BATCH]))
        points.append(sole_points(skeleton, posed))
        hips.append(posed[:, joints[0]][..., :3, 3])
        ankles.append(posed[:, joints[1]][..., :3, 3])
    return np.concatenate(points), np.concatenate(hips), np.concatenate(ankles)


def _drops(skeleton: Skeleton, hips: Array, goals: Array, standing: NDArray[np.bool_], step: float) -> Array:
    """Metres (N,), smooth over time, by which the body is lowered so that standing legs reach their goals.

    Args:
        skeleton: Skeleton with legs.
        hips, goals: Hip joints, and goals of the ankles, (N, 2, 3) metres.
        standing: Whether each foot stands, (N, 2).
        step: Seconds between poses.
    """
    drop: Array = np.zeros(len(hips))
    for foot, (_, side) in enumerate(_SIDES):
        longest = STRAIGHTEST * float(
            skeleton.lengths[[skeleton.bone(f"{side}_hip"), skeleton.bone(f"{side}_knee")]].sum()
        )
        leg = hips[:, foot] - goals[:, foot]
        height = np.sqrt(np.maximum(longest**2 - (leg[:, :2] ** 2).sum(-1), 0.0))
        drop = np.maximum(drop, np.where(standing[:, foot], leg[:, 2] - height, 0.0))
    drop = np.minimum(drop, _MAX_DROP)
    width = 2 * max(1, round(_DROP_TIME / step / 2)) + 1
    for _ in range(2):
        # the mean of maxima over the same window is never below the required value
        drop = scipy.ndimage.uniform_filter1d(
            scipy.ndimage.maximum_filter1d(drop, width, mode="nearest"), width, mode="nearest"
        )
    return np.asarray(drop)


def _shifts(points: Array, standing: NDArray[np.bool_]) -> Array:
    """Corrections (N, 2, 3) that keep feet in place while they stand."""
    loads = sole_loads(points)
    out = np.zeros((len(points), 2, 3))
    for foot in (0, 1):
        height = (points[:, foot, :, 2] * loads[:, foot]).sum(-1)
        steps = contact_steps(points[:, foot], loads[:, foot])
        runs = true_runs(standing[:, foot])
        for first, last in runs:
            path = np.concatenate([np.zeros((1, 2)), np.cumsum(steps[first:last, :2], axis=0)])
            out[first : last + 1, foot, :2] = path.mean(0) - path
            out[first : last + 1, foot, 2] = -height[first : last + 1]
        if not runs:
            continue
        out[: runs[0][0], foot] = out[runs[0][0], foot]
        out[runs[-1][1] :, foot] = out[runs[-1][1], foot]
        for (_, left), (right, _) in pairwise(runs):
            weight = smooth_step(np.linspace(0.0, 1.0, right - left + 1))[:, None]
            out[left : right + 1, foot] = (1 - weight) * out[left, foot] + weight * out[right, foot]
        # a foot in the air must stay above the floor
        out[:, foot, 2] = np.maximum(out[:, foot, 2], -points[:, foot, :, 2].min(-1))
    size = np.linalg.norm(out, axis=-1, keepdims=True)
    return np.asarray(out * np.minimum(1.0, _MAX_SHIFT / np.maximum(size, 1e-12)))
