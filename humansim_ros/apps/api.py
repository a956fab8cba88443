"""The commands ``record``, ``export`` and ``evaluate`` as functions: ``from humansim_ros import record``."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from humansim_ros.io.files import write_file

if TYPE_CHECKING:
    from humansim_ros.scene.scene import Scene


@dataclass(frozen=True)
class Comparison:
    """Result of :func:`evaluate`; ``print`` shows the table that ``humansim evaluate`` prints.

    Attributes:
        data: All metrics with the keys of docs/evaluation.md; metres, seconds, and shares from 0 to 1.
        table: The table.
        page: Makes the HTML page.
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
        keypoints: Keypoint set of the estimate, such as ``coco17``; None: as its names say.
        names: YAML file: name of a joint in the truth by name in the estimate.
        scale: Metres of a unit of the estimate.
        axes: Axes of the estimate, such as ``y-up``; None: the axes of ``map``.
        offset: Seconds by which the stamps of the estimate are late, or ``"auto"`` to measure them.
        gate: Largest mean joint distance at which a person counts as found, metres; None: 0.5. Of boxes:
            of their centres on the floor; None: 1.
        min_score: Detections in images with a lower score count for average precision only.
        radius: Radius of the robot whose path is the estimate, metres; None: that of the scene's robot.

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
        scene: Scene, or its file; None: the demo scene.
        output: Folder of the bag, which must not exist unless ``resume``.
        frames: Number of frames; or give ``seconds``.
        seconds: Length of the recording, seconds.
        topics: Names of topics, or patterns such as ``/camera_*/joints``; the default topics if empty.
        images: Format of colour images.
        depth: Format of depth images.
        storage: Storage plugin of rosbag2.
        compression: Compression of the chunks of an MCAP file; lossless.
        max_bag_size: Bytes after which a new file begins; 0: one file.
        max_bag_duration: Seconds after which a new file begins; 0: one file.
        jobs: Number of worker processes; None: one per core.
        resume: Continue an interrupted recording, or start it.
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

    A recipe (docs/datasets.md) has keys for its formats, frames, keypoints and images: leave them out.

    Args:
        source: Scene, its file, a recipe, or a bag; None: the demo scene.
        output: Folder, which must not exist unless ``resume``.
        formats: Names of formats, such as ``coco`` (docs/export.md).
        scenes: Number of scenes of a recipe, instead of its own.
        frames: Number of frames, or their numbers; None: all of a bag.
        keypoints: Keypoint set of the formats with keypoints.
        images: Format of colour images.
        shard_size: Size of the shards of ``webdataset``, bytes.
        jobs: Number of worker processes; None: one per core.
        resume: Continue an interrupted export, or start it.
        on_progress: Called after each frame with the number of finished frames and of all frames; after each
            scene with those of scenes if there is a recipe.

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
    # not by an import statement: type checkers would put all modules into one circle
    return import_module("humansim_ros.apps.work")
