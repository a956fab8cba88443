"""Panel of numbers: of a pixel, or of a point of a person, that was clicked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from humansim_ros.view.source import PixelInfo

if TYPE_CHECKING:
    from humansim_ros.view.app import ViewApp

_HINT = "Click a person in 3D, or a pixel of an image."


class NumbersPanel:
    """Table of the numbers of what was clicked last."""

    def __init__(self, app: ViewApp) -> None:
        with app.gui.add_folder("Numbers", order=3) as self._folder:
            self._text = app.gui.add_markdown(_HINT)

    def show(self, info: PixelInfo) -> None:
        """Show numbers."""
        rows = "\n".join(f"| {name} | {_cell(text)} |" for name, text in info.values.items())
        self._text.content = f"| | |\n|---|---|\n{rows}"

    def remove(self) -> None:
        """Remove the panel."""
        self._folder.remove()


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
