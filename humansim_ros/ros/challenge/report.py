"""Show the results of a challenge: as a table in a terminal, as a picture, and as an HTML page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from humansim_ros.data.formats import Markup, drawing, page
from humansim_ros.files.reading import write_file
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
_INK, _PALE, _BACK = "#1d2433", "#6b7385", "#f3f5f8"
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
    y = _HEAD + 26 * (len(reports) - 1)
    groups = []
    for name, axes in _groups(report).items():
        heading, shown = y + 26, []
        y += _GROUP
        for axis in axes:
            shown.append(_axis(reports, axis, y))
            y += len(reports) * (_HEIGHT + 2) + _GAP + (4 if len(reports) > 1 else 0)
        groups.append({"name": name.upper(), "y": heading, "axes": shown})
    cases = sum(1 for each in report.results.values() if each.strength)
    quick = ", quick" if report.settings.get("is_quick") else ""
    return drawing(
        "challenge",
        width=WIDTH,
        height=y + 66,
        margin=_MARGIN,
        tiles=_TILES,
        tile_width=_TILE,
        tile_height=_HEIGHT,
        curves=_CURVES,
        curve_width=_CURVE,
        ink=_INK,
        pale=_PALE,
        back=_BACK,
        suite=f"suite {report.suite}{quick} · {cases} cases",
        trackers=[_tracker(each, index, len(reports)) for index, each in enumerate(reports)],
        groups=groups,
        scale=[color_of(index / 59) for index in range(60)],
        legend=f"✕ broken: failed, or score or IDF1 below {report.breaks_below:.0%} of the baseline · "
        "score: joints within 150 mm × real people among the found ones, %",
    )


def _groups(report: Report) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name, info in report.axes.items():
        if report.of_axis(name):
            groups.setdefault(info.group, []).append(name)
    return groups


def _tracker(report: Report, index: int, count: int) -> dict[str, Any]:
    """What the head of the picture shows of a tracker: command, baseline, and robustness as a ring."""
    name = report.tracker if len(report.tracker) <= _MAX_COMMAND else f"{report.tracker[:_MAX_COMMAND]}…"
    ring = _TRACKERS[index] if count > 1 else color_of((report.points or 0.0) / 100)
    return {
        "color": _TRACKERS[index],
        "name": f"{'AB'[index]}  {name}" if count > 1 else name,
        "baseline": _baseline_words(report.baseline),
        "points": report.points,
        "x": WIDTH - _MARGIN - 52 - 130 * (count - 1 - index),
        "ring": ring,
        "label": f"{'AB'[index]}: robustness" if count > 1 else "robustness",
    }


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


def _axis(reports: Sequence[Report], axis: str, y: int) -> dict[str, Any]:
    """Title of an axis, and a row of the picture for each report. ``y``: upper end of the first row."""
    info, rows = reports[0].axes[axis], []
    for index, report in enumerate(reports):
        results = {each.strength: each for each in report.of_axis(axis)}
        top, broken = y + index * (_HEIGHT + 2), report.breaks_at(axis)
        labels = info.labels if index == 0 else ("",) * STRENGTHS
        limit, points = _curve(report, axis, top)
        rows.append(
            {
                "y": top,
                "tiles": [_tile(report, results.get(n), labels[n - 1], n) for n in range(1, STRENGTHS + 1)],
                "letter": "AB"[index] if len(reports) > 1 else "",
                "color": _TRACKERS[index],
                "limit": limit,
                "points": points,
                "words": "holds" if broken is None else f"breaks at {broken.label}",
                "words_color": _PALE if broken is None else _SCALE[0][1],
                "words_weight": "400" if broken is None else "600",
            }
        )
    return {"title": info.title, "middle": y + len(reports) * (_HEIGHT + 2) / 2 + 5, "rows": rows}


def _tile(report: Report, result: CaseResult | None, label: str, strength: int) -> dict[str, Any]:
    short = label if len(label) <= _MAX_LABEL else f"{label[: _MAX_LABEL - 1]}…"
    place = {"x": _TILES + (strength - 1) * (_TILE + _GAP), "label": short}
    if result is None:
        return {**place, "number": None}
    share = _share(report, result)
    mark = "✕ " if report.is_broken(result) else ""
    return {
        **place,
        "title": f"{result.label}: {result.failure or f'score {result.score:.0f}'}",
        "fill": color_of(share),
        "ink": "#ffffff" if share < 0.5 or share > 0.93 else _INK,
        "number": mark + (f"{result.score:.0f}" if not result.failure else "failed"),
    }


def _curve(report: Report, axis: str, y: int) -> tuple[float, list[tuple[float, float, str]]]:
    """Height of the limit below which a tracker is broken; place and colour of each score, from the baseline
    on, over the strength of a difficulty."""
    base, bottom, height = report.baseline, y + _HEIGHT - 5, _HEIGHT - 10
    points = [
        (
            _CURVES + _CURVE * each.strength / STRENGTHS,
            bottom - height * min(1.0, _share(report, each)),
            _SCALE[0][1] if report.is_broken(each) else _INK,
        )
        for each in ([base] if base is not None else []) + report.of_axis(axis)
    ]
    return bottom - height * report.breaks_below, points


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
        write_file(folder / name, content)
    return [folder / name for name in contents]


def html_page(report: Report, other: Report | None = None) -> str:
    """HTML page with the picture, and with the numbers of all cases."""
    reports = {"": report} if other is None else {"A: ": report, "B: ": other}
    trackers = [
        {
            "name": f"{name}{each.tracker}",
            "blind": BLIND if each.is_blind else "",
            "rows": [_cells(each, result) for result in each.results.values()],
            "classes": ["broken" if each.is_broken(result) else "" for result in each.results.values()],
        }
        for name, each in reports.items()
    ]
    header = ("case", "strength", *_COLUMNS)
    title = "Crash test of a tracker"
    return page("challenge", title=title, picture=picture(report, other), trackers=trackers, header=header)


def _cells(report: Report, result: CaseResult) -> tuple[str, ...]:
    info = report.axes.get(result.axis)
    strength = result.label if result.strength else ""
    title = "Baseline" if info is None else info.title
    return (title, strength, *(show(result) for show in _COLUMNS.values()))


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
