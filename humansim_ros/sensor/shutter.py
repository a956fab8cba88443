"""Exposure of the image rows over time: times at which images are rendered, and their weights per row."""

from __future__ import annotations

import numpy as np

from humansim_ros.types import Array

#: Shortest exposure, seconds: stamps are whole nanoseconds.
_SHORTEST = 1e-9


def sample_times(height: int, exposure: float, row_time: float, samples: int) -> Array:
    """Times at which the scene is rendered.

    A global shutter uses the midpoints of equal parts of the exposure; a rolling shutter distributes the
    times evenly from the start of the first row to the end of the last.

    Args:
        height: Number of image rows.
        exposure: Exposure time of a row, seconds.
        row_time: Time from the exposure of a row to that of the next, seconds; 0 for a global shutter.
        samples: Number of times.

    Returns:
        Times (T,) in seconds from the midpoint of the exposure of the middle row; one 0.0 if there is neither
        motion blur nor a rolling shutter.
    """
    span = exposure + (height - 1) * row_time
    if span < _SHORTEST or samples == 1:
        return np.zeros(1)
    if row_time == 0:
        return exposure * ((np.arange(samples) + 0.5) / samples - 0.5)
    return np.linspace(-span / 2, span / 2, samples, dtype=float)


def row_weights(height: int, exposure: float, row_time: float, samples: int) -> Array:
    """Weights of the times of :func:`sample_times` in the light of each row.

    With a rolling shutter, the midpoint of the exposure of row y is (y - (H - 1) / 2) row_time. Light is
    interpolated linearly between samples, so that the mean time of each row is exact for any number of
    samples.

    Args:
        height: Number of image rows.
        exposure: Exposure time of a row, seconds.
        row_time: Time from the exposure of a row to that of the next, seconds.
        samples: Number of times.

    Returns:
        Weights (H, T); rows sum to 1.
    """
    times = sample_times(height, exposure, row_time, samples)
    if len(times) == 1 or row_time == 0:
        return np.full((height, len(times)), 1 / len(times))
    step = times[1] - times[0]
    middle = (np.arange(height) - (height - 1) / 2)[:, None] * row_time
    if exposure < _SHORTEST:
        weights = np.maximum(0.0, 1 - np.abs(middle - times) / step)
    else:
        weights = _triangle_integral((middle + exposure / 2 - times) / step)
        weights = weights - _triangle_integral((middle - exposure / 2 - times) / step)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=float)


def _triangle_integral(u: Array) -> Array:
    """Integral from -1 to ``u`` of the triangle function 1 - |u|."""
    u = np.clip(u, -1.0, 1.0)
    return np.where(u < 0, (1 + u) ** 2 / 2, 1 - (1 - u) ** 2 / 2)
