"""HOTA, CLEAR MOT and IDF1: how well an estimate keeps the identities of people.

The formulas follow TrackEval, and the tests compare their results. TrackEval itself is not used: its package
on PyPI demands NumPy 2.3 and replaces OpenCV, which ROS installations cannot have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from humansim_ros.types import Array, Indices

#: Localisation thresholds of HOTA.
ALPHAS: Array = np.arange(0.05, 0.99, 0.05)
_EPSILON = float(np.finfo(float).eps)
#: Similarity from which a pair can be a match for MOTA and IDF1.
_MATCH = 0.5


@dataclass(frozen=True)
class TrackedFrame:
    """Identities (T,) of the truth and (E,) of the estimate in a frame; similarities (T, E), 0 to 1."""

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
        switches: People whose identity changed, counted at each change.
        fragments: Interruptions of the tracks of people.
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
    """Similarity of people from mean joint distances: 1 at no distance, 0.5 at ``gate``, both in metres."""
    return np.clip(1.0 - distances / (2.0 * gate), 0.0, 1.0)


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
    last = np.full(len(truth_count), -1)  # estimate that a person of the truth had when it was last matched
    before = np.full(len(truth_count), -1)  # estimate that it had in the frame before
    starts = np.zeros(len(truth_count), int)
    hits = switches = 0
    total_similarity = 0.0
    for frame in frames:
        if not len(frame.truth) or not len(frame.estimate):
            continue  # as TrackEval: such a frame does not end a match either
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
