"""The commands ``record``, ``export`` and ``evaluate`` as functions: ``from humansim_ros import record``."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from humansim_ros.files.reading import write_file

if TYPE_CHECKING:
    from humansim_ros.scene.core import Scene


@dataclass(frozen=True)
class Comparison:
    """Result of :func:`evaluate`; ``print`` shows the table that ``humansim evaluate`` prints.

    Attributes:
        data: All metrics, with the keys of docs/evaluation.md. Units are metres and seconds; shares are 0 to
            1.
        table: The table.
        page: Function that returns the HTML page.
    """

    data: dict[str, Any]
    table: str
    page: Callable[[], str]

    def __str__(self) -> str:
        return self.table

    def write_report(self, path: str | os.PathLike[str]) -> None:
        """Write tables, plots and the worst frames to an HTML file."""
        write_file(path, self.page())


def evaluate(
    truth: str | os.PathLike[str],
    estimate: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    keypoints: str | None = None,
    names: str | os.PathLike[str] | None = None,
    scale: float = 1.0,
    axes: str | None = None,
    offset: float | Literal["auto"] = 0.0,
    gate: float | None = None,
    min_score: float | None = None,
    radius: float | None = None,
) -> Comparison:
    """Compare poses or boxes of people, detections in images, or the path of a robot, with the truth.

    Args:
        truth: Scene file, bag with the topics ``/humans/<id>/joints``, or folder of an export.
        estimate: File or folder of poses, boxes or detections, or ``BAG:TOPIC``; or several of them. A topic
            with the pose of a robot is judged by docs/social_navigation.md.
        keypoints: Keypoint set of the estimate, such as ``coco17``. If None, the names of joints decide.
        names: YAML file: name of a joint in the truth by name in the estimate.
        scale: Length of one unit of the estimate, metres.
        axes: Axes of the estimate, such as ``y-up``. If None, the axes of ``map``.
        offset: Delay of the stamps of the estimate, seconds. With ``"auto"``, the delay is measured.
        gate: A person counts as found up to this mean joint distance, metres. If None, 0.5. For boxes, the
            distance of their centres on the floor; if None, 1.
        min_score: Detections in images with a lower score count only for average precision.
        radius: If the estimate is the path of a robot, its radius, metres. If None, that of the robot in the
            scene.

    Raises:
        HumansimError: A file cannot be read, or truth and estimate cannot be compared.

    Example:
        >>> result = evaluate("scene.yaml", "poses.csv", offset="auto")  # doctest: +SKIP
        >>> result.data["position"].get("mpjpe")  # doctest: +SKIP
        0.031
        >>> result.write_report("report.html")  # doctest: +SKIP
    """
    several = [estimate] if isinstance(estimate, (str, os.PathLike)) else estimate
    compared: Comparison = _work().compare(
        Path(truth),
        [os.fspath(each) for each in several],
        min_score,
        keypoints=keypoints,
        names=names,
        scale=scale,
        axes=axes,
        offset=offset,
        gate=gate,
        radius=radius,
    )
    return compared


def record(
    scene: Scene | str | os.PathLike[str] | None,
    output: str | os.PathLike[str],
    *,
    frames: int | None = None,
    seconds: float | None = None,
    topics: Sequence[str] = (),
    images: Literal["raw", "jpeg", "png"] = "raw",
    depth: Literal["raw", "png"] = "raw",
    storage: Literal["mcap", "sqlite3"] = "mcap",
    compression: Literal["none", "zstd", "lz4"] = "none",
    max_bag_size: int = 0,
    max_bag_duration: float = 0.0,
    jobs: int | None = None,
    resume: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, frames: None,
) -> Path:
    """Record a scene into a bag of rosbag2, frame by frame: no frame is lost, and ROS is not needed.

    Args:
        scene: Scene, or its file. If None, the demo scene.
        output: Folder of the bag. It must not exist, unless ``resume`` is set.
        frames: Number of frames, in place of ``seconds``.
        seconds: Length of the recording, seconds.
        topics: Names of topics, or patterns such as ``/camera_*/joints``. If empty, the default topics.
        images: Format of colour images.
        depth: Format of depth images.
        storage: Storage plugin of rosbag2.
        compression: Lossless compression of the chunks of an MCAP file.
        max_bag_size: Bytes after which a new file begins. If 0, there is one file.
        max_bag_duration: Seconds after which a new file begins. If 0, there is one file.
        jobs: Number of worker processes. If None, one per core.
        resume: Whether to continue an interrupted recording. If there is none, a new one starts.
        on_progress: Called after each frame with the number of finished frames and of all frames.

    Returns:
        Folder of the bag.

    Raises:
        HumansimError: The scene, a topic or the folder is wrong, or the disk is full.

    Example:
        >>> record("scene.yaml", "walk", frames=90, topics=["/camera_*/image_raw"])  # doctest: +SKIP
        PosixPath('walk')
    """
    _work().write_bag(
        scene,
        Path(output),
        frames,
        seconds,
        topics,
        jobs,
        resume,
        on_progress,
        images=images,
        depth=depth,
        storage=storage,
        compression=compression,
        max_size=max_bag_size,
        max_duration=max_bag_duration,
    )
    return Path(output)


def export(
    source: Scene | str | os.PathLike[str] | None,
    output: str | os.PathLike[str],
    formats: Sequence[str] = (),
    *,
    scenes: int | None = None,
    frames: int | range | None = None,
    keypoints: str = "coco17",
    images: Literal["png", "jpg"] = "png",
    shard_size: int = 1_000_000_000,
    jobs: int | None = None,
    resume: bool = False,
    on_progress: Callable[[int, int], None] = lambda done, frames: None,
) -> Path:
    """Write frames of a scene, a bag, or the scenes of a recipe, as a data set: images, annotations, motions.

    A recipe (docs/datasets.md) has keys for formats, frames, keypoints and images, so leave out these
    arguments.

    Args:
        source: Scene, its file, a recipe, or a bag. If None, the demo scene.
        output: Folder. It must not exist, unless ``resume`` is set.
        formats: Names of formats, such as ``coco`` (docs/export.md).
        scenes: Number of scenes, in place of that in the recipe.
        frames: Number of frames, or their numbers. If None, all frames of a bag.
        keypoints: Keypoint set of the formats with keypoints.
        images: Format of colour images.
        shard_size: Size of the shards of ``webdataset``, bytes.
        jobs: Number of worker processes. If None, one per core.
        resume: Whether to continue an interrupted export. If there is none, a new one starts.
        on_progress: Called after each frame with the number of finished frames and of all frames. For a
            recipe, called after each scene with the numbers of scenes.

    Returns:
        The folder.

    Raises:
        HumansimError: The scene, recipe, a format, an option or the folder is wrong, or the disk is full.

    Example:
        >>> export("scene.yaml", "walk", ["coco", "depth-png"], frames=range(100, 200))  # doctest: +SKIP
        PosixPath('walk')
    """
    _work().write_data_set(
        source,
        Path(output),
        formats,
        scenes,
        frames,
        keypoints,
        images,
        shard_size,
        jobs,
        resume,
        on_progress,
    )
    return Path(output)


def _work() -> Any:
    # no import statement, since type checkers would put all modules into one circle
    return import_module("humansim_ros.data.work")
