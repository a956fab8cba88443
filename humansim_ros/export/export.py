"""Export a scene or bag with any number of processes, and continue an interrupted export."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from humansim_ros.bags.chunks import Chunk
from humansim_ros.camera import write_calibration
from humansim_ros.errors import ExportError, HumansimError
from humansim_ros.export.folder import TEMPORARY, ExportFolder, FileEntry
from humansim_ros.export.formats import ExportFormat, needed_channels
from humansim_ros.export.plan import INDEX, ExportPlan
from humansim_ros.export.source import ExportSource
from humansim_ros.export.writer import ExportFrame, ExportSettings, Record, frame_name
from humansim_ros.io.files import read_text
from humansim_ros.record.progress import FrameProgress
from humansim_ros.record.workers import FrameEncoding

#: Largest file that a frame leaves for the files of the whole export, bytes.
_MAX_RECORD = 1 << 30
#: Names of files while :func:`~humansim_ros.io.files.atomic_path` writes them.
_TEMPORARY_NAME = re.compile(r"\..+\.[a-z0-9_]{8}(\.[^.]*)?")
#: Cameras of the scene, in the root of an export.
CALIBRATION = "calibration.yaml"


@dataclass(frozen=True)
class Export:
    """A scene or bag, and the plan of its export to a folder. It can be copied to another process."""

    source: ExportSource
    plan: ExportPlan
    root: Path

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.source, self.plan, self.root)

    @property
    def formats(self) -> Sequence[ExportFormat]:
        """Rows of the formats that are written."""
        return self.source.formats

    @cached_property
    def settings(self) -> ExportSettings:
        """What writers get."""
        plan = self.plan
        return ExportSettings(
            self.source.scene, plan.frames, plan.keypoints, plan.image_suffix, plan.shard_size
        )

    @property
    def cameras(self) -> int:
        """Number of cameras whose images are needed."""
        return len(self.source.scene.cameras) if needed_channels(self.formats) else 0

    def start(self) -> FrameExporter:
        """Load the renderer, or open the bag. Raises HumansimError if this machine cannot do it."""
        return FrameExporter(self)

    def pending(self, resume: bool) -> tuple[Sequence[int] | None, FrameProgress]:
        """Numbers of the frames that are not written, None if the export is complete; and its progress.

        ``resume``: continue the export if it has begun.

        Raises:
            ExportError: The folder exists, or has another export.
        """
        frames, total = self.plan.frames, len(self.plan.frames)
        if not (self.root.exists() or self.root.is_symlink()):
            return frames, FrameProgress(0, total, 0)
        if not resume:
            text = "this path exists; choose another one, or continue with --resume"
            raise ExportError(text, path=self.root)
        if self.plan.check_continues(self.root):
            return None, FrameProgress(total, total, total)
        left = [index for index in frames if not self.finished(index)]
        return left, FrameProgress(total - len(left), total, total - len(left))

    def begin(self) -> None:
        """Make the folder, with the plan. Raises HumansimError if it cannot be made."""
        ExportFolder(self.root).write(INDEX, self.plan.index())

    def finish(self) -> None:
        """Write the files of the whole export; all frames are written. Raises HumansimError."""
        _finish(self)

    def finished(self, index: int) -> bool:
        """Whether a frame and all its files have been written.

        Raises:
            ExportError: Something else is in place of its record, such as a named pipe.
        """
        path = self.root / self.record_path(index)
        if not path.exists():
            return False
        try:
            files: Mapping[str, FileEntry] = self._read(index)["files"]
            return all((self.root / name).stat().st_size == entry["bytes"] for name, entry in files.items())
        except (HumansimError, OSError, ValueError):
            if not path.is_file():
                raise
            return False  # empty or cut after a power cut

    def files(self, index: int) -> dict[str, FileEntry]:
        """Files of a finished frame."""
        files: dict[str, FileEntry] = self._read(index)["files"]
        return files

    def records(self, name: str) -> FrameRecords:
        """What the frames leave for the files of a format."""
        return FrameRecords(self, name)

    def record_path(self, index: int) -> str:
        """File that says that a frame is finished, relative to the root."""
        return f"{TEMPORARY}/{frame_name(index)}.json"

    def _read(self, index: int) -> dict[str, Any]:
        path = self.root / self.record_path(index)
        content: dict[str, Any] = json.loads(read_text(path, ExportError, "record of a frame", _MAX_RECORD))
        return content


@dataclass(frozen=True)
class FrameRecords:
    """Number of each frame, with what it leaves for the files of a format; read from disk each time."""

    export: Export
    name: str

    def __iter__(self) -> Iterator[tuple[int, Record]]:
        for index in self.export.plan.frames:
            yield index, self.export._read(index)["formats"][self.name]


class FrameExporter:
    """Renders or reads frames of an export and writes their files; use it in a ``with`` block.

    Attributes:
        costs: Seconds of processor time by step.
    """

    def __init__(self, export: Export) -> None:
        self._export = export
        self._frames = export.source.open()
        self._writers = {row.name: row.writer(export.settings) for row in export.formats}
        self.costs: dict[str, float] = {}

    def __enter__(self) -> FrameExporter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the renderer, or close the bag."""
        self._frames.close()

    def encode(self, index: int) -> list[Chunk]:
        """Write the files of a frame, at last the one that says that it is finished; there are no chunks.

        Raises:
            HumansimError: The frame cannot be rendered or read, or a file cannot be written.
        """
        start = time.process_time()
        frame = ExportFrame(self._frames.frame(index), self._export.settings)
        start = self._add_cost(self._export.source.step, start)
        folder = ExportFolder(self._export.root)
        records = {}
        for name, writer in self._writers.items():
            records[name] = writer.frame(frame, folder.subfolder(name))
            start = self._add_cost(name, start)
        text = json.dumps({"files": folder.written, "formats": records}, default=_plain)
        ExportFolder(self._export.root).write(self._export.record_path(index), text)
        return []

    def _add_cost(self, step: str, start: float) -> float:
        """Add the processor time since ``start`` to a step; return the time now."""
        now = time.process_time()
        self.costs[step] = self.costs.get(step, 0.0) + now - start
        return now


def _plain(value: Any) -> Any:
    """NumPy arrays and numbers for JSON."""
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

    However the export ends, its files are whole, and finished frames are not written again.

    Args:
        job: Source, plan and folder. The folder must not exist unless ``resume``.
        jobs: Number of processes that render; with 1, this process does.
        resume: Continue the export if it has begun; nothing happens if it is complete.
        on_progress: Called after each frame; its argument is also the result.

    Raises:
        ExportError: The folder exists, or has another export.
        WorkerDiedError: A worker process has died.
        HumansimError: A frame cannot be rendered or read, or a file cannot be written: a full disk.
    """
    pending, progress = job.pending(resume)
    if pending:
        with FrameEncoding(job, min(jobs, len(pending))) as encoding:
            if not job.root.exists():  # after the start of the encoder: without OpenGL no folder is made
                job.begin()
            _write(job, encoding, pending, progress, on_progress)
    if pending is not None:
        job.finish()
    return progress


def _write(
    job: Export,
    encoding: FrameEncoding,
    pending: Sequence[int],
    progress: FrameProgress,
    on_progress: Callable[[FrameProgress], None],
) -> None:
    """Write the frames that the export lacks."""
    start = time.monotonic()
    for index, _ in zip(pending, encoding.frames(pending), strict=True):
        progress.done += 1
        progress.size += sum(entry["bytes"] for entry in job.files(index).values())
        progress.seconds = time.monotonic() - start
        progress.costs = dict(encoding.costs)
        on_progress(progress)


def _remove_temporary_files(root: Path, files: Collection[str]) -> None:
    """Remove files that processes were writing when they were killed. ``files``: those of the export."""
    for folder, _, names in os.walk(root):
        for name in names:
            path = Path(folder) / name
            if _TEMPORARY_NAME.fullmatch(name) and path.relative_to(root).as_posix() not in files:
                path.unlink(missing_ok=True)


def _finish(job: Export) -> None:
    """Write the files of the whole export, then the index, and remove the records of the frames."""
    folder, scene = ExportFolder(job.root), job.source.scene
    if scene.cameras:
        with folder.path(CALIBRATION) as path:
            write_calibration(path, {name: each.camera for name, each in scene.cameras.items()}, "scene")
    for row in job.formats:
        row.writer(job.settings).finish(job.records(row.name), folder.subfolder(row.name))
    files = dict(folder.written)
    for index in job.plan.frames:
        files |= job.files(index)
    _remove_temporary_files(job.root, files)
    ExportFolder(job.root).write(
        INDEX,
        job.plan.index(
            finished=True,
            provenance=job.source.provenance(job.plan.frames),
            rate=scene.rate,
            humans=scene.people,
            objects=list(scene.objects),
            cameras={name: list(each.camera.size) for name, each in scene.cameras.items()},
            files={name: files[name] for name in sorted(files) if not name.startswith(f"{TEMPORARY}/")},
        ),
    )
    with suppress(OSError):  # the index is complete: nothing reads them again
        shutil.rmtree(job.root / TEMPORARY)
