"""Interface of the page for its panels; the player, which keeps the time; and work in the background."""

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
#: Playback speeds that the page offers, as multiples of real time.
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


@dataclass
class Player:
    """Playback: computes from the wall clock which frame is shown.

    Attributes:
        frames: Number of frames; None for a live source, which has no fixed number.
        period: Nanoseconds between frames.
        playing: Whether the player plays; otherwise it is paused.
        speed: Seconds of scene time per second of real time.
        loop: Whether to start again after the last frame. Otherwise the player pauses at the last frame.
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
        """Number of the present frame."""
        return int(self._position)

    def advance(self, now: float) -> int:
        """Move on to time ``now`` (monotonic clock, seconds); returns the number of the frame."""
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
        """Go to the frame ``index``, or to the first or last frame if ``index`` is out of range."""
        self._position = float(min(max(index, 0), (self.frames or 1) - 1))

    def step(self, count: int) -> None:
        """Pause, and go ``count`` frames forward, or back if ``count`` is negative."""
        self.playing = False
        self.seek(self.index + count)


class Page(Protocol):
    """The page as its panels use it. Only :meth:`post` may be called from other threads.

    Attributes:
        server: The web server.
        gui: Elements of the page (the GUI of viser).
        source: The scene, bag, graph or photographs on the page.
        player: Playback: frame, speed, and whether it is paused.
        head: Folder above the tabs, for the controls of the time.
        tabs: Tabs by name.
        dark: Whether the page is dark.
        shown_cameras: Cameras with images that are shown.
        shown_channels: Channels that are shown.
        through: Camera that the user looks through; only its image is shown. If None, all images are shown.
        enlarged: Camera and channel of the image that is enlarged, in full size; None if no image is.
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
        """Run a function in the thread of the page. If it raises an error, the user is notified."""

    def refresh(self) -> None:
        """Draw the present frame again, even while the player is paused."""

    def seek(self, index: int) -> None:
        """Pause the player, and show the frame with number ``index``."""

    def scrub(self, index: int) -> None:
        """Pause the player, and show a frame while the user drags the time. Its images may come later."""

    def set_options(self, options: Options) -> None:
        """Choose what is drawn in 3D."""

    def step_back(self, redo: bool = False) -> None:
        """Undo the last edit of the scene. If ``redo``, redo the edit that was undone last."""

    def hide_camera(self, name: str | None) -> None:
        """Do not draw a camera in 3D, because the user looks through it."""

    def set_dark(self, dark: bool) -> None:
        """Make the page dark or light."""

    def replace_source(self, source: ViewSource) -> None:
        """Show another source, at the same frame number if the source has that frame."""

    def compare(self, path: Path | None) -> None:
        """Show the estimate of a tracker next to the truth of the scene. ``path`` None hides the estimate."""

    def saved(self, path: Path) -> None:
        """Watch the file that the scene has just been saved to, to see changes by other programs."""

    def notify(self, title: str, text: str) -> None:
        """Show a notification in all browsers."""

    def send_state(self, **values: Any) -> None:
        """Send values of the state to the scripts of the page (``page/*.js``)."""

    def pick_pixel(self, camera: str, across: float, down: float) -> None:
        """Show the values of a pixel, such as its depth. ``across``, ``down``: place in the image, 0 to 1."""


class Background:
    """Runs steps that take seconds, one at a time, in a thread, so that the page stays responsive.

    Args:
        app: The page. All methods are called in its thread.
        tell: Function that shows a text about the running step. An empty text hides it at the end.
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
        """Start a step in the background thread.

        Args:
            what: Description of the step for the user.
            step: Function that does the work, in the background thread.
            done: Function that gets the result of the step, in the thread of the page.
            failed: Function that gets the error of the step. The page also shows the error.

        Raises:
            HumansimError: The previous step is still running.
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
    """Make a callback that runs ``action`` only when a user, not the program, has changed an element.

    ``post``: runs a function in the thread of the page.
    """

    def used(event: Any) -> None:
        if event.client_id is not None:
            post(action)

    return used


def plain_markdown(text: str) -> str:
    """Escape a text (which may come from other programs), so that Markdown shows it unchanged."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+-!|~$" else c for c in text.replace("\n", " "))
