"""The commands ``record``, ``export`` and ``evaluate`` as functions: ``from humansim_ros import record``."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from humansim_ros.data.engine import WorkPlan, WorkProgress, ignore, is_url, prepare_processes, run
from humansim_ros.errors import BagError, ExportError
from humansim_ros.files.reading import cores

if TYPE_CHECKING:
    from humansim_ros.data.evaluation.compare import Comparison
    from humansim_ros.data.formats.formats import ExportFormat
    from humansim_ros.data.formats.source import ExportSource
    from humansim_ros.scene.core import Scene

#: Modules that the worker processes of a recording, and of an export, import.
RECORD_MODULES = ("humansim_ros.data.recording", "humansim_ros.render.frame.gl", "rosbags.typesys")
EXPORT_MODULES = ("humansim_ros.data.formats.exporting", "humansim_ros.render.frame.gl")


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
    from humansim_ros.data.evaluation.compare import compare

    return compare(
        Path(truth),
        [os.fspath(each) for each in several],
        min_score=min_score,
        keypoints=keypoints,
        names=names,
        scale=scale,
        axes=axes,
        offset=offset,
        gate=gate,
        radius=radius,
    )


def record(
    scene: Scene | str | os.PathLike[str] | None,
    output: str | os.PathLike[str],
    *,
    frames: int | None = None,
    seconds: float | None = None,
    topics: Sequence[str] = (),
    images: Literal["raw", "jpeg", "png"] = "raw",
    depth: Literal["raw", "png"] = "raw",
    labels: Literal["raw", "png"] = "raw",
    storage: Literal["mcap", "sqlite3"] = "mcap",
    compression: Literal["none", "zstd", "lz4"] = "none",
    max_bag_size: int | None = None,
    max_bag_duration: float = 0.0,
    shard_frames: int | None = None,
    jobs: int | None = None,
    ray: str | None = None,
    resume: bool = False,
    on_progress: Callable[[int, int], None] = ignore,
    on_state: Callable[[WorkPlan, WorkProgress], None] = ignore,
) -> Path:
    """Record a scene into a bag of rosbag2, frame by frame: no frame is lost, and ROS is not needed.

    The bag has a file for every few frames, so that several processes write it, and an interrupted recording
    continues.

    Args:
        scene: Scene, or its file. If None, the demo scene.
        output: Folder of the bag. It must not exist, unless ``resume`` is set. With ``ray``, it may be a URL.
        frames: Number of frames, in place of ``seconds``.
        seconds: Length of the recording, seconds.
        topics: Names of topics, or patterns such as ``/camera_*/joints``. If empty, the default topics.
        images: Format of colour images.
        depth: Format of depth images.
        labels: Format of label images.
        storage: Storage plugin of rosbag2. ``sqlite3`` is deprecated.
        compression: Lossless compression of the chunks of an MCAP file.
        max_bag_size: Bytes after which a file is split. If 0, the bag has one file, which one process writes.
        max_bag_duration: Seconds of each file. If 0, the number of frames decides.
        shard_frames: Number of frames of each file. If None, a 32nd of all frames, but at least 5 and at
            most 100.
        jobs: Number of worker processes. If None, one per core.
        ray: Address of a Ray cluster that does the work, such as ``local`` or ``auto``.
        resume: Whether to continue an interrupted recording. If there is none, a new one starts.
        on_progress: Called from time to time with the number of finished frames and of all frames.
        on_state: Called from time to time, and at the end, with the plan and with the progress: rate, size
            and processor time.

    Returns:
        Folder of the bag.

    Raises:
        RetryError: A worker process has died.
        PartialError: The disk is full.
        HumansimError: The scene, a topic or the folder is wrong.

    Example:
        >>> record("scene.yaml", "walk", frames=90, topics=["/camera_*/image_raw"])  # doctest: +SKIP
        PosixPath('walk')
    """
    if ray is None:
        prepare_processes(RECORD_MODULES, jobs, frames)
    from humansim_ros.data.recording import SceneRecording

    if (frames is None) == (seconds is None):
        raise BagError("give either frames or seconds", key="record")
    if ray is None and is_url(os.fspath(output)):
        raise BagError("URLs need --ray, such as --ray local", key="record")
    loaded = _loaded(scene)
    plan = SceneRecording.of(
        loaded,
        frames if frames is not None else max(1, round((seconds or 0.0) * loaded.config.rate)),
        topics,
        images=images,
        depth=depth,
        labels=labels,
        storage=storage,
        compression=compression,
        max_size=max_bag_size,
        max_duration=max_bag_duration,
        shard_frames=shard_frames,
        name=Path(output).name,
    )
    _run(plan, output, jobs, ray, resume, on_progress, on_state)
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
    license: str = "",
    shard_frames: int | None = None,
    jobs: int | None = None,
    ray: str | None = None,
    resume: bool = False,
    on_progress: Callable[[int, int], None] = ignore,
    on_state: Callable[[WorkPlan, WorkProgress], None] = ignore,
) -> Path:
    """Write frames of a scene, a bag, or the scenes of a recipe, as a data set: images, annotations, motions.

    A recipe (docs/datasets.md) has keys for formats, frames, keypoints, images and licence, so leave out
    these arguments.

    Args:
        source: Scene, its file, a recipe, or a bag. If None, the demo scene.
        output: Folder. It must not exist, unless ``resume`` is set. With ``ray``, all hosts share it.
        formats: Names of formats, such as ``coco`` (docs/export.md).
        scenes: Number of scenes, in place of that in the recipe.
        frames: Number of frames, or their numbers. If None, all frames of a bag.
        keypoints: Keypoint set of the formats with keypoints.
        images: Format of colour images.
        shard_size: Size of the shards of ``webdataset``, bytes.
        license: Licence of the data set, such as ``CC-BY-4.0``. If empty, that of the scene.
        shard_frames: Number of frames that a worker writes at a time. If None, a 32nd of all frames, but at
            least 5 and at most 100.
        jobs: Number of worker processes. If None, one per core.
        ray: Address of a Ray cluster that does the work, such as ``local`` or ``auto``.
        resume: Whether to continue an interrupted export. If there is none, a new one starts.
        on_progress: Called from time to time with the number of finished frames and of all frames. For a
            recipe, these are numbers of scenes.
        on_state: Called from time to time, and at the end, with the plan and with the progress: rate, size
            and processor time.

    Returns:
        The folder.

    Raises:
        RetryError: A worker process has died.
        PartialError: The disk is full.
        HumansimError: The scene, recipe, a format, an option or the folder is wrong.

    Example:
        >>> export("scene.yaml", "walk", ["coco", "depth-png"], frames=range(100, 200))  # doctest: +SKIP
        PosixPath('walk')
    """
    if ray is None:
        prepare_processes(EXPORT_MODULES, jobs, frames)
    from humansim_ros.data.formats.exporting import Export
    from humansim_ros.data.formats.formats import chosen_formats
    from humansim_ros.data.formats.plan import ExportPlan

    if is_url(os.fspath(output)):
        raise ExportError("an export needs a folder; with --ray one that all hosts share", key="--output")
    root = Path(output) if ray is None else Path(output).resolve()
    if isinstance(source, (str, os.PathLike)):
        if not Path(source).exists():
            raise ExportError("no such scene file, recipe or bag; check the path", path=source)
        source = source if ray is None else Path(source).resolve()  # workers are in other folders
    options = {"--format": formats, "--frames": frames, "--keypoints": keypoints, "--images": images}
    options |= {"--license": license, "--shard-size": shard_size, "--shard-frames": shard_frames}
    if (plan := _recipe(source, root, scenes, options)) is None:
        opened = export_source(source, tuple(chosen_formats(formats)), keypoints)
        chosen = range(frames) if isinstance(frames, int) else frames
        of_scene = ExportPlan.of(opened, chosen, f".{images}", shard_size, license)
        plan = Export(opened, of_scene, shard_frames=shard_frames)
    _run(plan, root, jobs, ray, resume, on_progress, on_state)
    return Path(output)


def _run(
    plan: WorkPlan,
    output: str | os.PathLike[str],
    jobs: int | None,
    ray: str | None,
    resume: bool,
    on_progress: Callable[[int, int], None],
    on_state: Callable[[WorkPlan, WorkProgress], None],
) -> None:
    """Do the work of a plan, and tell its progress."""

    def show(progress: WorkProgress) -> None:
        on_progress(progress.done, progress.total)
        on_state(plan, progress)

    if ray is not None and not is_url(os.fspath(output)):
        output = Path(output).resolve()  # workers are in other folders
    show(run(plan, output, workers=jobs or cores(), ray=ray, resume=resume, on_progress=show))


def _recipe(
    source: Scene | str | os.PathLike[str] | None,
    output: Path,
    scenes: int | None,
    options: Mapping[str, Any],
) -> WorkPlan | None:
    """Plan the data set of many scenes if the source is a recipe; otherwise return None.

    Args:
        source: Scene, bag or recipe.
        output: Folder of the data set.
        scenes: Number of scenes, in place of that in the recipe.
        options: Options of an export of one scene, by name, such as ``--format``.

    Raises:
        ExportError: The recipe is wrong, an option does not fit a recipe, or ``scenes`` is given without a
            recipe.
        RenderError: OpenGL is missing.
    """
    from humansim_ros.files.yaml import has_key
    from humansim_ros.scene.config import RECIPE

    if not isinstance(source, (str, os.PathLike)) or not has_key(Path(source), RECIPE):
        if scenes is not None:
            raise ExportError("is for recipes; a scene file is one scene", key="--scenes")
        return None
    from humansim_ros.data.datasets.data_set import DataSet, check_options
    from humansim_ros.data.datasets.recipe import Recipe

    check_options(options)
    return DataSet.of(Recipe.load(source, scenes), output)


def export_source(
    source: Scene | str | os.PathLike[str] | None, formats: tuple[ExportFormat, ...], keypoints: str
) -> ExportSource:
    """Create the source of an export from a scene, its file, or a bag."""
    from humansim_ros.data.bags import is_bag
    from humansim_ros.data.formats.source import SimulatedSource
    from humansim_ros.people.keypoints import keypoint_set

    points = keypoint_set(keypoints).name
    if isinstance(source, (str, os.PathLike)) and is_bag(Path(source)):
        from humansim_ros.data.formats.bag import BagSource

        return BagSource.read(Path(source), formats, points)
    return SimulatedSource(_loaded(source), formats, points)


def _loaded(scene: Scene | str | os.PathLike[str] | None) -> Scene:
    from humansim_ros.scene.core import Scene

    return scene if isinstance(scene, Scene) else Scene.load(scene)
