"""Export a scene or bag with any number of processes, and continue an interrupted export."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.formats import write_calibration
from humansim_ros.data.engine.frame_job import Costs, FrameProgress, FrameResult, FrameWorker
from humansim_ros.data.engine.ray_cluster import (
    PART_FRAMES,
    ClusterPart,
    PartResult,
    connected,
    missing_text,
    run_parts,
)
from humansim_ros.data.engine.workers import run_frames
from humansim_ros.data.formats.formats import ExportFormat, needed_channels
from humansim_ros.data.formats.plan import INDEX, ExportPlan, read_index
from humansim_ros.data.formats.source import ExportSource
from humansim_ros.data.formats.writer import (
    TEMPORARY,
    ExportFolder,
    ExportFrame,
    ExportSettings,
    FileEntry,
    Record,
    frame_name,
)
from humansim_ros.errors import ExportError, HumansimError
from humansim_ros.files.reading import read_json

#: Largest record of a frame, bytes. A record is the data of a frame that the files of the whole export need.
_MAX_RECORD = 1 << 30
#: Names that files have while :func:`~humansim_ros.files.reading.files.atomic_path` writes them.
_TEMPORARY_NAME = re.compile(r"\..+\.[a-z0-9_]{8}(\.[^.]*)?")
#: Name of the file with the cameras of the scene, in the root of an export.
CALIBRATION = "calibration.yaml"


@dataclass(frozen=True)
class WrittenFiles:
    """Files that were written for some frames, by path."""

    files: Mapping[str, FileEntry]

    @property
    def size(self) -> int:
        """Total size of the files, bytes."""
        return sum(entry["bytes"] for entry in self.files.values())


@dataclass(frozen=True)
class Export:
    """Job that exports a scene or bag to a folder according to a plan. It can be copied to other processes.

    ``texts``: content of further text files in the folder, by name.
    """

    source: ExportSource
    plan: ExportPlan
    root: Path
    texts: Mapping[str, str] = field(default_factory=dict)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.source, self.plan, self.root, self.texts)

    @property
    def formats(self) -> Sequence[ExportFormat]:
        """The formats that are written."""
        return self.source.formats

    @cached_property
    def settings(self) -> ExportSettings:
        """Settings for the writers of formats."""
        plan = self.plan
        return ExportSettings(
            self.source.scene, plan.frames, plan.keypoints, plan.image_suffix, plan.shard_size, plan.license
        )

    @property
    def cameras(self) -> int:
        """Number of cameras with images that the formats need."""
        return len(self.source.scene.cameras) if needed_channels(self.formats) else 0

    def start(self) -> ExportWorker:
        """Load the renderer, or open the bag. Raises HumansimError if this machine cannot do it."""
        return ExportWorker(self)

    @property
    def key(self) -> str:
        """Key that is equal for two exports if they write the same files to the same folder."""
        return f"{self.root} {self.plan.index()}"

    def write_part(self, worker: FrameWorker, part: ClusterPart) -> PartResult:
        """Write those frames of a part that are not finished. This method runs in a task of a cluster.

        Raises:
            HumansimError: The host of the task does not share the folder, or cannot write a file or make a
                frame.
        """
        if not (self.root / INDEX).exists():
            text = "does not have this folder: export to one that all hosts share"
            raise ExportError(f"host {socket.gethostname()} {text}", path=self.root)
        files: dict[str, FileEntry] = {}
        for index in part.frames:
            written = self.files_of(index)  # of an attempt before
            files |= worker.work(index).value if written is None else written
        return WrittenFiles(files)

    def files_of(self, index: int) -> Mapping[str, FileEntry] | None:
        """Files of a frame; None if some of them have not been written.

        Raises:
            ExportError: The record is no regular file, but for example a named pipe.
        """
        path = self.root / self.record_path(index)
        if not path.exists():
            return None
        try:
            files: Mapping[str, FileEntry] = self._read(index)["files"]
            whole = all((self.root / name).stat().st_size == entry["bytes"] for name, entry in files.items())
            return files if whole else None
        except (HumansimError, OSError, ValueError):
            if not path.is_file():
                raise
            return None  # empty or cut after a power cut

    def record_path(self, index: int) -> str:
        """Path of the file that marks a frame as finished, relative to the root."""
        return f"{TEMPORARY}/{frame_name(index)}.json"

    def _read(self, index: int) -> dict[str, Any]:
        path = self.root / self.record_path(index)
        content: dict[str, Any] = read_json(path, ExportError, "record of a frame", _MAX_RECORD)
        return content


@dataclass(frozen=True)
class FrameRecords:
    """Pairs of frame number and record of the frame for one format. Each iteration reads the records from
    disk."""

    export: Export
    name: str

    def __iter__(self) -> Iterator[tuple[int, Record]]:
        for index in self.export.plan.frames:
            yield index, self.export._read(index)["formats"][self.name]


class ExportWorker:
    """Renders or reads frames of an export and writes their files.

    Attributes:
        costs: Seconds of processor time by step.
    """

    def __init__(self, export: Export) -> None:
        self._export = export
        self._frames = export.source.open()
        self._writers = {row.name: row.writer(export.settings) for row in export.formats}
        self.costs = Costs()

    def close(self) -> None:
        """Free the renderer, or close the bag."""
        self._frames.close()

    def work(self, index: int) -> FrameResult:
        """Write the files of a frame, then the file that marks the frame as finished. Returns the files.

        Raises:
            HumansimError: The frame cannot be rendered or read, or a file cannot be written.
        """
        start = time.process_time()
        frame = ExportFrame(self._frames.frame(index), self._export.settings)
        start = self.costs.add(self._export.source.step, start)
        folder = ExportFolder(self._export.root)
        records = {}
        for name, writer in self._writers.items():
            records[name] = writer.frame(frame, folder.subfolder(name))
            start = self.costs.add(name, start)
        text = json.dumps({"files": folder.written, "formats": records}, default=_plain)
        ExportFolder(self._export.root).write(self._export.record_path(index), text)
        return FrameResult(folder.written)


def _plain(value: Any) -> Any:
    """Convert NumPy arrays and numbers to values for JSON."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"a record holds no {type(value).__name__}")


def export(
    job: Export,
    jobs: int = 1,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> FrameProgress:
    """Export a scene or bag. The files do not depend on ``jobs``, nor on interruptions.

    After an interruption all files are complete, and a continued export does not write finished frames again.

    Args:
        job: Source, plan and folder. The folder must not exist unless ``resume``.
        jobs: Number of processes that render. If 1, this process renders.
        resume: Whether to continue an export that has begun. A complete export stays unchanged.
        on_progress: Called after each frame. Its argument is also the result.

    Raises:
        ExportError: The folder exists and ``resume`` is not set, or has another export.
        WorkerDiedError: A worker process has died.
        HumansimError: A frame cannot be rendered or read, or a file cannot be written, for example on a full
            disk.
    """
    frames, files = _unwritten(job, resume)
    progress = FrameProgress.of(len(job.plan.frames), len(frames))

    def take(_: int, result: FrameResult) -> int:
        written = WrittenFiles(result.value)
        files.update(written.files)
        return written.size

    if frames:
        run_frames(job, frames, jobs, progress, take, begin=lambda: _begin(job), on_progress=on_progress)
    _finish(job, files)
    return progress


def export_on_cluster(
    job: Export,
    address: str,
    *,
    workers: int | None = None,
    shard_frames: int = PART_FRAMES,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> FrameProgress:
    """Export a scene or bag on a Ray cluster. The files do not depend on the number of workers.

    Args:
        job: Source, plan and folder. The folder has an absolute path that all hosts share.
        address: ``local`` starts Ray on this machine; ``auto``, ``host:port`` and ``ray://host:port`` name a
            cluster.
        workers: Number of workers of ``local``. If None, one for each core.
        shard_frames: Number of frames of a task.
        resume: Whether to continue an export that has begun.
        on_progress: Called after each task. Its argument is also the result.

    Raises:
        ExportError: The folder exists, or has another export; or frames could not be written. The message
            lists them. Finished frames stay for ``resume``.
        BagError: Ray is missing or cannot be reached.
    """
    frames, files = _unwritten(job, resume)
    progress = FrameProgress.of(len(job.plan.frames), len(frames))
    parts = [_part(frames[start : start + shard_frames]) for start in range(0, len(frames), shard_frames)]
    if parts:
        with connected(address, workers) as ray:
            _begin(job)
            results, failures = run_parts(ray, [(job, parts)], progress, on_progress)
        if text := missing_text([(job, parts)], results, failures, "parts", "writes"):
            raise ExportError(text, path=job.root)
        for result in results.values():
            assert isinstance(result, WrittenFiles)
            files.update(result.files)
    _finish(job, files)
    return progress


def _part(frames: Sequence[int]) -> ClusterPart:
    text = f"frames {frames[0]} to {frames[-1]}"
    return ClusterPart(text, text, tuple(frames), len(frames))


def _unwritten(job: Export, resume: bool) -> tuple[Sequence[int], dict[str, FileEntry]]:
    """Numbers of the frames that are not written yet, and the files of the other frames.

    ``resume``: whether to continue an export that has begun.

    Raises:
        ExportError: The folder exists, or has another export.
    """
    frames, files = job.plan.frames, dict[str, FileEntry]()
    if not (job.root.exists() or job.root.is_symlink()):
        return frames, files
    if not resume:
        raise ExportError("this path exists; choose another one, or continue with --resume", path=job.root)
    if job.plan.check_continues(job.root):
        return (), files
    left = []
    for index in frames:
        written = job.files_of(index)
        if written is None:
            left.append(index)
        else:
            files |= written
    return left, files


def _begin(job: Export) -> None:
    """Make the folder, with the plan of the export. Raises HumansimError if that fails."""
    if not job.root.exists():
        ExportFolder(job.root).write(INDEX, job.plan.index())


def _remove_temporary_files(root: Path, files: Collection[str]) -> None:
    """Remove incomplete files that killed processes have left. ``files``: files of the export, which stay."""
    for folder, _, names in os.walk(root):
        for name in names:
            path = Path(folder) / name
            if _TEMPORARY_NAME.fullmatch(name) and path.relative_to(root).as_posix() not in files:
                path.unlink(missing_ok=True)


def _finish(job: Export, files_of_frames: dict[str, FileEntry]) -> None:
    """Write the files of the whole export, then the index, and remove the records of the frames."""
    if read_index(job.root)["finished"]:
        return
    folder, scene = ExportFolder(job.root), job.source.scene
    if scene.cameras:
        with folder.path(CALIBRATION) as path:
            write_calibration(path, {name: each.camera for name, each in scene.cameras.items()}, "scene")
    for name, text in job.texts.items():
        folder.write(name, text)
    for row in job.formats:
        row.writer(job.settings).finish(FrameRecords(job, row.name), folder.subfolder(row.name))
    files = folder.written | files_of_frames
    _remove_temporary_files(job.root, files)
    ExportFolder(job.root).write(
        INDEX,
        job.plan.index(
            finished=True,
            provenance=job.source.provenance(job.plan.frames),
            rate=scene.rate,
            humans=scene.people,
            **({"license": job.plan.license} if job.plan.license else {}),
            licenses=dict(scene.licenses),
            objects=list(scene.objects),
            cameras={name: list(each.camera.size) for name, each in scene.cameras.items()},
            files={name: files[name] for name in sorted(files) if not name.startswith(f"{TEMPORARY}/")},
        ),
    )
    with suppress(OSError):  # the index is complete: nothing reads them again
        shutil.rmtree(job.root / TEMPORARY)
