"""The page of ``humansim view``: runs the source, the player, the 3D scene and the panels in one thread."""

from __future__ import annotations

import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import HumansimError, printable
from humansim_ros.types import Array
from humansim_ros.view.edit.scene_file import file_signature
from humansim_ros.view.panels.commands import CommandsPanel
from humansim_ros.view.panels.editor import EditorPanel
from humansim_ros.view.panels.human import HumanPanel
from humansim_ros.view.panels.images import ImagesPanel, NumbersPanel
from humansim_ros.view.panels.page import Player, plain_markdown
from humansim_ros.view.panels.photographs import PhotographsPanel
from humansim_ros.view.panels.show import ALL, ShowPanel, ThroughPanel, TimelinePanel, TracksPanel
from humansim_ros.view.panels.stage import Options, Stage
from humansim_ros.view.server.server import MOST_UPLOAD, PageServer, size_of_upload
from humansim_ros.view.sources.inputs import Opened, TopicOptions
from humansim_ros.view.sources.photo_source import PhotoSource
from humansim_ros.view.sources.picking import hit_person, person_info
from humansim_ros.view.sources.scene_source import SceneViewSource
from humansim_ros.view.sources.source import FrameRequest, ViewFrame, ViewSource

_LOG = logging.getLogger(__name__)
#: Frames per second of the page.
_RATE = 30.0
#: The file of the scene is checked for changes every this number of seconds.
_LOOK = 0.5
#: Without a browser, the page waits this number of seconds between two checks for one.
_IDLE = 0.2
#: For this number of seconds after a step of a drag, the page does not wait for images.
_DRAG = 0.3
#: Longest wait, seconds, for the first images after a change of the source.
_FIRST_IMAGES = 60.0


class ViewApp:
    """The page in the browser: shows a source, such as a scene or a bag.

    Everything runs in the thread that calls :meth:`run`. Other threads use :meth:`post` to run a function in
    this thread.

    Args:
        opened: The scene, bag, graph or photographs to show.
        port: Port. If the port is in use, the next free one is taken.

    Raises:
        HumansimError: No port is free.
    """

    def __init__(self, opened: Opened, port: int = 8080) -> None:
        source, document = opened.source, opened.document
        self.editor: EditorPanel | None = None
        self.human: HumanPanel | None = None
        self._unseen_since: float | None = None  # when another source has replaced the first
        self.commands: CommandsPanel | None = None
        self.chosen_camera = ALL
        self._state: dict[str, Any] = {}
        self.options = Options()
        self.server = PageServer(f"{source.title} · humansim", port)
        self.gui: Any = self.server.viser.gui
        self.source = source
        self.dark = False
        self.shown_cameras: tuple[str, ...] = tuple(source.cameras)
        self.shown_channels: tuple[str, ...] = source.channels[:1]
        self.through: str | None = None
        self.enlarged: tuple[str, str] | None = None
        photographs = isinstance(source, PhotoSource)
        self.player = Player(source.frames, source.period, playing=not photographs)
        self.frames_shown = 0
        self._posted: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wanted = threading.Event()
        self._stopped = threading.Event()
        self._reload, self._path = opened.reload, opened.path
        self._modified = file_signature(opened.path)
        self._looked = self._scrubbed = 0.0
        self._notice: Any = None
        self._broken: str | None = None
        self.gui.main_panel.dock_right()
        self.set_dark(False)
        self.head = self.gui.add_folder("Time", order=0)
        tabs = self.gui.add_tab_group(order=1)
        names = ["Show", "Numbers"] if document is None else ["Show", "Numbers", "Human", "Edit", "Run"]
        if photographs:
            names.insert(0, "Photographs")
            self.server.add_script("photographs.js")
        self.tabs: dict[str, Any] = {name: tabs.add_tab(name) for name in names}
        self._place_view()
        self._tracks = TracksPanel(self)
        self._build()
        self._say_broken(opened.problem)
        if document is not None:
            self._take_files()
            self.editor = EditorPanel(self, document)
            self.human = HumanPanel(self, document, self._show_scene)
            self.commands = CommandsPanel(self, document)

    # --- the thread of the page --------------------------------------------------------------------------

    def run(self) -> None:
        """Show frames until :meth:`stop` is called."""
        self.source.prepare(self.shown_cameras, self.shown_channels)
        due = time.monotonic()
        while not self._stopped.is_set():
            self._run_posted()
            self._look_at_file()
            if self.commands is not None:
                self.commands.update()
            try:
                if self.server.viser.get_clients():
                    self._tracks.follow()
                self._show_next()
            except HumansimError as error:
                self.player.playing = False
                self._say_broken(str(error))
            except RuntimeError as error:
                # viser wakes its connections from this thread while one is being opened or closed
                if "mutated during iteration" not in str(error):
                    raise
                self.refresh()
            due = max(due + 1 / _RATE, time.monotonic())
            self._sleep(due)

    def stop(self) -> None:
        """End :meth:`run`. May be called from any thread."""
        self._stopped.set()
        self._wanted.set()

    def close(self) -> None:
        """Close the panels and the source, and stop the server."""
        if self.commands is not None:
            self.commands.close()
        if self.human is not None:
            self.human.close()
        self._tracks.close()
        self.source.close()
        self.server.close()

    def post(self, function: Callable[[], None]) -> None:
        """Run a function in the thread of the page.

        Errors are shown as a notification; errors other than HumansimError are also logged.
        """
        self._posted.put(function)
        self._wanted.set()

    def refresh(self) -> None:
        """Draw the present frame again, even while the player is paused."""
        self._needs_frame = True
        self._wanted.set()

    # --- what panels ask for (in the thread of the page) ---------------------------------------------------

    def seek(self, index: int) -> None:
        """Pause the player, and show the frame with number ``index``."""
        self.player.playing = False
        self._unseen_since = None
        self.player.seek(index)
        self.refresh()

    def scrub(self, index: int) -> None:
        """Pause the player, and show a frame while the user drags the time. Its images may come later."""
        self._scrubbed = time.monotonic()
        self.seek(index)

    def set_options(self, options: Options) -> None:
        """Choose what is drawn in 3D."""
        self.options = options
        self._stage.set_options(options)
        self.refresh()

    def step_back(self, redo: bool = False) -> None:
        """Undo the last edit of the scene. If ``redo``, redo the edit that was undone last."""
        if self.editor is not None:
            (self.editor.redo if redo else self.editor.undo)()

    def hide_camera(self, name: str | None) -> None:
        """Do not draw a camera in 3D, because the user looks through it."""
        self._stage.hide_camera(name)

    def send_state(self, **values: Any) -> None:
        """Send values of the state to the scripts of the page (``page/*.js``)."""
        self._state |= values
        self.server.stream(json.dumps(self._state), "state")

    def set_dark(self, dark: bool) -> None:
        """Make the page dark or light."""
        self.dark = dark
        self.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)

    def replace_source(self, source: ViewSource) -> None:
        """Show another source, at the present frame number, or at its last frame if the source is shorter."""
        previous, index = self.source, self.player.index
        playing = self.player.playing
        self._remove_panels()
        self.source = source
        source.estimate = source.estimate or previous.estimate
        if isinstance(source, SceneViewSource):
            source.take_over(previous)
        previous.close()
        self.player = Player(
            source.frames, source.period, playing, speed=self.player.speed, loop=self.player.loop
        )
        self.player.seek(index)
        self._unseen_since = time.monotonic()
        self._build()
        self._say_broken(None)

    def compare(self, path: Path | None) -> None:
        """Show an estimate of a tracker next to the truth of the scene. If ``path`` is None, show no
        estimate."""
        if self.editor is None or not isinstance(self.source, SceneViewSource):
            return
        found = None
        if path is not None:
            try:
                found = TopicOptions([str(path)]).estimate_beside(self.source)
            except HumansimError as error:  # such as detections in images, which can be evaluated
                self.notify("Not shown beside the truth", str(error))
                return
        self.source.estimate = None
        source = self.editor.make_source()
        source.estimate = found
        self.replace_source(source)

    def pick_pixel(self, camera: str, across: float, down: float) -> None:
        """Show the values of a pixel, such as its depth. ``across``, ``down``: place in the image, 0 to 1."""
        if self._frame is None or camera not in self._frame.cameras:
            return
        width, height = self._frame.cameras[camera].size
        self.player.playing = False
        self.refresh()
        info = self.source.describe(camera, int(across * width), int(down * height))
        self._stage.mark(info.world)
        self._numbers.show(info)

    def pick_person(self, name: str, origin: Array, direction: Array) -> None:
        """Show the values of the point where a ray (origin and direction (3,) in ``map``) hits a person."""
        frame = self._frame
        if frame is None or name not in frame.joints or name not in self.source.people:
            return
        self.player.playing = False
        human = self.source.people[name]
        hit = hit_person(human, frame.joints[name], origin, direction)
        if hit is None:
            return
        info = person_info(self.source, frame, name, hit)
        self._stage.mark(info.world)
        self._numbers.show(info)

    @property
    def scene_seconds(self) -> float:
        """Scene time that is shown, seconds."""
        return self.player.index * self.source.period * 1e-9

    def saved(self, path: Path) -> None:
        """Watch the file that the scene has just been saved to, to see changes by other programs."""
        self._path, self._modified = path, file_signature(path)

    def notify(self, title: str, text: str) -> None:
        """Show a notification in all browsers."""
        for client in self.server.viser.get_clients().values():
            client.add_notification(title=title, body=text, auto_close_seconds=8.0)

    def _show_scene(self) -> None:
        """Show the scene of the document again."""
        assert self.editor is not None
        self.editor.show_scene()

    def _take_files(self) -> None:
        """Let browsers upload files, and notify the user when an upload is refused."""
        self.server.add_script("uploads.js", most=MOST_UPLOAD)

        def refused(reason: str) -> None:
            self.post(lambda: self.notify("Not taken", reason))

        def asked(query: Mapping[str, str]) -> None:
            refused(f"{printable(query.get('name', 'this file'), 60)}: {size_of_upload(query.get('size'))}")

        self.server.on_refused = refused
        self.server.on_request("refused", asked)

    # --- parts of the loop -------------------------------------------------------------------------------

    def _build(self) -> None:
        self.shown_cameras = tuple(self.source.cameras)
        kept = tuple(name for name in self.source.channels if name in self.shown_channels)
        self.shown_channels = kept or self.source.channels[:1]
        self._frame: ViewFrame | None = None
        self._needs_frame = True
        self._stage = Stage(
            self.server,
            self.source,
            lambda name, origin, direction: self.post(lambda: self.pick_person(name, origin, direction)),
        )
        self._timeline = TimelinePanel(self)
        self._tracks.show()
        self._show = ShowPanel(self)
        self._through = ThroughPanel(self)
        self._numbers = NumbersPanel(self)
        self._images: ImagesPanel | PhotographsPanel = (
            PhotographsPanel(self, self.source) if isinstance(self.source, PhotoSource) else ImagesPanel(self)
        )
        self._messages = self.gui.add_markdown("", visible=False, order=-1)
        self._tell([*self.source.messages, *self._tracks.notes])
        self._built_of = self._content()
        if self.editor is not None:
            self.editor.stage_made()
        if self.human is not None:
            self.human.stage_made()

    def _content(self) -> object:
        """People, cameras, objects and channels: if they change, panels and 3D scene must be rebuilt."""
        source = self.source
        people = {name: id(human) for name, human in source.people.items()}
        return people, tuple(source.cameras), tuple(source.objects), source.channels

    def _tell(self, messages: Sequence[str]) -> None:
        """Show the messages of the source to the user, above the tabs."""
        text = "\n\n".join(plain_markdown(message) for message in messages)
        if text != self._messages.content:
            self._messages.content, self._messages.visible = text, bool(text)

    def _remove_panels(self) -> None:
        for panel in (self._timeline, self._show, self._through, self._numbers, self._images):
            panel.remove()
        self._messages.remove()

    def _place_view(self) -> None:
        """Set the first view of the 3D scene, from above, far enough away to show all cameras."""
        centers = [camera.center for camera in self.source.cameras.values()]
        reach = max([3.0, *(float(np.linalg.norm(center[:2])) for center in centers)])
        start = self.server.viser.initial_camera
        start.position = (1.3 * reach, -0.95 * reach, 1.0 * reach)
        start.look_at = (0.0, 0.0, 0.8)

    def _show_next(self) -> None:
        if not self.server.has_pages:
            self.player.advance(time.monotonic())
            return
        index = self.player.advance(time.monotonic())
        shown = self._frame
        late = shown is not None and shown.image_index is not None and shown.image_index != shown.index
        live = self.player.frames is None
        same = shown is not None and (index == shown.index if not live else not self.player.playing)
        pending = self._images_are_pending()
        if same and not self._needs_frame and not late and not pending:
            return
        self._needs_frame = False
        still = not self.player.playing
        dragged = time.monotonic() - self._scrubbed < _DRAG
        cameras = self.shown_cameras if self.through is None else (self.through,)
        channels = self.shown_channels or (self.source.channels[:1] if self.through else ())
        full = cameras if len(cameras) == 1 else [name for name in cameras if self._is_large(name)]
        exact = still and not (pending or dragged)
        scans = self.options.scans and bool(self.source.scanners)
        frame = self.source.frame(index, FrameRequest(cameras, channels, exact, full, scans))
        if self._content() != self._built_of:  # people and cameras of a graph come and go
            self._remove_panels()
            self._build()
        self._frame = frame
        self._tell([*self.source.messages, *self._tracks.notes])
        self._stage.show(frame)
        self._timeline.update(frame)
        self._tracks.update(frame)
        self._images.update(frame)
        self._through.update(frame)
        self.frames_shown += 1

    def _is_large(self, camera: str) -> bool:
        return self.enlarged is not None and self.enlarged[0] == camera

    def _images_are_pending(self) -> bool:
        """Whether the first images of a new source are missing yet. Meanwhile the page shows poses only."""
        shown, since = self._frame, self._unseen_since
        if since is None:
            return False
        if (shown is not None and shown.image_index is not None) or time.monotonic() - since > _FIRST_IMAGES:
            self._unseen_since = None
        return self._unseen_since is not None

    def _run_posted(self) -> None:
        self._wanted.clear()
        while True:
            try:
                function = self._posted.get_nowait()
            except queue.Empty:
                return
            try:
                function()
            except HumansimError as error:
                self.notify("This does not work", str(error))
            except Exception:  # browsers send anything: the page goes on for all others
                _LOG.exception("the page could not do what a browser asked for")
                self.notify("This does not work", "The terminal of humansim view has the details.")

    def _sleep(self, due: float) -> None:
        """Wait until the next frame is due. While paused, also stop waiting when the user asks for
        something."""
        if self.player.playing and self.server.has_pages:
            time.sleep(max(0.0, due - time.monotonic()))
        else:
            self._wanted.wait(_IDLE)

    def _look_at_file(self) -> None:
        now = time.monotonic()
        make = self._reload if self.editor is None else self.editor.make_source
        if make is None or self._path is None or now - self._looked < _LOOK:
            return
        self._looked = now
        signature = file_signature(self._path)
        if signature == self._modified:
            return
        self._modified = signature
        try:
            if self.editor is not None and not self.editor.file_changed():
                return
            source = make()
        except HumansimError as error:
            self._say_broken(str(error))
        else:
            self.replace_source(source)
        if self.editor is not None:
            self.editor.refresh()

    def _say_broken(self, problem: str | None) -> None:
        """Show an error at the top of the page. None removes the error."""
        if problem == self._broken:
            return
        self._broken = problem
        if self._notice is not None:
            self._notice.remove()
            self._notice = None
        if problem is not None:
            text = (
                f"**This cannot be shown.** The page shows the last state that could.\n\n```\n{problem}\n```"
            )
            self._notice = self.gui.add_markdown(text, order=-2)
