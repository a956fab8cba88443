"""Show the results of a challenge: as a table in a terminal, as a picture, and as an HTML page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from humansim_ros.data.formats import Markup, element, page, polyline, svg, table
from humansim_ros.files.reading import atomic_path
from humansim_ros.ros.challenge.results import CaseResult, Report
from humansim_ros.ros.challenge.suite import STRENGTHS

#: Width and margin of the picture, pixels.
WIDTH, _MARGIN = 1180, 40
#: Left edges of the tiles of cases and of the curves; width, height and distance of tiles, pixels.
_TILES, _CURVES, _TILE, _HEIGHT, _GAP = 250, 812, 180, 30, 6
#: Width of a curve, pixels.
_CURVE = 96
#: Heights of the head of the picture, and of the heading of a group of axes, pixels.
_HEAD, _GROUP = 176, 40
_INK, _PALE, _BACK, _PAPER = "#1d2433", "#6b7385", "#f3f5f8", "#ffffff"
#: Colours by share of the baseline's score. They also differ in lightness.
_SCALE = ((0.0, "#b3324b"), (0.45, "#e0693f"), (0.7, "#f2b84b"), (0.85, "#7fb77e"), (1.0, "#1f8a84"))
#: Colours of the trackers.
_TRACKERS = ("#1f4e9c", "#c2561a")
#: Most characters of a command line, and of the label of a tile, that are shown.
_MAX_COMMAND, _MAX_LABEL = 100, 21
#: File names of the picture and of the HTML page in the folder of a report.
PICTURE, PAGE = "challenge.svg", "index.html"


def picture(report: Report, other: Report | None = None) -> Markup:
    """Picture of the results as SVG. ``other``: report of a second tracker, shown below the first."""
    reports = [report] if other is None else [report, other]
    shapes = list(_head(reports))
    y = _HEAD + 26 * (len(reports) - 1)
    for group, axes in _groups(report).items():
        shapes.append(_text(_MARGIN, y + 26, group.upper(), 12, _PALE, "700", spacing=1.5))
        y += _GROUP
        for axis in axes:
            shapes += _row(reports, axis, y)
            y += len(reports) * (_HEIGHT + 2) + _GAP + (4 if len(reports) > 1 else 0)
    shapes += _legend(report, y + 24)
    height = y + 66
    fonts = "Inter, 'Segoe UI', 'DejaVu Sans', Helvetica, sans-serif"
    paper = element("rect", width=WIDTH, height=height, fill=_PAPER)
    return svg([paper, *shapes], WIDTH, height, font_family=fonts)


def _groups(report: Report) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name, info in report.axes.items():
        if report.of_axis(name):
            groups.setdefault(info.group, []).append(name)
    return groups


def _head(reports: Sequence[Report]) -> Iterator[Markup]:
    yield _text(_MARGIN, 62, "Where does the tracker break?", 30, _INK, "700")
    cases = sum(1 for each in reports[0].results.values() if each.strength)
    quick = ", quick" if reports[0].settings.get("is_quick") else ""
    yield _text(
        _MARGIN, 88, f"humansim challenge · suite {reports[0].suite}{quick} · {cases} cases", 14, _PALE
    )
    for index, report in enumerate(reports):
        y = 122 + 40 * index
        color = _TRACKERS[index]
        letter = f"{'AB'[index]}  " if len(reports) > 1 else ""
        name = report.tracker if len(report.tracker) <= _MAX_COMMAND else f"{report.tracker[:_MAX_COMMAND]}…"
        yield element("rect", x=_MARGIN, y=y - 12, width=4, height=32, rx=2, fill=color)
        yield _text(_MARGIN + 14, y, f"{letter}{name}", 14, _INK, "600")
        yield _text(_MARGIN + 14, y + 18, _baseline_words(report.baseline), 13, _PALE)
    for index, report in enumerate(reports):
        yield from _ring(
            report, WIDTH - _MARGIN - 52 - 130 * (len(reports) - 1 - index), 78, index, len(reports)
        )


def _baseline_words(base: CaseResult | None) -> str:
    if base is None:
        return "no baseline"
    words = [f"without difficulty: score {base.score:.0f}"]
    if base.mpjpe is not None:
        words.append(f"error {1000 * base.mpjpe:.0f} mm")
    words += [
        f"{name} {value:.0%}"
        for name, value in (("found", base.recall), ("IDF1", base.idf1))
        if value is not None
    ]
    return " · ".join(words)


def _ring(report: Report, x: int, y: int, index: int, count: int) -> Iterator[Markup]:
    """Draw the robustness of a tracker (0 to 100) as a ring around this number."""
    if report.points is None:
        return
    length = 2 * 3.14159265 * 40
    filled = length * report.points / 100
    color = _TRACKERS[index] if count > 1 else color_of(report.points / 100)
    yield element("circle", cx=x, cy=y, r=40, fill="none", stroke=_BACK, stroke_width=11)
    yield element(
        "circle",
        cx=x,
        cy=y,
        r=40,
        fill="none",
        stroke=color,
        stroke_width=11,
        stroke_linecap="round",
        stroke_dasharray=f"{filled:.1f} {length:.1f}",
        transform=f"rotate(-90 {x} {y})",
    )
    yield _text(x, y + 10, f"{report.points:.0f}", 28, _INK, "700", "middle")
    letter = f"{'AB'[index]}: " if count > 1 else ""
    yield _text(x, y + 66, f"{letter}robustness", 12, _PALE, anchor="middle")


def _row(reports: Sequence[Report], axis: str, y: int) -> Iterator[Markup]:
    info = reports[0].axes[axis]
    middle = y + len(reports) * (_HEIGHT + 2) / 2
    yield _text(_MARGIN, middle + 5, info.title, 15, _INK, "600")
    for index, report in enumerate(reports):
        results = {each.strength: each for each in report.of_axis(axis)}
        top = y + index * (_HEIGHT + 2)
        for strength in range(1, STRENGTHS + 1):
            x = _TILES + (strength - 1) * (_TILE + _GAP)
            label = info.labels[strength - 1] if index == 0 else ""
            yield from _tile(report, results.get(strength), label, x, top)
        if len(reports) > 1:
            yield _text(_TILES - 16, top + 20, "AB"[index], 12, _TRACKERS[index], "700", "middle")
        yield from _curve(report, axis, _CURVES, top)
        broken = report.breaks_at(axis)
        words = "holds" if broken is None else f"breaks at {broken.label}"
        color, weight = (_PALE, "400") if broken is None else (_SCALE[0][1], "600")
        yield _text(_CURVES + _CURVE + 18, top + 20, words, 13, color, weight)


def _tile(report: Report, result: CaseResult | None, label: str, x: int, y: int) -> Iterator[Markup]:
    back = {"x": x, "y": y, "width": _TILE, "height": _HEIGHT, "rx": 6}
    if result is None:
        yield element("rect", **back, fill=_BACK)
        yield _text(x + 12, y + 20, _short(label), 12, "#a3aab8")
        return
    share = _share(report, result)
    fill = color_of(share)
    ink = "#ffffff" if share < 0.5 or share > 0.93 else _INK
    title = f"{result.label}: {result.failure or f'score {result.score:.0f}'}"
    number = f"{result.score:.0f}" if not result.failure else "failed"
    mark = "✕ " if report.is_broken(result) else ""
    yield element(
        "g",
        element("title", title),
        element("rect", **back, fill=fill),
        _text(x + 12, y + 20, _short(label), 12, ink),
        _text(x + _TILE - 12, y + 20, f"{mark}{number}", 14, ink, "700", "end"),
    )


def _curve(report: Report, axis: str, x: int, y: int) -> Iterator[Markup]:
    """Draw a small curve of the score over the strength of a difficulty, from the baseline on; with a line at
    the limit below which the tracker is broken."""
    base = report.baseline
    results = ([base] if base is not None else []) + report.of_axis(axis)
    bottom, height = y + _HEIGHT - 5, _HEIGHT - 10
    points = [
        (x + _CURVE * each.strength / STRENGTHS, bottom - height * min(1.0, _share(report, each)), each)
        for each in results
    ]
    limit = bottom - height * report.breaks_below
    dashed = {"stroke": "#c9cfda", "stroke_dasharray": "3 3"}
    yield element("line", x1=x, y1=limit, x2=x + _CURVE, y2=limit, **dashed)
    yield polyline([(px, py) for px, py, _ in points], _INK, 1.6)
    for px, py, each in points:
        fill = _SCALE[0][1] if report.is_broken(each) else _INK
        yield element("circle", cx=px, cy=py, r=3, fill=fill)


def _legend(report: Report, y: int) -> Iterator[Markup]:
    for index in range(60):
        x = _TILES + 3 * index
        yield element("rect", x=x, y=y - 10, width=3.5, height=12, fill=color_of(index / 59))
    yield _text(_TILES - 8, y, "0", 12, _PALE, anchor="end")
    yield _text(_TILES + 188, y, "score of the baseline", 12, _PALE)
    words = (
        f"✕ broken: failed, or score or IDF1 below {report.breaks_below:.0%} of the baseline · "
        "score: joints within 150 mm × real people among the found ones, %"
    )
    yield _text(WIDTH - _MARGIN, y + 24, words, 12, _PALE, anchor="end")


def _share(report: Report, result: CaseResult) -> float:
    """Score of a case divided by the score of the baseline. 0 if the case failed."""
    base = report.baseline
    if result.failure:
        return 0.0
    return result.score / base.score if base is not None and base.score else result.score / 100


def color_of(share: float) -> str:
    """Colour for a score that is given as a share of the baseline's score."""
    value = min(1.0, max(0.0, share))
    for (low, first), (high, second) in pairwise(_SCALE):
        if value <= high:
            part = (value - low) / (high - low)
            mixed = (
                round(int(first[i : i + 2], 16) * (1 - part) + int(second[i : i + 2], 16) * part)
                for i in (1, 3, 5)
            )
            return "#" + "".join(f"{channel:02x}" for channel in mixed)
    return _SCALE[-1][1]


def _short(label: str) -> str:
    return label if len(label) <= _MAX_LABEL else f"{label[: _MAX_LABEL - 1]}…"


def _text(
    x: float,
    y: float,
    text: str,
    size: int,
    color: str,
    weight: str = "400",
    anchor: str = "start",
    spacing: float | None = None,
) -> Markup:
    return element(
        "text",
        text,
        x=x,
        y=y,
        font_size=size,
        font_weight=weight,
        fill=color,
        text_anchor=anchor,
        letter_spacing=spacing,
    )


def _millimetres(value: float | None) -> str:
    return "–" if value is None else f"{1000 * value:.1f} mm"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.1%}"


_COLUMNS: dict[str, Callable[[CaseResult], str]] = {
    "score": lambda r: f"{r.score:.1f}",
    "error (MPJPE)": lambda r: _millimetres(r.mpjpe),
    "joints within 150 mm": lambda r: _percent(r.pck),
    "people found": lambda r: _percent(r.recall),
    "found people who are real": lambda r: _percent(r.precision),
    "IDF1": lambda r: _percent(r.idf1),
    "switches": lambda r: "–" if r.switches is None else str(r.switches),
    "frames with estimate": lambda r: f"{r.estimates} of {r.frames}",
    "latency": lambda r: "–" if r.latency is None else f"{1000 * r.latency:.0f} ms",
    "failure": lambda r: r.failure,
}


#: Warning about a tracker that uses no images.
BLIND = (
    "This tracker subscribes to no topic of images: difficulties of images do not reach it, and its score "
    "says nothing about them."
)


def write_pages(folder: Path, report: Report, other: Report | None = None) -> Sequence[Path]:
    """Write the picture and the HTML page into the folder of a report.

    Returns:
        Paths of both files.

    Raises:
        HumansimError: A file cannot be written.
    """
    contents = {PICTURE: f"{picture(report, other)}\n", PAGE: html_page(report, other)}
    for name, content in contents.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return [folder / name for name in contents]


def html_page(report: Report, other: Report | None = None) -> str:
    """HTML page with the picture, and with the numbers of all cases."""
    reports = {"": report} if other is None else {"A: ": report, "B: ": other}
    tables = [
        part
        for name, each in reports.items()
        for part in (
            element("h2", f"{name}{each.tracker}"),
            *([element("p", BLIND)] if each.is_blind else ()),
            _html_table(each),
        )
    ]
    return page("Crash test of a tracker", "challenge", picture(report, other), *tables)


def _html_table(report: Report) -> Markup:
    rows, classes = [], []
    for result in report.results.values():
        info = report.axes.get(result.axis)
        rows.append(
            (
                "Baseline" if info is None else info.title,
                result.label if result.strength else "",
                *(show(result) for show in _COLUMNS.values()),
            )
        )
        classes.append("broken" if report.is_broken(result) else None)
    return table(("case", "strength", *_COLUMNS), rows, classes)


def show_table(report: Report, other: Report | None = None) -> str:
    """Table for a terminal. It has for each axis (difficulty) the score at each strength, the errors at the
    last strength, and the strength that breaks the tracker."""
    reports = [report] if other is None else [report, other]
    rows = [list(_header(reports))]
    base = ["baseline"]
    for each in reports:
        base += ["", "", "", *_summary(each.baseline), ""]
    rows.append(base)
    for axis, info in report.axes.items():
        if not report.of_axis(axis):
            continue
        row = [info.title]
        for each in reports:
            results = {result.strength: result for result in each.of_axis(axis)}
            row += [_score(each, results.get(strength)) for strength in (1, 2, 3)]
            row += _summary(results[max(results)] if results else None)
            broken = each.breaks_at(axis)
            row.append("" if broken is None else broken.label)
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    legend = [
        "score: joints within 150 mm (PCK) times real people among the estimated ones, percent",
        f"*: broken: it failed, or score or IDF1 is below {report.breaks_below:.0%} of the baseline's",
        "error, found, IDF1: at the greatest strength that was run",
    ]
    failed = [
        f"{f'{name}: ' if name else ''}{result.name}: {result.failure}"
        for name, each in zip(("A", "B") if other else ("",), reports, strict=True)
        for result in each.results.values()
        if result.failure
    ]
    blind = [BLIND] if any(each.is_blind for each in reports) else []
    return "\n".join([*(line.rstrip() for line in lines), "", *legend, *failed, *blind, *_points(reports)])


def _header(reports: list[Report]) -> Iterator[str]:
    yield "axis"
    for name in ("",) if len(reports) == 1 else ("A ", "B "):
        yield from (f"{name}1", f"{name}2", f"{name}3", "error", "found", "IDF1", "breaks at")


def _points(reports: list[Report]) -> Iterator[str]:
    for name, each in zip(("",) if len(reports) == 1 else ("A: ", "B: "), reports, strict=True):
        if each.points is not None:
            yield f"{name}robustness {each.points:.0f} of 100 ({each.tracker})"


def _score(report: Report, result: CaseResult | None) -> str:
    if result is None:
        return "–"
    return f"{result.score:.0f}{'*' if report.is_broken(result) else ''}"


def _summary(result: CaseResult | None) -> list[str]:
    """Cells of a table about a case: mean joint error, share of people found, and IDF1."""
    if result is None:
        return ["–"] * 3
    error = "–" if result.mpjpe is None else f"{1000 * result.mpjpe:.0f} mm"
    return [error, *("–" if each is None else f"{each:.0%}" for each in (result.recall, result.idf1))]
