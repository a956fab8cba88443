"""What panels know of the page that they are part of."""

from __future__ import annotations

from collections.abc import Callable
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

    def pick_pixel(self, camera: str, across: float, down: float) -> None:
        """Show the numbers of a pixel, given as shares of the width and height of an image."""
