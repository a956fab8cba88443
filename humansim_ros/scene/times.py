"""Scene times of frames."""

from __future__ import annotations

_SECOND = 1_000_000_000


def frame_time(index: int, rate: float) -> int:
    """Nanoseconds from the start to frame ``index``, round(index * period): errors do not accumulate."""
    return round(index * _SECOND / rate)


def frame_at(scene_time: int, rate: float) -> int:
    """Number of the frame that is nearest to a scene time in nanoseconds."""
    return max(0, round(scene_time * rate / _SECOND))
