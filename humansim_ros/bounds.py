"""Bounds of numbers from files and messages: a number beyond them is a mistake."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

#: Largest coordinate and size in metres, and velocity in m/s or rad/s.
MAX_COORDINATE = 1e6


def within_bounds(numbers: ArrayLike) -> bool:
    """Whether all numbers are finite and at most :data:`MAX_COORDINATE`."""
    return bool((np.abs(numbers) <= MAX_COORDINATE).all())  # False for NaN, too
