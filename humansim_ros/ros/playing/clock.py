"""Clock of the motion player, and the frames in which a camera takes its pictures by this clock."""

from __future__ import annotations

import math
from dataclasses import dataclass

from humansim_ros.scene.config import CameraTiming

#: Nanoseconds by which a frame may be early; at most a tenth of a period.
_EARLY = 5_000_000


@dataclass(frozen=True)
class Tick:
    """One step of the playback clock.

    Attributes:
        stamp: Stamp of the frame, nanoseconds.
        elapsed: Scene time of the frame, nanoseconds.
        pace: Seconds of the scene per second; 0 while paused.
        dropped: Number of frames that were skipped before it.
        index: Number of the frame since the start of the clock, with those that were skipped.
    """

    stamp: int
    elapsed: int
    pace: float
    dropped: int = 0
    index: int = 0


class PlaybackClock:
    """Stamps of frames on a wall clock in nanoseconds, and the scene time of each.

    Frame k has the stamp start + round(k * period); :meth:`cut` sets a new start. Stamps increase, unless the
    wall clock is set (:meth:`shift`). The scene time follows the stamps at ``speed``, does not change while
    paused, and jumps only by :meth:`seek`.
    """

    def __init__(self, rate: float, speed: float = 1.0, seconds: float = 0.0) -> None:
        self.period = 1e9 / rate
        self.speed = speed
        self.paused = False
        self.elapsed = round(seconds * 1e9)
        self.last: int | None = None
        self._start = self._next = 0
        self._index = -1
        # stamp (None: of the next frame) and scene time from which the scene time is counted
        self._base: tuple[int | None, int] = (None, self.elapsed)
        self._steps = 0

    def due(self, now: int) -> Tick | None:
        """The newest frame that is due; None if there is none, as timers may be early."""
        if now <= 0:
            return None  # simulated time has not started: zero is never a stamp
        if self.last is None:
            return self.cut(now)
        frame = int((now - self._start + min(0.1 * self.period, _EARLY)) / self.period)
        if frame < self._next:
            return None
        dropped, self._next = frame - self._next, frame + 1
        return self._tick(self._start + round(frame * self.period), dropped)

    def next(self) -> Tick:
        """The next frame, whatever time it is; the first one has the stamp 1, as in ``Simulation``."""
        if self.last is None:
            return self.cut(1)
        self._next += 1
        return self._tick(self._start + round((self._next - 1) * self.period))

    def begin_at(self, stamp: int) -> int:
        """Let :meth:`next` begin with a later frame than the first one.

        Returns:
            Number of the first frame from stamp 1 on that is not before ``stamp``.
        """
        self._start, self._next = 1, max(0, math.ceil((stamp - 1) / self.period - 1e-6))
        self.last, self._base, self._index = 1, (1, self.elapsed), self._next - 1
        return self._next

    def cut(self, now: int) -> Tick:
        """A frame now; the next frames are counted from it."""
        stamp = now if self.last is None else max(now, self.last + 1)
        self._start, self._next = stamp, 1
        return self._tick(stamp)

    def shift(self, step: int) -> None:
        """Follow a wall clock that was set by ``step`` nanoseconds: stamps jump, scene time goes on."""
        since, elapsed = self._base
        self._start += step
        self._base = (None if since is None else since + step, elapsed)
        if self.last is not None:
            self.last += step

    def set_rate(self, rate: float) -> None:
        """Set the frames per second after the last frame."""
        self._rebase()
        self.period = 1e9 / rate
        if self.last is not None:
            self._start, self._next = self.last, 1

    def set_speed(self, speed: float) -> None:
        """Set the seconds of the scene per second after the last frame."""
        self._rebase()
        self.speed = speed

    def pause(self, paused: bool) -> None:
        """Pause at the scene time of the last frame, or continue from it."""
        self._rebase()
        self.paused = paused

    def step(self, now: int) -> Tick:
        """The next frame now, while paused."""
        self._steps += 1
        self.elapsed = self._base[1] + round(self._steps * self.period * (self.speed or 1.0))
        return self.cut(now)

    def seek(self, seconds: float) -> None:
        """Jump to a scene time with the next frame."""
        self.elapsed = round(seconds * 1e9)
        self._base, self._steps = (None, self.elapsed), 0

    def _rebase(self) -> None:
        self._base, self._steps = (self.last, self.elapsed), 0

    def _tick(self, stamp: int, dropped: int = 0) -> Tick:
        since, elapsed = self._base
        if since is None:
            self._base = (stamp, elapsed)
        elif not self.paused:
            self.elapsed = elapsed + round((stamp - since) * self.speed)
        self.last = stamp
        self._index += 1 + dropped
        return Tick(stamp, self.elapsed, 0.0 if self.paused else self.speed, dropped, self._index)


class PictureTimer:
    """Decide, for frames in order, which ones the camera captures. If the frame of a picture is skipped,
    because the machine is too slow, the next frame takes its place. So a camera never starves, and cameras of
    one rate and offset show the same frames."""

    def __init__(self, timing: CameraTiming) -> None:
        self._timing = timing
        #: The last frame, and whether it had a picture.
        self._last: tuple[int, bool] | None = None

    def takes(self, index: int) -> bool:
        """Return whether a picture is taken in the next frame; the same if it is the same frame again."""
        if self._last is None or self._last[0] != index:
            number = self._timing.number(index)
            due = self._timing.frame(number)
            skipped = self._last is not None and self._last[0] < due
            self._last = index, number >= 0 and (due == index or skipped)
        return self._last[1]
