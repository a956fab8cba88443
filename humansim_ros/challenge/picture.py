"""The picture of a challenge: a tile for each case, coloured by its score, of one tracker or of two."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from itertools import pairwise

from humansim_ros.challenge.results import CaseResult, Report
from humansim_ros.challenge.suite import STRENGTHS

#: Width of the picture, and its margin, pixels.
WIDTH, _MARGIN = 1180, 40
#: Left edges of the tiles and of the curves; width, height and distance of tiles.
_TILES, _CURVES, _TILE, _HEIGHT, _GAP = 250, 812, 180, 30, 6
#: Width of a curve.
_CURVE = 96
#: Heights of the head and of the heading of a group.
_HEAD, _GROUP = 176, 40
_INK, _PALE, _BACK, _PAPER = "#1d2433", "#6b7385", "#f3f5f8", "#ffffff"
#: Colours by share of the baseline's score; they differ in lightness, too.
_SCALE = ((0.0, "#b3324b"), (0.45, "#e0693f"), (0.7, "#f2b84b"), (0.85, "#7fb77e"), (1.0, "#1f8a84"))
#: Colours of the trackers.
_TRACKERS = ("#1f4e9c", "#c2561a")
#: Most characters of a command, and of the label of a tile.
_MAX_COMMAND, _MAX_LABEL = 100, 21


def picture(report: Report, other: Report | None = None) -> str:
    """The picture as SVG. ``other``: a second tracker, whose tiles stand below those of the first."""
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
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" '
        f'height="{height}" '
        f"font-family=\"Inter, 'Segoe UI', 'DejaVu Sans', Helvetica, sans-serif\">"
        f'<rect width="{WIDTH}" height="{height}" fill="{_PAPER}"/>{"".join(shapes)}</svg>\n'
    )


def _groups(report: Report) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name, info in report.axes.items():
        if report.of_axis(name):
            groups.setdefault(info.group, []).append(name)
    return groups


def _head(reports: Sequence[Report]) -> Iterator[str]:
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
        yield f'<rect x="{_MARGIN}" y="{y - 12}" width="4" height="32" rx="2" fill="{color}"/>'
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


def _ring(report: Report, x: int, y: int, index: int, count: int) -> Iterator[str]:
    """Robustness as a ring around its number."""
    if report.points is None:
        return
    length = 2 * 3.14159265 * 40
    filled = length * report.points / 100
    color = _TRACKERS[index] if count > 1 else color_of(report.points / 100)
    yield f'<circle cx="{x}" cy="{y}" r="40" fill="none" stroke="{_BACK}" stroke-width="11"/>'
    yield (
        f'<circle cx="{x}" cy="{y}" r="40" fill="none" stroke="{color}" stroke-width="11" '
        f'stroke-linecap="round" stroke-dasharray="{filled:.1f} {length:.1f}" '
        f'transform="rotate(-90 {x} {y})"/>'
    )
    yield _text(x, y + 10, f"{report.points:.0f}", 28, _INK, "700", "middle")
    letter = f"{'AB'[index]}: " if count > 1 else ""
    yield _text(x, y + 66, f"{letter}robustness", 12, _PALE, anchor="middle")


def _row(reports: Sequence[Report], axis: str, y: int) -> Iterator[str]:
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


def _tile(report: Report, result: CaseResult | None, label: str, x: int, y: int) -> Iterator[str]:
    if result is None:
        yield f'<rect x="{x}" y="{y}" width="{_TILE}" height="{_HEIGHT}" rx="6" fill="{_BACK}"/>'
        yield _text(x + 12, y + 20, _short(label), 12, "#a3aab8")
        return
    share = _share(report, result)
    fill = color_of(share)
    ink = "#ffffff" if share < 0.5 or share > 0.93 else _INK
    title = f"{result.label}: {result.failure or f'score {result.score:.0f}'}"
    yield f"<g><title>{escape(title)}</title>"
    yield f'<rect x="{x}" y="{y}" width="{_TILE}" height="{_HEIGHT}" rx="6" fill="{fill}"/>'
    yield _text(x + 12, y + 20, _short(label), 12, ink)
    number = f"{result.score:.0f}" if not result.failure else "failed"
    mark = "✕ " if report.is_broken(result) else ""
    yield _text(x + _TILE - 12, y + 20, f"{mark}{number}", 14, ink, "700", "end")
    yield "</g>"


def _curve(report: Report, axis: str, x: int, y: int) -> Iterator[str]:
    """Score from the baseline on, as a small curve, with the line below which the tracker is broken."""
    base = report.baseline
    results = ([base] if base is not None else []) + report.of_axis(axis)
    bottom, height = y + _HEIGHT - 5, _HEIGHT - 10
    points = [
        (x + _CURVE * each.strength / STRENGTHS, bottom - height * min(1.0, _share(report, each)), each)
        for each in results
    ]
    limit = bottom - height * report.breaks_below
    ends = f'x1="{x}" y1="{limit:.1f}" x2="{x + _CURVE}" y2="{limit:.1f}"'
    yield f'<line {ends} stroke="#c9cfda" stroke-dasharray="3 3"/>'
    path = " ".join(f"{px:.1f},{py:.1f}" for px, py, _ in points)
    yield f'<polyline points="{path}" fill="none" stroke="{_INK}" stroke-width="1.6"/>'
    for px, py, each in points:
        fill = _SCALE[0][1] if report.is_broken(each) else _INK
        yield f'<circle cx="{px:.1f}" cy="{py:.1f}" r="3" fill="{fill}"/>'


def _legend(report: Report, y: int) -> Iterator[str]:
    for index in range(60):
        x = _TILES + 3 * index
        yield f'<rect x="{x}" y="{y - 10}" width="3.5" height="12" fill="{color_of(index / 59)}"/>'
    yield _text(_TILES - 8, y, "0", 12, _PALE, anchor="end")
    yield _text(_TILES + 188, y, "score of the baseline", 12, _PALE)
    words = (
        f"✕ broken: failed, or score or IDF1 below {report.breaks_below:.0%} of the baseline · "
        "score: joints within 150 mm × real people among the found ones, %"
    )
    yield _text(WIDTH - _MARGIN, y + 24, words, 12, _PALE, anchor="end")


def _share(report: Report, result: CaseResult) -> float:
    """Score as a share of the baseline's; 0 for a failure."""
    base = report.baseline
    if result.failure:
        return 0.0
    return result.score / base.score if base is not None and base.score else result.score / 100


def color_of(share: float) -> str:
    """Colour of a score, given as a share of the best."""
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
    spacing: float = 0.0,
) -> str:
    extra = f' letter-spacing="{spacing:g}"' if spacing else ""
    return (
        f'<text x="{x:g}" y="{y:g}" font-size="{size}" font-weight="{weight}" fill="{color}" '
        f'text-anchor="{anchor}"{extra}>{escape(text)}</text>'
    )
