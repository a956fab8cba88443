"""Which frames a node leaves out that cannot keep up."""

from __future__ import annotations

_WINDOW = 1.0
#: More than this share of a second's frames lost: too fast.
_LOST = 0.2
#: Less than this share of the time at work: twice as fast may do.
_IDLE = 0.46
_MAX = 8
_FIRST_WAIT, _LONGEST_WAIT = 2.0, 16.0


class FrameSkipper:
    """Keeps every frame, or every second, fourth or eighth, counted by stamp.

    Nodes that are late together so leave out the same frames, and several cameras still show the same
    instants; each leaving out what it happens to miss, hardly a frame would be whole. ``period``: nanoseconds
    between frames. Times are monotonic seconds.
    """

    def __init__(self, period: float) -> None:
        self.stride = 1
        self._period = period
        self._since: float | None = None
        self._kept = self._lost = 0
        self._busy = 0.0
        self._wait = _FIRST_WAIT
        self._next_try = 0.0

    def keeps(self, stamp: int) -> bool:
        """Whether the frame of this stamp is one to work on; the same answer in every node of this stride."""
        return round(stamp / self._period) % self.stride == 0

    def lost(self, frames: int) -> None:
        """Frames that should have been kept were not."""
        self._lost += frames

    def worked(self, start: float, end: float) -> None:
        """A frame was worked on from ``start`` to ``end``. Once a second, this changes the pace where it
        must.
        """
        self._kept += 1
        self._busy += end - start
        if self._since is None:
            self._since = start
        span = end - self._since
        if span < _WINDOW:
            return
        if self._lost > _LOST * (self._kept + self._lost) and self.stride < _MAX:
            self.stride *= 2
            self._next_try = end + self._wait
            self._wait = min(2 * self._wait, _LONGEST_WAIT)  # each failed try makes the next one rarer
        elif self.stride > 1 and self._busy < _IDLE * span and end > self._next_try:
            self.stride //= 2
        self._since, self._kept, self._lost, self._busy = end, 0, 0, 0.0
