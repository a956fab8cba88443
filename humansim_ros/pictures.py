"""Pictures of objects in notebooks. The package ``scene.pictures`` draws the pictures."""

from __future__ import annotations

import warnings
from importlib import import_module
from typing import Any

from humansim_ros.errors import HumansimWarning


class Pictured:
    """Base class of objects that notebooks show as a picture, at most 640 pixels wide."""

    def _repr_png_(self) -> bytes | None:
        """PNG file for IPython. If it cannot be drawn, warns and returns None, so that IPython shows text."""
        try:
            png: bytes = drawing("sheets").notebook_png(self)
        except Exception as reason:  # a cell with this object as its value must not fail
            text = f"{type(reason).__name__}: {reason}"
            warnings.warn(f"{type(self).__name__} has no picture: {text}", HumansimWarning, stacklevel=2)
            return None
        return png


def drawing(module: str) -> Any:
    """Load a module of ``scene.pictures`` on first use, since these modules import the packages that call
    this."""
    return import_module(f"humansim_ros.scene.pictures.{module}")
