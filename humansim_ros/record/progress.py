"""Progress of work that goes frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class FrameProgress:
    """State of a recording or an export.

    Attributes:
        first: Number of frames that were done before.
        frames: Number of frames of the whole.
        done: Number of frames that are done.
        size: Bytes that this process has written.
        seconds: Wall-clock seconds of writing, from the first frame on.
        costs: Seconds of processor time of all processes by step.
    """

    first: int
    frames: int
    done: int
    size: int = 0
    seconds: float = 0.0
    costs: dict[str, float] = field(default_factory=dict)

    @property
    def new(self) -> int:
        """Number of frames that this process has done."""
        return self.done - self.first

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.new / self.seconds if self.seconds else 0.0
