"""When each row of a picture gathers light, and how pictures rendered at a few times make up that light."""

from __future__ import annotations

import numpy as np

from humansim_ros.types import Array

#: Stamps are in whole nanoseconds: what is shorter is an instant.
_INSTANT = 1e-9


def sample_times(height: int, exposure: float, row_time: float, samples: int) -> Array:
    """Times (T,) at which the scene is rendered, seconds from the middle of the exposure of the middle row.

    ``exposure``, ``row_time``: seconds. One time, 0, where neither matters. A global shutter takes the
    middles of equal parts of the exposure; a rolling one spreads them from the start of the first row to the
    end of the last.
    """
    span = exposure + (height - 1) * row_time
    if span < _INSTANT or samples == 1:
        return np.zeros(1)
    if row_time == 0:
        return exposure * ((np.arange(samples) + 0.5) / samples - 0.5)
    return np.linspace(-span / 2, span / 2, samples, dtype=float)


def row_weights(height: int, exposure: float, row_time: float, samples: int) -> Array:
    """Share (H, T) of each of the times of :func:`sample_times` in the light of each row; rows sum to 1.

    Under a rolling shutter row y gathers light around (y - (H - 1) / 2) row_time. Light is taken to change
    linearly between two samples, so that the mean time of every row is exactly that, however few they are.
    """
    times = sample_times(height, exposure, row_time, samples)
    if len(times) == 1 or row_time == 0:
        return np.full((height, len(times)), 1 / len(times))
    step = times[1] - times[0]
    middle = (np.arange(height) - (height - 1) / 2)[:, None] * row_time
    if exposure < _INSTANT:
        weights = np.maximum(0.0, 1 - np.abs(middle - times) / step)
    else:
        weights = _gathered((middle + exposure / 2 - times) / step)
        weights = weights - _gathered((middle - exposure / 2 - times) / step)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=float)


def _gathered(u: Array) -> Array:
    """Integral up to ``u`` of the triangle that rises from -1 to 0 and falls from 0 to 1."""
    u = np.clip(u, -1.0, 1.0)
    return np.where(u < 0, (1 + u) ** 2 / 2, 1 - (1 - u) ** 2 / 2)
