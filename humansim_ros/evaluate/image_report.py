"""Results of a comparison in images as JSON and as tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from humansim_ros.evaluate.images import ImageEvaluation, ImageScores, KindScores
from humansim_ros.evaluate.report import percent

#: Words for the kinds of detections, and for their similarity.
TITLES = {"keypoints": ("keypoints", "OKS"), "boxes": ("boxes", "IoU"), "masks": ("masks", "IoU")}


def pixels(value: float | None) -> str:
    """Length in pixels, or a dash."""
    return "–" if value is None else f"{value:.2f} px"


def image_summary(evaluation: ImageEvaluation) -> Iterator[tuple[str, str, str]]:
    """Rows of the main table: group, name, value."""
    yield "images", "compared", str(evaluation.images)
    for kind, scores in evaluation.kinds.items():
        title, word = TITLES[kind]
        for name, value in _rows(scores.all, word):
            yield title, name, value


def _rows(scores: ImageScores, word: str) -> Iterator[tuple[str, str]]:
    precision = scores.precision
    yield "AP", percent(precision["ap"])
    yield f"AP at {word} 0.50", percent(precision["ap50"])
    yield f"AP at {word} 0.75", percent(precision["ap75"])
    yield "AP medium, large", f"{percent(precision['ap_medium'])}, {percent(precision['ap_large'])}"
    yield "AR", percent(precision["ar"] if "ar" in precision else precision["ar100"])
    yield f"mean {word}", percent(scores.similarity)
    yield "found", f"{scores.found} of {scores.present}"
    yield "false", str(scores.false)
    if scores.error is not None:
        yield "error: mean, median", f"{pixels(scores.error.mean)}, {pixels(scores.error.median)}"
        yield "error: visible, occluded", f"{pixels(scores.error.visible)}, {pixels(scores.error.occluded)}"


def camera_header(kind: str) -> tuple[str, ...]:
    """Names of the columns of :func:`camera_rows`."""
    word = TITLES[kind][1]
    error = ("error",) if kind == "keypoints" else ()
    return ("camera", "AP", f"AP at {word} 0.50", f"mean {word}", "found", "false", *error)


def camera_rows(scores: KindScores) -> Iterator[tuple[str, ...]]:
    """A row for each camera."""
    for camera, own in scores.by_camera.items():
        error = (pixels(own.error.mean),) if own.error is not None else ()
        yield (
            camera,
            percent(own.precision["ap"]),
            percent(own.precision["ap50"]),
            percent(own.similarity),
            f"{own.found} of {own.present}",
            str(own.false),
            *error,
        )


def name_rows(scores: KindScores) -> Iterator[tuple[str, str, str]]:
    """A row for each person and object: name, images where it was found, mean OKS or IoU."""
    for name, own in scores.by_name.items():
        yield name, f"{own.found} of {own.present}", percent(own.similarity)


def keypoint_rows(scores: KindScores) -> Iterator[tuple[str, str, str]]:
    """A row for each keypoint: name, mean error, mean difference in x and y."""
    for name, own in scores.by_keypoint.items():
        bias = "–" if own.bias is None else ", ".join(f"{round(each, 2) + 0.0:.2f}" for each in own.bias)
        yield name, pixels(own.error), bias


def show_images(evaluation: ImageEvaluation) -> str:
    """Tables for a terminal: all metrics, then cameras, people and objects, and keypoints."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=100, highlight=False)
    with console.capture() as capture:
        main = Table("", "metric", "value", box=box.SIMPLE, pad_edge=False)
        before = ""
        for group, name, value in image_summary(evaluation):
            main.add_row(group if group != before else "", name, value)
            before = group
        console.print(main)
        for kind, scores in evaluation.kinds.items():
            title, word = TITLES[kind]
            for header, rows in (
                (camera_header(kind), camera_rows(scores)),
                (("person or object", "found", f"mean {word}"), name_rows(scores)),
                (("keypoint", "error", "bias x, y (px)"), keypoint_rows(scores)),
            ):
                table = Table(*header, title=title, title_justify="left", box=box.SIMPLE, pad_edge=False)
                for row in rows:
                    table.add_row(*row)
                if table.row_count:
                    console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines()).strip("\n")
