"""Report of an evaluation as one HTML page without other files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from humansim_ros.data.evaluation.evaluation import Evaluation, WorstPose
from humansim_ros.data.evaluation.images import ImageEvaluation, KindScores, WorstImage
from humansim_ros.data.evaluation.joint_names import body_joint
from humansim_ros.data.evaluation.metrics import AUC_THRESHOLDS, pck
from humansim_ros.data.evaluation.pictures import ESTIMATE_COLOR, TRUTH_COLOR, Pictures, Shape, draw_over
from humansim_ros.data.evaluation.report import TITLES, AnyEvaluation, millimetres, percent, quantity, tables
from humansim_ros.data.formats.markup import Markup, page, part, picture
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.types import Array

WIDTH, HEIGHT = 640, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 12, 14, 34
#: Colours of Okabe and Ito, which colour-blind people can tell apart.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
#: Most intervals between the ticks of an axis.
_INTERVALS = 5
#: Most points of a line in a plot, since a screen cannot show more.
_MOST_POINTS = 1000
#: Pairs of joints of the package's skeleton that are connected by a line in drawn poses.
_LINES = (
    "vt3_end vt3 l_shoulder l_elbow l_wrist",
    "vt3 r_shoulder r_elbow r_wrist",
    "l_shoulder l_hip l_knee l_ankle",
    "r_shoulder r_hip r_knee r_ankle",
    "l_hip r_hip",
    "l_shoulder r_shoulder",
)
#: Heading and content of sections of the page.
_Sections = list[tuple[str, Markup]]


def html_report(evaluation: AnyEvaluation, pictures: Pictures | None = None) -> str:
    """HTML page with all tables. For poses also with errors over time and by joint, PCK curve, and people by
    frame; for poses and detections in images with the worst ones.

    ``pictures``: images of the cameras, to draw the worst poses or detections over. If None, the page has no
    images.

    Raises:
        HumansimError: An image cannot be rendered or read.
    """
    plots: _Sections = []
    worst: list[tuple[str, str, _Sections]] = []
    if isinstance(evaluation, Evaluation):
        plots = list(_plots(evaluation))
        views = "From the front, and from above"
        if pictures is not None:
            views = "In the camera that shows most of the person, from the front, and from above"
        text = f"{views}, in the colours of truth and estimate."
        worst.append(("Worst poses", text, _worst_poses(evaluation, pictures)))
    elif isinstance(evaluation, ImageEvaluation):
        for kind, scores in evaluation.kinds.items():
            if scores.by_keypoint:
                errors = {name: each.error for name, each in scores.by_keypoint.items()}
                plots.append(("Error by keypoint", bar_plot(errors, "px")))
            if pictures is not None:
                drawn = _worst_images(evaluation, kind, scores, pictures)
                worst.append((f"Worst {TITLES[kind][0]}", "In the colours of truth and estimate.", drawn))
    metrics, *others = [(each.heading, part("table", each.header, each.rows)) for each in tables(evaluation)]
    return page(
        "evaluation",
        title="Evaluation",
        truth=evaluation.truth,
        estimate=evaluation.estimate,
        figures=[metrics, *plots, *others],
        worst=worst,
    )


# --- plots


def line_plot(
    lines: Mapping[str, tuple[Array, Array]], x_label: str, y_label: str, top: float = 0.0
) -> Markup:
    """Draw lines in a plot. Returns SVG, which is empty if no value is finite.

    Args:
        lines: x (N,) and y (N,) by name. NaN in y breaks a line.
        x_label: Quantity and unit of x.
        y_label: Quantity and unit of y.
        top: Upper end of the y axis. If 0, the largest y of the lines.
    """
    known = [(x, y) for x, y in lines.values() if np.isfinite(y).any()]
    if not known:
        return Markup()
    span = min(float(x[0]) for x, _ in known), max(float(x[-1]) for x, _ in known)
    highest = top or max(float(np.nanmax(y)) for _, y in known) or 1.0
    drawn = []
    for number, (name, (x, y)) in enumerate(lines.items()):
        chosen = np.unique(np.linspace(0, len(x) - 1, _MOST_POINTS).astype(np.intp))
        parts = _finite_parts(_pixels(x[chosen], y[chosen], span, highest))
        paths = [" ".join(f"{left:.1f},{up:.1f}" for left, up in each) for each in parts]
        drawn.append((name, COLORS[number % len(COLORS)], paths))
    columns, rows = np.array(_ticks(*span)), np.array(_ticks(0.0, highest))
    x_ticks = _labelled(columns, _pixels(columns, 0 * columns, span, highest)[:, 0])
    y_ticks = _labelled(rows, _pixels(0 * rows, rows, span, highest)[:, 1])
    area = _LEFT, _TOP, WIDTH - _RIGHT, HEIGHT - _BOTTOM
    return part("line_plot", WIDTH, HEIGHT, area, drawn, x_ticks, y_ticks, x_label, y_label)


def bar_plot(values: Mapping[str, float | None], unit: str) -> Markup:
    """Plot with a horizontal bar and a number for each name. If the value is None, the bar is missing."""
    widest = max((value for value in values.values() if value is not None), default=0.0) or 1.0
    bars = [
        (name, (WIDTH - 250) * (value or 0.0) / widest, quantity(value, unit, 1))
        for name, value in values.items()
    ]
    return part("bar_plot", WIDTH, bars, COLORS[0])


def pose_plot(truth: Array, estimate: Array, edges: Sequence[tuple[int, int]]) -> Markup:
    """Draw a true pose (C, 3) and the estimated pose, seen from the front (y to the left, z up) and from
    above (y to the left, x up)."""
    known = np.concatenate([truth, estimate])
    known = known[np.isfinite(known).all(axis=1)]
    centre = (known.min(axis=0) + known.max(axis=0)) / 2
    scale = 200 / max(0.5, float((known.max(axis=0) - known.min(axis=0)).max()))
    shapes = []
    for number, axis in enumerate((2, 0)):
        for pose, color in ((truth, COLORS[0]), (estimate, COLORS[1])):
            points = (pose - centre) * scale
            pixels = np.stack([120 + 250 * number - points[:, 1], 120 - points[:, axis]], axis=1)
            finite = np.isfinite(pixels).all(axis=1)
            lines = [pixels[[start, end]].tolist() for start, end in edges if finite[start] and finite[end]]
            shapes.append((color, lines, pixels[finite].tolist()))
    return part("pose_plot", 500, 240, shapes)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from low to high: multiples of 1, 2 or 5 times a power of ten, at most six."""
    if not high > low:
        return [low]
    power = 10.0 ** np.floor(np.log10((high - low) / _INTERVALS))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor * _INTERVALS >= high - low)
    first, last = np.ceil(low / step - 1e-9) + 0.0, np.floor(high / step + 1e-9)
    # rounded, since a product such as 3 * 0.1 has a wrong last digit
    return [float(f"{number * step:.12g}") for number in np.arange(first, last + 1).tolist()]


def _labelled(values: Array, places: Array) -> list[tuple[str, float]]:
    """Text and place of each tick."""
    return [(f"{value:g}", place) for value, place in zip(values, places.tolist(), strict=True)]


def _pixels(x: Array, y: Array, span: tuple[float, float], highest: float) -> Array:
    """Places (N, 2) of values in a plot."""
    width, height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    share = (x - span[0]) / ((span[1] - span[0]) or 1.0)
    return np.stack([_LEFT + width * share, HEIGHT - _BOTTOM - height * np.minimum(y / highest, 1)], axis=1)


def _finite_parts(points: Array) -> list[Array]:
    """Divide a line of points (N, 2) into parts without points that are not finite."""
    finite = np.isfinite(points).all(axis=1)
    ends = np.flatnonzero(np.diff(finite)) + 1
    parts = zip(np.split(points, ends), np.split(finite, ends), strict=True)
    return [part for part, known in parts if len(part) and known[0]]


# --- figures of poses


def _plots(e: Evaluation) -> Iterator[tuple[str, Markup]]:
    times = np.asarray((e.frame_times - e.frame_times[0]) * 1e-9, float)
    with np.errstate(invalid="ignore"):
        count = np.isfinite(e.errors).sum(axis=1)
        mean = 1000 * np.nansum(e.errors, axis=1) / np.where(count, count, np.nan)
    lines = {}
    for person in e.by_person:
        error = np.full(len(times), np.nan)
        rows = [index for index, name in enumerate(e.matches.person) if name == person]
        error[e.matches.frame[rows]] = mean[rows]
        lines[person] = times, error
    yield "Error over time", line_plot(lines, "time (s)", "mean error (mm)")
    errors = {name: None if j.mpjpe is None else 1000 * j.mpjpe for name, j in e.by_joint.items()}
    yield "Error by joint (MPJPE)", bar_plot(errors, "mm")
    shares = [100 * (pck(e.counted_errors, float(t), e.missed_joints) or 0.0) for t in AUC_THRESHOLDS]
    curve = {"PCK": (1000 * AUC_THRESHOLDS, np.array(shares))}
    yield "Share of correct joints (PCK) by threshold", line_plot(curve, "threshold (mm)", "share (%)", 100)
    counts = e.found_by_frame.astype(float).T
    people = dict(zip(("found", "missed", "false"), ((times, each) for each in counts), strict=True))
    yield "People by frame", line_plot(people, "time (s)", "people")
    parts = {name: None if share is None else 100 * share for name, share in e.pcp.by_person.items()}
    yield "Share of correct limbs (PCP) by person", bar_plot(parts, "%")


def _worst_poses(e: Evaluation, pictures: Pictures | None) -> _Sections:
    places = {body_joint(name): index for index, name in reversed(list(enumerate(e.joints)))}
    chains = [[places[name] for name in line.split() if name in places] for line in _LINES]
    edges = [pair for chain in chains for pair in pairwise(chain)]
    keys = list(zip(e.matches.stamp.tolist(), e.matches.person, strict=True))
    sections = []
    for pose in e.worst:
        row = keys.index((pose.stamp, pose.person))
        title = f"{pose.person} at {pose.stamp * 1e-9:.3f} s: {millimetres(pose.error)}"
        truth, estimate = e.matches.truth[row], e.matches.estimate[row]
        over = Markup() if pictures is None else _over_image(pictures, pose, truth, estimate, edges)
        sections.append((title, over + pose_plot(truth, estimate, edges)))
    return sections


def _over_image(
    pictures: Pictures, pose: WorstPose, truth: Array, estimate: Array, edges: Sequence[tuple[int, int]]
) -> Markup:
    """Draw a pose over the image of the camera that shows most of its joints. Empty without such a camera."""
    best, found = (0, 0.0), ""
    pixels: dict[str, tuple[Array, Array]] = {}
    for name, camera in pictures.cameras(pose.stamp).items():
        pixels[name] = camera.project(truth)[0], camera.project(estimate)[0]  # NaN stays NaN
        own = pixels[name][0]
        inside = own[((own > -0.5) & (own < np.array(camera.size) - 0.5)).all(axis=1)]
        if len(inside) and (value := (len(inside), float(np.ptp(inside, axis=0).max()))) > best:
            best, found = value, name
    image = pictures.image(pose.stamp, found) if found else None
    if image is None:
        return Markup()
    shapes = [
        Shape(color, points, edges)
        for color, points in zip((TRUTH_COLOR, ESTIMATE_COLOR), pixels[found], strict=True)
    ]
    return Markup("<p>{}</p>{}<br>").format(
        found, picture(draw_over(image, shapes), f"{pose.person} in {found}")
    )


# --- figures of detections in images


def _worst_images(
    evaluation: ImageEvaluation, kind: str, scores: KindScores, pictures: Pictures
) -> _Sections:
    sections = []
    for worst in scores.worst:
        similarity = f"{TITLES[kind][1]} {percent(worst.similarity)}"
        heading = f"{worst.name} in {worst.camera}, frame {worst.frame}: {similarity}"
        error = "" if worst.error is None else f", {quantity(worst.error, 'px')}"
        image, content = pictures.image(worst.stamp, worst.camera), Markup()
        if image is not None:
            drawn = draw_over(image, list(_shapes(evaluation, kind, worst)))
            content = picture(drawn, f"{worst.name} in {worst.camera}")
        sections.append((heading + error, content))
    return sections


def _shapes(evaluation: ImageEvaluation, kind: str, worst: WorstImage) -> Iterator[Shape]:
    """Yield the shapes of the annotation and, if it is not missed, of the detection."""
    for row, color in zip(
        evaluation.matches[kind, worst.image, worst.name], (TRUTH_COLOR, ESTIMATE_COLOR), strict=True
    ):
        if row is None:
            continue
        if kind == "keypoints":
            points = np.reshape(np.asarray(row["keypoints"], float), (-1, 3))
            absent = ~points.any(axis=1) | (points[:, 2] <= 0)
            known, scores = keypoint_set(evaluation.keypoint_set), evaluation.keypoints
            edges = known.subset([known.index(name) for name in scores.by_keypoint]).edges if scores else ()
            yield Shape(color, np.where(absent[:, None], np.nan, points[:, :2]), edges)
        elif kind == "boxes":
            yield Shape(color, box=np.asarray(row["bbox"], float))
        else:
            from pycocotools.mask import decode

            yield Shape(color, mask=decode(row["segmentation"]).astype(bool))
