"""Soles of a posed skeleton: toes and heels, the times in which a foot stands, and how far it slides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.types import Array

#: The heel is behind the ankle by this distance, metres.
_HEEL = 0.04


def sole_points(skeleton: Skeleton, posed: Array) -> Array:
    """World positions (..., 2, 2, 3) of toe and heel of the left and the right foot. At rest, their height is
    0."""
    points = []
    for name in ("l_ankle", "r_ankle"):
        bone = skeleton.bone(name)
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        for point in ((tail[0], 0.0, tail[2]), (head[0], 0.0, head[2] - _HEEL)):
            offset = skeleton.rest_inverse[bone] @ np.array([*point, 1.0])
            points.append((posed[..., bone, :, :] @ offset)[..., :3])
    stacked = np.stack(points, axis=-2)
    return stacked.reshape(*stacked.shape[:-2], 2, 2, 3)


def sole_heights(skeleton: Skeleton, posed: Array) -> Array:
    """World heights (..., 4) of toes and heels of both feet."""
    heights = sole_points(skeleton, posed)[..., 2]
    return heights.reshape(*heights.shape[:-2], 4)


#: A toe or heel is on the floor if its height (metres) and its horizontal speed (m/s) are lower than these
#: values.
_CONTACT_HEIGHT, _CONTACT_SPEED = 0.05, 0.35
#: A foot that is faster than this (m/s) jumps from one cycle of a loop to the next.
_MAX_SPEED = 20.0
#: Stances and gaps between stances that are shorter (seconds) are noise.
_MIN_STANCE, _MIN_GAP = 0.10, 0.06
#: Difference (metres) of the heights of toe and heel over which the load moves from one to the other.
_LOAD_SOFTNESS = 0.01


@dataclass(frozen=True)
class Stance:
    """A stance of a foot (0 left, 1 right) from sample ``first`` to sample ``last``."""

    foot: int
    first: int
    last: int


def find_stances(skeleton: Skeleton, posed: Array, times: Array) -> list[Stance]:
    """Find the stances of both feet in posed bone frames (N, B, 4, 4) in ``map``, at evenly spaced times
    (N,)."""
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
    """Movement (N - 1, 3) of the loaded part of a sole between samples.

    ``points``: (N, 2, 3) toe and heel. ``loads``: (N, 2) from :func:`sole_loads`.
    """
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
