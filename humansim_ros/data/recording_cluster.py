"""Record on a Ray cluster: tasks write shards, and the command writes the index of the bag.

A shard is a range of frames. The division into shards depends only on the recording, never on the number of
machines. A worker writes its shard to a temporary folder, and moves it to the output when it is complete.
``metadata.yaml`` appears last, since a folder without it is no bag.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from humansim_ros import __version__
from humansim_ros.data.bags.metadata import NAME as METADATA
from humansim_ros.data.bags.metadata import Content, metadata_text
from humansim_ros.data.engine.frame_job import FrameProgress, FrameWorker
from humansim_ros.data.engine.output import OutputFolder
from humansim_ros.data.engine.ray_cluster import (
    PART_FRAMES,
    ClusterPart,
    PartResult,
    connected,
    missing_text,
    run_parts,
)
from humansim_ros.data.recording import FrameChunks, SceneRecording
from humansim_ros.errors import BagError
from humansim_ros.files.reading import temporary_folder

#: Name of a file in the folder of an incomplete bag, which states what is being recorded.
_PLAN = "recording.json"


@dataclass(frozen=True)
class ShardResult:
    """A shard that a task has written: its content and its size in bytes."""

    content: Content
    size: int


@dataclass(frozen=True)
class ClusterRecording:
    """Job that records a bag on a cluster. Each shard becomes one file of the bag.

    Attributes:
        recording: Scene and plan of the recording.
        output: Folder of the bag, which also gives the bag its name.
        shard_frames: Number of frames of a shard. The last shard may have fewer.
    """

    recording: SceneRecording
    output: OutputFolder
    shard_frames: int = PART_FRAMES

    @property
    def shards(self) -> list[ClusterPart]:
        """Shards in the order of their frames."""
        cameras, count = ", ".join(self.recording.cameras), self.recording.frames
        shards = []
        for number, first in enumerate(range(0, count, self.shard_frames)):
            frames = range(first, min(first + self.shard_frames, count))
            name = f"{self.output.name}_{number}.mcap"
            text = f"{name} (frames {first} to {frames[-1]} of {cameras})"
            size = len(frames) * max(1, len(self.recording.cameras))
            shards.append(ClusterPart(name, text, frames, size, self.output.url))
        return shards

    @property
    def plan(self) -> str:
        """Text that determines which files the folder will have, and their content."""
        places = [(self.output.name, shard.name) for shard in self.shards]
        return json.dumps({"version": __version__, "custom": dict(self.recording.custom), "shards": places})

    @property
    def key(self) -> str:
        """Key that is equal for recordings with the same content."""
        return json.dumps(dict(self.recording.custom))

    def start(self) -> FrameWorker:
        """Start a worker of the recording."""
        return self.recording.start()

    def write_part(self, worker: FrameWorker, part: ClusterPart) -> PartResult:
        """Write a shard and move it to the output. This method runs in a task.

        Raises:
            HumansimError: A disk is full, or the host of the task cannot render a frame.
        """
        from humansim_ros.data.bags.mcap_file import McapFile

        with temporary_folder() as folder:
            path = folder / part.name
            try:
                file = McapFile.create(path, self.recording.topics)
                chunks = FrameChunks(self.recording.plan.compression)
                try:
                    for index in part.frames:
                        group = chunks.of(worker.work(index))
                        for position, chunk in enumerate(group, 1):
                            file.append(chunk, index, position == len(group))
                    file.finish()
                finally:
                    file.close()
            except OSError as reason:
                text = f"{reason.strerror or reason} on host {socket.gethostname()}"
                text += "; TMPDIR of its Ray can name a larger disk"
                raise BagError(text, path=folder.parent) from None
            self.output.put(path, part.name)
            return ShardResult(file.content, file.size)


def cluster_recordings(
    scenes: Mapping[str, SceneRecording], output: str, shard_frames: int = PART_FRAMES
) -> list[ClusterRecording]:
    """Create the jobs that record scenes on a cluster.

    Args:
        scenes: Recordings by the name of their folder in ``output``. "" is ``output`` itself.
        output: Absolute path or URL.
        shard_frames: Number of frames of a shard.

    Raises:
        BagError: A plan has options that a cluster does not support.
    """
    recordings = []
    for name, scene in scenes.items():
        plan, folder = scene.plan, OutputFolder(output)
        if plan.storage != "mcap":
            raise BagError("shards are MCAP files", key="--storage")
        if plan.max_size or plan.max_duration:
            message = "each shard is a file: choose --shard-frames"
            raise BagError(message, key="--max-bag-size" if plan.max_size else "--max-bag-duration")
        recordings.append(ClusterRecording(scene, folder.folder(name) if name else folder, shard_frames))
    return recordings


def record_on_cluster(
    recordings: Sequence[ClusterRecording],
    address: str,
    *,
    workers: int | None = None,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> FrameProgress:
    """Record bags on a Ray cluster. The bags do not depend on the number of workers.

    Args:
        recordings: Bags to record.
        address: ``local`` starts Ray on this machine. ``auto``, ``host:port`` and ``ray://host:port`` name a
            cluster.
        workers: Number of workers of ``local``. If None, one for each core.
        resume: Whether to continue, and record only shards that are missing in the outputs.
        on_progress: Called after each shard with the progress, in camera-frames. The last progress is also
            the result.

    Raises:
        BagError: Ray is missing or cannot be reached; an output exists, or holds another recording; or shards
            could not be written. The message lists these. Complete shards stay for ``resume``.
    """
    work = [(recording, _unwritten(recording, resume)) for recording in recordings]
    progress = FrameProgress.of(
        sum(shard.size for recording in recordings for shard in recording.shards),
        sum(shard.size for _, shards in work for shard in shards),
    )
    with connected(address, workers) as ray:
        for recording in recordings:
            _begin(recording)
        results, failures = run_parts(ray, work, progress, on_progress)
    for recording, shards in work:
        if results.keys() >= set(shards):
            _finish(recording, results)
    if text := missing_text(work, results, failures, "shards", "records"):
        folder = next(recording.output for recording, shards in work if not results.keys() >= set(shards))
        raise BagError(text, path=folder.url)
    return progress


def _unwritten(recording: ClusterRecording, resume: bool) -> list[ClusterPart]:
    """Shards that an output lacks. Raises BagError if the output exists and must not be continued."""
    output, shards = recording.output, recording.shards
    found = output.names()
    if not resume:
        if _PLAN in found:
            raise BagError("a recording has begun here; --resume completes it", path=output.url)
        if found or (output.local is not None and output.local.exists()):
            raise BagError("this path exists; choose another name for the bag", path=output.url)
        return shards
    if _PLAN not in found:
        if found:
            return []
        raise BagError("there is no recording to resume here", path=output.url)
    if output.read(_PLAN).decode() != recording.plan:
        message = (
            "another recording has begun here: scene, options or version differ; --resume needs the same"
        )
        raise BagError(message, path=output.url)
    return [shard for shard in shards if shard.name not in found]


def _begin(recording: ClusterRecording) -> None:
    """Create the folder of the shards, with a file that states the plan."""
    if METADATA not in recording.output.names():
        recording.output.create()
        recording.output.write(_PLAN, recording.plan.encode())


def _finish(recording: ClusterRecording, results: Mapping[ClusterPart, PartResult]) -> None:
    """Complete the bag of a recording, if all its shards are written: write the metadata."""
    output, recipe = recording.output, recording.recording
    if _PLAN not in output.names():
        return  # it was complete before
    files = [(shard.name, _content(output, shard, results)) for shard in recording.shards]
    output.write(METADATA, metadata_text("mcap", recipe.topics, files, recipe.custom).encode())
    output.remove(_PLAN)


def _content(output: OutputFolder, shard: ClusterPart, results: Mapping[ClusterPart, PartResult]) -> Content:
    """Numbers and times of the messages in a shard that this run or an earlier run has written."""
    from humansim_ros.data.bags.mcap_file import content_in

    if isinstance(result := results.get(shard), ShardResult):
        return result.content
    with output.open(shard.name) as file:
        return content_in(file, Path(shard.name))
