"""Bounds of numbers from files, options and messages: a number beyond them is a mistake."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

#: Largest coordinate and size in metres, and velocity in m/s or rad/s.
MAX_COORDINATE = 1e6
#: Most frames of a run or a recording: a month at 30 Hz.
MAX_FRAMES = 100_000_000


def within_bounds(numbers: ArrayLike) -> bool:
    """Whether all numbers are finite and at most :data:`MAX_COORDINATE`."""
    import numpy as np  # not needed by the command line, which imports the limits

    return bool((np.abs(numbers) <= MAX_COORDINATE).all())  # False for NaN, too
