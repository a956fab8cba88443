"""Report of a comparison in images as one HTML page that loads nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from humansim_ros.evaluate.html import page, section, table
from humansim_ros.evaluate.image_report import (
    TITLES,
    camera_header,
    camera_rows,
    image_summary,
    keypoint_rows,
    name_rows,
    pixels,
)
from humansim_ros.evaluate.images import ImageEvaluation, WorstImage
from humansim_ros.evaluate.pictures import (
    ESTIMATE_COLOR,
    TRUTH_COLOR,
    Pictures,
    Shape,
    draw_over,
    jpeg_image,
)
from humansim_ros.evaluate.plots import bar_plot
from humansim_ros.evaluate.report import percent
from humansim_ros.keypoints import keypoint_set


def image_html_report(evaluation: ImageEvaluation, pictures: Pictures | None = None) -> str:
    """The page: tables, and the worst frames of each kind of detection, drawn over the images.

    ``pictures``: images to draw over; None: without them.

    Raises:
        HumansimError: An image cannot be rendered or read.
    """
    parts = ['<div class="row">', section("Metrics", table((), image_summary(evaluation)))]
    for kind, scores in evaluation.kinds.items():
        title, word = TITLES[kind]
        parts += [
            section(f"{title.capitalize()}: cameras", table(camera_header(kind), camera_rows(scores))),
            section(
                f"{title.capitalize()}: people and objects",
                table(("name", "found", f"mean {word}"), name_rows(scores)),
            ),
        ]
        if scores.by_keypoint:
            bars = {name: each.error for name, each in scores.by_keypoint.items()}
            parts.append(section("Error by keypoint", bar_plot(bars, "px")))
            rows = table(("keypoint", "error", "bias x, y (px)"), keypoint_rows(scores))
            parts.append(section("Keypoints", rows))
    parts.append("</div>")
    for kind, scores in evaluation.kinds.items() if pictures is not None else ():
        title, word = TITLES[kind]
        parts.append(f"<h2>Worst {title}</h2><p>In the colours of truth and estimate.</p>")
        parts.append('<div class="row">')
        for worst in scores.worst:
            error = f", {pixels(worst.error)}" if worst.error is not None else ""
            heading = (
                f"{worst.name} in {worst.camera}, frame {worst.frame}: {word} {percent(worst.similarity)}"
            )
            parts.append(section(heading + error, _picture(evaluation, kind, worst, pictures)))
        parts.append("</div>")
    return page(evaluation.truth, evaluation.estimate, parts)


def _picture(evaluation: ImageEvaluation, kind: str, worst: WorstImage, pictures: Pictures | None) -> str:
    image = pictures.image(worst.stamp, worst.camera) if pictures is not None else None
    if image is None:
        return ""
    truth, estimate = evaluation.matches[kind, worst.image, worst.name]
    shapes = [_shape(evaluation, kind, truth, TRUTH_COLOR)]
    if estimate is not None:
        shapes.append(_shape(evaluation, kind, estimate, ESTIMATE_COLOR))
    return jpeg_image(draw_over(image, shapes), escape(f"{worst.name} in {worst.camera}"))


def _shape(
    evaluation: ImageEvaluation, kind: str, row: Mapping[str, Any], color: tuple[int, int, int]
) -> Shape:
    """What is drawn of an annotation or a detection."""
    nothing = np.zeros((0, 2))
    if kind == "keypoints":
        points = np.reshape(np.asarray(row["keypoints"], float), (-1, 3))
        absent = ~points.any(axis=1) | (points[:, 2] <= 0)
        edges = keypoint_set(evaluation.keypoint_set).edges
        return Shape(color, np.where(absent[:, None], np.nan, points[:, :2]), edges)
    if kind == "boxes":
        return Shape(color, nothing, box=np.asarray(row["bbox"], float))
    from pycocotools.mask import decode

    return Shape(color, nothing, mask=decode(row["segmentation"]).astype(bool))
