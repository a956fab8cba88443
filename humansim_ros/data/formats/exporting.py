"""Export of a scene or bag: the plan for the engine, and the worker that writes its shards."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.formats import write_calibration
from humansim_ros.data.engine import (
    TEMPORARY,
    Costs,
    Done,
    OutputFolder,
    WorkPlan,
    WorkShard,
    Written,
    shards_of,
)
from humansim_ros.data.formats.formats import ExportFormat, needed_channels
from humansim_ros.data.formats.plan import INDEX, ExportPlan, read_index
from humansim_ros.data.formats.source import ExportSource
from humansim_ros.data.formats.writer import (
    ExportFolder,
    ExportFrame,
    ExportSettings,
    FileEntry,
    Record,
)
from humansim_ros.errors import ExportError

#: Name of the file with the cameras of the scene, in the root of an export.
CALIBRATION = "calibration.yaml"


@dataclass(frozen=True)
class Export(WorkPlan):
    """Plan to export a scene or bag. It can be copied to other processes.

    Attributes:
        source: Scene or bag, with the formats.
        plan: Everything that determines the files.
        texts: Content of further text files in the folder, by name.
        shard_frames: Number of frames of a shard. If None, it follows from the number of frames.
    """

    source: ExportSource
    plan: ExportPlan
    texts: Mapping[str, str] = field(default_factory=dict)
    shard_frames: int | None = None
    what = "export"
    error = ExportError

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.source, self.plan, self.texts, self.shard_frames)

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
    def views(self) -> int:
        """Number of cameras with images that the formats need."""
        return len(self.source.scene.cameras) if needed_channels(self.formats) else 0

    @property
    def device(self) -> str:  # type: ignore[override]
        """Device that renders. Empty if nothing is rendered."""
        return self.plan.device

    @property
    def key(self) -> Mapping[str, Any]:
        """JSON values that are equal for exports with the same files."""
        return asdict(self.plan)

    @cached_property
    def shards(self) -> Sequence[WorkShard]:
        """Shards of consecutive frames."""
        return shards_of(self.plan.frames, self.shard_frames)

    def open(self) -> ExportWorker:
        """Load the renderer, or open the bag. Raises HumansimError if this machine cannot do it."""
        return ExportWorker(self)

    def finished(self, folder: OutputFolder) -> tuple[Mapping[str, Any], Collection[int]] | None:
        """Key and shards of a finished export. Raises ExportError if the folder has no export."""
        if folder.local is None or folder.size(INDEX) is None:
            return None
        index = read_index(folder.local)
        if not index["finished"] or not isinstance(index.get("plan"), dict):
            text = "this export was begun by an older version: it cannot be continued"
            raise ExportError(text, path=folder.url)
        return index["plan"], [shard.number for shard in self.shards]

    def finish(self, done: Collection[Done], folder: OutputFolder) -> None:
        """Write the files of the whole export, then the index."""
        assert folder.local is not None
        root, scene = ExportFolder(folder.local), self.source.scene
        if scene.cameras:
            with root.path(CALIBRATION) as path:
                write_calibration(path, {name: each.camera for name, each in scene.cameras.items()}, "scene")
        for name, text in self.texts.items():
            root.write(name, text)
        for row in self.formats:
            row.writer(self.settings).finish(FrameRecords(done, row.name), root.subfolder(row.name))
        files = {name: entry for each in done for name, entry in each.rows["files"].items()} | root.written
        root.write(
            INDEX,
            self.plan.index(
                finished=True,
                provenance=self.source.provenance(self.plan.frames),
                rate=scene.rate,
                humans=scene.people,
                **({"license": self.plan.license} if self.plan.license else {}),
                licenses=dict(scene.licenses),
                objects=list(scene.objects),
                cameras={name: list(each.camera.size) for name, each in scene.cameras.items()},
                files={name: files[name] for name in sorted(files) if not name.startswith(f"{TEMPORARY}/")},
            ),
        )


@dataclass(frozen=True)
class FrameRecords:
    """Pairs of frame number and record of the frame for one format."""

    done: Collection[Done]
    name: str

    def __iter__(self) -> Iterator[tuple[int, Record]]:
        for each in self.done:
            for index, records in each.rows["frames"]:
                yield index, records[self.name]


class ExportWorker:
    """Renders or reads frames of an export and writes their files.

    Attributes:
        device: Device that renders. Empty if nothing is rendered.
        costs: Seconds of processor time by step.
    """

    def __init__(self, export: Export) -> None:
        self._export = export
        self._frames = export.source.open()
        self.device = self._frames.device
        self._writers = {row.name: row.writer(export.settings) for row in export.formats}
        self.costs = Costs()

    def close(self) -> None:
        """Free the renderer, or close the bag."""
        self._frames.close()

    def write(self, shard: WorkShard, folder: Path, tick: Callable[[], None]) -> Written:
        """Write the files of some frames. The rows have hashes and sizes of the files, and for each frame the
        records of the formats.

        Raises:
            HumansimError: A frame cannot be rendered or read, or a file cannot be written.
        """
        files: dict[str, FileEntry] = {}
        frames = []
        for index in shard.items:
            start = time.process_time()
            frame = ExportFrame(self._frames.frame(index), self._export.settings)
            start = self.costs.add(self._export.source.step, start)
            root = ExportFolder(folder)
            records = {}
            for name, writer in self._writers.items():
                records[name] = writer.frame(frame, root.subfolder(name))
                start = self.costs.add(name, start)
            files |= root.written
            frames.append([index, records])
            tick()
        return Written(json.loads(json.dumps({"files": files, "frames": frames}, default=_plain)))


def _plain(value: Any) -> Any:
    """Convert NumPy arrays and numbers to values for JSON."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"a record holds no {type(value).__name__}")
