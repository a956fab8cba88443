"""The page, as its panels use it: its time, and what they may ask it to do."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from humansim_ros.errors import HumansimError
from humansim_ros.view.panels.stage import Options
from humansim_ros.view.server.server import PageServer
from humansim_ros.view.sources.source import ViewSource

_Result = TypeVar("_Result")
#: Speeds that the page offers.
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


@dataclass
class Player:
    """Frame that is shown, as a function of the wall clock.

    Attributes:
        frames: Number of frames; None for a live source, which has no time of its own.
        period: Nanoseconds between frames.
        playing: Whether it plays.
        speed: Seconds of the scene per second.
        loop: Whether it starts again after the last frame; else it pauses there.
    """

    frames: int | None
    period: int
    playing: bool = True
    speed: float = 1.0
    loop: bool = True
    _position: float = 0.0
    _last: float | None = None

    @property
    def index(self) -> int:
        """Number of the frame."""
        return int(self._position)

    def advance(self, now: float) -> int:
        """Frame at a time of a monotonic clock, seconds."""
        passed = 0.0 if self._last is None else max(0.0, now - self._last)
        self._last = now
        if self.frames is None:
            self._position += 1 if self.playing else 0
            return self.index
        if self.playing:
            self._position += passed * self.speed * 1e9 / self.period
            if self._position >= self.frames:
                if self.loop:
                    self._position %= self.frames
                else:
                    self._position, self.playing = float(self.frames - 1), False
        return self.index

    def seek(self, index: int) -> None:
        """Go to a frame; to the first or last one if there is no such frame."""
        self._position = float(min(max(index, 0), (self.frames or 1) - 1))

    def step(self, count: int) -> None:
        """Pause, and go some frames on or back."""
        self.playing = False
        self.seek(self.index + count)


class Page(Protocol):
    """The page, for its panels. All but :meth:`post` belongs to the thread of the page.

    Attributes:
        server: The server.
        gui: Its elements.
        source: The scene, bag, graph or photographs on the page.
        player: Time of the page.
        head: Folder above the tabs, for the time.
        tabs: Tabs by name.
        dark: Whether the page is dark.
        shown_cameras: Cameras with images that are shown.
        shown_channels: Channels that are shown.
        through: Camera that the user looks through. Only the image of this camera is shown. If None, all
            images are shown.
        enlarged: Camera and channel of the tile that is large. Its images keep their size. If None, no tile
            is large.
        chosen_camera: Camera that was chosen, or ``all``. It stays when the source is replaced.
        options: Drawings in 3D. They stay when the source is replaced.
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
    enlarged: tuple[str, str] | None
    chosen_camera: str
    options: Options

    @property
    def scene_seconds(self) -> float:
        """Scene time that is shown, seconds."""

    def post(self, function: Callable[[], None]) -> None:
        """Run a function in the thread of the page. Its errors are shown as a notification."""

    def refresh(self) -> None:
        """Show the frame again, also while paused."""

    def seek(self, index: int) -> None:
        """Pause, and show a frame."""

    def scrub(self, index: int) -> None:
        """Pause, and show a frame while the time is dragged: its images may come later."""

    def set_options(self, options: Options) -> None:
        """Change the drawings in 3D."""

    def step_back(self, redo: bool = False) -> None:
        """Take the last edit of the scene back, or do it again."""

    def hide_camera(self, name: str | None) -> None:
        """Do not draw a camera in 3D: the one that is looked through."""

    def set_dark(self, dark: bool) -> None:
        """Dark or light page."""

    def replace_source(self, source: ViewSource) -> None:
        """Show another source, at the same time if it has it."""

    def compare(self, path: Path | None) -> None:
        """Show an estimate of a tracker next to the truth of the scene. If None, none."""

    def saved(self, path: Path) -> None:
        """The scene has been saved as a file, which is watched from now on."""

    def notify(self, title: str, text: str) -> None:
        """Show a notification in all browsers."""

    def send_state(self, **values: Any) -> None:
        """Send values of the state to the scripts of the page (``page/*.js``)."""

    def pick_pixel(self, camera: str, across: float, down: float) -> None:
        """Show the numbers of a pixel, given as shares of the width and height of an image."""


class Background:
    """Runs steps that take seconds, one at a time, in a thread, so that the page stays responsive.

    Args:
        app: The page; all methods run in its thread.
        tell: Shows what is done, and an empty text at its end.
    """

    def __init__(self, app: Page, tell: Callable[[str], None]) -> None:
        self._app, self._tell = app, tell
        self.works = self.closed = False

    def run(
        self,
        what: str,
        step: Callable[[], _Result],
        done: Callable[[_Result], None],
        failed: Callable[[Exception], None] = lambda error: None,
    ) -> None:
        """Do a step in the thread.

        Args:
            what: What is done, for the user.
            step: The step.
            done: Takes its result, in the thread of the page.
            failed: Takes its error, in the thread of the page, which shows it then.

        Raises:
            HumansimError: The step before has not ended.
        """
        if self.works:
            raise HumansimError("wait until the step before has ended")
        self.works = True
        self._tell(what)

        def work() -> None:
            try:
                result = step()
            except Exception as error:  # shown by the page, as all errors of what it is asked to do
                failure = error
                self._app.post(lambda: self._end(lambda: failed(failure), failure))
            else:
                self._app.post(lambda: self._end(lambda: done(result)))

        threading.Thread(target=work, daemon=True).start()

    def _end(self, then: Callable[[], None], failure: Exception | None = None) -> None:
        self.works = False
        if self.closed:
            return
        self._tell("")
        then()
        if failure is not None:
            raise failure


def by_user(post: Callable[[Callable[[], None]], None], action: Callable[[], Any]) -> Callable[[Any], None]:
    """A callback for an element of the page: an action, if a user has used the element, not the program.

    ``post``: runs a function in the thread of the page.
    """

    def used(event: Any) -> None:
        if event.client_id is not None:
            post(action)

    return used


def plain_markdown(text: str) -> str:
    """Text that Markdown shows as it is: it can come from other programs."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+-!|~$" else c for c in text.replace("\n", " "))
