"""Options of commands that replace parts of a scene; errors about these parts name the option."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from humansim_ros.errors import HumansimError, did_you_mean
from humansim_ros.io.files import exists, expand_user

if TYPE_CHECKING:
    from humansim_ros.scene import Scene


@dataclass(frozen=True)
class SceneOptions:
    """Options that replace parts of a scene.

    Attributes:
        motion: Motion file or built-in motion of the first human; it is placed in the centre of the room.
        mesh: Body of the first human.
        joint_names: Joint table of that motion.
        live: Names of the humans that another node moves.
    """

    motion: str | None = None
    mesh: str | None = None
    joint_names: str | None = None
    live: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.motion or self.mesh or self.joint_names or self.live)

    def write(self, path: Path, folder: Path) -> Path:
        """Write a copy of a scene with the replaced parts. Raises HumansimError.

        ``folder``: folder of the copy.
        """
        import yaml

        from humansim_ros.errors import SceneError
        from humansim_ros.scene.config import LIVE, load_config, map_files
        from humansim_ros.scene.source import SceneSource
        from humansim_ros.scene.variety import with_variety

        source = SceneSource.of_file(path)
        with source.locating_errors():
            scene = with_variety(load_config(path), source)
        config = map_files(
            scene.model_dump(exclude_none=True), lambda name: _absolute_in(source.folder, name)
        )
        config.setdefault("room", None)
        humans = config["humans"]
        if not humans:
            raise SceneError("the scene has no human to give a motion or mesh to", path=path, key="humans")
        for name in self.live:
            if name not in humans:
                known = ", ".join(humans)
                message = f"no human {name!r} for --live; the scene has {known}{did_you_mean(name, humans)}"
                raise SceneError(message, path=path, key="humans")
            place = humans[name]["motion"]
            humans[name]["motion"] = {
                "file": LIVE,
                "position": place["position"],
                "yaw_deg": place["yaw_deg"],
            }
        human = next(iter(humans.values()))
        if self.mesh:
            human["body"] = _absolute(self.mesh)
            human.pop("outfit", None)
        if self.motion:
            human["motion"] = {"file": _absolute(self.motion), "anchor": "center"}
        if self.joint_names:
            human["motion"]["joint_names"] = _absolute(self.joint_names)
        changed = folder / path.name
        changed.write_text(yaml.safe_dump(config, sort_keys=False))
        return changed

    def load(self, path: Path, changed: Path) -> Scene:
        """Load the copy of a scene. Errors name the option, or the file and line of the scene itself."""
        from humansim_ros.scene import Scene
        from humansim_ros.scene.config import load_config
        from humansim_ros.scene.source import SceneSource

        config = load_config(changed)
        with self.naming_options(next(iter(config.humans))):
            return Scene.from_config(config, SceneSource.of_file(path))

    def option(self, human: str, key: str) -> str | None:
        """Option that has replaced a key of the scene, if any. ``human``: name of the first human."""
        section = f"humans.{human}."
        given = {
            f"{section}motion.joint_names": ("--joint-names", self.joint_names),
            f"{section}motion": ("--motion", self.motion),
            f"{section}body": ("--mesh", self.mesh),
            f"{section}outfit": ("--mesh", self.mesh),
        }
        replaced = (name for start, (name, value) in given.items() if value and _begins(key, start))
        live = ("--live" for name in self.live if _begins(key, f"humans.{name}.motion"))
        return next(replaced, None) or next(live, None)

    @contextmanager
    def naming_options(self, human: str) -> Iterator[None]:
        """Name the option in errors about a part that it has replaced."""
        try:
            yield
        except HumansimError as error:
            option = None if error.key is None else self.option(human, error.key)
            if option is None:
                raise
            raise type(error)(error.message, key=option) from error.__cause__


def _begins(key: str, start: str) -> bool:
    return f"{key}.".startswith(f"{start}.")


def _absolute_in(folder: Path, name: str) -> str:
    """Absolute path of a file that a scene names; names of built-ins, and ``live``, stay."""
    from humansim_ros.scene.config import LIVE

    if name == LIVE:
        return name
    path = folder / name.split("#")[0]
    # a folder may have the name of a built-in
    is_path = (exists(path) and (path.is_file() or "/" in name)) or "{name}" in name
    return str(folder / name if is_path else name)


def _absolute(name: str) -> str:
    """Absolute path; the name of a built-in is unchanged."""
    path = expand_user(name)
    return str(path.resolve()) if path.suffix or exists(path) else name
