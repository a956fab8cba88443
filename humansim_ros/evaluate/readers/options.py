"""What readers need to know beside the file."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReadOptions:
    """Facts that some formats do not state.

    Attributes:
        names: Names of the points, in their order, for formats without names.
        period: Nanoseconds between frames, for formats that number frames; 0 if unknown.
        start: Stamp of frame 0 and of time 0, nanoseconds.
        axes: Axes of the file, as of ``axes_matrix``; those of its format if None.
        scale: Metres of a unit of the file, after the unit that the file states.
    """

    names: tuple[str, ...] | None = None
    period: int = 0
    start: int = 0
    axes: str | None = None
    scale: float = 1.0
