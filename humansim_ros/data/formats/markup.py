"""HTML and SVG for reports that consist of one file: templates of ``config/pages``, and elements.

All texts are escaped, unless they are :class:`~markupsafe.Markup` already.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup as Markup
from markupsafe import escape
from numpy.typing import NDArray

from humansim_ros.files.reading import resource_path
from humansim_ros.types import Array

#: Elements that have no content.
_EMPTY = frozenset(("br", "circle", "img", "line", "polyline", "rect"))
_JPEG_QUALITY = 82


@cache
def _templates() -> Environment:
    templates = Environment(
        loader=FileSystemLoader(resource_path("config")),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    templates.filters["px"] = _value
    return templates


def page(title: str, style: str, *content: str, template: str = "page", **values: Any) -> str:
    """Text of an HTML page.

    Args:
        title: Title of the page.
        style: Name of a style sheet in ``config/styles``.
        content: Elements and texts, for the template ``page``.
        template: Name of a template in ``config/pages``.
        values: What the template needs.
    """
    found = _templates().get_template(f"pages/{template}.html")
    return found.render(title=title, style=style, content=joined(content), **values)


def part(name: str, *values: Any) -> Markup:
    """Call a macro of ``config/pages/parts.html``."""
    macro = getattr(_templates().get_template("pages/parts.html").module, name)
    return Markup(macro(*values).strip())


def joined(parts: Iterable[str]) -> Markup:
    """Join elements and texts. Plain texts are escaped."""
    return Markup().join(parts)


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


def section(title: str, content: str) -> Markup:
    """A section of a page: a heading and content."""
    return part("section", title, content)


def table(header: Sequence[str], rows: Iterable[Sequence[str]], classes: Sequence[str | None] = ()) -> Markup:
    """Table of texts. ``classes``: class of each row. If empty, rows have no class."""
    return part("table", header, rows, classes)


def picture(image: NDArray[np.uint8], title: str) -> Markup:
    """Element with an image (H, W, 3) RGB, embedded as JPEG."""
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    height, width = image.shape[:2]
    return part("picture", title, width, height, base64.b64encode(encoded.tobytes()).decode("ascii"))


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
