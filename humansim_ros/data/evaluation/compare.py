"""Comparison of an estimate with the truth: the command ``evaluate`` and ``humansim_ros.evaluate``."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from humansim_ros.data.evaluation.alignment import MAX_OFFSET
from humansim_ros.data.evaluation.boxes import DEFAULT_GATE as BOX_GATE
from humansim_ros.data.evaluation.boxes import evaluate_boxes, scene_boxes
from humansim_ros.data.evaluation.evaluation import DEFAULT_GATE, evaluate_poses
from humansim_ros.data.evaluation.export_truth import AnyTruth, ExportTruth, SceneImages, open_truth
from humansim_ros.data.evaluation.html import html_report
from humansim_ros.data.evaluation.images import evaluate_images
from humansim_ros.data.evaluation.joint_names import set_of_names
from humansim_ros.data.evaluation.live import LiveOptions
from humansim_ros.data.evaluation.navigation import DEFAULT_RADIUS, evaluate_navigation
from humansim_ros.data.evaluation.nearby import bag_nearby, robot_size, scene_nearby
from humansim_ros.data.evaluation.pictures import ScenePictures
from humansim_ros.data.evaluation.readers.box_files import is_box_file, read_box_file
from humansim_ros.data.evaluation.readers.detections import is_of_images, read_image_estimates
from humansim_ros.data.evaluation.readers.estimates import read_estimates
from humansim_ros.data.evaluation.readers.robot_paths import is_robot_path, read_robot_path
from humansim_ros.data.evaluation.report import AnyEvaluation, show, to_data
from humansim_ros.data.evaluation.truth import RecordedTruth, SceneTruth, with_camera_counts
from humansim_ros.errors import EvaluationError, RenderError, warn_about
from humansim_ros.files.reading import write_file
from humansim_ros.people.keypoints import keypoint_set

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

    @classmethod
    def of(cls, result: AnyEvaluation, source: AnyTruth | None = None) -> Comparison:
        """Comparison with a result. The page has images of ``source``, if it has images."""

        def page() -> str:
            if isinstance(source, RecordedTruth) or source is None:
                return html_report(result)
            opened = source if isinstance(source, ExportTruth) else ScenePictures(source.scene)
            try:
                with closing(opened) as pictures:
                    return html_report(result, pictures)
            except RenderError as error:
                warn_about(result.truth, f"the report has no images: {error}")
                return html_report(result)

        return cls(to_data(result), show(result), page)

    def __str__(self) -> str:
        return self.table

    def write_report(self, path: str | os.PathLike[str]) -> None:
        """Write tables, plots and the worst frames to an HTML file."""
        write_file(path, self.page())


def compare(truth: Path, estimate: Sequence[str], **options: Any) -> Comparison:
    """Compare an estimate with the truth. All parameters are those of
    :func:`humansim_ros.data.api.evaluate`."""

    def chosen(content: str, *names: str) -> dict[str, Any]:
        """Options ``names``, for an estimate with some content. It has no others."""
        for name, value in options.items():
            if name not in names and value != _DEFAULTS.get(name):
                kind = "detections in images" if name == "min_score" else "3D poses"
                text = f"is for {kind}; the estimate is {content}"
                raise EvaluationError(text, key=f"--{name.replace('_', '-')}")
        return {name: options[name] for name in names}

    if any(map(is_robot_path, estimate)):
        return _navigation(truth, estimate, **chosen("the path of a robot", "radius"))
    if options.pop("radius") is not None:
        text = f"needs the path of a robot; {', '.join(estimate)} does not exist or is not one"
        raise EvaluationError(text, key="--radius")
    if any(map(is_of_images, estimate)):
        return _images(truth, estimate, **chosen("detections in images", "keypoints", "min_score"))
    if any(map(is_box_file, estimate)):
        return _boxes(truth, estimate, **chosen("upright boxes", "gate"))
    return _poses(truth, estimate, **chosen("3D poses", *(options.keys() - {"min_score"})))


def _only(estimate: Sequence[str], content: str) -> str:
    if len(estimate) > 1:
        raise EvaluationError(f"give {content}", key="--estimate")
    return estimate[0]


def _without_bags(path: Path, content: str) -> SceneTruth | ExportTruth:
    """Open a truth that a bag does not have. ``content``: what the estimate has, for the error."""
    source = open_truth(path)
    if isinstance(source, RecordedTruth):
        text = f"the truth of {content} is a scene, or a folder of humansim export"
        raise EvaluationError(text, path=path, key="--truth")
    return source


def _poses(
    truth: Path,
    estimate: Sequence[str],
    *,
    keypoints: str | None,
    gate: float | None,
    names: str | os.PathLike[str] | None,
    scale: float,
    axes: str | None,
    offset: float | Literal["auto"],
) -> Comparison:
    """Compare 3D poses of people."""
    late = None if offset == "auto" else offset
    options = LiveOptions.of(keypoints, names, scale, axes, DEFAULT_GATE if gate is None else gate)
    source = open_truth(truth)
    estimated = read_estimates(estimate, replace(options, period=source.period, start=source.start))
    shift = round((late or 0.0) * 1e9)
    points = options.keypoints
    if points is None and isinstance(source, SceneTruth):
        points = set_of_names(estimated.names)
    times = estimated.times.tolist() or [source.start + shift]  # for a scene, the first frames
    span = times[0] - shift, times[-1] - shift
    poses = source.poses(span, MAX_OFFSET if estimated.count else 0.0, points)
    result = evaluate_poses(poses, estimated, names=options.table, gate=options.gate, offset=late)
    if isinstance(source, SceneTruth):
        result = with_camera_counts(result, source.scene)
    return Comparison.of(result, source)


def _boxes(truth: Path, estimate: Sequence[str], gate: float | None) -> Comparison:
    """Compare upright 3D boxes of people."""
    found = read_box_file(Path(_only(estimate, "one file of boxes")))
    source = _without_bags(truth, "boxes")
    if isinstance(source, SceneTruth):
        boxes = scene_boxes(source.scene, found.span)
    elif not found.frames and "aicity" not in source.formats:
        return _images(truth, estimate, None, None)  # the file is one of MOTChallenge
    else:
        boxes = source.boxes()
    return Comparison.of(evaluate_boxes(boxes, found, BOX_GATE if gate is None else gate))


def _navigation(truth: Path, estimate: Sequence[str], radius: float | None) -> Comparison:
    """Compare the path of a robot with the people of the truth."""
    text, source = _only(estimate, "the path of one robot"), open_truth(truth)
    if isinstance(source, ExportTruth):
        raise EvaluationError("the truth around a robot is a scene or a bag", path=truth, key="--truth")
    if isinstance(source, RecordedTruth):
        path, size = read_robot_path(text, None), None
        nearby = bag_nearby(source, path)
    else:
        path, size = read_robot_path(text, source.scene), robot_size(source.scene)
        nearby = scene_nearby(source.scene, path)
    if radius is None:
        radius = DEFAULT_RADIUS if size is None else size[0]
    return Comparison.of(evaluate_navigation(nearby, path.source, radius))


def _images(
    truth: Path, estimate: Sequence[str], keypoints: str | None, min_score: float | None
) -> Comparison:
    """Compare detections in images."""
    source = _without_bags(truth, "detections in images")
    given = keypoint_set(keypoints) if keypoints else None
    images = (
        SceneImages(source.scene, given or keypoint_set("coco17"))
        if isinstance(source, SceneTruth)
        else source
    )
    found = read_image_estimates(estimate, images, given)
    numbers = found.images if found.images is not None else {row["image_id"] for row in found.results}
    result = evaluate_images(images.images(numbers, found.keypoints), found, min_score or 0.0)
    return Comparison.of(result, source)
