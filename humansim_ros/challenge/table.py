"""The table of a challenge for a terminal, of one tracker or of two side by side."""

from __future__ import annotations

from collections.abc import Iterator

from humansim_ros.challenge.results import CaseResult, Report


def show_table(report: Report, other: Report | None = None) -> str:
    """The table: for each axis the scores of its strengths, errors of the last one, and where it breaks."""
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
    return "\n".join([*(line.rstrip() for line in lines), "", *legend, *failed, *_points(reports)])


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
    """Error, found people and IDF1."""
    if result is None:
        return ["–"] * 3
    error = "–" if result.mpjpe is None else f"{1000 * result.mpjpe:.0f} mm"
    return [error, *("–" if each is None else f"{each:.0%}" for each in (result.recall, result.idf1))]
