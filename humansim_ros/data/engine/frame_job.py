"""Interfaces of work on the frames of a scene.

A :class:`FrameJob` can be copied to another process. There it starts a :class:`FrameWorker`, which makes one
:class:`FrameResult` for each frame. ``run_frames`` (``workers.py``) gives the frames to workers, takes the
results in the order of the frames, and reports the :class:`FrameProgress`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeAlias

#: Bytes in memory. A NumPy array or shared memory is passed as ``memoryview``.
Buffer: TypeAlias = bytes | bytearray | memoryview


class FrameResult(NamedTuple):
    """What a worker returns for a frame.

    Attributes:
        value: Small object, which is pickled if it goes to another process.
        data: Groups of buffers. If another process has made the result, each group is one buffer in shared
            memory, which is valid until the next result.
    """

    value: Any = None
    data: Sequence[Sequence[Buffer]] = ()


class Costs(dict[str, float]):
    """Seconds of processor time by step."""

    def add(self, step: str, start: float) -> float:
        """Add the processor time since ``start`` to a step. Returns the present processor time."""
        now = time.process_time()
        self[step] = self.get(step, 0.0) + now - start
        return now


class FrameWorker(Protocol):
    """Does the work of single frames.

    Attributes:
        costs: Processor time by step. In a worker process, all costs are set to 0 before each frame.
    """

    costs: Costs

    def work(self, frame: Any, /) -> FrameResult:
        """Do the work of one frame. Raises HumansimError if that fails.

        ``frame``: number of the frame, or another object that identifies the frame.
        """

    def close(self) -> None:
        """Free the renderer and open files."""


class FrameJob(Protocol):
    """Work on the frames of a scene. It can be copied to another process."""

    def start(self) -> FrameWorker:
        """Create a worker with all that it needs. Raises HumansimError if this machine cannot do the work."""


@dataclass
class FrameProgress:
    """State of a recording or an export.

    Attributes:
        first: Number of frames that were done before this run.
        frames: Number of frames in total.
        done: Number of frames that are done so far.
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

    @classmethod
    def of(cls, frames: int, missing: int | None = None) -> FrameProgress:
        """Progress at the start of a run with ``missing`` frames left. If None, all are left."""
        done = 0 if missing is None else frames - missing
        return cls(done, frames, done)

    @property
    def new(self) -> int:
        """Number of frames that this process has done."""
        return self.done - self.first

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.new / self.seconds if self.seconds else 0.0

    def add_cost(self, step: str, seconds: float) -> None:
        """Add processor time to a step. The step becomes the last one in the order of ``costs``."""
        self.costs[step] = self.costs.pop(step, 0.0) + seconds
