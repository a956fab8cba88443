"""Elements of HTML and SVG for reports that consist of one file. All texts are escaped."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.files.reading import resource_path
from humansim_ros.types import Array

#: Elements that have no content.
_EMPTY = frozenset(("br", "circle", "img", "line", "polyline", "rect"))
_JPEG_QUALITY = 82


class Markup(str):
    """Text that is HTML or SVG already. It is not escaped again."""


def joined(parts: Iterable[str]) -> Markup:
    """Join elements and texts. Plain texts are escaped."""
    return Markup("".join(part if isinstance(part, Markup) else escape(part) for part in parts))


def element(tag: str, *content: str, **attributes: str | float | None) -> Markup:
    """Make an element of HTML or SVG.

    Args:
        tag: Name of the element.
        content: Elements and texts inside the element.
        attributes: Attributes by name. ``_`` in a name becomes ``-``; at the end (``class_``) it is removed.
            Numbers have at most two decimals. None leaves the attribute out.

    Example:
        >>> print(element("text", "a < b", font_size=12.0, class_="title"))
        <text font-size="12" class="title">a &lt; b</text>
    """
    words = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(_value(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{tag}{words}/>" if tag in _EMPTY else f"<{tag}{words}>{joined(content)}</{tag}>")


def _value(value: str | float) -> str:
    return f"{round(value, 2) + 0.0:.10g}" if isinstance(value, float) else str(value)


def page(title: str, style: str, *content: str) -> str:
    """Text of an HTML page. ``style``: name of a style sheet in ``config/styles``."""
    sheet = resource_path(f"config/styles/{style}.css").read_text("utf-8")
    head = element("head", Markup('<meta charset="utf-8">'), element("title", title))
    head = Markup(head.replace("</head>", f"<style>\n{sheet}</style></head>"))
    body = element("body", *content)
    return f'<!DOCTYPE html>\n<html lang="en">{head}\n{body}</html>\n'


def section(title: str, content: str) -> Markup:
    """A section of a page: a heading and content."""
    return element("section", element("h2", title), content or element("p", "No data."))


def table(header: Sequence[str], rows: Iterable[Sequence[str]], classes: Iterable[str | None] = ()) -> Markup:
    """Table of texts. ``classes``: class of each row. If empty, rows have no class."""
    lines = [element("tr", *(element("th", word) for word in header))] if header else []
    kinds = iter(classes)
    for row in rows:
        lines.append(element("tr", *(element("td", cell) for cell in row), class_=next(kinds, None)))
    return element("table", *lines)


def picture(image: NDArray[np.uint8], title: str) -> Markup:
    """Element with an image (H, W, 3) RGB, embedded as JPEG."""
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    data = base64.b64encode(encoded.tobytes()).decode("ascii")
    height, width = image.shape[:2]
    return element("img", alt=title, width=width, height=height, src=f"data:image/jpeg;base64,{data}")


def svg(shapes: Iterable[str], width: float, height: float, **attributes: str | float | None) -> Markup:
    """A drawing in SVG. ``width``, ``height``: pixels."""
    return element(
        "svg",
        *shapes,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {width} {height}",
        width=width,
        height=height,
        **attributes,
    )


def polyline(points: Array | Sequence[tuple[float, float]], color: str, width: float) -> Markup:
    """Line through points (N, 2)."""
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return element("polyline", points=path, fill="none", stroke=color, stroke_width=width)
