"""Results of an evaluation as JSON and as tables, for a terminal and for the HTML report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from itertools import groupby
from typing import Any

from humansim_ros.data.evaluation.boxes import BoxEvaluation
from humansim_ros.data.evaluation.evaluation import Evaluation
from humansim_ros.data.evaluation.images import ImageEvaluation, ImageScores, KindScores
from humansim_ros.data.evaluation.navigation import SPACES, NavigationEvaluation
from humansim_ros.data.evaluation.pose_sequence import Timing
from humansim_ros.data.evaluation.tracking import TrackingScores

#: Result of any kind of comparison.
AnyEvaluation = Evaluation | ImageEvaluation | BoxEvaluation | NavigationEvaluation
#: Version of the keys in JSON.
JSON_VERSION = 1
#: Words for each kind of detection, and for its measure of similarity.
TITLES = {"keypoints": ("keypoints", "OKS"), "boxes": ("boxes", "IoU"), "masks": ("masks", "IoU")}
#: Rows of the table of metrics: group, name, value.
_Metrics = Iterator[tuple[str, str, str]]


def to_data(evaluation: AnyEvaluation) -> dict[str, Any]:
    """Convert a result for JSON, without the poses. The keys are the attributes of the class."""
    data = {field.name: getattr(evaluation, field.name) for field in fields(evaluation) if field.repr}
    return {"version": JSON_VERSION, **{name: _plain(value) for name, value in data.items()}}


def _plain(value: Any) -> Any:
    """Convert a result to mappings, lists and numbers."""
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


# --- numbers as text


def quantity(value: float | None, unit: str, digits: int = 2) -> str:
    """A number with its unit, or a dash."""
    return "–" if value is None else f"{value:.{digits}f} {unit}"


def millimetres(value: float | None) -> str:
    """A length, given in metres, in millimetres; or a dash."""
    return "–" if value is None else f"{thousand(value)} mm"


def percent(value: float | None) -> str:
    """Share in percent, or a dash."""
    return "–" if value is None else f"{value * 100:.1f} %"


def thousand(value: float) -> str:
    """A number times 1000 as text with one decimal. Never ``-0.0``: this becomes ``0.0``."""
    return f"{round(value * 1000, 1) + 0.0:.1f}"


def _count(value: int | None) -> str:
    return "–" if value is None else str(value)


# --- tables


@dataclass(frozen=True)
class Table:
    """A table of texts.

    Attributes:
        heading: Heading in the HTML report.
        header: Names of the columns.
        rows: The rows.
        title: Title in a terminal.
    """

    heading: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""


def tables(evaluation: AnyEvaluation) -> list[Table]:
    """All tables of a result that have rows: first the metrics, then people, cameras and others."""
    if isinstance(evaluation, Evaluation):
        metrics, others = _pose_metrics(evaluation), _pose_tables(evaluation)
    elif isinstance(evaluation, ImageEvaluation):
        metrics, others = _image_metrics(evaluation), _image_tables(evaluation)
    elif isinstance(evaluation, BoxEvaluation):
        metrics, others = _box_metrics(evaluation), _box_tables(evaluation)
    else:
        metrics, others = _navigation_metrics(evaluation), _navigation_tables(evaluation)
    grouped = [
        (group if row == 0 else "", name, value)
        for group, rows in groupby(metrics, key=lambda each: each[0])
        for row, (_, name, value) in enumerate(rows)
    ]
    return [Table("Metrics", ("", "metric", "value"), grouped), *(each for each in others if each.rows)]


def show(evaluation: AnyEvaluation) -> str:
    """All tables of a result as text for a terminal."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as TextTable

    console = Console(width=100, highlight=False)
    with console.capture() as capture:
        for each in tables(evaluation):
            text = TextTable(
                *each.header, title=each.title or None, title_justify="left", box=box.SIMPLE, pad_edge=False
            )
            for row in each.rows:
                text.add_row(*row)
            console.print(text)
    return "\n".join(line.rstrip() for line in capture.get().splitlines()).strip("\n")


# --- 3D poses


def _pose_metrics(e: Evaluation) -> _Metrics:
    yield "frames", "compared", str(e.frames.compared)
    yield "frames", "without estimate", str(e.frames.without_estimate)
    yield "frames", "estimate without truth", str(e.frames.without_truth)
    measured = "unknown" if e.offset.measured is None else f"{thousand(e.offset.measured)} ms"
    applied = f"{thousand(e.offset.applied)} ms corrected" if e.offset.applied else "not corrected"
    yield "frames", "stamps are late by", f"{measured} ({applied})"
    if e.live is not None:
        yield from _timing_metrics(e.live)
    yield "people", "found", f"{e.people.found} of {e.people.present} ({percent(e.people.recall)})"
    yield "people", "missed", str(e.people.missed)
    yield "people", "false", str(e.people.false)
    p = e.position
    yield "position", "MPJPE", millimetres(p.mpjpe)
    yield "position", "PA-MPJPE", millimetres(p.pa_mpjpe)
    yield "position", "median, 90 %, 99 %", ", ".join(map(millimetres, (p.median, p.p90, p.p99)))
    yield "position", "PCK at 150 mm", percent(p.pck)
    yield "position", "AUC, 0 to 150 mm", percent(p.auc)
    yield "motion", "velocity error", quantity(e.motion.velocity, "m/s", 3)
    yield "motion", "acceleration error", quantity(e.motion.acceleration, "m/s²", 3)
    yield "parts", "PCP, all limbs", percent(e.pcp.all)
    yield "parts", "PCP, mean of people", percent(e.pcp.mean_of_people)
    for limb, share in e.pcp.by_limb.items():
        yield "parts", f"PCP, {limb}", percent(share)
    for distance in ("25", "50", "100", "150"):
        yield "detection", f"AP at {distance} mm", percent(e.detection.ap[distance])
    yield "detection", "mean AP", percent(e.detection.mean_ap)
    yield "detection", "recall at 500 mm", percent(e.detection.recall["500"])
    if e.tracking is not None:
        yield from _tracking_metrics("identity", e.tracking)


def _timing_metrics(timing: Timing) -> _Metrics:
    if timing.latency is not None:
        times = (timing.latency.median, timing.latency.p99, timing.latency.worst)
        yield "live", "latency: median, 99 %, worst", ", ".join(f"{thousand(each)} ms" for each in times)
    if timing.rate is not None:
        yield "live", "rate", f"{timing.rate:.1f} frames/s"
    after = f", and {timing.after} after the last estimate" if timing.after else ""
    yield "live", "lost", f"{timing.lost} frames ({percent(timing.lost_share)}){after}"
    yield "live", "repeated, out of order", f"{timing.duplicates}, {timing.out_of_order} messages"


def _tracking_metrics(group: str, t: TrackingScores) -> _Metrics:
    yield group, "HOTA (DetA, AssA)", f"{percent(t.hota)} ({percent(t.deta)}, {percent(t.assa)})"
    yield group, "MOTA", percent(t.mota)
    yield group, "IDF1", percent(t.idf1)
    yield group, "switches, fragments", f"{t.switches}, {t.fragments}"


def _pose_tables(e: Evaluation) -> list[Table]:
    joints = [
        (
            name,
            millimetres(joint.mpjpe),
            millimetres(joint.pa_mpjpe),
            percent(joint.pck),
            "–" if joint.bias is None else ", ".join(map(thousand, joint.bias)),
        )
        for name, joint in e.by_joint.items()
    ]
    people = [
        (
            name,
            f"{person.found} of {person.present}",
            millimetres(person.mpjpe),
            millimetres(person.pa_mpjpe),
            quantity(person.velocity, "m/s", 3),
        )
        for name, person in e.by_person.items()
    ]
    cameras = [(count, str(own.joints), millimetres(own.mpjpe)) for count, own in e.by_cameras.items()]
    heading = "Error by number of cameras with the joint in their image"
    return [
        Table("Joints", ("joint", "MPJPE", "PA-MPJPE", "PCK", "bias x, y, z (mm)"), joints),
        Table("People", ("person", "found", "MPJPE", "PA-MPJPE", "velocity error"), people),
        Table(heading, ("cameras", "joints", "MPJPE"), cameras),
    ]


# --- detections in images


def _image_metrics(evaluation: ImageEvaluation) -> _Metrics:
    yield "images", "compared", str(evaluation.images)
    for kind, scores in evaluation.kinds.items():
        title, word = TITLES[kind]
        for name, value in _image_scores(scores.all, word):
            yield title, name, value


def _image_scores(scores: ImageScores, word: str) -> Iterator[tuple[str, str]]:
    precision = scores.precision
    yield "AP", percent(precision["ap"])
    yield f"AP at {word} 0.50", percent(precision["ap50"])
    yield f"AP at {word} 0.75", percent(precision["ap75"])
    yield "AP medium, large", f"{percent(precision['ap_medium'])}, {percent(precision['ap_large'])}"
    yield "AR", percent(precision["ar"] if "ar" in precision else precision["ar100"])
    yield f"mean {word}", percent(scores.similarity)
    yield "found", f"{scores.found} of {scores.present}"
    yield "false", str(scores.false)
    if (error := scores.error) is not None:
        yield "error: mean, median", f"{quantity(error.mean, 'px')}, {quantity(error.median, 'px')}"
        yield "error: visible, occluded", f"{quantity(error.visible, 'px')}, {quantity(error.occluded, 'px')}"


def _image_tables(evaluation: ImageEvaluation) -> list[Table]:
    found = []
    for kind, scores in evaluation.kinds.items():
        title, word = TITLES[kind]
        header: tuple[str, ...] = ("camera", "AP", f"AP at {word} 0.50", f"mean {word}", "found", "false")
        if kind == "keypoints":
            header = (*header, "error")
        names = [
            (name, f"{own.found} of {own.present}", percent(own.similarity))
            for name, own in scores.by_name.items()
        ]
        parts = [
            (part, quantity(own.epe, "px"), percent(own.pck), percent(own.nme))
            for part, own in scores.by_part.items()
        ]
        own_title = title.capitalize()
        found += [
            Table(f"{own_title}: cameras", header, _camera_rows(scores), title),
            Table(
                f"{own_title}: people and objects",
                ("person or object", "found", f"mean {word}"),
                names,
                title,
            ),
            Table("Face and hands", ("part", "EPE", "PCK at 0.2", "NME"), parts, title),
            Table("Keypoints", ("keypoint", "error", "bias x, y (px)"), _keypoint_rows(scores), title),
        ]
    return found


def _camera_rows(scores: KindScores) -> list[tuple[str, ...]]:
    return [
        (
            camera,
            percent(own.precision["ap"]),
            percent(own.precision["ap50"]),
            percent(own.similarity),
            f"{own.found} of {own.present}",
            str(own.false),
            *(() if own.error is None else (quantity(own.error.mean, "px"),)),
        )
        for camera, own in scores.by_camera.items()
    ]


def _keypoint_rows(scores: KindScores) -> list[tuple[str, ...]]:
    return [
        (
            name,
            quantity(own.error, "px"),
            "–" if own.bias is None else ", ".join(f"{round(each, 2) + 0.0:.2f}" for each in own.bias),
        )
        for name, own in scores.by_keypoint.items()
    ]


# --- upright boxes


def _box_metrics(evaluation: BoxEvaluation) -> _Metrics:
    people, errors = evaluation.people, evaluation.errors
    yield "frames", "compared", str(evaluation.frames)
    yield "people", "found", f"{people.found} of {people.present} ({percent(people.recall)})"
    yield "people", "missed", str(people.missed)
    yield "people", "false", str(people.false)
    yield "boxes", "error of the centre", millimetres(errors.center)
    yield "boxes", "error of length, width, height", ", ".join(map(millimetres, errors.size or (None,) * 3))
    yield "boxes", "error of the yaw", "–" if errors.yaw_deg is None else f"{errors.yaw_deg:.1f}°"
    yield "boxes", "mean 3D IoU", percent(errors.overlap)
    yield from _tracking_metrics("3D IoU", evaluation.tracking["iou"])
    yield from _tracking_metrics("distance", evaluation.tracking["distance"])


def _box_tables(evaluation: BoxEvaluation) -> list[Table]:
    rows = [
        (name, f"{own.found} of {own.present}", millimetres(own.center))
        for name, own in evaluation.by_person.items()
    ]
    return [Table("People", ("person", "found", "error of the centre"), rows)]


# --- the path of a robot


def _navigation_metrics(evaluation: NavigationEvaluation) -> _Metrics:
    frames, path, nearest = evaluation.frames, evaluation.path, evaluation.nearest
    yield "frames", "compared", str(frames.compared)
    yield "frames", "without a pose of the robot", str(frames.without_pose)
    yield "path", "time, length", f"{path.seconds:.2f} s, {path.length:.2f} m"
    yield "path", "mean speed", quantity(path.speed, "m/s", 3)
    yield "path", "irregularity", quantity(path.irregularity, "rad/m", 3)
    yield "people", "least distance", quantity(nearest.distance, "m", 3)
    yield "people", "least clearance of bodies", quantity(nearest.clearance, "m", 3)
    yield "people", "collisions", _count(nearest.collisions)
    yield "people", "in contact", quantity(nearest.contact, "s")
    yield "people", "least time to collision", quantity(nearest.time_to_collision, "s")
    for name, value in nearest.spaces.items():
        yield "nearest person", f"in {name} space", quantity(value, "s")
    yield "nearest person", "farther than 0.5 m", percent(nearest.compliance)


def _navigation_tables(evaluation: NavigationEvaluation) -> list[Table]:
    header = ("person", "distance", "clearance", "collisions", "time to collision", *SPACES, "public")
    rows = [
        (
            name,
            quantity(own.distance, "m", 3),
            quantity(own.clearance, "m", 3),
            _count(own.collisions),
            quantity(own.time_to_collision, "s"),
            *(quantity(value, "s") for value in own.spaces.values()),
        )
        for name, own in evaluation.by_person.items()
    ]
    return [Table("People", header, rows)]
