"""A scene file that is being edited: keys, comments, undo and redo, errors by key and line, saving."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import HumansimError, SceneError, in_section
from humansim_ros.files.reading import exists, expand_user
from humansim_ros.files.yaml import Section, parse_yaml, schema_errors
from humansim_ros.motion.body import body_joints
from humansim_ros.motion.files import KeyframeTrack, read_keyframes
from humansim_ros.scene.checks import check_scene
from humansim_ros.scene.config import (
    CameraConfig,
    HumanConfig,
    KeyframesConfig,
    ObjectConfig,
    RigConfig,
    SceneConfig,
    file_keys,
)
from humansim_ros.scene.core import (
    Obstacle,
    Scene,
    SceneCamera,
    find_obstacles,
    rig_placement,
    without_enclosures,
)
from humansim_ros.types import Array
from humansim_ros.view.edit.scene_file import NEW_SCENE, SceneFile
from humansim_ros.view.edit.scene_keys import (
    ItemPose,
    PeoplePoints,
    SectionKeys,
    camera_keys,
    camera_pose,
    check_name,
    find_key,
    free_place,
    free_view,
    human_keys,
    human_pose,
    metres,
    object_keys,
    object_pose,
    plain,
    rig_keys,
    split_key,
)
from humansim_ros.view.edit.yaml_edit import YamlKey, remove_value, rename_key, set_value, value_at

#: Sections of items that have a place in the scene. The rig is one item, with the name ``rig``.
SectionName = Literal["humans", "objects", "cameras", "rig"]

_SINGULAR = {"humans": "person", "objects": "object", "cameras": "camera"}
#: Camera that stands in while a scene has no cameras yet.
_A_CAMERA = {"position": [3.0, 0.0, 1.8], "look_at": [0, 0, 0.9]}
#: Height of new cameras, and of the point at which they look, metres.
_EYE, _CHEST = 1.8, 0.9
#: Scene times at which a new camera should see people, seconds; its least distance from a wall, metres.
_FIRST, _FROM_WALL = np.linspace(0.0, 2.0, 5), 0.3


class SceneFault(NamedTuple):
    """An error in a scene file: its key, the line of the key (None if unknown), and the reason."""

    key: str
    line: int | None
    message: str


class SceneDocument(SceneFile):
    """A scene file that is being edited.

    Each edit changes only the lines of its key. Comments, order, anchors and quotes of all other lines stay.
    After an edit the scene may have errors, which :meth:`errors` lists. Methods may be called from several
    threads. ``version`` increases with each change.

    Args:
        text: Content of the scene file.
        path: The file; None for a new scene.
        folder: Folder that relative file names start from. If None, the folder of the file.

    Example:
        >>> document = SceneDocument()
        >>> document.set("humans.person.motion.yaw_deg", 90)
        >>> document.add_person("anna", near=(1, 1))
        'anna'
        >>> document.errors()
        []
        >>> print(document.command())
          anna: {body: adult_woman, motion: {file: walk, position: [1, 1], loop: continue}}
        >>> document.undo()
        'Add anna'
    """

    def __init__(
        self,
        text: str = NEW_SCENE,
        path: str | os.PathLike[str] | None = None,
        folder: str | os.PathLike[str] | None = None,
    ) -> None:
        super().__init__(text, path, folder)
        self._parsed: tuple[str, dict[str, Any]] | None = None
        self._built: tuple[object, list[SceneFault], Scene | None] | None = None

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SceneDocument:
        """Open a scene file, which may have errors. Raises SceneError if it cannot be read or is binary."""
        document = cls("", path)
        document._read()
        return document

    @classmethod
    def copy_of(cls, path: str | os.PathLike[str], folder: Path | None = None) -> SceneDocument:
        """Make a new, unsaved scene with the text of a file, such as a built-in scene. ``folder``: folder for
        the files of the scene. If None, the folder of the file."""
        original = cls.load(path)
        return cls(original.text(), folder=folder or original.folder)

    # --- the text and its values

    def data(self) -> dict[str, Any]:
        """The text parsed as YAML, with anchors and merge keys applied. Raises SceneError if that fails."""
        return copy.deepcopy(self._values())

    def _values(self) -> dict[str, Any]:
        """Cached result of :meth:`data`. Callers must not change it."""
        with self._lock:
            if self._parsed is None or self._parsed[0] != self._text:
                data, _ = parse_yaml(self._text, SceneError, self._name)
                if data is not None and not isinstance(data, dict):
                    raise SceneError("a scene is a mapping with 'humans' and 'cameras'", path=self.path)
                self._parsed = self._text, data or {}
            return self._parsed[1]

    def value(self, key: str | Sequence[YamlKey]) -> Any:
        """Value of a key in the text, or its default if the key is absent; None without a default.

        Args:
            key: Dotted key, such as ``humans.anna.motion.yaw_deg``, or its parts.

        Raises:
            SceneError: Scenes have no such key, or the text is not valid.
        """
        found = find_key(key)
        value: Any = self._values()
        for number, part in enumerate(found.keys):
            if isinstance(value, str) and find_key(found.keys[:number]).short_key == part:
                return value
            items = dict(enumerate(value)) if isinstance(value, list) else value
            by_name = {str(name): item for name, item in items.items()} if isinstance(items, dict) else {}
            if str(part) not in by_name:
                return found.default
            value = by_name[str(part)]
        return copy.deepcopy(value)

    def has(self, key: str | Sequence[YamlKey]) -> bool:
        """Whether a key is in the text; False if the text is not valid."""
        try:
            keys = split_key(key)
            value = self._raw(keys[:-1])
        except SceneError:
            return False
        items = dict(enumerate(value)) if isinstance(value, list) else value
        return isinstance(items, dict) and str(keys[-1]) in map(str, items)

    def names(self, kind: SectionName) -> list[str]:
        """Names of the items in a section, in the order of the file; ``["rig"]`` if there is a rig."""
        section = self._values().get(kind)
        if kind == "rig":
            return ["rig"] if section is not None else []
        return [str(name) for name in section] if isinstance(section, dict) else []

    # --- edits

    def set(self, key: str | Sequence[YamlKey], value: Any, *, continues: bool = False) -> None:
        """Set a key. Missing sections above the key are added.

        Args:
            key: Dotted key, or its parts.
            value: Plain data or arrays. A wrong value is written, and :meth:`errors` reports it.
            continues: Whether the change joins the undo step of the last change of this key, for example
                while a slider moves.

        Raises:
            SceneError: Scenes have no such key; a number is not finite; a value is too long.
        """
        found = find_key(key)
        dotted = ".".join(map(str, found.keys))
        given = plain(value, dotted)
        with self.step(f"Set {dotted}", continues=continues):
            self._expand(found.keys)
            self._edit(set_value(self._text, found.keys, given, self._name))

    def remove(self, key: str | Sequence[YamlKey]) -> None:
        """Remove a key with its value, or an item such as a person. Raises SceneError if the key is
        absent."""
        keys = split_key(key)
        with self.step(f"Remove {'.'.join(map(str, keys))}"):
            self._edit(remove_value(self._text, keys, self._name))

    def rename(self, kind: SectionName, old: str, new: str) -> None:
        """Rename a person, an object or a camera. Raises SceneError if a name is wrong or taken."""
        find_key([kind, new])
        if new in self._names():
            raise SceneError(f"the name {new!r} is taken", key=f"{kind}.{old}")
        with self.step(f"Rename {old}"):
            self._edit(rename_key(self._text, [kind, old], new, self._name))

    def add_person(
        self,
        name: str = "person",
        near: ArrayLike = (0.0, 0.0),
        body: str = "adult_woman",
        motion: str = "walk",
    ) -> str:
        """Add a person.

        Args:
            name: Name of the person. If the name is taken, a number is added.
            near: Point (2,) or (3,) of the floor. The person gets the nearest place that is 0.8 m from people
                and objects.
            body: Name of a human, or a file.
            motion: Name of a motion, or a file.

        Returns:
            Name of the new person.
        """
        section: SectionKeys = {"body": body, "motion": {"file": motion, "position": self._free(near)}}
        if motion.startswith("walk"):
            section["motion"]["loop"] = "continue"
        return self.add_section("humans", name, section)

    def add_object(self, name: str = "object", near: ArrayLike = (0.0, 0.0), mesh: str = "box") -> str:
        """Add an object on the floor. ``mesh``: its shape. The rest is as in :meth:`add_person`."""
        section: SectionKeys = {"mesh": mesh}
        height = 0.0
        if mesh in ("box", "sphere", "cylinder"):
            section["size"], height = [0.5, 0.5, 0.5], 0.25
        section["position"] = [*self._free(near), height]
        return self.add_section("objects", name, section)

    def add_camera(
        self, name: str = "camera_1", near: ArrayLike | None = None, look_at: ArrayLike | None = None
    ) -> str:
        """Add a camera.

        Args:
            name: Name of the camera. If the name is taken, a number is added.
            near: Position (3,) of the camera, or (2,) at a height of 1.8 m. If None, the camera sees the
                people from a direction far from the other cameras.
            look_at: Point (3,) that the camera looks at. If None, the middle of the people.

        Returns:
            Name of the new camera.
        """
        target = (
            self._middle() if look_at is None else ItemPose(np.zeros(3), np.eye(3)).changed(look_at).position
        )
        if near is None:
            near = self._free_view(target)
        position = ItemPose(np.array([0, 0, _EYE]), np.eye(3)).changed(near).position
        if np.linalg.norm(target - position) < 1e-3:
            target = position + np.array([1.0, 0.0, 0.0])
        section = {
            "size": [640, 480],
            "position": metres(position),
            "look_at": metres(target),
            "fov_deg": 60,
        }
        return self.add_section("cameras", name, section)

    def duplicate(self, kind: SectionName, name: str) -> str:
        """Add a copy of a person, an object or a camera, half a metre away. Returns the name of the copy."""
        section = self._section(kind, name)
        with self.step(f"Duplicate {name}"):
            short = find_key([kind, name]).short_key
            section = {short: section} if isinstance(section, str) and short else section
            copied = self.add_section(kind, name, section)
            with suppress(SceneError):  # a trajectory moves it
                self.place(kind, copied, self.pose(kind, name).position + np.array([0.5, 0.5, 0.0]))
        return copied

    def place(
        self,
        kind: SectionName,
        name: str,
        position: ArrayLike | None = None,
        *,
        yaw_deg: float | None = None,
        quaternion: ArrayLike | None = None,
        seconds: float = 0.0,
        continues: bool = False,
    ) -> None:
        """Place a person, an object, a camera or the rig.

        Keeps the form of the pose of a camera: ``position`` and ``look_at``, or R and t, or P. These keys
        override a pose from a calibration file. If only ``position`` is given, a camera keeps its
        ``look_at``.

        Args:
            kind: Section.
            name: Name of the item.
            position: (3,) in ``map``, metres; (2,) for the same height. A person stays on the floor.
            yaw_deg: Heading in ``map``, degrees, counter-clockwise from +x.
            quaternion: Rotation (4,) xyzw instead of ``yaw_deg``, as :meth:`pose` gives it.
            seconds: Scene time at which the item is at this place, if it has keyframes.
            continues: Whether the change joins the undo step of the last placing, as during a drag.

        Raises:
            SceneError: The item cannot be placed, because a trajectory moves it, or because it is a camera of
                a rig.
        """
        old = self.pose(kind, name, seconds)
        pose = old.changed(position, yaw_deg, quaternion, forward=2 if kind == "cameras" else 0)
        at: list[str] = ["rig"] if kind == "rig" else [kind, name]
        with in_section(".".join(at)):
            if kind == "humans":
                keys = human_keys(pose, self.track(kind, name), seconds)
                keys = {part: keys[part] for part in self._asked(keys, position, yaw_deg, quaternion)}
                at.append("motion")
            elif kind == "objects":
                keys = object_keys(pose, self.track(kind, name), seconds)
                keys = {part: keys[part] for part in self._asked(keys, position, yaw_deg, quaternion)}
            elif kind == "cameras":
                turned = quaternion is not None or yaw_deg is not None
                keys = camera_keys(self.config(kind, name), self.camera(name), pose, turned)
            else:
                keys = rig_keys(pose)
        with self.step(f"Move {name}", continues=continues):
            for key, value in keys.items():
                if value is not None:
                    self.set([*at, key], value)
                elif key in (self._raw(at) or {}):
                    self.remove([*at, key])

    def pose(self, kind: SectionName, name: str, seconds: float = 0.0) -> ItemPose:
        """Pose of a person (the anchor of its motion), an object, a camera or the rig.

        Args:
            kind: Section of the item.
            name: Name of the item.
            seconds: Scene time of the pose, if the item has keyframes.

        Raises:
            HumansimError: The item is not in the file, or its section is wrong.
        """
        config = self.config(kind, name)
        if kind == "humans":
            return human_pose(config, self.track(kind, name), seconds)
        if kind == "objects":
            return object_pose(config, self.track(kind, name), seconds)
        if kind == "cameras":
            return camera_pose(self.camera(name))
        placement = rig_placement(config, self.source)
        return ItemPose(placement.position, placement.rotation)

    def own_pose(self, kind: SectionName, name: str) -> ItemPose:
        """Pose of a person or an object before its keyframes are applied; see :meth:`pose`."""
        config = self.config(kind, name)
        return human_pose(config) if kind == "humans" else object_pose(config)

    # --- the scene of the text

    def errors(self) -> list[SceneFault]:
        """Errors that loading the scene finds; empty if the scene can be loaded. Never raises."""
        return list(self._build()[0])

    def scene(self) -> Scene:
        """The scene, built from the text and cached. Raises SceneError with the first error of the text."""
        faults, scene = self._build()
        if scene is None:
            first = faults[0]
            raise SceneError(first.message, path=self.path, line=first.line, key=first.key or None)
        return scene

    @property
    def lacks_cameras(self) -> bool:
        """Whether the scene has no cameras yet. Such a scene cannot run, but the page can show it."""
        try:
            data = self._values()
        except SceneError:
            return False
        return not data.get("cameras") and data.get("rig") is None

    def scene_so_far(self) -> Scene:
        """The scene to show. If it has no cameras, one is added (not in the text), so that it can be built.

        Raises:
            HumansimError: The scene has another error.
        """
        if not self.lacks_cameras:
            return self.scene()
        with self.source.locating_errors():
            data = self.data() | {"cameras": {"none": _A_CAMERA}}
            try:
                return Scene.from_config(SceneConfig.model_validate(data), self.source)
            except ValidationError as reason:
                raise schema_errors(reason, SceneConfig, SceneError)[0] from None

    def findings(self) -> list[SceneFault]:
        """Probable mistakes in a valid scene, as ``humansim check`` finds them. This takes about 1 s."""
        scene = self._build()[1]
        if scene is None:
            return []
        return [SceneFault(found.key, found.line, found.text) for found in check_scene(scene, quick=True)]

    def _build(self) -> tuple[list[SceneFault], Scene | None]:
        with self._lock:
            state = self._text, self.version, self.path
            if self._built is None or self._built[0] != state:
                self._built = state, *self._checked()
            return self._built[1:]

    def _checked(self) -> tuple[list[SceneFault], Scene | None]:
        try:
            data, tree = parse_yaml(self._text, SceneError, self._name)
            if not isinstance(data, dict):
                raise SceneError("a scene is a mapping with 'humans' and 'cameras'", line=1)
            config = SceneConfig.model_validate(data)
            return [], Scene.from_config(config, self.source)
        except ValidationError as reason:
            found = schema_errors(reason, SceneConfig, SceneError, None, tree)
            return [SceneFault(error.key or "", error.line, error.message) for error in found], None
        except HumansimError as error:
            elsewhere = error.path is not None and error.path not in (self._name, str(self.path))
            message = str(error) if elsewhere else error.message
            return [SceneFault(error.key or "", None if elsewhere else error.line, message)], None

    # --- parts

    def _moved_to(self, folder: Path) -> str:
        """Text of the scene in which relative file names are relative to another folder."""
        if folder == self.folder:
            return self._text
        text, data = self._text, self.data()
        for keys, name in file_keys(SceneConfig.model_validate(data) if not self.errors() else None):
            if "://" in name or expand_user(name).is_absolute() or not exists(self.folder / name):
                continue
            given = self._written_keys(data, keys)
            text = set_value(text, given, os.path.relpath(self.folder / name, folder), self._name)
        return text

    def _expand(self, keys: Sequence[YamlKey]) -> None:
        """Rewrite sections above a key that are a single text, such as ``anna: adult_woman``, as mappings."""
        for number in range(1, len(keys)):
            value, short = self._raw(keys[:number]), find_key(keys[:number]).short_key
            if isinstance(value, str) and short is not None:
                self._edit(set_value(self._text, keys[:number], {short: value}, self._name))

    def _raw(self, keys: Sequence[YamlKey]) -> Any:
        """Value of a key as written in the text, not a copy; None if absent."""
        return value_at(self._values(), keys)

    def _written_keys(self, data: Any, keys: Sequence[YamlKey]) -> Sequence[YamlKey]:
        """Path of a value in the text. It ends earlier if a section is written short, as a single text."""
        for number, key in enumerate(keys):
            if isinstance(data, str):
                return keys[:number]
            data = data[int(key)] if isinstance(data, list) else data[key]
        return keys

    def _section(self, kind: SectionName, name: str) -> Any:
        section = self._raw(["rig"] if kind == "rig" else [kind, name])
        if section is None:
            raise SceneError(self._missing(kind, name), key=kind if kind == "rig" else f"{kind}.{name[:60]}")
        return section

    def _missing(self, kind: SectionName, name: str) -> str:
        if kind == "cameras" and self._raw(["rig"]) is not None:
            return "this is a camera of the rig: place the rig, or its cameras one by one in `cameras`"
        return f"not in the file; there are {', '.join(self.names(kind)[:20]) or 'none'}"

    def config(self, kind: SectionName, name: str) -> Any:
        """Section of an item or the rig as a config object. Raises SceneError if the section is wrong."""
        models: dict[str, type[Section]] = {
            "humans": HumanConfig,
            "objects": ObjectConfig,
            "cameras": CameraConfig,
            "rig": RigConfig,
        }
        section = self._section(kind, name)
        try:
            return models[kind].model_validate(section)
        except ValidationError as reason:
            error = schema_errors(reason, models[kind], SceneError)[0]
            raise error.within(kind if kind == "rig" else f"{kind}.{name}") from None

    def camera(self, name: str) -> Camera:
        """Build a camera of the file, with its uncropped image. Raises HumansimError if it is wrong."""
        with self.source.locating_errors(), in_section("cameras"):
            return SceneCamera.build(name, self.config("cameras", name), self.source).whole

    def track(self, kind: SectionName, name: str) -> KeyframeTrack | None:
        """Keyframes of a person or an object, or None. Raises HumansimError if the keyframes are wrong."""
        keyframes: KeyframesConfig | None = self.config(kind, name).keyframes
        if keyframes is None:
            return None
        with in_section(f"{kind}.{name}.keyframes.file"):
            return read_keyframes(self.source.find(keyframes.file)).track(keyframes.object or name)

    @staticmethod
    def _asked(
        keys: SectionKeys, position: ArrayLike | None, yaw_deg: float | None, quaternion: ArrayLike | None
    ) -> list[str]:
        """Those of the keys of position and rotation that must be written, because a new value is given."""
        first, second = keys
        turned = yaw_deg is not None or quaternion is not None
        return ([first] if position is not None else []) + ([second] if turned else [])

    def _names(self) -> AbstractSet[str]:
        """Names of all humans, objects and cameras; also the cameras of the rig if the scene loads."""
        built = self._built[2] if self._built is not None else None
        rig = frozenset[str]() if built is None else frozenset(built.cameras)
        return rig.union(self.names("humans"), self.names("objects"), self.names("cameras"))

    def add_section(self, kind: SectionName, name: str, section: Any) -> str:
        """Add a person, an object or a camera with its keys.

        Args:
            kind: Section.
            name: Name of the item. If the name is taken, a number is added.
            section: Keys and values of the item.

        Returns:
            Name of the new item.
        """
        find_key([kind, name])
        taken = self._names()
        free, number = name, 2
        stem = name.rstrip("0123456789").rstrip("_") or name
        while free in taken:
            free, number = f"{stem}_{number}", number + 1
        check_name(free, key=kind)
        with self.step(f"Add {free}"):
            self._edit(set_value(self._text, [kind, free], plain(section, f"{kind}.{free}"), self._name))
        return free

    def _floor_places(self) -> dict[str, tuple[float, float]]:
        """Place (x, y) of each person and object on the floor, metres, such as ``humans.anna``."""
        places = {}
        for kind, keys in (("humans", ("motion", "position")), ("objects", ("position",))):
            for name in self.names("humans" if kind == "humans" else "objects"):
                value = self._raw([kind, name, *keys]) or [0, 0]
                try:
                    x, y = (float(part) for part in value[:2])
                except (TypeError, ValueError):  # it is wrong
                    continue
                places[f"{kind}.{name}"] = (x, y)
        return places

    def _free(self, near: ArrayLike) -> list[float]:
        at = ItemPose(np.zeros(3), np.eye(3)).changed(near).position
        placed: list[float] = metres(free_place((float(at[0]), float(at[1])), self._floor_places()))
        return placed

    def _free_view(self, target: Array) -> Array:
        """Find a place (3,) in the room for a camera that looks at a target, where nothing hides the
        people."""
        people = [at for name, at in self._floor_places().items() if name.startswith("humans.")]
        points = np.array([[x, y, z] for x, y in people or [(target[0], target[1])] for z in (0.1, 1.8)])
        seen = PeoplePoints(points, np.zeros(len(points)))
        centers = np.zeros((0, 3))
        obstacles: list[Obstacle] = []
        inside: tuple[float, float] | None = None
        with suppress(HumansimError):  # the scene has errors: its places on the floor are enough
            scene = self.scene_so_far()
            if scene.actors:
                paths = [
                    actor.joint_paths(_FIRST)[:, body_joints(actor.human.skeleton.joint_names)]
                    for actor in scene.actors.values()
                ]
                times = [np.repeat(_FIRST, path.shape[1]) for path in paths]
                points = np.concatenate([path.reshape(-1, 3) for path in paths])
                seen = PeoplePoints(points, np.concatenate(times))
            if not self.lacks_cameras:
                centers = np.array([camera.center for camera in scene.cameras.values()]).reshape(-1, 3)
            if scene.config.room is not None:
                length, width, _ = scene.config.room.size
                inside = (length / 2 - _FROM_WALL, width / 2 - _FROM_WALL)
            obstacles = without_enclosures(find_obstacles(scene), np.vstack([points, centers]))
        return free_view(seen, centers, target, _EYE, inside, obstacles)

    def _middle(self) -> np.ndarray[Any, Any]:
        people = [at for name, at in self._floor_places().items() if name.startswith("humans.")]
        x, y = np.mean(people, axis=0) if people else (0.0, 0.0)
        return np.array([x, y, _CHEST])
