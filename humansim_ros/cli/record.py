"""``humansim record``: record a scene into a bag of rosbag2, without nodes."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from humansim_ros.cli.options import JobsOption, RayOption, ResumeOption, TopicsOption, argument, option
from humansim_ros.cli.output import costs_text, frame_progress, print_text, rate_text, run_frames_shown
from humansim_ros.cli.scene import warn_about_mistakes
from humansim_ros.data.engine import PART_FRAMES
from humansim_ros.errors import MAX_FRAMES, BagError
from humansim_ros.ros.processes import Stopped

if TYPE_CHECKING:
    from humansim_ros.data import ClusterRecording, SceneRecording
    from humansim_ros.data.engine import FrameProgress


class _Storage(str, Enum):
    mcap = "mcap"
    sqlite3 = "sqlite3"


class _Compression(str, Enum):
    none = "none"
    zstd = "zstd"
    lz4 = "lz4"


class _Images(str, Enum):
    raw = "raw"
    jpeg = "jpeg"
    png = "png"


class _Lossless(str, Enum):
    raw = "raw"
    png = "png"


def record(
    output: Annotated[str, option("record.output")],
    scene: Annotated[list[Path] | None, argument("record.scene")] = None,
    frames: Annotated[int | None, option("record.frames", max=MAX_FRAMES)] = None,
    seconds: Annotated[float | None, option("record.seconds")] = None,
    topics: TopicsOption = None,
    jobs: JobsOption = None,
    storage: Annotated[_Storage, option("record.storage")] = _Storage.mcap,
    compression: Annotated[_Compression, option("record.compression")] = _Compression.none,
    images: Annotated[_Images, option("record.images")] = _Images.raw,
    depth: Annotated[_Lossless, option("record.depth")] = _Lossless.raw,
    labels: Annotated[_Lossless, option("record.labels")] = _Lossless.raw,
    max_bag_size: Annotated[int, option("record.max_bag_size")] = 0,
    max_bag_duration: Annotated[float, option("record.max_bag_duration")] = 0.0,
    resume: ResumeOption = False,
    ray: RayOption = None,
    shard_frames: Annotated[int, option("record.shard_frames")] = PART_FRAMES,
) -> None:
    """Record a scene into a bag of rosbag2, frame by frame, without nodes: no frame is lost."""
    from humansim_ros.data import SceneRecording, cluster_recordings
    from humansim_ros.data.engine import is_url
    from humansim_ros.files.reading import cores
    from humansim_ros.scene.core import Scene

    if (frames is None) == (seconds is None):
        raise BagError("give either --frames or --seconds", key="record")
    if ray is None and (is_url(output) or (scene and len(scene) > 1)):
        raise BagError("URLs and several scenes need --ray, such as --ray local", key="record")

    def planned(path: Path | None) -> SceneRecording:
        loaded = Scene.load(path)
        warn_about_mistakes(loaded)
        return SceneRecording.of(
            loaded,
            frames or max(1, round((seconds or 0.0) * loaded.config.rate)),
            topics or (),
            images=images.value,
            depth=depth.value,
            labels=labels.value,
            storage=storage.value,
            compression=compression.value,
            max_size=max_bag_size,
            max_duration=max_bag_duration,
            jobs=processes,
        )

    processes = jobs or cores()
    if ray is None:
        _record_here(planned(scene[0] if scene else None), Path(output), processes, resume)
        return
    paths: list[Path | None] = list(scene) if scene else [None]
    names = [path.stem if path and len(paths) > 1 else "" for path in paths]
    if len(set(names)) < len(names):
        raise BagError("scenes need different file names, which become folders of the output", key="record")
    recordings = cluster_recordings(
        dict(zip(names, map(planned, paths), strict=True)),
        output if is_url(output) else str(Path(output).resolve()),
        shard_frames,
    )
    _record_on_ray(recordings, output, ray, jobs, resume)


def _record_here(recording: SceneRecording, output: Path, jobs: int, resume: bool) -> None:
    """Record with several processes on this machine."""
    from humansim_ros.data import record

    cameras = len({topic.camera for topic in recording.table if topic.camera and topic.per_frame})

    def interrupted(done: int) -> str:
        how = "the same command with --resume continues" if output.exists() else "nothing was recorded"
        return f"{output}: {done} of {recording.frames} frames are in the bag; {how}"

    state = run_frames_shown(
        "recording", cameras, lambda show: record(recording, output, jobs, resume, show), interrupted
    )
    print_text(_summary(state, cameras, output))


def _record_on_ray(
    recordings: Sequence[ClusterRecording], output: str, address: str, jobs: int | None, resume: bool
) -> None:
    """Record with the workers of a Ray cluster."""
    from humansim_ros.data import record_on_cluster

    # its numbers count camera-frames
    with frame_progress("recording", 1, "camera-frames") as display:
        try:
            state = record_on_cluster(recordings, address, workers=jobs, resume=resume, on_progress=display)
        except Stopped:
            print_text(f"stopped; the same command with --resume records what is missing in {output}")
            raise
    if not state.new:
        print_text(f"{output}: nothing is missing")
        return
    bags = f"{len(recordings)} bags in " if len(recordings) > 1 else ""
    each = f"{state.size / state.new:.0f} bytes per camera-frame"
    print_text(f"wrote {bags}{output}: {state.new} camera-frames, {rate_text(state, 1)}, {each}")


def _summary(progress: FrameProgress, cameras: int, output: Path) -> str:
    """Text after a recording: rate, size, and the processor time of each step."""
    if not progress.new:
        return f"{output}: all {progress.frames} frames are in the bag already"
    units = progress.new * max(cameras, 1)
    unit = "camera-frame" if cameras else "frame"
    return (
        f"wrote {output}: {progress.done} frames, {rate_text(progress, cameras)}, "
        f"{progress.size / units:.0f} bytes per {unit}\n"
        f"{costs_text(progress, cameras, 2)}"
    )
