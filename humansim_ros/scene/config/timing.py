"""Frames of a scene in which a camera takes a picture (docs/scene.md, "Rates of cameras")."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil, floor, isclose

from humansim_ros.errors import SceneError

_SECOND = 1_000_000_000
#: Stamp of frame 0 of a scene in lockstep and in ``Simulation``, nanoseconds.
FIRST_STAMP = 1
#: Rounding of numbers in scene files: share by which a rate may be wrong, and frames by which an offset may.
_RATE_ROUNDING, _OFFSET_ROUNDING = 5e-4, 0.01


@dataclass(frozen=True)
class CameraTiming:
    """Frames of a scene in which a camera takes a picture: frame ``first``, and each ``step`` frames later.

    Pictures have the stamps of these frames, so that cameras meet at exactly equal stamps.

    Attributes:
        scene_rate: Frames per second of the scene.
        step: Frames of the scene per picture.
        first: Frame of the first picture, below ``step``.

    Example:
        >>> timing = CameraTiming.of(30.0, rate=10.0, offset=1 / 30)
        >>> timing.step, timing.first, timing.frames(range(9))
        (3, 1, [1, 4, 7])
    """

    scene_rate: float
    step: int = 1
    first: int = 0

    @classmethod
    def of(cls, scene_rate: float, rate: float | None = None, offset: float = 0.0) -> CameraTiming:
        """Timing of a camera with a rate and an offset.

        Args:
            scene_rate: Frames per second of the scene.
            rate: Pictures per second; the rate of the scene if None.
            offset: Seconds from the start of the scene to the first picture.

        Raises:
            SceneError: The rate of the scene is no multiple of ``rate``, or ``offset`` is not a whole number
                of frames of the scene, or not shorter than 1 / ``rate``. The ``key`` of the error is ``rate``
                or ``offset``.
        """
        step = 1
        if rate is not None:
            share = scene_rate / rate
            step = max(1, round(share))
            if not isclose(share, step, rel_tol=_RATE_ROUNDING):
                around = " or ".join(
                    f"{scene_rate / n:.6g}" for n in sorted({max(1, floor(share)), ceil(share)})
                )
                text = f"{rate:g} Hz does not divide the rate of the scene, {scene_rate:g} Hz: give {around}"
                raise SceneError(f"{text}, or the scene a multiple of the rates of its cameras", key="rate")
        frames = offset * scene_rate
        first = round(frames)
        if abs(frames - first) > _OFFSET_ROUNDING:
            around = " or ".join(f"{n / scene_rate:.6g}" for n in (floor(frames), ceil(frames)))
            text = f"{offset:g} s is no whole number of frames of the scene, which last 1/{scene_rate:g} s"
            raise SceneError(f"{text}: give {around}, or the scene a higher rate", key="offset")
        if first >= step:
            text = f"{offset:g} s is not shorter than the time between two pictures of the camera"
            raise SceneError(f"{text}: give at most {(step - 1) / scene_rate:.6g}", key="offset")
        return cls(scene_rate, step, first)

    def __str__(self) -> str:
        later = f" from {self.first / self.scene_rate:.6g} s on" if self.first else ""
        return f"{self.rate:g} Hz{later}"

    @property
    def rate(self) -> float:
        """Pictures per second."""
        return self.scene_rate / self.step

    @property
    def is_full(self) -> bool:
        """Whether it takes a picture in every frame."""
        return self.step == 1

    def __contains__(self, index: object) -> bool:
        """Return whether a picture is taken in a frame of the scene, from 0."""
        return isinstance(index, int) and index >= self.first and (index - self.first) % self.step == 0

    def frames(self, frames: Iterable[int]) -> list[int]:
        """Return those of some frames in which a picture is taken."""
        return [index for index in frames if index in self]

    def number(self, index: int) -> int:
        """Number from 0 of the newest picture up to a frame; negative before the first one."""
        return (index - self.first) // self.step

    def frame(self, number: int) -> int:
        """Frame of the scene in which a picture is taken."""
        return self.first + number * self.step

    def time(self, number: int) -> int:
        """Scene time of a picture, nanoseconds."""
        return frame_time(self.frame(number), self.scene_rate)


def frame_time(index: int, rate: float) -> int:
    """Nanoseconds from the start to frame ``index``, round(index * period): errors do not accumulate."""
    return round(index * _SECOND / rate)


def frame_at(scene_time: int, rate: float) -> int:
    """Number of the frame that is nearest to a scene time in nanoseconds."""
    return max(0, round(scene_time * rate / _SECOND))
