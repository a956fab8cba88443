"""Controls for the keys of a section of a scene, made from the schema. Errors are shown below the
controls."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args, get_origin

from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.files.reading import built_in_names
from humansim_ros.files.yaml import ByteColor, parse_yaml
from humansim_ros.scene.config import LIVE, SceneConfig
from humansim_ros.scene.core import BUILT_IN_MESHES
from humansim_ros.view.edit.document import SceneDocument, SceneFault
from humansim_ros.view.edit.scene_keys import SceneKey, alternatives, find_key
from humansim_ros.view.edit.yaml_edit import YamlKey, flow
from humansim_ros.view.panels.files import upload_button
from humansim_ros.view.panels.page import by_user, plain_markdown
from humansim_ros.view.server.uploads import files_in, kind_of_key

#: Changes a key; None removes it.
KeyChange = Callable[[tuple[YamlKey, ...], Any], None]
#: Functions of a control: the first converts the value that the user entered for the document; the second
#: shows a value of the document.
ReadValue = Callable[[SceneKey, Any], Any]
ShowValue = Callable[[Any, Any, SceneDocument, SceneKey], None]

_OFF = "(default)"


class SectionControls:
    """Controls for all keys of a section; nested sections get folders.

    Args:
        gui: The GUI of viser.
        document: The scene.
        keys: Path of the section.
        change: Function that is called with a key and its new value when a user changes the value.
        only: Keys of the section that get controls. If empty, all keys get one.
        choices: Values that the user can choose from, by dotted key within the section.
        post: Runs a function in the thread that edits the document.
        folder: Folder of the page for the controls and their errors. If None, the root of the page.
    """

    def __init__(
        self,
        gui: Any,
        document: SceneDocument,
        keys: Sequence[YamlKey],
        change: KeyChange,
        only: Sequence[str] = (),
        choices: Mapping[str, Sequence[str]] | None = None,
        post: Callable[[Callable[[], None]], None] = lambda function: function(),
        folder: Any = None,
    ) -> None:
        self.keys = tuple(keys)
        self._gui, self._document, self._change, self._post = gui, document, change, post
        self._choices = choices or {}
        self.controls: dict[tuple[YamlKey, ...], KeyControl] = {}
        self._order = 0.0
        self._add(tuple(keys), folder, only)

    def refresh(self) -> None:
        """Show the values of the document."""
        for control in self.controls.values():
            control.show(self._document)

    def show_errors(self, faults: Sequence[SceneFault]) -> list[SceneFault]:
        """Show errors below their controls. Returns the errors that belong to no control."""
        told: dict[tuple[YamlKey, ...], str] = {}
        others = []
        for fault in faults:
            keys = tuple(fault.key.split("."))
            own = [known for known in self.controls if tuple(map(str, known)) == keys[: len(known)]]
            if own:
                told.setdefault(max(own, key=len), fault.message)
            else:
                others.append(fault)
        for keys_of, control in self.controls.items():
            control.tell(self._gui, told.get(keys_of))
        return others

    def control(self, key: str) -> KeyControl:
        """Return the control of a key. ``key``: dotted key within the section."""
        return next(
            one for one in self.controls.values() if key == ".".join(map(str, one.key.keys[len(self.keys) :]))
        )

    def _add(self, keys: tuple[YamlKey, ...], folder: Any, only: Sequence[str] = ()) -> None:
        model = find_key(keys).section if keys else SceneConfig
        assert model is not None
        nested = []
        for name, info in model.model_fields.items():
            key = info.alias or name
            if only and key not in only:
                continue
            found = find_key((*keys, key))
            if found.section is not None and get_origin(_single(found.annotation)) is None:
                nested.append(found)
            else:
                self._add_control(found, folder)
        for found in nested:
            self._add_section(found)

    def _add_section(self, found: SceneKey) -> None:
        """Add a folder for a section. If the section is optional, a box turns it on."""
        self._order += 1
        optional = type(None) in get_args(found.annotation)
        folder = self._gui.add_folder(str(found.keys[-1]), order=self._order, expand_by_default=False)
        with folder:
            if optional:
                needs = any(info.is_required() for info in found.section.model_fields.values())  # type: ignore[union-attr]
                if needs:
                    self._add_control(found, folder)
                    return
                self._order += 1
                box = self._gui.add_checkbox("on", False, hint=_hint(found), order=self._order)
                self._register(KeyControl(found, box, folder, self._order, _read_switch, _show_switch))
            self._add(found.keys, folder)

    def _add_control(self, found: SceneKey, folder: Any) -> None:
        self._order += 1
        gui, label = self._gui, str(found.keys[-1])
        options = {"hint": _hint(found), "order": self._order}
        single = _single(found.annotation)
        optional = type(None) in get_args(found.annotation)
        kind = kind_of_key(found.keys)
        names = self._names_for(found, kind)
        read: ReadValue = _read_plain
        show: ShowValue = _show_plain
        if names:
            handle = gui.add_dropdown(label, (_OFF, *names), **options)
            read, show = _read_choice, _show_choice
        elif single is bool and not optional:
            handle = gui.add_checkbox(label, False, **options)
        elif get_origin(single) is Literal and not optional:
            handle = gui.add_dropdown(label, tuple(map(str, get_args(single))), **options)
        elif single in (int, float) and not optional:
            start = 0 if single is int else 0.0
            handle = gui.add_number(label, start, step=1 if single is int else 0.01, **options)
            show = _show_number
        elif single == ByteColor and not optional:
            handle = gui.add_rgb(label, (0, 0, 0), **options)
        else:
            handle = gui.add_text(label, "", **options)
            read, show = _read_text, _show_text
        control = KeyControl(found, handle, folder, self._order, read, show, tuple(names))
        self._register(control)
        if kind is not None:
            upload_button(
                gui,
                self._document,
                kind,
                lambda name: self._take_file(control, name),
                self._post,
                label=f"Upload {label} …",
                order=self._order + 0.25,
            )

    def _take_file(self, control: KeyControl, name: str) -> None:
        """Set the key of a control to a file that the user has uploaded."""
        try:
            self._change(control.key.keys, name)
        except HumansimError as error:
            control.tell(self._gui, error.message)

    def _register(self, control: KeyControl) -> None:
        control.show(self._document)
        self.controls[control.key.keys] = control
        control.handle.on_update(by_user(self._post, lambda: self.changed(control)))

    def changed(self, control: KeyControl) -> None:
        """Change the document after a user has changed a control. An error is shown below the control."""
        try:
            self._change(control.key.keys, control.read())
        except HumansimError as error:
            control.tell(self._gui, error.message)

    def offer(self, key: str, names: Sequence[str]) -> None:
        """Replace the names that the list of a key offers. ``key``: dotted key within the section."""
        control = self.control(key)
        value = self._document.value(control.key.keys)
        shown = (_OFF, *names) if value is None or value in names else (_OFF, *names, str(value))
        if tuple(control.handle.options) != shown:
            control.handle.options = shown
            control.show(self._document)

    def _names_for(self, found: SceneKey, kind: str | None) -> list[str]:
        """Names to choose from: built-ins, files of a kind, and the value of the document."""
        dotted = ".".join(map(str, found.keys[len(self.keys) :]))
        names = list(self._choices.get(dotted, ()))
        if kind is not None and all(one is str for one in alternatives(found.annotation)):
            names += files_in(self._document.folder, kind)
        value = self._document.value(found.keys)
        return [*names, value] if names and isinstance(value, str) and value not in names else names


def choices_of(kind: str) -> dict[str, Sequence[str]]:
    """Built-in names to choose from, by dotted key, for a kind of section (``humans``, ``objects``)."""
    if kind == "humans":
        return {"body": built_in_names("humans"), "motion.file": [*built_in_names("motions"), LIVE]}
    return {"mesh": list(BUILT_IN_MESHES)} if kind == "objects" else {}


class KeyControl:
    """The control of one key, and the text of its error below."""

    def __init__(
        self,
        key: SceneKey,
        handle: Any,
        folder: Any,
        order: float,
        read: ReadValue,
        show: ShowValue,
        names: tuple[str, ...] = (),
    ) -> None:
        self.key, self.handle, self.names = key, handle, names
        self._folder, self._order = folder, order
        self._read, self._show = read, show
        self._error: Any = None

    @property
    def error(self) -> str | None:
        """Text of the error below the control; None if no error is shown."""
        return None if self._error is None else self._error.content

    def read(self) -> Any:
        """Value for the document; None removes the key."""
        return self._read(self.key, self.handle.value)

    def show(self, document: SceneDocument) -> None:
        """Show the value of the document. If the value has a wrong type, its text stays as the user typed
        it."""
        try:
            value = document.value(self.key.keys)
            self._show(self.handle, value, document, self.key)
        except (HumansimError, TypeError, ValueError):
            return

    def tell(self, gui: Any, message: str | None) -> None:
        """Show an error below the control. If the message is None, no error is shown."""
        if message is None:
            if self._error is not None:
                self._error.remove()
                self._error = None
            return
        text = f"⚠ **{self.key.keys[-1]}**: {plain_markdown(message)}"
        if self._error is not None:
            self._error.content = text
            return
        with contextlib.nullcontext() if self._folder is None else self._folder:
            self._error = gui.add_markdown(text, order=self._order + 0.5)


def _read_plain(_: SceneKey, value: Any) -> Any:
    return value


def _read_choice(_: SceneKey, value: Any) -> Any:
    return None if value == _OFF else value


def _read_switch(_: SceneKey, value: Any) -> Any:
    return {} if value else None


def _read_text(key: SceneKey, value: str) -> Any:
    """Value of a text that the user typed: the text itself for names and files, otherwise parsed as YAML."""
    text = value.strip()
    if not text:
        return None
    kinds = list(alternatives(key.annotation))
    if all(kind is str for kind in kinds):
        return text
    return parse_yaml(text, SceneError, "value")[0]


def _show_plain(handle: Any, value: Any, _: SceneDocument, key: SceneKey) -> None:
    shown = tuple(value) if isinstance(value, list) else value
    if handle.value != shown and shown is not None:
        handle.value = shown


def _show_number(handle: Any, value: Any, _: SceneDocument, key: SceneKey) -> None:
    if value is not None and handle.value != float(value):
        handle.value = int(value) if isinstance(handle.value, int) else float(value)


def _show_choice(handle: Any, value: Any, document: SceneDocument, key: SceneKey) -> None:
    shown = _OFF if value is None else str(value)
    if handle.value != shown:
        if shown not in handle.options:
            handle.options = (*handle.options, shown)
        handle.value = shown


def _show_switch(handle: Any, value: Any, _: SceneDocument, key: SceneKey) -> None:
    handle.value = value is not None


def _show_text(handle: Any, value: Any, _: SceneDocument, key: SceneKey) -> None:
    written = value if isinstance(value, str) else "" if value is None else flow(value)
    read = None
    with contextlib.suppress(HumansimError):  # it is not YAML
        read = _read_text(key, handle.value)
    if written != handle.value and (read != value or not handle.value):
        handle.value = written


def _single(annotation: Any) -> Any:
    """The type of an annotation, without metadata and None; None if the annotation allows several types."""
    found = list(alternatives(annotation))
    return found[0] if len(found) == 1 else None


def _hint(found: SceneKey) -> str | None:
    return found.field.description if found.field is not None else None
