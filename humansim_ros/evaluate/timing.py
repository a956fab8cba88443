"""Latency, rate and losses of an estimate that arrives message by message."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.evaluate.tracks import PoseSequence
from humansim_ros.types import Array


@dataclass(frozen=True)
class Latency:
    """Seconds from the stamp of a frame to its estimate."""

    median: float
    p99: float
    worst: float


@dataclass(frozen=True)
class Timing:
    """How messages arrive; docs/evaluation.md.

    Attributes:
        latency: None if it is not known, such as in recordings of lockstep.
        rate: Frames in a second of the times of arrival; None with fewer than two.
        messages: Messages with a stamp, also repeated ones.
        frames: Frames with an estimate: different stamps.
        duplicates: Messages that add nobody to the estimate of their frame.
        out_of_order: Messages that are older than the one before on their topic.
        lost: Frames of the truth without an estimate, between the first and the last estimate.
        lost_share: Their share of these frames of the truth; None if there are none.
        after: Frames of the truth after the last estimate; None if the truth is computed.
    """

    latency: Latency | None
    rate: float | None
    messages: int
    frames: int
    duplicates: int
    out_of_order: int
    lost: int
    lost_share: float | None
    after: int | None


def timing(truth: PoseSequence, estimate: PoseSequence) -> Timing | None:
    """Timing of an estimate; None for one of a file, which has no times of arrival."""
    arrivals = estimate.arrivals
    if arrivals is None:
        return None
    seconds = float(np.ptp(arrivals.times)) * 1e-9
    frames = len(arrivals.times)
    lost, expected, after = _losses(truth.times, estimate.times)
    return Timing(
        latency=_latency(arrivals.latencies),
        rate=(frames - 1) / seconds if seconds > 0 else None,
        messages=arrivals.messages,
        frames=frames,
        duplicates=arrivals.duplicates,
        out_of_order=arrivals.out_of_order,
        lost=lost,
        lost_share=lost / expected if expected else None,
        # a truth that is computed has no end
        after=after if truth.arrivals is not None else None,
    )


def _latency(values: Array) -> Latency | None:
    if not len(values):
        return None
    median, p99, worst = np.percentile(values, [50, 99, 100]).tolist()
    return Latency(median, p99, worst)


def _losses(truth: NDArray[np.int64], own: NDArray[np.int64]) -> tuple[int, int, int]:
    """Frames of the truth: without an estimate within half a period, all between the first and the last
    estimate, and those after the last one.
    """
    if not len(truth):
        return 0, 0, 0
    half = float(np.median(np.diff(truth))) / 2 if len(truth) > 1 else 0.0
    between = truth[(truth >= own[0] - half) & (truth <= own[-1] + half)]
    after = np.clip(np.searchsorted(own, between), 1, max(1, len(own) - 1))
    near = np.minimum(
        np.abs(own[after - 1] - between), np.abs(own[np.minimum(after, len(own) - 1)] - between)
    )
    return int((near > half).sum()), len(between), int((truth > own[-1] + half).sum())
