"""Reports of one file, as HTML and SVG, and files of other programs, from the templates of ``config/pages``.

The templates are those of jinja2. They escape all texts, unless they are :class:`~markupsafe.Markup` already.
"""

from __future__ import annotations

import base64
from functools import cache
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup as Markup
from numpy.typing import NDArray

from humansim_ros.files.reading import resource_path

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
    templates.filters["px"] = lambda value: f"{round(value, 2) + 0.0:.10g}"
    templates.filters["numbers"] = joined
    return templates


def joined(values: NDArray[Any]) -> str:
    """Text of numbers, separated by spaces. Numbers that are no integers are rounded to nine digits."""
    form = "d" if np.issubdtype(values.dtype, np.integer) else ".9g"
    return " ".join(f"{value:{form}}" for value in np.ravel(values).tolist())


def page(name: str, **values: Any) -> str:
    """Text of the HTML page of a template. Its style sheet in ``config/styles`` has the same name."""
    return _templates().get_template(f"pages/{name}.html").render(style=name, **values)


def document(name: str, **values: Any) -> str:
    """Text of the file of a template. The filter ``numbers`` writes arrays."""
    return _templates().get_template(f"pages/{name}").render(**values) + "\n"


def drawing(name: str, **values: Any) -> Markup:
    """SVG of a template."""
    return Markup(_templates().get_template(f"pages/{name}.svg").render(**values))


def part(name: str, *values: Any) -> Markup:
    """Result of a macro of ``parts.html``."""
    macro = getattr(_templates().get_template("pages/parts.html").module, name)
    return Markup(macro(*values).strip())


def picture(image: NDArray[np.uint8], title: str) -> Markup:
    """Element with an image (H, W, 3) RGB, embedded as JPEG."""
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    height, width = image.shape[:2]
    return part("picture", title, width, height, base64.b64encode(encoded.tobytes()).decode("ascii"))
