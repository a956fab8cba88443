"""What panels know of the page that they are part of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from humansim_ros.view.player import Player
from humansim_ros.view.server import PageServer
from humansim_ros.view.source import ViewSource
from humansim_ros.view.stage import Options


class Page(Protocol):
    """The page, for its panels. All but :meth:`post` belongs to the thread of the page.

    Attributes:
        server: The server.
        gui: Its elements.
        source: What is shown.
        player: Time of the page.
        head: Folder above the tabs, for the time.
        tabs: Tabs by name.
        dark: Whether the page is dark.
        shown_cameras: Cameras whose images are shown.
        shown_channels: Channels that are shown.
        through: Camera that is looked through, whose image alone is shown; None: all are shown.
        chosen_camera: Camera that was chosen, or ``all``; it stays when the source is replaced.
        options: What is drawn in 3D; it stays, too.
    """

    server: PageServer
    gui: Any
    source: ViewSource
    player: Player
    head: Any
    tabs: dict[str, Any]
    dark: bool
    shown_cameras: tuple[str, ...]
    shown_channels: tuple[str, ...]
    through: str | None
    chosen_camera: str
    options: Options

    @property
    def scene_seconds(self) -> float:
        """Scene time that is shown, seconds."""

    def post(self, function: Callable[[], None]) -> None:
        """Run a function in the thread of the page; its errors are shown as a notification."""

    def refresh(self) -> None:
        """Show the frame again, also while paused."""

    def seek(self, index: int) -> None:
        """Pause, and show a frame."""

    def set_options(self, options: Options) -> None:
        """Change what is drawn in 3D."""

    def set_dark(self, dark: bool) -> None:
        """Dark or light page."""

    def replace_source(self, source: ViewSource) -> None:
        """Show another source, at the same time if it has it."""

    def saved(self, path: Path) -> None:
        """The scene has been saved as a file, which is watched from now on."""

    def notify(self, title: str, text: str) -> None:
        """Show a notification in all browsers."""

    def pick_pixel(self, camera: str, across: float, down: float) -> None:
        """Show the numbers of a pixel, given as shares of the width and height of an image."""
