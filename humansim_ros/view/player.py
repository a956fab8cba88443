"""Time of the page: play, pause, step, scrub, speed and loop."""

from __future__ import annotations

from dataclasses import dataclass

#: Speeds that the page offers.
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


@dataclass
class Player:
    """Frame that is shown, as a function of the wall clock.

    Attributes:
        frames: Number of frames; None for a live source, which has no time of its own.
        period: Nanoseconds between frames.
        playing: Whether it plays.
        speed: Seconds of the scene per second.
        loop: Whether it starts again after the last frame; else it pauses there.
    """

    frames: int | None
    period: int
    playing: bool = True
    speed: float = 1.0
    loop: bool = True
    _position: float = 0.0
    _last: float | None = None

    @property
    def index(self) -> int:
        """Number of the frame."""
        return int(self._position)

    def advance(self, now: float) -> int:
        """Frame at a time of a monotonic clock, seconds."""
        passed = 0.0 if self._last is None else max(0.0, now - self._last)
        self._last = now
        if self.frames is None:
            self._position += 1 if self.playing else 0
            return self.index
        if self.playing:
            self._position += passed * self.speed * 1e9 / self.period
            if self._position >= self.frames:
                if self.loop:
                    self._position %= self.frames
                else:
                    self._position, self.playing = float(self.frames - 1), False
        return self.index

    def seek(self, index: int) -> None:
        """Go to a frame; to the first or last one if there is no such frame."""
        self._position = float(min(max(index, 0), (self.frames or 1) - 1))

    def step(self, count: int) -> None:
        """Pause, and go some frames on or back."""
        self.playing = False
        self.seek(self.index + count)
