"""Pair the frames and people of a truth and an estimate, and find reasons why they cannot be compared."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize_scalar

from humansim_ros.data.evaluation.pose_sequence import People, PoseSequence
from humansim_ros.errors import EvaluationError
from humansim_ros.types import Array, Indices

#: Axes of files by name. The value lists the axes of the file that become x, y and z of ``map``.
AXES = {"z-up": "x,y,z", "y-up": "z,x,y", "y-down": "x,z,-y"}
#: If people of truth and estimate differ in size by more than this factor, the units must differ.
_UNIT_FACTOR = 2.0
#: Number of frames that the checks of unit and axes use.
_CHECKED_FRAMES = 50
#: Stamps from this time (the year 2001) on, nanoseconds, come from a wall clock.
_WALL_CLOCK = 10**18
#: Longest offset that is measured, seconds.
MAX_OFFSET = 1.0
#: Number of poses of the estimate that are compared to measure the offset.
_SAMPLES = 300
_STEPS = 101
#: Limit of each distance in the cost of an offset, metres, so that missed people do not dominate.
_MOST = 1.0
#: ``_AROUND`` seconds away from the best offset, the cost must be higher by at least ``_LEAST_RISE`` metres.
#: If not, people hardly move, and the offset is unknown.
_LEAST_RISE, _AROUND = 0.001, 0.1


@dataclass(frozen=True)
class FramePairs:
    """Frames of truth and estimate that are compared with each other.

    Attributes:
        truth: (N,) frame numbers in the truth.
        estimate: (N,) frame number in the estimate for each of them, -1 where the estimate has no frame.
        without_truth: Number of frames of the estimate that have no frame of the truth.
    """

    truth: Indices
    estimate: Indices
    without_truth: int


def axes_matrix(text: str) -> Array:
    """Matrix (3, 3) from the axes of a file to ``map``.

    ``text``: a name of :data:`AXES`, or the axes of the file that are x, y and z of ``map``, such as
    ``z,x,y``. Raises EvaluationError.

    Example:
        >>> axes_matrix("y-up") @ [1.0, 2.0, 3.0]
        array([3., 1., 2.])
    """
    words = re.fullmatch(r"([+-]?[xyz]),([+-]?[xyz]),([+-]?[xyz])", AXES.get(text, text).replace(" ", ""))
    if words is None or len({word[-1] for word in words.groups()}) != 3:
        known = ", ".join(AXES)
        raise EvaluationError(
            f"{text!r} is neither one of {known} nor three axes of the file, such as z,x,y", key="--axes"
        )
    matrix = np.zeros((3, 3))
    for row, word in enumerate(words.groups()):
        matrix[row, "xyz".index(word[-1])] = -1.0 if word[0] == "-" else 1.0
    return matrix


def seconds(nanoseconds: int) -> str:
    """Seconds as text, for messages."""
    return f"{nanoseconds * 1e-9:.3f} s"


def pair_frames(truth: PoseSequence, estimate: PoseSequence) -> FramePairs:
    """Pair each frame of the estimate with the nearest one of the truth, within half a period of the truth.

    Between the first and the last pair, frames of the truth without a frame of the estimate count, too:
    everybody in them is missed. If the estimate has fewer frames per second than the truth, such gaps are
    filled at the rate of the estimate. If the estimate has no frame, all frames of the truth are compared.

    Raises:
        EvaluationError: Truth and estimate do not overlap in time.
    """
    times, own = truth.times, estimate.times
    if not len(own):
        return FramePairs(np.arange(len(times)), np.full(len(times), -1), 0)
    _check_overlap(truth, estimate)
    period = truth.period or estimate.period or 1
    after = np.clip(np.searchsorted(times, own), 1, max(1, len(times) - 1))
    if len(times) == 1:
        nearest = np.zeros(len(own), np.intp)
    else:
        nearest = after - (own - times[after - 1] <= times[after] - own)
    distance = np.abs(times[nearest] - own)
    order = np.lexsort((distance, nearest))
    order = order[distance[order] <= period / 2]
    paired, first = np.unique(nearest[order], return_index=True)
    if not len(paired):
        raise EvaluationError(
            "no frame of the estimate is within half a period "
            f"({seconds(period // 2)}) of a frame of the truth: check the stamps, or give --offset to "
            "humansim evaluate",
            path=estimate.source,
        )
    chosen = order[first]
    step = max(1, round(estimate.period / period))
    truth_frames, estimate_frames = [int(paired[0])], [int(chosen[0])]
    for frame, match in zip(paired[1:].tolist(), chosen[1:].tolist(), strict=True):
        gap = list(range(truth_frames[-1] + step, frame - step + 1, step))
        truth_frames += [*gap, frame]
        estimate_frames += [*(-1 for _ in gap), match]
    return FramePairs(
        np.array(truth_frames, np.intp), np.array(estimate_frames, np.intp), len(own) - len(chosen)
    )


def _check_overlap(truth: PoseSequence, estimate: PoseSequence) -> None:
    slack = max(truth.period, estimate.period)
    first, last = int(estimate.times[0]), int(estimate.times[-1])
    if first <= truth.times[-1] + slack and last >= truth.times[0] - slack:
        return
    late = first - int(truth.times[0])
    clock = (
        " One of them has the time of a wall clock: record truth and estimate together, or run in lockstep."
        if (first > _WALL_CLOCK) != (int(truth.times[0]) > _WALL_CLOCK)
        else ""
    )
    raise EvaluationError(
        f"truth and estimate do not overlap in time: the truth has {seconds(int(truth.times[0]))} to "
        f"{seconds(int(truth.times[-1]))}, the estimate {seconds(first)} to {seconds(last)}.{clock} "
        f"If both begin at the same moment, give --offset {late * 1e-9:.9g} to humansim evaluate",
        path=estimate.source,
    )


def check_unit(truth: PoseSequence, estimate: PoseSequence, pairs: FramePairs) -> None:
    """Raise EvaluationError if people of the truth and people of the estimate differ in size."""
    sizes = [body_size(people.values()) for people in _frames(truth, pairs.truth)]
    own = [body_size(people.values()) for people in _frames(estimate, pairs.estimate)]
    if not np.isfinite(sizes).any() or not np.isfinite(own).any():
        return  # people with a single point have no size
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = float(np.nanmedian(sizes) / np.nanmedian(own))
    if not np.isfinite(factor) or 1 / _UNIT_FACTOR < factor < _UNIT_FACTOR:
        return
    power = 10.0 ** round(np.log10(factor))
    scale = power if 1 / _UNIT_FACTOR < factor / power < _UNIT_FACTOR else factor
    word = f"{1 / scale:g} times as large" if scale < 1 else f"{scale:g} times as small"
    raise EvaluationError(
        f"the people of the estimate are {word} as the people of the truth: is the estimate in another unit? "
        f"Give --scale {scale:.3g}",
        path=estimate.source,
    )


def body_size(people: Iterable[Array]) -> float:
    """Median size of people, measured as the spread of their joints, metres. NaN if there are no people."""
    spreads = [
        float(np.sqrt(np.nanvar(pose, axis=0).sum()))
        for pose in people
        if np.isfinite(pose).all(axis=1).sum() > 1
    ]
    return float(np.median(spreads)) if spreads else np.nan


def check_axes(truth: PoseSequence, estimate: PoseSequence, pairs: FramePairs, gate: float) -> None:
    """Check that the people of the estimate do not match the truth only after a swap of axes.

    Args:
        truth: The true poses.
        estimate: The poses to judge, with the same joints.
        pairs: Frames to compare.
        gate: Greatest mean joint distance of a match, metres.

    Raises:
        EvaluationError: People match only after a swap of axes. The message names the right axes.
    """
    both = np.stack([pairs.truth, pairs.estimate], axis=1)[pairs.estimate >= 0]
    samples = [
        (truth.people[t], estimate.people[e])
        for t, e in both[_spread(len(both))]
        if truth.people[t] and estimate.people[e]
    ]

    def matches(matrix: Array) -> int:
        return sum(
            len(
                match_people(pair_distances(list(t.values()), [pose @ matrix.T for pose in e.values()]), gate)
            )
            for t, e in samples
        )

    if not samples or matches(np.eye(3)):
        return
    best, found = max(
        ((text, matches(axes_matrix(text))) for text in _all_axes()),
        key=lambda each: each[1],
        default=("", 0),
    )
    if 2 * found > len(samples):
        name = next((name for name, text in AXES.items() if text == best), best)
        raise EvaluationError(
            f"no person of the estimate is within {gate:g} m of the truth, but they are after a swap of "
            f"axes: give --axes {name}",
            path=estimate.source,
        )


def _all_axes() -> list[str]:
    """All 48 ways to name the axes of a file, rotations first."""
    texts = [
        ",".join(sign + axis for sign, axis in zip(signs, axes, strict=True))
        for axes in itertools.permutations("xyz")
        for signs in itertools.product(("", "-"), repeat=3)
    ]
    return sorted(texts, key=lambda text: (np.linalg.det(axes_matrix(text)) < 0, text.count("-")))


def _frames(sequence: PoseSequence, frames: Indices) -> list[People]:
    chosen = frames[frames >= 0]
    return [sequence.people[frame] for frame in chosen[_spread(len(chosen))]]


def _spread(count: int) -> Indices:
    """At most :data:`_CHECKED_FRAMES` numbers below ``count``, at even distances."""
    return np.linspace(0, count - 1, min(_CHECKED_FRAMES, count)).astype(np.intp)


def measure_offset(truth: PoseSequence, estimate: PoseSequence) -> float | None:
    """Measure the delay of the stamps of the estimate, seconds, at most :data:`MAX_OFFSET`; None if people
    hardly move. With this delay removed, the mean joint distance to the nearest person of the truth is
    smallest. The truth is interpolated linearly. Truth and estimate must have the same joints."""
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
        """Mean distance, metres, at a delay of ``late`` seconds. NaN if most times are outside the truth."""
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


def pair_distances(truth: Sequence[Array], estimate: Sequence[Array]) -> Array:
    """Mean joint distance (T, E) of each true person to each estimated person. inf without common joints.
    ``truth`` and ``estimate``: joints (C, 3) of each person, NaN where absent."""
    if not truth or not estimate:
        return np.zeros((len(truth), len(estimate)))
    errors = np.linalg.norm(np.stack(truth)[:, None] - np.stack(estimate)[None], axis=3)
    common = np.isfinite(errors)
    count = common.sum(axis=2)
    total = np.where(common, errors, 0.0).sum(axis=2)
    return np.divide(total, count, out=np.full(count.shape, np.inf), where=count > 0)


def match_people(distances: Array, gate: float) -> list[tuple[int, int]]:
    """Index pairs (truth, estimate) of matching people: as many as possible, with the least sum of distances.

    Args:
        distances: (T, E) mean joint distances, metres.
        gate: Greatest distance of a pair, metres.
    """
    # a pair beyond the gate costs more than any number of pairs within it
    cost = np.where(distances <= gate, distances, (1.0 + gate) * (1 + min(distances.shape)))
    rows, columns = linear_sum_assignment(cost)
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if distances[r, c] <= gate]
