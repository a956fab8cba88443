"""Steps of a node's clock: the system clock has been set, or simulated time has jumped back."""

from __future__ import annotations

import time
from collections.abc import Callable

#: Smallest step of the system clock that counts, nanoseconds; smaller ones do not disturb the output.
_SMALLEST = 10_000_000


class ClockSteps:
    """Tells by how much a clock has been set between two readings.

    The system clock is compared with the monotonic clock, which nobody can set. Simulated time may run at any
    rate, so that only a jump back is a step of it, and its start.

    Args:
        now: Nanoseconds of the clock.
        is_simulated: Whether the clock is simulated time at present.
    """

    def __init__(self, now: Callable[[], int], is_simulated: Callable[[], bool]) -> None:
        self._now, self._is_simulated = now, is_simulated
        self._last: int | None = None
        self._was_simulated = False
        # system clock minus monotonic clock, and the most by which it may be wrong
        self._offset = self._doubt = 0

    def read(self) -> tuple[int, int]:
        """Nanoseconds of the clock, and by how many it has been set since the last call (0: it was not)."""
        before = time.monotonic_ns()
        now, simulated = self._now(), self._is_simulated()
        doubt = time.monotonic_ns() - before  # the process may have waited between the two clocks
        last, offset = self._last, now - before
        step = 0
        if last is None:
            pass
        elif simulated != self._was_simulated or (simulated and (now < last or last == 0)):
            step = now - last
        elif not simulated and abs(offset - self._offset) > _SMALLEST + doubt + self._doubt:
            step = offset - self._offset
        self._last, self._was_simulated, self._offset, self._doubt = now, simulated, offset, doubt
        return now, step
