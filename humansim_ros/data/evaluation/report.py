"""Results of an evaluation as JSON and as tables for a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, fields, is_dataclass
from itertools import groupby
from typing import Any

from humansim_ros.data.evaluation.boxes import BoxEvaluation
from humansim_ros.data.evaluation.evaluation import Evaluation
from humansim_ros.data.evaluation.images import ImageEvaluation, ImageScores, KindScores
from humansim_ros.data.evaluation.navigation import NavigationEvaluation
from humansim_ros.data.evaluation.pose_sequence import Timing
from humansim_ros.data.evaluation.tracking import TrackingScores

#: Result of any kind of comparison.
AnyEvaluation = Evaluation | ImageEvaluation | BoxEvaluation | NavigationEvaluation
#: Version of the keys in JSON.
JSON_VERSION = 1
#: Words for each kind of detection, and for its measure of similarity.
TITLES = {"keypoints": ("keypoints", "OKS"), "boxes": ("boxes", "IoU"), "masks": ("masks", "IoU")}


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


def millimetres(value: float | None) -> str:
    """Length in millimetres, or a dash."""
    return "–" if value is None else f"{thousand(value)} mm"


def metres(value: float | None) -> str:
    """Length in metres, or a dash."""
    return "–" if value is None else f"{value:.3f} m"


def seconds(value: float | None) -> str:
    """Time in seconds, or a dash."""
    return "–" if value is None else f"{value:.2f} s"


def thousand(value: float) -> str:
    """A number times 1000 as text with one decimal. Never ``-0.0``: this becomes ``0.0``."""
    return f"{round(value * 1000, 1) + 0.0:.1f}"


def percent(value: float | None) -> str:
    """Share in percent, or a dash."""
    return "–" if value is None else f"{value * 100:.1f} %"


def per_second(unit: str) -> Callable[[float | None], str]:
    """Function that formats a velocity or acceleration with a unit."""
    return lambda value: "–" if value is None else f"{value:.3f} {unit}"


def summary(evaluation: Evaluation) -> Iterator[tuple[str, str, str]]:
    """Rows of the main table: group, name, value. ``humansim evaluate`` and the HTML report show them."""
    e = evaluation
    yield "frames", "compared", str(e.frames.compared)
    yield "frames", "without estimate", str(e.frames.without_estimate)
    yield "frames", "estimate without truth", str(e.frames.without_truth)
    measured = "unknown" if e.offset.measured is None else f"{thousand(e.offset.measured)} ms"
    applied = f"{thousand(e.offset.applied)} ms corrected" if e.offset.applied else "not corrected"
    yield "frames", "stamps are late by", f"{measured} ({applied})"
    if e.live is not None:
        yield from _timing_rows(e.live)
    yield "people", "found", f"{e.people.found} of {e.people.present} ({percent(e.people.recall)})"
    yield "people", "missed", str(e.people.missed)
    yield "people", "false", str(e.people.false)
    p = e.position
    yield "position", "MPJPE", millimetres(p.mpjpe)
    yield "position", "PA-MPJPE", millimetres(p.pa_mpjpe)
    yield "position", "median, 90 %, 99 %", ", ".join(map(millimetres, (p.median, p.p90, p.p99)))
    yield "position", "PCK at 150 mm", percent(p.pck)
    yield "position", "AUC, 0 to 150 mm", percent(p.auc)
    yield "motion", "velocity error", per_second("m/s")(e.motion.velocity)
    yield "motion", "acceleration error", per_second("m/s²")(e.motion.acceleration)
    yield "parts", "PCP, all limbs", percent(e.pcp.all)
    yield "parts", "PCP, mean of people", percent(e.pcp.mean_of_people)
    for limb, share in e.pcp.by_limb.items():
        yield "parts", f"PCP, {limb}", percent(share)
    for distance in ("25", "50", "100", "150"):
        yield "detection", f"AP at {distance} mm", percent(e.detection.ap[distance])
    yield "detection", "mean AP", percent(e.detection.mean_ap)
    yield "detection", "recall at 500 mm", percent(e.detection.recall["500"])
    if e.tracking is not None:
        yield from _tracking_rows("identity", e.tracking)


def _tracking_rows(group: str, t: TrackingScores) -> Iterator[tuple[str, str, str]]:
    yield group, "HOTA (DetA, AssA)", f"{percent(t.hota)} ({percent(t.deta)}, {percent(t.assa)})"
    yield group, "MOTA", percent(t.mota)
    yield group, "IDF1", percent(t.idf1)
    yield group, "switches, fragments", f"{t.switches}, {t.fragments}"


def box_summary(evaluation: BoxEvaluation) -> Iterator[tuple[str, str, str]]:
    """Rows of the main table: group, name, value."""
    people, errors = evaluation.people, evaluation.errors
    yield "frames", "compared", str(evaluation.frames)
    yield "people", "found", f"{people.found} of {people.present} ({percent(people.recall)})"
    yield "people", "missed", str(people.missed)
    yield "people", "false", str(people.false)
    yield "boxes", "error of the centre", millimetres(errors.center)
    sizes = (None,) * 3 if errors.size is None else errors.size
    yield "boxes", "error of length, width, height", ", ".join(map(millimetres, sizes))
    yield "boxes", "error of the yaw", "–" if errors.yaw_deg is None else f"{errors.yaw_deg:.1f}°"
    yield "boxes", "mean 3D IoU", percent(errors.overlap)
    yield from _tracking_rows("3D IoU", evaluation.tracking["iou"])
    yield from _tracking_rows("distance", evaluation.tracking["distance"])


BOX_HEADER = ("person", "found", "error of the centre")


def box_rows(evaluation: BoxEvaluation) -> Iterator[tuple[str, str, str]]:
    """A row for each person."""
    for name, own in evaluation.by_person.items():
        yield name, f"{own.found} of {own.present}", millimetres(own.center)


def show_boxes(evaluation: BoxEvaluation) -> str:
    """Tables for a terminal: all metrics, and people."""
    return _terminal_text(box_summary(evaluation), ("", BOX_HEADER, box_rows(evaluation)))


def _timing_rows(timing: Timing) -> Iterator[tuple[str, str, str]]:
    if timing.latency is not None:
        times = (timing.latency.median, timing.latency.p99, timing.latency.worst)
        yield "live", "latency: median, 99 %, worst", ", ".join(f"{thousand(each)} ms" for each in times)
    if timing.rate is not None:
        yield "live", "rate", f"{timing.rate:.1f} frames/s"
    after = f", and {timing.after} after the last estimate" if timing.after else ""
    yield "live", "lost", f"{timing.lost} frames ({percent(timing.lost_share)}){after}"
    yield "live", "repeated, out of order", f"{timing.duplicates}, {timing.out_of_order} messages"


def camera_count_rows(evaluation: Evaluation) -> Iterator[tuple[str, str, str]]:
    """Rows of errors by number of cameras: number, joints, error."""
    for count, score in evaluation.by_cameras.items():
        yield count, str(score.joints), millimetres(score.mpjpe)


def show(evaluation: Evaluation) -> str:
    """Tables for a terminal: the metrics, joints and people."""
    joints = (
        (
            name,
            millimetres(joint.mpjpe),
            millimetres(joint.pa_mpjpe),
            percent(joint.pck),
            "–" if joint.bias is None else ", ".join(thousand(b) for b in joint.bias),
        )
        for name, joint in evaluation.by_joint.items()
    )
    people = (
        (
            name,
            f"{person.found} of {person.present}",
            millimetres(person.mpjpe),
            millimetres(person.pa_mpjpe),
            per_second("m/s")(person.velocity),
        )
        for name, person in evaluation.by_person.items()
    )
    return _terminal_text(
        summary(evaluation),
        ("", ("joint", "MPJPE", "PA-MPJPE", "PCK", "bias x, y, z (mm)"), joints),
        ("", ("person", "found", "MPJPE", "PA-MPJPE", "velocity error"), people),
        ("", ("cameras", "joints", "MPJPE"), camera_count_rows(evaluation)),
    )


#: Title, header and rows of a table.
_Table = tuple[str, Sequence[str], Iterable[Sequence[str]]]


def _terminal_text(metrics: Iterable[tuple[str, str, str]], *tables: _Table) -> str:
    """Text of the main table and of further tables. Tables without rows are left out."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=100, highlight=False)
    grouped = (
        (group if row == 0 else "", name, value)
        for group, rows in groupby(metrics, key=lambda each: each[0])
        for row, (_, name, value) in enumerate(rows)
    )
    with console.capture() as capture:
        for title, header, rows in (("", ("", "metric", "value"), grouped), *tables):
            table = Table(*header, title=title or None, title_justify="left", box=box.SIMPLE, pad_edge=False)
            for row in rows:
                table.add_row(*row)
            if table.row_count:
                console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines()).strip("\n")


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


PART_HEADER = ("part", "EPE", "PCK at 0.2", "NME")


def part_rows(scores: KindScores) -> Iterator[tuple[str, str, str, str]]:
    """A row for face and hands: end-point error, PCK of a hand, NME of a face."""
    for part, own in scores.by_part.items():
        yield part, pixels(own.epe), percent(own.pck), percent(own.nme)


def show_images(evaluation: ImageEvaluation) -> str:
    """Tables for a terminal: all metrics, then cameras, people and objects, and keypoints."""
    tables: list[_Table] = []
    for kind, scores in evaluation.kinds.items():
        title, word = TITLES[kind]
        tables += [
            (title, camera_header(kind), camera_rows(scores)),
            (title, ("person or object", "found", f"mean {word}"), name_rows(scores)),
            (title, PART_HEADER, part_rows(scores)),
            (title, ("keypoint", "error", "bias x, y (px)"), keypoint_rows(scores)),
        ]
    return _terminal_text(image_summary(evaluation), *tables)


def navigation_summary(evaluation: NavigationEvaluation) -> Iterator[tuple[str, str, str]]:
    """Rows of the main table: group, name, value."""
    frames, path, nearest = evaluation.frames, evaluation.path, evaluation.nearest
    yield "frames", "compared", str(frames.compared)
    yield "frames", "without a pose of the robot", str(frames.without_pose)
    yield "path", "time, length", f"{path.seconds:.2f} s, {path.length:.2f} m"
    yield "path", "mean speed", per_second("m/s")(path.speed)
    yield "path", "irregularity", "–" if path.irregularity is None else f"{path.irregularity:.3f} rad/m"
    yield "people", "least distance", metres(nearest.distance)
    yield "people", "least clearance of bodies", metres(nearest.clearance)
    yield "people", "collisions", "–" if nearest.collisions is None else str(nearest.collisions)
    yield "people", "in contact", seconds(nearest.contact)
    yield "people", "least time to collision", seconds(nearest.time_to_collision)
    for name, value in nearest.spaces.items():
        yield "nearest person", f"in {name} space", seconds(value)
    yield "nearest person", "farther than 0.5 m", percent(nearest.compliance)


CLOSENESS_HEADER = (
    *("person", "distance", "clearance", "collisions", "time to collision", "intimate", "personal"),
    *("social", "public"),
)


def closeness_rows(evaluation: NavigationEvaluation) -> Iterator[tuple[str, ...]]:
    """A row for each person: least distance, clearance, collisions, time to collision, times in spaces."""
    for name, own in evaluation.by_person.items():
        collisions = "–" if own.collisions is None else str(own.collisions)
        yield (
            name,
            metres(own.distance),
            metres(own.clearance),
            collisions,
            seconds(own.time_to_collision),
            *map(seconds, own.spaces.values()),
        )


def show_navigation(evaluation: NavigationEvaluation) -> str:
    """Tables for a terminal: all metrics, and people."""
    return _terminal_text(navigation_summary(evaluation), ("", CLOSENESS_HEADER, closeness_rows(evaluation)))
