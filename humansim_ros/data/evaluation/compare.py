"""Comparison of an estimate with the truth: the command ``evaluate`` and ``humansim_ros.evaluate``."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from humansim_ros.errors import EvaluationError, RenderError, warn_about
from humansim_ros.files.reading import write_file

if TYPE_CHECKING:
    from humansim_ros.data.evaluation.export_truth import ExportTruth
    from humansim_ros.data.evaluation.truth import RecordedTruth, SceneTruth

#: Default values of the options for 3D poses. Another value means that the user has set the option.
_DEFAULTS = {"scale": 1, "offset": 0}


@dataclass(frozen=True)
class Comparison:
    """Result of ``humansim_ros.evaluate``; ``print`` shows the table that ``humansim evaluate`` prints.

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


def compare(truth: Path, estimate: Sequence[str], min_score: float | None, **options: Any) -> Comparison:
    """Compare an estimate with the truth. All parameters are those of
    :func:`humansim_ros.data.api.evaluate`."""
    from humansim_ros.data.evaluation.readers.box_files import is_box_file
    from humansim_ros.data.evaluation.readers.detections import is_of_images
    from humansim_ros.data.evaluation.readers.robot_paths import is_robot_path

    radius = options.pop("radius")
    if any(map(is_robot_path, estimate)):
        _refuse({**options, "min-score": min_score}, "the path of a robot")
        return _navigation(truth, estimate, radius)
    if radius is not None:
        text = f"needs the path of a robot; {', '.join(estimate)} does not exist or is not one"
        raise EvaluationError(text, key="--radius")
    in_images = any(map(is_of_images, estimate))
    if any(map(is_box_file, estimate)) and not in_images:
        gate = options.pop("gate")
        _refuse({**options, "min-score": min_score}, "upright boxes")
        return _boxes(truth, estimate, gate)
    if in_images:
        keypoints = options.pop("keypoints")
        _refuse(options, "detections in images")
        return _images(truth, estimate, keypoints, min_score)
    if min_score is not None:
        raise EvaluationError("is for detections in images; the estimate is 3D poses", key="--min-score")
    return _poses(truth, estimate, **options)


def _refuse(options: Mapping[str, Any], content: str) -> None:
    """Raise EvaluationError if options for 3D poses are given, since the estimate is of another kind."""
    for name, value in options.items():
        if value != _DEFAULTS.get(name):
            raise EvaluationError(f"is for 3D poses; the estimate is {content}", key=f"--{name}")


def _open_truth(path: Path) -> SceneTruth | RecordedTruth | ExportTruth:
    from humansim_ros.data.evaluation.export_truth import ExportTruth, is_export
    from humansim_ros.data.evaluation.truth import open_truth

    return ExportTruth(path) if is_export(path) else open_truth(path)


def _poses(
    truth: Path,
    estimate: Sequence[str],
    keypoints: str | None,
    names: str | os.PathLike[str] | None,
    scale: float,
    axes: str | None,
    offset: float | Literal["auto"],
    gate: float | None,
) -> Comparison:
    """Compare 3D poses of people."""
    from humansim_ros.data.evaluation.alignment import MAX_OFFSET
    from humansim_ros.data.evaluation.evaluation import DEFAULT_GATE, evaluate_poses
    from humansim_ros.data.evaluation.html import html_report
    from humansim_ros.data.evaluation.joint_names import read_names, set_of_names
    from humansim_ros.data.evaluation.pictures import ScenePictures
    from humansim_ros.data.evaluation.readers.estimates import read_estimates
    from humansim_ros.data.evaluation.readers.pose_files import ReadOptions
    from humansim_ros.data.evaluation.report import show, to_data
    from humansim_ros.data.evaluation.truth import RecordedTruth, SceneTruth, with_camera_counts
    from humansim_ros.people.keypoints import keypoint_set

    late = None if offset == "auto" else offset
    given = read_names(Path(names)) if names is not None else None
    source = _open_truth(truth)
    points = keypoint_set(keypoints) if keypoints is not None else None
    listed = tuple(given) if isinstance(given, list) else points.names if points is not None else None
    estimated = read_estimates(estimate, ReadOptions(listed, source.period, source.start, axes, scale))
    shift = round((late or 0.0) * 1e9)
    if points is None and isinstance(source, SceneTruth):
        points = set_of_names(estimated.names)
    times = estimated.times.tolist() or [source.start + shift]  # for a scene, the first frames
    span = times[0] - shift, times[-1] - shift
    result = evaluate_poses(
        source.poses(span, MAX_OFFSET if estimated.count else 0.0, points),
        estimated,
        names=given if isinstance(given, dict) else None,
        gate=DEFAULT_GATE if gate is None else gate,
        offset=late,
    )
    if isinstance(source, SceneTruth):
        result = with_camera_counts(result, source.scene)

    def page() -> str:
        if isinstance(source, RecordedTruth):
            return html_report(result)
        opened = ScenePictures(source.scene) if isinstance(source, SceneTruth) else source.pictures()
        try:
            with closing(opened) as pictures:
                return html_report(result, pictures)
        except RenderError as error:
            warn_about(truth, f"the report has no images: {error}")
            return html_report(result)

    return Comparison(to_data(result), show(result), page)


def _boxes(truth: Path, estimate: Sequence[str], gate: float | None) -> Comparison:
    """Compare upright 3D boxes of people."""
    from humansim_ros.data.evaluation.boxes import DEFAULT_GATE, evaluate_boxes
    from humansim_ros.data.evaluation.export_truth import ExportTruth, is_export, open_box_truth
    from humansim_ros.data.evaluation.html import html_report
    from humansim_ros.data.evaluation.readers.box_files import read_box_file
    from humansim_ros.data.evaluation.report import show, to_data

    if len(estimate) > 1:
        raise EvaluationError("give one file of boxes", key="--estimate")
    found = read_box_file(Path(estimate[0]))
    if not found.frames and is_export(truth) and "aicity" not in ExportTruth(truth).formats:
        return _images(truth, estimate, None, None)  # the file is one of MOTChallenge
    result = evaluate_boxes(open_box_truth(truth, found), found, DEFAULT_GATE if gate is None else gate)
    return Comparison(to_data(result), show(result), lambda: html_report(result))


def _navigation(truth: Path, estimate: Sequence[str], radius: float | None) -> Comparison:
    """Compare the path of a robot with the people of the truth."""
    from humansim_ros.data.bags import is_bag
    from humansim_ros.data.evaluation.export_truth import is_export
    from humansim_ros.data.evaluation.html import html_report
    from humansim_ros.data.evaluation.navigation import DEFAULT_RADIUS, evaluate_navigation
    from humansim_ros.data.evaluation.nearby import bag_nearby, robot_size, scene_nearby
    from humansim_ros.data.evaluation.readers.robot_paths import read_robot_path
    from humansim_ros.data.evaluation.report import show, to_data
    from humansim_ros.scene.core import Scene

    if len(estimate) > 1:
        raise EvaluationError("give the path of one robot", key="--estimate")
    if is_export(truth):
        raise EvaluationError("the truth around a robot is a scene or a bag", path=truth, key="--truth")
    scene = None if is_bag(truth) else Scene.load(truth)
    path = read_robot_path(estimate[0], scene)
    nearby = bag_nearby(truth, path) if scene is None else scene_nearby(scene, path)
    size = None if scene is None else robot_size(scene)
    if radius is None:
        radius = DEFAULT_RADIUS if size is None else size[0]
    result = evaluate_navigation(nearby, path.source, radius)
    return Comparison(to_data(result), show(result), lambda: html_report(result))


def _images(
    truth: Path, estimate: Sequence[str], keypoints: str | None, min_score: float | None
) -> Comparison:
    """Compare detections in images."""
    from humansim_ros.data.evaluation.export_truth import open_image_truth
    from humansim_ros.data.evaluation.html import html_report
    from humansim_ros.data.evaluation.images import evaluate_images
    from humansim_ros.data.evaluation.readers.detections import read_image_estimates
    from humansim_ros.data.evaluation.report import show, to_data
    from humansim_ros.people.keypoints import keypoint_set

    source = open_image_truth(truth, keypoints)
    found = read_image_estimates(estimate, source, keypoint_set(keypoints) if keypoints else None)
    numbers = found.images if found.images is not None else {row["image_id"] for row in found.results}
    result = evaluate_images(source.images(numbers, found.keypoints), found, min_score or 0.0)

    def page() -> str:
        with closing(source.pictures()) as pictures:
            return html_report(result, pictures)

    return Comparison(to_data(result), show(result), page)
