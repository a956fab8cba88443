"""Measure by how much the stamps of an estimate are late."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from humansim_ros.evaluate.tracks import PoseSequence
from humansim_ros.types import Array

#: Longest offset that is measured, seconds.
MAX_OFFSET = 1.0
#: Poses of the estimate that are compared.
_SAMPLES = 300
_STEPS = 101
#: A wrong offset costs at most this distance, metres: people who are not found do not decide.
_MOST = 1.0
#: The cost must rise by this distance, metres, within ``_AROUND`` seconds: else people hardly move.
_LEAST_RISE, _AROUND = 0.001, 0.1


def measure_offset(truth: PoseSequence, estimate: PoseSequence) -> float | None:
    """Seconds by which the stamps of the estimate are late, up to :data:`MAX_OFFSET`; None if unknown.

    The mean joint distance to the nearest person of the truth, which is interpolated linearly, is least at
    that offset. It is unknown if people hardly move. Both have the same joints.
    """
    cost = _cost(truth, estimate)
    if cost is None:
        return None
    grid = np.linspace(-MAX_OFFSET, MAX_OFFSET, _STEPS)
    values = np.array([cost(late) for late in grid])
    if not np.isfinite(values).any():
        return None
    best, step = float(grid[np.nanargmin(values)]), float(grid[1] - grid[0])
    found = minimize_scalar(
        cost, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-5}
    )
    late = float(found.x)
    rise = [cost(late + side) - found.fun for side in (-_AROUND, _AROUND)]
    return late if np.nanmax([*rise, -np.inf]) > _LEAST_RISE else None


def _cost(truth: PoseSequence, estimate: PoseSequence) -> Callable[[float], float] | None:
    poses = [(time, pose) for time, people in zip(estimate.times, estimate.people, strict=True)
             for pose in people.values()]  # fmt: skip
    if not poses or len(truth.times) < 2:
        return None
    chosen = [poses[i] for i in np.unique(np.linspace(0, len(poses) - 1, _SAMPLES).astype(np.intp))]
    start = int(truth.times[0])
    times = np.array([int(time) - start for time, _ in chosen]) * 1e-9
    own: Array = np.stack([pose for _, pose in chosen])
    known = (truth.times - start) * 1e-9
    names = sorted({name for people in truth.people for name in people})
    absent = np.full((len(truth.names), 3), np.nan)
    paths = np.stack([[people.get(name, absent) for name in names] for people in truth.people])

    def cost(late: float) -> float:
        """Mean distance if the estimate is late by some seconds; NaN if most times are outside the truth."""
        at = times - late
        inside = (at >= known[0]) & (at <= known[-1])
        if inside.mean() < 0.5:
            return np.nan
        after = np.clip(np.searchsorted(known, at[inside]), 1, len(known) - 1)
        share = (at[inside] - known[after - 1]) / (known[after] - known[after - 1])
        share = share[:, None, None, None]
        people = (1 - share) * paths[after - 1] + share * paths[after]
        errors = np.linalg.norm(people - own[inside][:, None], axis=3)
        common = np.isfinite(errors)
        count = common.sum(axis=2)
        mean = np.where(count, np.where(common, errors, 0.0).sum(axis=2) / np.maximum(count, 1), _MOST)
        return float(np.minimum(mean.min(axis=1), _MOST).mean())

    return cost
