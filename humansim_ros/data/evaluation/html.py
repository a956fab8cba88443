"""Report of an evaluation as one HTML page without other files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from humansim_ros.data.evaluation.boxes import BoxEvaluation
from humansim_ros.data.evaluation.evaluation import Evaluation, WorstPose
from humansim_ros.data.evaluation.images import ImageEvaluation, WorstImage
from humansim_ros.data.evaluation.joint_names import body_joint
from humansim_ros.data.evaluation.metrics import AUC_THRESHOLDS, pck
from humansim_ros.data.evaluation.navigation import NavigationEvaluation
from humansim_ros.data.evaluation.pictures import ESTIMATE_COLOR, TRUTH_COLOR, Pictures, Shape, draw_over
from humansim_ros.data.evaluation.report import (
    PART_HEADER,
    TITLES,
    AnyEvaluation,
    camera_count_rows,
    camera_header,
    camera_rows,
    image_summary,
    keypoint_rows,
    millimetres,
    name_rows,
    part_rows,
    percent,
    pixels,
    summary,
)
from humansim_ros.data.formats.markup import (
    Markup,
    element,
    joined,
    page,
    picture,
    polyline,
    section,
    svg,
    table,
)
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
    left, right = min(float(x[0]) for x, _ in known), max(float(x[-1]) for x, _ in known)
    highest = top or max(float(np.nanmax(y)) for _, y in known) or 1.0
    shapes = _axes((left, right), highest, x_label, y_label)
    for number, (name, (x, y)) in enumerate(lines.items()):
        color = COLORS[number % len(COLORS)]
        chosen = np.unique(np.linspace(0, len(x) - 1, _MOST_POINTS).astype(np.intp))
        points = _pixels(x[chosen], y[chosen], (left, right), highest)
        shapes += [polyline(part, color, 1.5) for part in _finite_parts(points)]
        shapes.append(element("text", name, x=_LEFT + 8 + 110 * number, y=_TOP - 3, fill=color))
    return _plot(shapes, HEIGHT)


def bar_plot(values: Mapping[str, float | None], unit: str) -> Markup:
    """Plot with a horizontal bar and a number for each name. If the value is None, the bar is missing."""
    widest = max((value for value in values.values() if value is not None), default=0.0) or 1.0
    shapes = []
    for row, (name, value) in enumerate(values.items()):
        y = 18 * row + 14
        width = 0.0 if value is None else (WIDTH - 250) * value / widest
        text = "–" if value is None else f"{value:.1f} {unit}"
        shapes.append(element("text", name, x=150, y=y, text_anchor="end"))
        shapes.append(element("rect", x=158, y=y - 10, width=width, height=12, fill=COLORS[0]))
        shapes.append(element("text", text, x=164 + width, y=y))
    return _plot(shapes, 18 * len(values) + 8)


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
            for start, end in edges:
                if np.isfinite(pixels[[start, end]]).all():
                    (x1, y1), (x2, y2) = pixels[[start, end]].tolist()
                    shapes.append(element("line", x1=x1, y1=y1, x2=x2, y2=y2, stroke=color))
            for x, y in pixels[np.isfinite(pixels).all(axis=1)].tolist():
                shapes.append(element("circle", cx=x, cy=y, r=2.5, fill=color))
    return _plot(shapes, 240, 500)


def _axes(span: tuple[float, float], highest: float, x_label: str, y_label: str) -> list[Markup]:
    bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
    shapes = []
    for value in _ticks(0.0, highest):
        y = bottom - value / highest * (bottom - _TOP)
        shapes.append(element("line", x1=_LEFT, y1=y, x2=right, y2=y, stroke="#cdd1d7"))
        shapes.append(element("text", f"{value:g}", x=_LEFT - 5, y=y + 4, text_anchor="end"))
    for value in _ticks(*span):
        x = _LEFT + (value - span[0]) / ((span[1] - span[0]) or 1.0) * (right - _LEFT)
        shapes.append(element("text", f"{value:g}", x=x, y=bottom + 14, text_anchor="middle"))
    middle = (_LEFT + right) / 2
    shapes.append(element("text", x_label, x=middle, y=HEIGHT - 4, text_anchor="middle"))
    upright = f"translate(12 {HEIGHT / 2}) rotate(-90)"
    return [*shapes, element("text", y_label, transform=upright, text_anchor="middle")]


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from low to high: multiples of 1, 2 or 5 times a power of ten, at most six."""
    if not high > low:
        return [low]
    power = 10.0 ** np.floor(np.log10((high - low) / _INTERVALS))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor * _INTERVALS >= high - low)
    first, last = np.ceil(low / step - 1e-9) + 0.0, np.floor(high / step + 1e-9)
    # rounded, since a product such as 3 * 0.1 has a wrong last digit
    return [float(f"{number * step:.12g}") for number in np.arange(first, last + 1).tolist()]


def _pixels(x: Array, y: Array, span: tuple[float, float], highest: float) -> Array:
    width, height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    share = (x - span[0]) / ((span[1] - span[0]) or 1.0)
    return np.stack([_LEFT + width * share, HEIGHT - _BOTTOM - height * np.minimum(y / highest, 1)], axis=1)


def _finite_parts(points: Array) -> list[Array]:
    """Divide a line of points (N, 2) into parts without points that are not finite."""
    finite = np.isfinite(points).all(axis=1)
    ends = np.flatnonzero(np.diff(finite)) + 1
    parts = zip(np.split(points, ends), np.split(finite, ends), strict=True)
    return [part for part, known in parts if len(part) and known[0]]


def _plot(shapes: Sequence[str], height: int, width: int = WIDTH) -> Markup:
    return svg(shapes, width, height, font_family="sans-serif", font_size="11", fill="#3c4048")


#: Pairs of joints of the package's skeleton that are connected by a line in drawn poses.
_LINES = (
    "vt3_end vt3 l_shoulder l_elbow l_wrist",
    "vt3 r_shoulder r_elbow r_wrist",
    "l_shoulder l_hip l_knee l_ankle",
    "r_shoulder r_hip r_knee r_ankle",
    "l_hip r_hip",
    "l_shoulder r_shoulder",
)


def html_report(evaluation: Evaluation, pictures: Pictures | None = None) -> str:
    """HTML page with tables, errors over time and by joint, PCK curve, people by frame, and worst poses.

    ``pictures``: images of the cameras, to draw the worst poses over. If None, the page has no images.

    Raises:
        HumansimError: An image cannot be rendered or read.
    """
    e = evaluation
    views = "From the front, and from above"
    if pictures is not None:
        views = "In the camera that shows most of the person, from the front, and from above"
    figures = [
        section("Metrics", table((), summary(e))),
        section("Error over time", _error_over_time(e)),
        section("Error by joint (MPJPE)", bar_plot({n: _mm(j.mpjpe) for n, j in e.by_joint.items()}, "mm")),
        section("Share of correct joints (PCK) by threshold", _pck_curve(e)),
        section("People by frame", _people_over_time(e)),
        section("People", _people_table(e)),
        section(
            "Error by number of cameras with the joint in their image",
            table(("cameras", "joints", "MPJPE"), camera_count_rows(e)) if e.by_cameras else "",
        ),
    ]
    return _page(
        e,
        element("div", *figures, class_="row"),
        element("h2", "Worst poses"),
        element("p", f"{views}, in the colours of truth and estimate."),
        element("div", *_worst(e, pictures), class_="row"),
    )


def table_html_report(
    evaluation: BoxEvaluation | NavigationEvaluation,
    metrics: Iterable[Sequence[str]],
    header: Sequence[str],
    people: Iterable[Sequence[str]],
) -> str:
    """HTML page with two tables: metrics and people.

    Args:
        evaluation: The result; the page shows where truth and estimate come from.
        metrics: Rows of the table of metrics.
        header: Names of the columns of the table of people.
        people: Rows of the table of people.
    """
    figures = section("Metrics", table((), metrics)), section("People", table(header, people))
    return _page(evaluation, element("div", *figures, class_="row"))


def _page(evaluation: AnyEvaluation, *content: str) -> str:
    return page(
        "Evaluation",
        "evaluation",
        element("h1", "Evaluation"),
        element("p", f"Truth: {evaluation.truth}", class_="truth"),
        element("p", f"Estimate: {evaluation.estimate}", class_="estimate"),
        *content,
    )


def _mm(metres: float | None) -> float | None:
    return None if metres is None else metres * 1000


def _seconds(e: Evaluation) -> Array:
    """Times (N,) of the compared frames since the first one."""
    return np.asarray((e.frame_times - e.frame_times[0]) * 1e-9, float)


def _error_over_time(e: Evaluation) -> Markup:
    times = _seconds(e)
    with np.errstate(invalid="ignore"):
        count = np.isfinite(e.errors).sum(axis=1)
        mean = 1000 * np.nansum(e.errors, axis=1) / np.where(count, count, np.nan)
    lines = {}
    for person in e.by_person:
        error = np.full(len(times), np.nan)
        rows = [index for index, name in enumerate(e.matches.person) if name == person]
        error[e.matches.frame[rows]] = mean[rows]
        lines[person] = times, error
    return line_plot(lines, "time (s)", "mean error (mm)")


def _pck_curve(e: Evaluation) -> Markup:
    shares = [100 * (pck(e.counted_errors, float(t), e.missed_joints) or 0.0) for t in AUC_THRESHOLDS]
    return line_plot({"PCK": (1000 * AUC_THRESHOLDS, np.array(shares))}, "threshold (mm)", "share (%)", 100)


def _people_over_time(e: Evaluation) -> Markup:
    counts = e.found_by_frame.astype(float)
    lines = {name: (_seconds(e), counts[:, i]) for i, name in enumerate(("found", "missed", "false"))}
    return line_plot(lines, "time (s)", "people")


def _people_table(e: Evaluation) -> Markup:
    rows = (
        (
            name,
            f"{p.found} of {p.present}",
            millimetres(p.mpjpe),
            millimetres(p.pa_mpjpe),
            percent(e.pcp.by_person.get(name)),
        )
        for name, p in e.by_person.items()
    )
    return table(("person", "found", "MPJPE", "PA-MPJPE", "PCP"), rows)


def _worst(e: Evaluation, pictures: Pictures | None) -> list[Markup]:
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
        sections.append(section(title, joined([over, pose_plot(truth, estimate, edges)])))
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
    drawn = picture(draw_over(image, shapes), f"{pose.person} in {found}")
    return joined([element("p", found), drawn, element("br")])


def image_html_report(evaluation: ImageEvaluation, pictures: Pictures | None = None) -> str:
    """HTML page with tables and, for each kind of detection, the worst detections drawn over the images.

    ``pictures``: images to draw over. If None, no images are shown.

    Raises:
        HumansimError: An image cannot be rendered or read.
    """
    parts = [section("Metrics", table((), image_summary(evaluation)))]
    for kind, scores in evaluation.kinds.items():
        title, word = TITLES[kind]
        parts += [
            section(f"{title.capitalize()}: cameras", table(camera_header(kind), camera_rows(scores))),
            section(
                f"{title.capitalize()}: people and objects",
                table(("name", "found", f"mean {word}"), name_rows(scores)),
            ),
        ]
        if scores.by_part:
            parts.append(section("Face and hands", table(PART_HEADER, part_rows(scores))))
        if scores.by_keypoint:
            bars = {name: each.error for name, each in scores.by_keypoint.items()}
            parts.append(section("Error by keypoint", bar_plot(bars, "px")))
            rows = table(("keypoint", "error", "bias x, y (px)"), keypoint_rows(scores))
            parts.append(section("Keypoints", rows))
    content = [element("div", *parts, class_="row")]
    for kind, scores in evaluation.kinds.items() if pictures is not None else ():
        title, word = TITLES[kind]
        content.append(element("h2", f"Worst {title}"))
        content.append(element("p", "In the colours of truth and estimate."))
        pairs = []
        for worst in scores.worst:
            error = f", {pixels(worst.error)}" if worst.error is not None else ""
            heading = (
                f"{worst.name} in {worst.camera}, frame {worst.frame}: {word} {percent(worst.similarity)}"
            )
            pairs.append(section(heading + error, _picture(evaluation, kind, worst, pictures)))
        content.append(element("div", *pairs, class_="row"))
    return _page(evaluation, *content)


def _picture(evaluation: ImageEvaluation, kind: str, worst: WorstImage, pictures: Pictures | None) -> Markup:
    image = pictures.image(worst.stamp, worst.camera) if pictures is not None else None
    if image is None:
        return Markup()
    truth, estimate = evaluation.matches[kind, worst.image, worst.name]
    shapes = [_shape(evaluation, kind, truth, TRUTH_COLOR)]
    if estimate is not None:
        shapes.append(_shape(evaluation, kind, estimate, ESTIMATE_COLOR))
    return picture(draw_over(image, shapes), f"{worst.name} in {worst.camera}")


def _shape(
    evaluation: ImageEvaluation, kind: str, row: Mapping[str, Any], color: tuple[int, int, int]
) -> Shape:
    """Shape to draw for an annotation or a detection ``row`` of COCO."""
    nothing = np.zeros((0, 2))
    if kind == "keypoints":
        points = np.reshape(np.asarray(row["keypoints"], float), (-1, 3))
        absent = ~points.any(axis=1) | (points[:, 2] <= 0)
        known, scores = keypoint_set(evaluation.keypoint_set), evaluation.keypoints
        edges = known.subset([known.index(name) for name in scores.by_keypoint]).edges if scores else ()
        return Shape(color, np.where(absent[:, None], np.nan, points[:, :2]), edges)
    if kind == "boxes":
        return Shape(color, nothing, box=np.asarray(row["bbox"], float))
    from pycocotools.mask import decode

    return Shape(color, nothing, mask=decode(row["segmentation"]).astype(bool))
