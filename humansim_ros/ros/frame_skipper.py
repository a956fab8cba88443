"""Skipping of frames in nodes that cannot keep up."""

from __future__ import annotations

#: Seconds after which the stride is decided anew.
_WINDOW = 1.0
#: Share of lost frames in a window above which the stride doubles.
_MAX_LOST = 0.2
#: Share of busy time in a window below which the stride halves: half the stride doubles the work.
_MAX_BUSY = 0.46
_MAX_STRIDE = 8
#: Seconds until a smaller stride is tried again, at first and at most.
_FIRST_WAIT, _MAX_WAIT = 2.0, 16.0


class FrameSkipper:
    """Selects every frame, or every second, fourth or eighth, by stamp.

    Late nodes with the same stride select the same frames, so that several cameras still show the same
    stamps. If each node dropped frames at random, hardly a frame would be complete.

    ``period``: nanoseconds between frames. All other times are monotonic seconds.
    """

    def __init__(self, period: float) -> None:
        self.stride = 1
        self._period = period
        self._window_start: float | None = None
        self._processed = self._lost = 0
        self._busy = 0.0
        self._wait = _FIRST_WAIT
        self._next_try = 0.0

    def selects(self, stamp: int) -> bool:
        """Whether the frame of this stamp is to be processed; equal in all nodes with this stride."""
        return round(stamp / self._period) % self.stride == 0

    def add_lost(self, frames: int) -> None:
        """Count selected frames that were not processed."""
        self._lost += frames

    def add_processed(self, start: float, end: float) -> None:
        """Count a frame that was processed from ``start`` to ``end``; once a second, adapt the stride."""
        self._processed += 1
        self._busy += end - start
        if self._window_start is None:
            self._window_start = start
        span = end - self._window_start
        if span < _WINDOW:
            return
        if self._lost > _MAX_LOST * (self._processed + self._lost) and self.stride < _MAX_STRIDE:
            self.stride *= 2
            self._next_try = end + self._wait
            self._wait = min(2 * self._wait, _MAX_WAIT)  # each failed try makes the next one rarer
        elif self.stride > 1 and self._busy < _MAX_BUSY * span and end > self._next_try:
            self.stride //= 2
        self._window_start, self._processed, self._lost, self._busy = end, 0, 0, 0.0
