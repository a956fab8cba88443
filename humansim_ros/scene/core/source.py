"""Origin of a scene: files that it names are found here, and its errors get file and line."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import HumansimError, SceneError, in_section, warn_about
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import exists, expand_user, missing_file
from humansim_ros.files.yaml import line_of, parse_yaml, read_yaml
from humansim_ros.motion.body import Motion
from humansim_ros.motion.files import PositionChannels, find_motion, read_motion
from humansim_ros.people.humans import Human, Skinning
from humansim_ros.people.loading import find_human, load_human
from humansim_ros.scene.config.config import LIVE

T = TypeVar("T")

#: In the first frame of this motion, a person stands with hanging arms.
STANDING = "wave"


@dataclass(frozen=True)
class SceneSource:
    """Scene file, or objects in memory, that a scene is made of.

    Attributes:
        path: The scene file; None for a scene that is made in memory.
        folder: Folder that relative file names start from.
        objects: Humans, motions and meshes in memory, by their names in the configuration.
        text: Content of the scene file in place of the file on disk, while it is edited.
        loaded: Humans and motions so far, by what was asked for, see :meth:`loading`. If None, files are read
            each time.
    """

    path: Path | None = None
    folder: Path = field(default_factory=Path.cwd)
    objects: Mapping[str, Human | Motion | Mesh] = field(default_factory=dict)
    text: str | None = None
    loaded: dict[tuple[object, ...], Any] | None = field(default=None, compare=False, repr=False)

    @classmethod
    def of_file(cls, path: str | os.PathLike[str]) -> SceneSource:
        """Source of the scene in a file."""
        return cls(Path(path), Path(path).resolve().parent)

    def loading(self) -> SceneSource:
        """The same source for the time that a scene is loaded: it reads a file once for all people."""
        return replace(self, loaded={}) if self.loaded is None else self

    def once(self, make: Callable[[], T], *key: object) -> T:
        """Result of a function: while a scene is loaded, of the first call with a key."""
        if self.loaded is None:
            return make()
        if key not in self.loaded:
            self.loaded[key] = make()
        result: T = self.loaded[key]
        return result

    @contextmanager
    def locating_errors(self) -> Iterator[None]:
        """Add the scene file and the line of their key to errors."""
        try:
            yield
        except HumansimError as error:
            if error.path is not None or (self.path is None and self.text is None):
                raise
            line = self.line(error.key)
            located = type(error)(error.message, path=self.path, line=line, key=error.key)
            raise located from error.__cause__

    def warn(self, key: str, message: str) -> None:
        """Issue a HumansimWarning about a key of the scene."""
        line = self.line(key)
        where = "scene" if self.path is None else f"{self.path}{'' if line is None else f':{line}'}"
        warn_about(where, f"{key}: {message}")

    def find(self, name: str, hint: str = "") -> Path:
        """Path of an existing file or folder. ``hint``: what to use instead, for the SceneError."""
        path = self.folder / expand_user(name)
        if not exists(path):
            raise SceneError(missing_file(path, hint))
        return path

    def find_url(self, name: str) -> Path:
        """Path of an existing file or folder from a path or a ``file://`` or ``package://`` URL."""
        if "://" not in name:
            return self.find(name)
        try:
            from humansim_ros.cameras.formats import resolve_url

            path = resolve_url(name)
        except HumansimError as error:
            raise SceneError(f"{name}: {error.message}") from None
        if not exists(path):
            raise SceneError(missing_file(path))
        return path

    def joint_table(self, name: str) -> str:
        """Path of a joint table in the scene's folder. If there is no such file, ``name`` unchanged: it is
        that of a built-in table."""
        path = self.folder / expand_user(name)
        return str(path) if exists(path) and path.is_file() else name

    def human(
        self, name: str, outfit: str | None = None, skinning: Skinning | None = None, key: str = "body"
    ) -> Human:
        """Load a human.

        Args:
            name: Name of a built-in, path, or name of an object in memory.
            outfit: Name of an outfit; the first if None.
            skinning: Skinning function; the function of the file if None.
            key: Key of the scene that has the name, for errors.
        """
        with in_section(key):
            human = self._object(name, Human)
            if human is None:
                path = find_human(name, self.folder, SceneError)
                human = self.once(lambda: load_human(path), "human", name)
        if outfit is not None:
            with in_section("outfit"):
                human = self.once(partial(human.wearing, outfit), "human", name, outfit)
        return human if skinning is None else replace(human, skinning=skinning)

    def motion(self, name: str, positions: PositionChannels) -> Motion:
        """Read a motion by name or path; the rest pose for ``live``."""
        motion = self._object(name, Motion)
        if motion is not None:
            return motion
        if name == LIVE:
            standing = read_motion(STANDING)
            return replace(standing, values=standing.values[:1], path=LIVE)
        path = find_motion(name, self.folder, SceneError)
        return self.once(lambda: read_motion(path, positions), "motion", name, positions)

    def mesh(self, name: str) -> Mesh | None:
        """A mesh in memory; None for the name of a file."""
        return self._object(name, Mesh)

    def _object(self, name: str, kind: type[T]) -> T | None:
        value = self.objects.get(name)
        if value is None or isinstance(value, kind):
            return value
        raise SceneError(f"must be a {kind.__name__}, not a {type(value).__name__}")

    def line(self, key: str | None) -> int | None:
        """Line of a dotted key, or of its deepest section that is in the file."""
        if key is None or (self.path is None and self.text is None):
            return None
        return line_of(self.once(self._tree, "tree"), key.split("."))

    def _tree(self) -> yaml.Node | None:
        """Nodes of the scene file; None for a file that cannot be read any more."""
        try:
            if self.text is not None:
                return parse_yaml(self.text, SceneError, self.path or "scene")[1]
            assert self.path is not None
            return read_yaml(self.path, SceneError, "scene")[1]
        except SceneError:
            return None


def name_objects(value: Any, key: str, objects: dict[str, Human | Motion | Mesh]) -> Any:
    """Copy of a scene's mapping in which names stand for objects in memory.

    Args:
        value: Value of ``key``. Cameras in it become their keys of a scene file, arrays become lists.
        key: Position in the scene, such as ``humans.anna``; empty for the scene itself.
        objects: The humans, motions and meshes are added here, by name.
    """
    if isinstance(value, (Human, Motion, Mesh)):
        name = f"<{type(value).__name__} {key}>"
        objects[name] = value
        return name
    if isinstance(value, Camera):
        return _camera_keys(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        if isinstance(value.get("calibration"), Camera):
            value = _with_camera(value)
        return {
            name: name_objects(part, f"{key}.{name}".removeprefix("."), objects)
            for name, part in value.items()
        }
    if isinstance(value, (list, tuple)):
        return [name_objects(part, f"{key}.{index}", objects) for index, part in enumerate(value)]
    return value


def _with_camera(section: Mapping[str, Any]) -> dict[str, Any]:
    """Section of a camera with a Camera in place of a calibration file; a pose in the section wins."""
    keys = _camera_keys(section["calibration"])
    if section.keys() & {"position", "R", "trajectory"}:
        del keys["R"], keys["t"]
    return keys | {key: value for key, value in section.items() if key != "calibration"}


def _camera_keys(camera: Camera) -> dict[str, Any]:
    keys = {"size": camera.size, "K": camera.K.tolist(), "R": camera.R.tolist(), "t": camera.t.tolist()}
    keys |= {"distortion": camera.distortion, "distortion_model": camera.model}
    for name in ("rectification", "rectified"):
        matrix = getattr(camera, name)
        keys[name] = None if matrix is None else matrix.tolist()
    return keys


def found_name(folder: Path, name: str) -> str:
    """Absolute path of a file that a scene in ``folder`` names; names of built-ins, and ``live``, stay."""
    if name == LIVE:
        return name
    path = folder / name.split("#")[0]
    # a folder may have the name of a built-in
    is_path = (exists(path) and (path.is_file() or "/" in name)) or "{name}" in name
    return str(folder / name if is_path else name)
