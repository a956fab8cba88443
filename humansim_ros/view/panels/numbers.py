"""Panel of numbers: of a pixel, or of a point of a person, that was clicked."""

from __future__ import annotations

from humansim_ros.view.page_interface import Page
from humansim_ros.view.source import PixelInfo

_HINT = "Click a person in 3D, or a pixel of an image."


class NumbersPanel:
    """Table of the numbers of what was clicked last."""

    def __init__(self, app: Page) -> None:
        with app.tabs["Numbers"]:
            self._text = app.gui.add_markdown(_HINT)

    def show(self, info: PixelInfo) -> None:
        """Show numbers."""
        rows = "\n".join(f"| {name} | {_cell(text)} |" for name, text in info.values.items())
        self._text.content = f"| | |\n|---|---|\n{rows}"

    def remove(self) -> None:
        """Remove the panel."""
        self._text.remove()


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
