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

#: Colours by share of the baseline's score. They also differ in lightness.
_SCALE = ((0.0, "#b3324b"), (0.45, "#e0693f"), (0.7, "#f2b84b"), (0.85, "#7fb77e"), (1.0, "#1f8a84"))
#: Most characters of a command line that are shown.
_MAX_COMMAND = 100
#: File names of the picture and of the HTML page in the folder of a report.
PICTURE, PAGE = "challenge.svg", "index.html"


def picture(report: Report, other: Report | None = None) -> Markup:
    """Picture of the results as SVG. ``other``: report of a second tracker, shown below the first."""
    reports = [report] if other is None else [report, other]
    groups: dict[str, list[dict[str, Any]]] = {}
    for name, info in report.axes.items():
        if report.of_axis(name):
            rows = [_row(each, name) for each in reports]
            groups.setdefault(info.group, []).append(
                {"title": info.title, "labels": info.labels, "rows": rows}
            )
    cases = sum(1 for each in report.results.values() if each.strength)
    quick = ", quick" if report.settings.get("is_quick") else ""
    return drawing(
        "challenge",
        suite=f"suite {report.suite}{quick} · {cases} cases",
        trackers=[_tracker(each) for each in reports],
        groups=groups,
        limit=report.breaks_below,
        color_of=color_of,
        legend=f"✕ broken: failed, or score or IDF1 below {report.breaks_below:.0%} of the baseline · "
        "score: joints within 150 mm × real people among the found ones, %",
    )


def _tracker(report: Report) -> dict[str, Any]:
    """What the head of the picture shows of a tracker."""
    name = report.tracker if len(report.tracker) <= _MAX_COMMAND else f"{report.tracker[:_MAX_COMMAND]}…"
    return {"name": name, "baseline": _baseline_words(report.baseline), "points": report.points}


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


def _row(report: Report, axis: str) -> dict[str, Any]:
    """What a row of the picture shows of a tracker: tiles by strength, the curve of its scores, and where
    it breaks. Scores are shares of the score of the baseline."""
    results, broken = report.of_axis(axis), report.breaks_at(axis)
    tiles = {
        each.strength: {
            "title": f"{each.label}: {each.failure or f'score {each.score:.0f}'}",
            "share": _share(report, each),
            "number": "failed" if each.failure else f"{each.score:.0f}",
            "is_broken": report.is_broken(each),
        }
        for each in results
    }
    curve = [
        (each.strength / STRENGTHS, min(1.0, _share(report, each)), report.is_broken(each))
        for each in ([] if report.baseline is None else [report.baseline]) + results
    ]
    return {
        "tiles": [tiles.get(strength) for strength in range(1, STRENGTHS + 1)],
        "curve": curve,
        "breaks_at": None if broken is None else broken.label,
    }


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
