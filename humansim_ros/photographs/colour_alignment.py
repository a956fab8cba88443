"""Gains and biases of the colours of cameras, from places that several of them see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from humansim_ros.types import Array

#: Values below which noise is too much of a ratio.
_DARKEST = 8.0
#: Least number of places that two views have to share.
LEAST_SHARED = 30
#: Standard deviations of samples and biases (of 255), and of gains about their first guess.
_NOISE, _BIAS, _GAIN = 4.0, 0.5, 0.005
#: Number of independent samples in a view.
_SAMPLES = 20
#: Greatest logarithms of the ratio of two colours of one place to the ratio of the gains, in turns.
_FARTHEST = (0.5, 0.25, 0.15, 0.12, 0.12)
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Alignment:
    """Colours of C views: what is seen is gain times true colour plus bias, in sRGB values of 0 to 255.

    Attributes:
        gains: (C, 3); their geometric mean is 1.
        biases: (C, 3); their mean is 0.
        group: (C,) views with the same number are aligned with each other.
    """

    gains: Array
    biases: Array
    group: NDArray[np.int32]


def align_colours(colours: Array, weights: Array) -> Alignment:
    """Find gains and biases of C views from N places on a surface that reflects evenly in all directions.

    Gains follow from the means of what pairs of views share, biases from robust least squares, in turns with
    the true colours. Views that share too few places with the others keep gain 1.

    Args:
        colours: (C, N, 3) sRGB values, 0 to 255.
        weights: (C, N) how well the view sees the place; 0 where it does not, or its colour is clipped.
    """
    usable = (colours > _DARKEST).all(axis=2) & (weights > 0)
    shared = usable.astype(float) @ usable.T.astype(float)
    np.fill_diagonal(shared, 0)
    linked = shared >= LEAST_SHARED
    _, group = connected_components(coo_matrix(linked), directed=False)
    gains, biases = np.ones((len(colours), 3)), np.zeros((len(colours), 3))
    for number in np.unique(group):
        views = np.flatnonzero(group == number)
        if len(views) < 2:
            continue
        places = usable[views].sum(axis=0) >= 2
        own = np.where(usable[np.ix_(views, places)], weights[np.ix_(views, places)], 0.0)
        for channel in range(3):
            seen = colours[views][:, places, channel]
            gains[views, channel], biases[views, channel] = _solve(seen, own)
    return Alignment(gains, biases, group.astype(np.int32))


def _solve(seen: Array, weights: Array) -> tuple[Array, Array]:
    """Gains and biases (C,) of one channel. ``seen``, ``weights``: (C, N)."""
    guess = gains = _gains(seen, weights)
    biases = np.zeros(len(seen))
    for _ in range(_ROUNDS):
        # true colours, then a line through the samples of each view, near the guess of its gain
        robust = weights
        for _ in range(2):
            true = (robust * gains[:, None] * (seen - biases[:, None])).sum(0) / np.maximum(
                (robust * gains[:, None] ** 2).sum(0), 1e-9
            )
            errors = (seen - gains[:, None] * true - biases[:, None]) / _NOISE
            robust = weights / (1 + errors**2)
        # errors of neighbours are alike: they do not count as that many samples
        scale = _SAMPLES * robust / np.maximum(robust.sum(1), 1e-9)[:, None] / _NOISE**2
        a = (scale * true**2).sum(1) + 1 / _GAIN**2
        b = (scale * true).sum(1)
        c = scale.sum(1) + 1 / _BIAS**2
        right = (scale * true * seen).sum(1) + guess / _GAIN**2, (scale * seen).sum(1)
        determinant = a * c - b**2
        before = gains
        gains = (c * right[0] - b * right[1]) / determinant
        biases = (a * right[1] - b * right[0]) / determinant
        gains = gains / np.exp(np.log(gains).mean())
        biases -= biases.mean()
        if np.abs(gains - before).max() < 1e-5:
            break
    return gains, biases


def _gains(seen: Array, weights: Array) -> Array:
    """Gains (C,) from the ratios of the mean colours of the places that each pair of views shares.

    Means do not depend on how sharp the views are, unlike lines through samples of a pattern.
    """
    rows, values = [np.ones(len(seen))], [0.0]
    for first in range(len(seen)):
        for second in range(first):
            both = np.sqrt(weights[first] * weights[second])
            shared = both > 0
            if shared.sum() < LEAST_SHARED:
                continue
            one, other, own = seen[first][shared], seen[second][shared], both[shared]
            ratios = np.log(one / other)
            middle = float(np.median(ratios))
            for limit in _FARTHEST:
                near = own * (np.abs(ratios - middle) < limit)
                middle = float(np.log((near @ one) / (near @ other))) if near.any() else middle
            row = np.zeros(len(seen))
            row[first], row[second] = 1.0, -1.0
            certainty = float(np.sqrt(near.sum()))
            rows.append(certainty * row)
            values.append(certainty * middle)
    return np.asarray(np.exp(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]))


def without_gains(image: NDArray[np.float32], gains: Array, biases: Array) -> NDArray[np.float32]:
    """Colours (..., 3) of a view without its gains (3,) and biases (3,)."""
    return np.asarray((image - biases) / gains, np.float32)
