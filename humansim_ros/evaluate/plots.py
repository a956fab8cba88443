"""Plots as SVG, for reports that need no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from humansim_ros.drawing.markup import Markup, element, polyline, svg
from humansim_ros.types import Array

WIDTH, HEIGHT = 640, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 12, 14, 34
#: Colours that people with colour blindness tell apart, of Okabe and Ito.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
#: Most intervals between the ticks of an axis.
_INTERVALS = 5
#: Points of a line; more are not seen on a screen.
_MOST_POINTS = 1000


def line_plot(
    lines: Mapping[str, tuple[Array, Array]], x_label: str, y_label: str, top: float = 0.0
) -> Markup:
    """Plot of lines; empty if no value is finite.

    Args:
        lines: x (N,) and y (N,) by name; NaN in y breaks a line.
        x_label: Quantity and unit of x.
        y_label: Quantity and unit of y.
        top: Greatest y of the axis; the greatest y of the lines if 0.
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
    """Plot of a horizontal bar with its value for each name; None has no bar."""
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
    """A pose (C, 3) and its estimate from the front (y to the left, z up) and from above (y left, x up)."""
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
    """Round numbers from low to high: multiples of 1, 2 or 5 times a power of ten, six at most."""
    if not high > low:
        return [low]
    power = 10.0 ** np.floor(np.log10((high - low) / _INTERVALS))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor * _INTERVALS >= high - low)
    first, last = np.ceil(low / step - 1e-9) + 0.0, np.floor(high / step + 1e-9)
    # rounded: a product such as 3 * 0.1 has a wrong last digit
    return [float(f"{number * step:.12g}") for number in np.arange(first, last + 1).tolist()]


def _pixels(x: Array, y: Array, span: tuple[float, float], highest: float) -> Array:
    width, height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    share = (x - span[0]) / ((span[1] - span[0]) or 1.0)
    return np.stack([_LEFT + width * share, HEIGHT - _BOTTOM - height * np.minimum(y / highest, 1)], axis=1)


def _finite_parts(points: Array) -> list[Array]:
    """Runs of finite points (N, 2)."""
    finite = np.isfinite(points).all(axis=1)
    ends = np.flatnonzero(np.diff(finite)) + 1
    parts = zip(np.split(points, ends), np.split(finite, ends), strict=True)
    return [part for part, known in parts if len(part) and known[0]]


def _plot(shapes: Sequence[str], height: int, width: int = WIDTH) -> Markup:
    return svg(shapes, width, height, font_family="sans-serif", font_size="11", fill="#3c4048")
