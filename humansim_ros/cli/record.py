"""``humansim record``: record a scene into a bag of rosbag2, without nodes."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

from humansim_ros.cli.options import JobsOption, RayOption, ResumeOption, TopicsOption, argument, option
from humansim_ros.cli.output import WorkDisplay, print_text
from humansim_ros.cli.scene import warn_about_mistakes
from humansim_ros.errors import MAX_FRAMES, BagError


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
    max_bag_size: Annotated[int | None, option("record.max_bag_size")] = None,
    max_bag_duration: Annotated[float, option("record.max_bag_duration")] = 0.0,
    one_file: Annotated[bool, option("record.one_file")] = False,
    resume: ResumeOption = False,
    ray: RayOption = None,
    shard_frames: Annotated[int | None, option("record.shard_frames")] = None,
) -> None:
    """Record a scene into a bag of rosbag2, frame by frame, without nodes: no frame is lost."""
    from humansim_ros.data import api
    from humansim_ros.data.engine import prepare_processes

    if ray is None:
        prepare_processes(api.RECORD_MODULES, jobs, frames)
    from humansim_ros.scene.core import Scene

    if (frames is None) == (seconds is None):
        raise BagError("give either --frames or --seconds", key="record")
    paths: list[Path | None] = list(scene) if scene else [None]
    if ray is None and len(paths) > 1:
        raise BagError("several scenes need --ray, such as --ray local", key="record")
    names = [path.stem if path and len(paths) > 1 else "" for path in paths]
    if len(set(names)) < len(names):
        raise BagError("scenes need different file names, which become folders of the output", key="record")
    for path, name in zip(paths, names, strict=True):
        loaded = Scene.load(path)
        warn_about_mistakes(loaded)
        folder = f"{output.rstrip('/')}/{name}" if name else output
        with WorkDisplay("recording", folder) as display:
            api.record(
                loaded,
                folder,
                frames=frames,
                seconds=seconds,
                topics=topics or (),
                images=images.value,
                depth=depth.value,
                labels=labels.value,
                storage=storage.value,
                compression=compression.value,
                max_bag_size=0 if one_file else max_bag_size,
                max_bag_duration=max_bag_duration,
                shard_frames=shard_frames,
                jobs=jobs,
                ray=ray,
                resume=resume,
                on_state=display.show,
            )
        print_text(display.summary())
