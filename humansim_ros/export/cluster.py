"""Export on a Ray cluster: each task writes some frames to a folder that all hosts share."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

from humansim_ros import __version__
from humansim_ros.errors import ExportError
from humansim_ros.export.export import Export, FrameExporter
from humansim_ros.export.plan import INDEX
from humansim_ros.record.cluster import connected, missing_text, prepare_worker, run_tasks
from humansim_ros.record.progress import FrameProgress


@dataclass(frozen=True)
class _Frames:
    """Frames that a task writes, and the version of the package."""

    indices: tuple[int, ...]
    version: str = __version__

    def __str__(self) -> str:
        return f"frames {self.indices[0]} to {self.indices[-1]}"


@dataclass(frozen=True)
class _Job:
    """An export, by which its exporter is found again."""

    key: str
    export: Export = field(compare=False)


@lru_cache(maxsize=1)
def _exporter(job: _Job) -> FrameExporter:
    """Exporter that stays for the next task: a renderer takes seconds to draw what does not move."""
    return job.export.start()


def write_frames(export: Export, frames: _Frames) -> int:
    """Write frames that are not finished; returns their bytes. This runs in a worker.

    Raises:
        HumansimError: The worker has another version of the package or does not share the folder, a file
            cannot be written, or a frame cannot be rendered or read there.
    """
    prepare_worker(frames.version)
    host = socket.gethostname()
    if not (export.root / INDEX).exists():
        text = f"host {host} does not have this folder: export to one that all hosts share"
        raise ExportError(text, path=export.root)
    try:
        exporter = _exporter(_Job(f"{export.root} {export.plan.index()}", export))
        for index in frames.indices:
            if not export.finished(index):  # an attempt before may have written it
                exporter.encode(index)
    except BaseException:
        _exporter.cache_clear()  # it may be broken: the next attempt starts from the beginning
        raise
    return sum(entry["bytes"] for index in frames.indices for entry in export.files(index).values())


def export_on_cluster(
    job: Export,
    address: str,
    *,
    workers: int | None = None,
    shard_frames: int = 100,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> FrameProgress:
    """Export a scene or bag on a Ray cluster. The files do not depend on the number of workers.

    Args:
        job: Source, plan and folder, which has an absolute path that all hosts share.
        address: ``local`` starts Ray on this machine; ``auto``, ``host:port`` and ``ray://host:port`` name a
            cluster.
        workers: Number of workers of ``local``; one for each core if None.
        shard_frames: Frames of a task.
        resume: Continue the export if it has begun.
        on_progress: Called after each task; its argument is also the result.

    Raises:
        ExportError: The folder exists, or has another export; or frames could not be written, which the
            message lists. Those that are whole stay for ``resume``.
        BagError: Ray is missing or cannot be reached.
    """
    pending, progress = job.pending(resume)
    failures: list[str] = []
    if pending:
        parts = range(0, len(pending), shard_frames)
        tasks = [_Frames(tuple(pending[start : start + shard_frames])) for start in parts]
        left = {str(task): task for task in tasks}
        with connected(address, workers) as ray:
            if not job.root.exists():
                job.begin()
            start = time.monotonic()

            def add(task: _Frames, size: int) -> None:
                del left[str(task)]
                progress.done += len(task.indices)
                progress.size += size
                progress.seconds = time.monotonic() - start
                on_progress(progress)

            export = ray.put(job)  # once for all tasks
            failures = run_tasks(ray, write_frames, [(export, task) for task in tasks], add)
        if failures:
            raise ExportError(missing_text(list(left), failures, "parts", "writes"), path=job.root)
    if pending is not None:
        job.finish()
    return progress
