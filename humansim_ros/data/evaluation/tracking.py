"""HOTA, CLEAR MOT and IDF1: how well an estimate keeps the identities of people.

The formulas follow TrackEval, and tests compare the results of both. TrackEval itself is not used, since its
package on PyPI demands NumPy 2.3 and replaces OpenCV, which does not work with ROS installations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from humansim_ros.types import Array, Indices

#: Thresholds of similarity over which HOTA takes the mean.
ALPHAS: Array = np.arange(0.05, 0.99, 0.05)
_EPSILON = float(np.finfo(float).eps)
#: A pair with at least this similarity can be a match for MOTA and IDF1.
_MATCH = 0.5
#: Because of rounding, a corner of a rectangle counts as inside another one up to this distance outside,
#: metres.
_TOLERANCE = 1e-12


@dataclass(frozen=True)
class TrackedFrame:
    """One frame: identities (T,) of the truth and (E,) of the estimate, and similarity (T, E) of each pair, 0
    to 1."""

    truth: Indices
    estimate: Indices
    similarity: Array


@dataclass(frozen=True)
class TrackingScores:
    """Scores of identities over a sequence.

    Attributes:
        hota: Higher order tracking accuracy [Luiten 2021], mean over all thresholds.
        deta: Detection accuracy of HOTA.
        assa: Association accuracy of HOTA.
        loca: Localisation accuracy of HOTA.
        mota: Multiple object tracking accuracy [Bernardin 2008].
        motp: Mean similarity of the matches of MOTA.
        idf1: F1 score of identities [Ristani 2016].
        switches: Number of times that a true person gets another identity in the estimate.
        fragments: Number of interruptions in the tracks of true people.
    """

    hota: float
    deta: float
    assa: float
    loca: float
    mota: float
    motp: float
    idf1: float
    switches: int
    fragments: int


def similarity(distances: Array, gate: float) -> Array:
    """Similarity (0 to 1) of people from their mean joint distance, metres: 1 at 0, 0.5 at ``gate``, 0 from
    twice ``gate`` on."""
    return np.clip(1.0 - distances / (2.0 * gate), 0.0, 1.0)


def box_overlap(truth: Array, estimate: Array) -> Array:
    """3D IoU (T, E) of upright boxes (T, 7) and (E, 7). A box is given by its centre x, y, z and its sizes
    along its own axes (metres), and the yaw of its x axis (radians)."""
    a, b = truth[:, None, :], estimate[None, :, :]
    low = np.maximum(a[..., 2] - a[..., 5] / 2, b[..., 2] - b[..., 5] / 2)
    high = np.minimum(a[..., 2] + a[..., 5] / 2, b[..., 2] + b[..., 5] / 2)
    height = np.maximum(high - low, 0.0)
    reach = np.hypot(a[..., 3], a[..., 4]) / 2 + np.hypot(b[..., 3], b[..., 4]) / 2
    near = (height > 0) & (np.hypot(*np.moveaxis(a[..., :2] - b[..., :2], -1, 0)) < reach)
    rows, columns = np.nonzero(near)
    common = np.zeros(near.shape)
    common[rows, columns] = _common_area(truth[rows], estimate[columns]) * height[rows, columns]
    return common / (np.prod(a[..., 3:6], axis=-1) + np.prod(b[..., 3:6], axis=-1) - common)


def _common_area(a: Array, b: Array) -> Array:
    """Area (N,) on the floor that the rectangles of boxes ``a`` and ``b`` (N, 7) have in common. This area
    has its corners at corners of one rectangle inside the other, and where sides of both cross."""
    half = a[:, None, 3:5] / 2
    other = _corners(b[:, :2] - a[:, :2], b[:, 3:5], b[:, 6], -a[:, 6])  # in the frame of a
    own = _corners(np.zeros((len(a), 2)), a[:, 3:5], np.zeros(len(a)), np.zeros(len(a)))
    back = _corners(a[:, :2] - b[:, :2], a[:, 3:5], a[:, 6], -b[:, 6])  # corners of a in the frame of b
    points = [other, own]
    inside = [
        (np.abs(other) <= half + _TOLERANCE).all(axis=2),
        (np.abs(back) <= b[:, None, 3:5] / 2 + _TOLERANCE).all(axis=2),
    ]
    sides = np.roll(other, -1, axis=1) - other
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            line = sign * half[..., axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                share = (line - other[..., axis]) / sides[..., axis]
            crosses = (share >= 0) & (share <= 1)
            point = other + np.where(crosses, share, 0.0)[..., None] * sides
            points.append(point)
            inside.append(crosses & (np.abs(point[..., 1 - axis]) <= half[..., 1 - axis] + _TOLERANCE))
    polygon, known = np.concatenate(points, axis=1), np.concatenate(inside, axis=1)
    count = known.sum(axis=1)
    middle = (polygon * known[..., None]).sum(axis=1) / np.maximum(count, 1)[:, None]
    polygon = np.where(known[..., None], polygon - middle[:, None], 0.0)
    angle = np.where(known, np.arctan2(polygon[..., 1], polygon[..., 0]), np.inf)
    order = np.argsort(angle, axis=1)
    polygon = np.take_along_axis(polygon, order[..., None], axis=1)
    # points that are no corners come last, and repeat the first corner
    spare = np.arange(polygon.shape[1]) >= count[:, None]
    polygon = np.where(spare[..., None], polygon[:, :1], polygon)
    following = np.roll(polygon, -1, axis=1)
    area = (polygon[..., 0] * following[..., 1] - polygon[..., 1] * following[..., 0]).sum(axis=1) / 2
    return np.asarray(area)


def _corners(offset: Array, sizes: Array, yaw: Array, turn: Array) -> Array:
    """Corners (N, 4, 2) of rectangles.

    Args:
        offset: (N, 2) centres of the rectangles.
        sizes: (N, 2) lengths of the sides along their own axes.
        yaw: (N,) direction of their x axes, radians.
        turn: (N,) angle by which the corners are then turned about the origin, radians.
    """
    own = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * sizes[:, None] / 2
    return _turned(own, yaw + turn) + _turned(offset[:, None], turn)


def _turned(points: Array, angle: Array) -> Array:
    """Points (N, P, 2) turned by angles (N,), radians."""
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def tracking_scores(frames: Sequence[TrackedFrame]) -> TrackingScores:
    """Compute all scores of a sequence with at least one person in the truth and in the estimate."""
    hota, deta, assa, loca = _hota(frames)
    mota, motp, switches, fragments = _clear(frames)
    return TrackingScores(hota, deta, assa, loca, mota, motp, _idf1(frames), switches, fragments)


def _counts(frames: Sequence[TrackedFrame]) -> tuple[Array, Array]:
    """Number of frames (T,) of each identity of the truth, and (E,) of the estimate."""
    truth = np.concatenate([frame.truth for frame in frames])
    estimate = np.concatenate([frame.estimate for frame in frames])
    return np.bincount(truth).astype(float), np.bincount(estimate).astype(float)


def _hota(frames: Sequence[TrackedFrame]) -> tuple[float, float, float, float]:
    truth_count, estimate_count = _counts(frames)
    either = truth_count[:, None] + estimate_count
    potential = np.zeros_like(either)
    for frame in frames:
        s = frame.similarity
        total = s.sum(axis=0) + s.sum(axis=1)[:, None] - s
        share = np.divide(s, total, out=np.zeros_like(s), where=total > _EPSILON)
        potential[np.ix_(frame.truth, frame.estimate)] += share
    alignment = potential / (either - potential)
    matches = np.zeros((len(ALPHAS), *either.shape))
    localised = np.zeros(len(ALPHAS))
    for frame in frames:
        rows, columns = linear_sum_assignment(
            -alignment[np.ix_(frame.truth, frame.estimate)] * frame.similarity
        )
        found = frame.similarity[rows, columns]
        for number, alpha in enumerate(ALPHAS):
            near = found >= alpha - _EPSILON
            matches[number, frame.truth[rows[near]], frame.estimate[columns[near]]] += 1
            localised[number] += found[near].sum()
    hits = matches.sum(axis=(1, 2))
    deta = hits / np.maximum(1, truth_count.sum() + estimate_count.sum() - hits)
    assa = (matches * matches / np.maximum(1, either - matches)).sum(axis=(1, 2)) / np.maximum(1, hits)
    loca = np.maximum(1e-10, localised) / np.maximum(1e-10, hits)
    return tuple(float(each.mean()) for each in (np.sqrt(deta * assa), deta, assa, loca))  # type: ignore[return-value]


def _clear(frames: Sequence[TrackedFrame]) -> tuple[float, float, int, int]:
    """MOTA, MOTP, identity switches and fragments."""
    truth_count, estimate_count = _counts(frames)
    # identity of the estimate that each person had when it was last matched
    last = np.full(len(truth_count), -1)
    before = np.full(len(truth_count), -1)  # identity of the estimate that it had in the previous frame
    starts = np.zeros(len(truth_count), int)
    hits = switches = 0
    total_similarity = 0.0
    for frame in frames:
        if not len(frame.truth) or not len(frame.estimate):
            continue  # as in TrackEval, such a frame does not end a match either
        # people who are matched stay matched
        stays = frame.estimate[None, :] == before[frame.truth][:, None]
        score = np.where(frame.similarity < _MATCH - _EPSILON, 0.0, 1000.0 * stays + frame.similarity)
        rows, columns = linear_sum_assignment(-score)
        near = score[rows, columns] > _EPSILON
        rows, columns = rows[near], columns[near]
        truth, estimate = frame.truth[rows], frame.estimate[columns]
        switches += int(((last[truth] >= 0) & (last[truth] != estimate)).sum())
        hits += len(truth)
        total_similarity += float(frame.similarity[rows, columns].sum())
        last[truth] = estimate
        now = np.full_like(before, -1)
        now[truth] = estimate
        starts += (before < 0) & (now >= 0)
        before = now
    missed, false = truth_count.sum() - hits, estimate_count.sum() - hits
    mota = 1.0 - (missed + false + switches) / max(1.0, truth_count.sum())
    fragments = int(np.maximum(starts - 1, 0).sum())
    return float(mota), total_similarity / max(1, hits), switches, fragments


def _idf1(frames: Sequence[TrackedFrame]) -> float:
    truth_count, estimate_count = _counts(frames)
    together = np.zeros((len(truth_count), len(estimate_count)))
    for frame in frames:
        together[np.ix_(frame.truth, frame.estimate)] += frame.similarity >= _MATCH
    rows, columns = linear_sum_assignment(-together)
    return float(2 * together[rows, columns].sum() / (truth_count.sum() + estimate_count.sum()))
