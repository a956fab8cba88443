"""Record a scene into a bag, with any number of processes, and continue an interrupted recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from humansim_ros.bags.chunks import Chunk
from humansim_ros.bags.writer import BagWriter
from humansim_ros.errors import BagError
from humansim_ros.record.frame_chunks import FrameEncoder, SceneRecording
from humansim_ros.record.plan import RecordingPlan
from humansim_ros.record.workers import Workers

#: Step of giving the bytes to the system.
WRITING = "writing"


@dataclass
class RecordingProgress:
    """State of a recording.

    Attributes:
        first: First frame that this process records.
        frames: Number of frames of the whole recording.
        done: Number of frames in the bag.
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
        """Number of frames that this process has recorded."""
        return self.done - self.first

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.new / self.seconds if self.seconds else 0.0


def record(
    recording: SceneRecording,
    folder: Path,
    jobs: int = 1,
    resume: bool = False,
    on_progress: Callable[[RecordingProgress], None] = lambda _: None,
) -> RecordingProgress:
    """Record a scene. The bytes of the bag do not depend on ``jobs``.

    However the recording ends, the bag is readable and has whole frames.

    Args:
        recording: Scene and plan.
        folder: Folder of the bag, which must not exist unless ``resume``.
        jobs: Number of processes that render; with 1, this process does.
        resume: Continue an interrupted recording; nothing happens if it is complete.
        on_progress: Called after each frame; its argument is also the result.

    Raises:
        BagError: The folder exists, or cannot be written or continued; the disk is full.
        WorkerDiedError: A worker process has died.
        HumansimError: A frame cannot be rendered.
    """
    plan = recording.plan
    if resume:
        check_plan(plan, folder)
    elif folder.exists() or folder.is_symlink():
        raise BagError("this path exists; choose another one, or continue with --resume", path=folder)
    with ExitStack() as stack:
        progress = RecordingProgress(0, recording.frames, 0)
        if resume:
            writer = BagWriter.resume(folder, max_size=plan.max_size, max_duration=plan.max_duration)
            stack.enter_context(writer)
            progress.first = progress.done = writer.groups
            if progress.done >= progress.frames:
                return progress
        encoder = _Encoder(recording, min(jobs, progress.frames - progress.first))
        stack.enter_context(encoder)
        if not resume:  # after the start of the encoder: without OpenGL no folder is made
            writer = BagWriter(
                folder,
                recording.topics,
                storage=plan.storage,
                compression=plan.compression,
                max_size=plan.max_size,
                max_duration=plan.max_duration,
                custom=recording.custom,
            )
            stack.enter_context(writer)
        _write(encoder, writer, progress, on_progress)
    return progress


class _Encoder:
    """Encodes frames in this process, or in several others; use it in a ``with`` block."""

    def __init__(self, recording: SceneRecording, jobs: int) -> None:
        self._source = FrameEncoder(recording) if jobs == 1 else Workers(recording, jobs)

    def __enter__(self) -> _Encoder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._source.close()

    @property
    def costs(self) -> dict[str, float]:
        """Seconds of processor time by step."""
        return self._source.costs

    def frames(self, first: int, end: int) -> Iterator[Sequence[Chunk]]:
        """Chunks of the frames from ``first`` up to ``end``, in order; each is valid until the next."""
        if isinstance(self._source, Workers):
            return self._source.frames(first, end)
        return map(self._source.encode, range(first, end))


def _write(
    encoder: _Encoder,
    writer: BagWriter,
    progress: RecordingProgress,
    on_progress: Callable[[RecordingProgress], None],
) -> None:
    """Append the frames that the bag lacks."""
    start, writing = time.monotonic(), 0.0
    for chunks in encoder.frames(progress.first, progress.frames):
        begin = time.process_time()
        for number, chunk in enumerate(chunks, 1):
            writer.append(chunk, ends_group=number == len(chunks))
            progress.size += chunk.size
        writing += time.process_time() - begin
        progress.done += 1
        progress.seconds = time.monotonic() - start
        progress.costs = {**encoder.costs, WRITING: writing}
        on_progress(progress)


def check_plan(plan: RecordingPlan, folder: Path) -> None:
    """Raise BagError unless a bag has a plan, and the same."""
    if not folder.is_dir():
        raise BagError("there is no bag to continue here", path=folder)
    if differences := plan.differences(RecordingPlan.of_bag(folder)):
        raise BagError(f"this bag is another recording: {'; '.join(differences)}", path=folder)
