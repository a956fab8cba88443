"""Parts of the editor for some items only: keyframes, calibrations, ideal cameras, pictures of motions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from humansim_ros.drawing.motions import StickFigureArtist, strip
from humansim_ros.errors import HumansimError
from humansim_ros.scene.actor import Actor
from humansim_ros.types import Array, Image
from humansim_ros.view.calibrations import add_calibration, is_ideal, set_ideal
from humansim_ros.view.document import SceneDocument, SectionName
from humansim_ros.view.keyframe_edit import keyframe_times, remove_keyframe, set_keyframe
from humansim_ros.view.page_interface import Page
from humansim_ros.view.server import check_value

#: Makes an edit; whether it could be made.
Edit = Callable[[Callable[[], Any]], bool]

_ADD, _REMOVE = "Add", "Remove"
#: Size of a figure in the picture of a motion, pixels, and number of figures.
_FIGURE, _PHASES = (110, 150), 6


class KeyframeTools:
    """Keys of a person or an object at the time that is shown.

    Args:
        app: The page.
        document: The scene.
        edit: Makes an edit, and shows it.
    """

    def __init__(self, app: Page, document: SceneDocument, edit: Edit) -> None:
        self._app, self._document, self._edit = app, document, edit
        self._item: tuple[SectionName, str] = "humans", ""
        gui = app.gui
        self._folder = gui.add_folder("Keyframes", expand_by_default=False)
        with self._folder:
            self._actions = gui.add_button_group(
                "Key", (_ADD, _REMOVE), hint="at the time that is shown: add a key, or remove the nearest"
            )
            self._dragging = gui.add_checkbox("Gizmo sets keys", False, hint="a drag adds a key at that time")
            self._times = gui.add_markdown("")
        self._actions.on_click(lambda event: app.post(lambda: self.use(event.target.value)))

    @property
    def dragging(self) -> bool:
        """Whether a drag of the gizmo adds a key."""
        return bool(self._folder.visible and self._dragging.value)

    def use(self, action: str) -> None:
        """Add a key at the time that is shown, or remove the nearest: ``Add`` or ``Remove``."""
        change = set_keyframe if action == _ADD else remove_keyframe
        self._edit(lambda: change(self._document, *self._item, self._app.scene_seconds))

    def drag(self, position: Array | None, quaternion: Array | None) -> None:
        """Add a key for a place of the gizmo. Raises HumansimError."""
        set_keyframe(self._document, *self._item, self._app.scene_seconds, position, quaternion)

    def show(self, kind: SectionName, name: str) -> None:
        """Show the keys of an item; nothing for a camera or a section."""
        self._item = kind, name
        self._folder.visible = kind in ("humans", "objects") and self._document.has([kind, name])
        if self._folder.visible:
            try:
                times = keyframe_times(self._document, kind, name)
            except HumansimError:  # they are wrong; the status says so
                times = []
            self._times.content = (
                "keys at " + ", ".join(f"{t:g}" for t in times[:50]) + " s" if times else "no keys"
            )


class CalibrationTools:
    """A calibration file to load, and ideal cameras.

    Args:
        app: The page.
        document: The scene.
        edit: Makes an edit, and shows it.
    """

    def __init__(self, app: Page, document: SceneDocument, edit: Edit) -> None:
        self._document, self._edit = document, edit
        self._item: tuple[SectionName, str] = "rig", "rig"
        gui = app.gui
        self._ideal = gui.add_checkbox("Ideal lens", False, hint="no distortion, a centred principal point")
        with gui.add_folder("Calibration", expand_by_default=False):
            self._file = gui.add_text("Calibration file", "", hint="path from the folder of the scene")
            self._floor = gui.add_text(
                "Floor points",
                "",
                hint="file with points of the floor; without it, the cameras stand upright",
            )
            self._as_file = gui.add_checkbox("As the file says", False, hint="its world is map")
            load = gui.add_button("Load")
        load.on_click(lambda _: app.post(self._load))
        self._ideal.on_update(lambda event: self._used(app, event.client_id))

    def load(self, file: str, floor_points: str = "", as_file: bool = False) -> None:
        """Add the cameras of a calibration file; parameters as of :func:`add_calibration`."""

        def add() -> None:
            check_value(self._document.folder, [file, floor_points])
            add_calibration(self._document, file, floor_points or None, as_file)

        self._edit(add)

    def idealize(self, ideal: bool) -> None:
        """Take ideal cameras, or the real ones."""
        if not self._edit(lambda: set_ideal(self._document, *self._item, ideal)):
            self._ideal.value = not ideal

    def show(self, kind: SectionName, name: str) -> None:
        """Show whether a camera or the rig is ideal."""
        self._item = kind, name
        self._ideal.visible = kind == "rig" or (kind == "cameras" and self._document.has([kind, name]))
        if self._ideal.visible:
            self._ideal.value = is_ideal(self._document, kind, name)

    def _load(self) -> None:
        self.load(self._file.value, self._floor.value, bool(self._as_file.value))

    def _used(self, app: Page, client: int | None) -> None:
        if client is not None:
            app.post(lambda: self.idealize(bool(self._ideal.value)))


class MotionPicture:
    """A strip of the motion of a person; drawn when it changes. ``app``: the page."""

    def __init__(self, app: Page) -> None:
        self._gui = app.gui
        self._folder = app.gui.add_folder("Motion", visible=False)
        self._shown: object = None
        self._image: Any = None

    def show(self, actor: Actor | None) -> None:
        """Show the motion of a person; nothing for None."""
        self._folder.visible = actor is not None
        if actor is None or self._shown == (actor.motion.motion.path, actor.motion.mirror):
            return
        self._shown = actor.motion.motion.path, actor.motion.mirror
        picture = motion_picture(actor)
        if self._image is not None:
            self._image.remove()
        with self._folder:
            self._image = self._gui.add_image(picture)


def motion_picture(actor: Actor) -> Image:
    """Stick figures of the motion of a person, (H, W, 3)."""
    artist = StickFigureArtist.of_world(actor.motion, _FIGURE, "three-quarter")
    try:
        return strip([artist], _PHASES, actor.name)
    finally:
        artist.close()
