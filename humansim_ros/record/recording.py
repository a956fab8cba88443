"""Record a scene into a bag, with any number of processes, and continue an interrupted recording."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from humansim_ros.bags.writer import BagWriter
from humansim_ros.errors import BagError
from humansim_ros.record.frame_chunks import SceneRecording
from humansim_ros.record.plan import RecordingPlan
from humansim_ros.record.progress import FrameProgress
from humansim_ros.record.workers import FrameEncoding

#: Step of giving the bytes to the system.
WRITING = "writing"


def record(
    recording: SceneRecording,
    folder: Path,
    jobs: int = 1,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> FrameProgress:
    """Record a scene. The bytes of the bag do not depend on ``jobs``.

    However the recording ends, the bag is readable and has whole frames.

    Args:
        recording: Scene and plan.
        folder: Folder of the bag, which must not exist unless ``resume``.
        jobs: Number of processes that render; with 1, this process does.
        resume: Continue the recording if it has begun; nothing happens if it is complete.
        on_progress: Called after each frame; its argument is also the result.

    Raises:
        BagError: The folder exists, or cannot be written or continued; the disk is full.
        WorkerDiedError: A worker process has died.
        HumansimError: A frame cannot be rendered.
    """
    plan = recording.plan
    begun = folder.exists() or folder.is_symlink()
    if resume and begun:
        check_plan(plan, folder)
    elif begun:
        raise BagError("this path exists; choose another one, or continue with --resume", path=folder)
    with ExitStack() as stack:
        progress = FrameProgress(0, recording.frames, 0)
        if begun:
            writer = BagWriter.resume(folder, max_size=plan.max_size, max_duration=plan.max_duration)
            stack.enter_context(writer)
            progress.first = progress.done = writer.groups
            if progress.done >= progress.frames:
                return progress
        encoder = FrameEncoding(recording, min(jobs, progress.frames - progress.first))
        stack.enter_context(encoder)
        if not begun:  # after the start of the encoder: without OpenGL no folder is made
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


def _write(
    encoder: FrameEncoding,
    writer: BagWriter,
    progress: FrameProgress,
    on_progress: Callable[[FrameProgress], None],
) -> None:
    """Append the frames that the bag lacks."""
    start, writing = time.monotonic(), 0.0
    for chunks in encoder.frames(range(progress.first, progress.frames)):
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
