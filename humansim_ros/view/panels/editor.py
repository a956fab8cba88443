"""Panel that edits the scene (people, objects, cameras, light, world), with undo, and saves it as a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, cast

import numpy as np

from humansim_ros.cameras.formats import load_calibration
from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.scene.core import Actor
from humansim_ros.scene.pictures import StickFigureArtist, strip
from humansim_ros.types import Array, Image
from humansim_ros.view.edit.document import SceneDocument, SectionName
from humansim_ros.view.edit.edits import (
    add_calibration,
    is_ideal,
    keyframe_times,
    remove_keyframe,
    set_ideal,
    set_keyframe,
)
from humansim_ros.view.edit.yaml_edit import YamlKey
from humansim_ros.view.panels.controls import SectionControls, choices_of
from humansim_ros.view.panels.files import FileChoice
from humansim_ros.view.panels.matching import MatchingTools
from humansim_ros.view.panels.page import Page, by_user, plain_markdown
from humansim_ros.view.server.server import check_value, inside
from humansim_ros.view.sources.scene_source import SceneViewSource

#: What can be selected in addition to people, objects, cameras and the rig: sections of the file.
_SECTIONS = ("scene", "room", "light", "world", "randomise", "variety", "time")
#: Keys of the top of the file.
_TOP = ("rate", "renderer", "license")
_SINGULAR = {"humans": "person", "objects": "object", "cameras": "camera"}
_PLURAL = {value: key for key, value in _SINGULAR.items()}
_UNDO, _REDO = "Undo", "Redo"
_SAVE_WRONG = "Save with errors"
_COPY, _REMOVE = "Duplicate", "Remove"
#: Smaller movements of the gizmo are rounding errors and ignored: metres, and sine of half the angle.
_MOVED, _TURNED = 5e-5, 4e-5


class EditorPanel:
    """The tab ``Edit`` of a page, and the gizmo: 3D handles that move the selected item.

    Args:
        app: The page. All methods run in its thread.
        document: The scene.
    """

    def __init__(self, app: Page, document: SceneDocument) -> None:
        self.document = document
        self.selected = "scene"
        self._app = app
        self._shown = document.version
        self._gizmo: Any = None
        self._seconds = 0.0
        self._controls: SectionControls | None = None
        self.question: Any = None
        gui = app.gui
        self._tab = app.tabs["Edit"]
        with self._tab:
            self._status = gui.add_markdown("")
            self._history = gui.add_button_group("Steps", (_UNDO, _REDO))
            self._adding = gui.add_button_group("Add", tuple(_PLURAL))
            self._choice = gui.add_dropdown("Item", (self.selected,))
            self._actions = gui.add_button_group("Selected", (_COPY, _REMOVE))
            self._name = gui.add_text("Name", "")
            self._rename = gui.add_button("Rename")
            self._keys = gui.add_folder("Keys")
            self.picture = MotionPicture(app)
            self.matching = MatchingTools(app, document, self.edit)
            self.keyframes = KeyframeTools(app, document, self.edit)
            self.calibration = CalibrationTools(app, document, self.edit)
            self._command = gui.add_markdown("")
            path = "scene.yaml" if document.path is None else str(document.path)
            self._path = gui.add_text("File", path, hint="scene file (.yaml) to save")
            self._overwrite = gui.add_checkbox("Overwrite", False, visible=False)
            self._save = gui.add_button("Save")
        for event, action in (
            (self._history.on_click, lambda: self.undo() if self._history.value == _UNDO else self.redo()),
            (self._adding.on_click, lambda: self.add(_PLURAL[self._adding.value])),
            (self._choice.on_update, lambda: self.select(self._choice.value)),
            (
                self._actions.on_click,
                lambda: self.duplicate() if self._actions.value == _COPY else self.remove_selected(),
            ),
            (self._save.on_click, lambda: self.save(self._path.value, self._overwrite.value)),
            (self._rename.on_click, lambda: self.rename(self._name.value)),
        ):
            event(by_user(app.post, action))
        self.refresh()

    # --- edits

    def edit(self, action: Callable[[], Any]) -> bool:
        """Edit the document, and show the new scene. If the edit fails, the error is shown and nothing
        changes."""
        try:
            action()
        except HumansimError as error:
            self._app.notify("This cannot be done", str(error))
            self.place_gizmo()
            return False
        self.refresh()
        return True

    def add(self, kind: str) -> None:
        """Add a person, an object or a camera, and select it."""
        adders: dict[str, Callable[[], str]] = {
            "humans": self.document.add_person,
            "objects": self.document.add_object,
            "cameras": self.document.add_camera,
        }
        added: list[str] = []
        if self.edit(lambda: added.append(adders[kind]())):
            self.select(f"{_SINGULAR[kind]} {added[0]}")

    def duplicate(self) -> None:
        """Duplicate the selected item, and select the copy."""
        kind, name = self.item
        added: list[str] = []
        if kind in _SINGULAR and self.edit(lambda: added.append(self.document.duplicate(kind, name))):
            self.select(f"{_SINGULAR[kind]} {added[0]}")

    def remove_selected(self) -> None:
        """Remove the selected item from the file."""
        kind, name = self.item
        keys = [kind, name] if kind in _SINGULAR else [self.selected]
        if self.selected != "scene":
            self.edit(lambda: self.document.remove(keys))

    def rename(self, name: str) -> None:
        """Rename the selected item."""
        kind, old = self.item
        if kind not in _SINGULAR or not name or name == old:
            return
        if self.edit(lambda: self.document.rename(kind, old, name)):
            self.select(f"{_SINGULAR[kind]} {name}")

    def undo(self) -> None:
        """Undo the last step."""
        self.edit(self.document.undo)

    def redo(self) -> None:
        """Redo the step that was undone last."""
        self.edit(self.document.redo)

    def set(self, keys: tuple[YamlKey, ...], value: Any) -> None:
        """Set a key of the file; None removes the key. Raises HumansimError if the key or value is wrong."""
        if value is not None:
            check_value(self.document.folder, value)
            with self.document.step(f"Set {'.'.join(map(str, keys))}", continues=True):
                self.document.set(keys, value, continues=True)
                if keys[0] == "humans" and keys[2:] == ("body",):
                    self._leave_outfit(str(keys[1]))
        elif self.document.has(keys):
            self.document.remove(keys)
        self.refresh()

    def outfits(self, name: str) -> Sequence[str]:
        """Names of the outfits that the body of a person has; empty if the body cannot be read."""
        try:
            return self.document.source.human(str(self.document.value(["humans", name, "body"]))).outfits
        except HumansimError:  # the status says so
            return ()

    def _leave_outfit(self, name: str) -> None:
        """Remove the outfit of a person if the body does not have this outfit."""
        keys, outfits = ["humans", name, "outfit"], self.outfits(name)
        worn = self.document.value(keys)
        if worn is not None and outfits and worn not in outfits:
            self.document.remove(keys)
            self._app.notify("Another outfit", f"This body has no outfit {worn!r}: it wears {outfits[0]!r}.")

    def move(self, position: Array, quaternion: Array) -> None:
        """Move the selected item to the place of the gizmo.

        Args:
            position: (3,) in ``map``, metres.
            quaternion: (4,) xyzw.
        """
        kind, name = self.item

        def place() -> None:
            old = self.document.pose(kind, name, self._seconds)
            moved = bool(np.abs(position - old.position).max() > _MOVED)
            turned = 1 - abs(float(quaternion @ old.quaternion)) > _TURNED**2
            if not (moved or turned):
                return
            if self.keyframes.dragging:
                self.keyframes.drag(position if moved else None, quaternion if turned else None)
            else:
                self.document.place(
                    kind,
                    name,
                    position if moved else None,
                    quaternion=quaternion if turned else None,
                    seconds=self._seconds,
                )

        self.edit(place)

    def save(self, path: str, overwrite: bool = False, wrong: bool = False) -> None:
        """Save the scene as a file.

        Args:
            path: The file, below the folder of the scene.
            overwrite: Whether to replace a file that another program wrote.
            wrong: Whether to save a scene with errors. If False, the user is asked first.
        """
        faults = self.document.errors()
        if faults and not wrong:
            self._ask(faults[0].key, faults[0].message, lambda: self.save(path, overwrite, wrong=True))
            return
        try:
            target = inside(self.document.folder, path) if path else None
            saved = self.document.save(target, overwrite=overwrite)
        except HumansimError as error:
            self._app.notify("Not saved", str(error))
            self._overwrite.visible = "overwrite" in error.message
            return
        self._overwrite.visible = self._overwrite.value = False
        self._path.value = str(saved)
        self._app.saved(saved)
        self.refresh()

    def _ask(self, key: str, message: str, yes: Callable[[], None]) -> None:
        """Ask the user whether to save nevertheless, and call ``yes`` if so."""
        if self.question is not None:
            self.question.close()
        gui = self._app.gui
        self.question = modal = gui.add_modal("This scene does not run")

        def answer(action: Callable[[], None] | None) -> None:
            modal.close()
            self.question = None
            if action is not None:
                action()

        with modal:
            gui.add_markdown(f"**{plain_markdown(key)}**: {plain_markdown(message)}\n\nSave it anyway?")
            post = self._app.post
            gui.add_button(_SAVE_WRONG, color="red").on_click(by_user(post, lambda: answer(yes)))
            gui.add_button("Do not save").on_click(by_user(post, lambda: answer(None)))

    # --- selection and elements of the tab

    @property
    def item(self) -> tuple[SectionName, str]:
        """Section and name of the selected item."""
        word, _, name = self.selected.partition(" ")
        if word in _PLURAL and name:
            return cast("SectionName", _PLURAL[word]), name
        return cast("SectionName", self.selected), self.selected

    def select(self, choice: str) -> None:
        """Select a person, an object, a camera or a section, such as ``person anna`` or ``light``."""
        self.selected = choice if choice in self.choices() else "scene"
        self._show_names()
        self._build_controls()
        self.place_gizmo()
        self._show_status()

    def refresh(self) -> None:
        """Show the scene of the document. If the scene is not valid, show its errors and the last valid
        scene."""
        faults = self.document.errors()
        if self.document.version != self._shown and (not faults or self.document.lacks_cameras):
            with suppress(SceneError):  # the status says it
                source = self.make_source()
                self._shown = self.document.version
                self._app.replace_source(source)
        if self.selected not in self.choices():
            self.selected = "scene"
            self._controls = None
        self._show_names()
        if self._controls is None or self._controls.keys != self._path_of_selected():
            self._build_controls()
        self.controls_now().refresh()
        kind, name = self.item
        if kind == "humans":
            self.controls_now().offer("outfit", self.outfits(name))
        self._show_status()
        self.place_gizmo()

    def show_scene(self) -> None:
        """Show the scene of the document again, after something else was shown."""
        self._shown = -1
        self.refresh()
        if not isinstance(self._app.source, SceneViewSource):  # it is wrong
            raise SceneError("the scene cannot be shown: the tab Edit says what is wrong")

    def make_source(self) -> SceneViewSource:
        """Make the source that shows the scene of the document. Raises SceneError with its first error."""
        scene = self.document.scene_so_far()
        has_cameras = not self.document.lacks_cameras
        return SceneViewSource(scene, self._app.source.title, has_cameras=has_cameras)

    def stage_made(self) -> None:
        """Place the gizmo again, after the 3D scene has been rebuilt without the gizmo."""
        self._gizmo = None
        self.place_gizmo()

    def place_gizmo(self) -> None:
        """Put the gizmo at the selected item, or remove the gizmo if this item cannot be moved."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        kind, name = self.item
        if not isinstance(self._app.source, SceneViewSource):
            return
        if kind not in (*_SINGULAR, "rig") or not self.document.has(
            [kind] if kind == "rig" else [kind, name]
        ):
            return
        self._seconds = self._app.scene_seconds
        try:
            pose = self.document.pose(kind, name, self._seconds)
        except HumansimError:  # it is wrong; the status says so
            return
        x, y, z, w = pose.quaternion
        gizmo = self._app.server.viser.scene.add_transform_controls(
            "/editor",
            scale=0.6,
            depth_test=False,
            # people stand on the floor: they move along x and y, and turn about z
            active_axes=(True, True, kind != "humans"),
            position=tuple(pose.position.tolist()),
            wxyz=(w, x, y, z),
        )
        gizmo.on_update(self._dragged)
        self._gizmo = gizmo

    def file_changed(self) -> bool:
        """Read the file again if another program changed it. Returns False if unsaved edits prevent this."""
        if not self.document.changed_on_disk():
            return True
        if self.document.changed:
            self._app.notify(
                "The file has changed",
                "Another program has changed the file. Undo your edits, or overwrite it.",
            )
            return False
        self.document.reload()
        self._shown = self.document.version
        return True

    def _dragged(self, event: Any) -> None:
        if event.phase != "end":
            return
        position, wxyz = np.array(event.target.position), np.array(event.target.wxyz)
        self._app.post(lambda: self.move(position, np.roll(wxyz, -1)))

    def choices(self) -> list[str]:
        """Items that can be selected, such as ``person anna`` or ``light``."""
        try:
            named = [
                f"{_SINGULAR[kind]} {name}"
                for kind in _SINGULAR
                for name in self.document.names(cast(Any, kind))
            ]
            return [*named, *(["rig"] if self.document.has(["rig"]) else []), *_SECTIONS]
        except HumansimError:  # the text is not valid
            return ["scene"]

    def _path_of_selected(self) -> tuple[YamlKey, ...]:
        kind, name = self.item
        if kind in _SINGULAR:
            return (kind, name)
        return () if self.selected == "scene" else (self.selected,)

    def _build_controls(self) -> None:
        self._keys.remove()
        gui = self._app.gui
        with self._tab:
            self._keys = gui.add_folder(f"Keys of {self.selected}", order=self._rename.order + 0.5)
        kind, name = self.item
        choices: dict[str, Sequence[str]] = dict(choices_of(kind))
        if kind == "humans":
            choices["outfit"] = self.outfits(name) or ("",)
        with self._keys:
            self._controls = SectionControls(
                gui,
                self.document,
                self._path_of_selected(),
                lambda keys, value: self.set(keys, value),
                _TOP if self.selected == "scene" else (),
                choices,
                self._app.post,
                self._keys,
            )

    def controls_now(self) -> SectionControls:
        """Controls of the selected item."""
        assert self._controls is not None
        return self._controls

    def _show_names(self) -> None:
        choices = tuple(self.choices())
        if tuple(self._choice.options) != choices:
            self._choice.options = choices
        if self._choice.value != self.selected:
            self._choice.value = self.selected
        kind, name = self.item
        self._name.visible = self._rename.visible = kind in _SINGULAR
        self._name.value = name
        self.keyframes.show(kind, name)
        self.calibration.show(kind, name)
        source = self._app.source
        actors = source.scene.actors if isinstance(source, SceneViewSource) and kind == "humans" else {}
        self.picture.show(actors.get(name))
        self.matching.show(name, actors.get(name))

    def _show_status(self) -> None:
        faults = self.controls_now().show_errors(self.document.errors())
        lines = ["*not saved*" if self.document.changed else "saved"]
        for key, line, message in faults[:5]:
            where = " ".join(part for part in (key, f"line {line}" if line else "") if part)
            lines.append(f"⚠ **{plain_markdown(where)}**: {plain_markdown(message)}")
        self._status.content = "\n\n".join(lines)
        command = self.document.command()
        self._command.content = (
            f"The same without the page:\n\n```yaml\n{command[:2000]}\n```" if command else ""
        )


# --- parts for some items only: keyframes, calibrations, ideal cameras, pictures of motions

#: Makes an edit, and returns whether it worked.
Edit = Callable[[Callable[[], Any]], bool]

_ADD = "Add"
#: Only this number of cameras of a file get a box to choose them.
_MOST_BOXES = 100
#: Size of a figure in the picture of a motion, pixels, and number of figures.
_FIGURE, _PHASES = (110, 150), 6


class KeyframeTools:
    """Folder that adds and removes keyframes of a person or an object at the time that is shown.

    Args:
        app: The page.
        document: The scene.
        edit: Function that makes an edit of the scene, and shows the result.
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
        """Add a key at the time that is shown (``Add``), or remove the nearest key (``Remove``)."""
        change = set_keyframe if action == _ADD else remove_keyframe
        self._edit(lambda: change(self._document, *self._item, self._app.scene_seconds))

    def drag(self, position: Array | None, quaternion: Array | None) -> None:
        """Add a key with the pose of the gizmo. Raises HumansimError if the key cannot be added."""
        set_keyframe(self._document, *self._item, self._app.scene_seconds, position, quaternion)

    def show(self, kind: SectionName, name: str) -> None:
        """Show the times of the keyframes of an item. Only people and objects can have keyframes."""
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
    """Folder that loads the cameras of a calibration file, and a box to make a camera or the rig ideal.

    Args:
        app: The page.
        document: The scene.
        edit: Function that makes an edit of the scene, and shows the result.
    """

    def __init__(self, app: Page, document: SceneDocument, edit: Edit) -> None:
        self._document, self._edit = document, edit
        self._item: tuple[SectionName, str] = "rig", "rig"
        self._gui = gui = app.gui
        self._ideal = gui.add_checkbox("Ideal lens", False, hint="no distortion, a centred principal point")
        with gui.add_folder("Calibration", expand_by_default=False):
            self.file = FileChoice(app, document, "Calibration file", "calibration", self.describe)
            self._facts = gui.add_markdown("")
            self._cameras = gui.add_folder("Cameras of the file", visible=False)
            self._floor = FileChoice(app, document, "Floor points", "companion", lambda _: None)
            self._as_file = gui.add_checkbox("As the file says", False, hint="its world is map")
            load = gui.add_button("Load")
        self._boxes: dict[str, Any] = {}
        load.on_click(lambda _: app.post(self._load))
        self._ideal.on_update(by_user(app.post, lambda: self.idealize(bool(self._ideal.value))))

    def describe(self, file: str) -> None:
        """Show the cameras of a calibration file, each with a box. Raises HumansimError if it cannot be
        read."""
        for box in self._boxes.values():
            box.remove()
        self._boxes, self._facts.content, self._cameras.visible = {}, "", False
        if not file:
            return
        read = load_calibration(inside(self._document.folder, file), all_cameras=True)
        with self._cameras:
            for name, camera in list(read.cameras.items())[:_MOST_BOXES]:
                posed = "" if name in read.posed else ", no pose"
                label = f"{name[:40]} ({camera.size[0]}x{camera.size[1]}{posed})"
                self._boxes[name] = self._gui.add_checkbox(label, True)
        self._cameras.visible = True
        form = "" if read.format is None else f"{read.format.name}; "
        self._facts.content = plain_markdown(
            f"{form}{len(read.cameras)} cameras, {len(read.posed)} with a pose"
        )

    def load(
        self, file: str, floor_points: str = "", as_file: bool = False, only: Sequence[str] | None = None
    ) -> None:
        """Add the cameras of a calibration file.

        Args:
            file: Path of the file, relative to the folder of the scene.
            floor_points: File of floor points that place the rig. If empty, the cameras are assumed to stand
                upright.
            as_file: Whether the world frame of the file is ``map``, so that the rig is not moved.
            only: Names of the cameras to take. If None, all are taken.
        """

        def add() -> None:
            check_value(self._document.folder, [file, floor_points])
            add_calibration(self._document, file, floor_points or None, as_file, only)

        self._edit(add)

    def idealize(self, ideal: bool) -> None:
        """Use ideal cameras (without lens distortion) if ``ideal``, else the real cameras again."""
        if not self._edit(lambda: set_ideal(self._document, *self._item, ideal)):
            self._ideal.value = not ideal

    def show(self, kind: SectionName, name: str) -> None:
        """Show whether a camera or the rig is ideal."""
        self._item = kind, name
        self._ideal.visible = kind == "rig" or (kind == "cameras" and self._document.has([kind, name]))
        if self._ideal.visible:
            self._ideal.value = is_ideal(self._document, kind, name)

    def _load(self) -> None:
        chosen = [name for name, box in self._boxes.items() if box.value]
        if self._boxes and not chosen:
            raise HumansimError("choose a camera of the file")
        only = None if len(chosen) == len(self._boxes) else chosen
        self.load(self.file.value, self._floor.value, bool(self._as_file.value), only)


class MotionPicture:
    """A row of stick figures that shows the motion of a person. It is redrawn when the motion changes.
    ``app``: the page."""

    def __init__(self, app: Page) -> None:
        self._gui = app.gui
        self._folder = app.gui.add_folder("Motion", visible=False)
        self._shown: object = None
        self._image: Any = None

    def show(self, actor: Actor | None) -> None:
        """Show the motion of a person. If ``actor`` is None, show nothing."""
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
    """Image (H, W, 3) with a row of stick figures of the motion of a person."""
    artist = StickFigureArtist.of_world(actor.motion, _FIGURE, "three-quarter")
    try:
        return strip([artist], _PHASES, actor.name)
    finally:
        artist.close()
