"""Motions of the player: parameters, files that requests may name, and a thread that reads them."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from rclpy.parameter import Parameter

from humansim_ros.errors import HumansimError, MotionError, RosError, warn_about
from humansim_ros.files.reading import built_in_names, expand_user, hiding_quotes, size_text
from humansim_ros.motion.body import Motion
from humansim_ros.motion.files import (
    MOTION_TITLES,
    PositionChannels,
    find_motion,
    is_activity,
    split_motion_name,
)
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.config import LIVE, MotionConfig
from humansim_ros.scene.core import Playback, SceneSource

#: Largest scene time in seconds that parameters accept.
MAX_SECONDS = 1e6
#: Value of the parameter of the hands for the hands of the scene file.
HANDS_OF_SCENE = "scene"
#: Most characters of the parameter of the hands.
_MAX_HANDS = 100


@dataclass(frozen=True)
class _Setting:
    """A parameter of the motion of a human. ``key``: key under ``motion`` in the scene file."""

    key: str
    type: Parameter.Type
    description: str
    limits: tuple[float, float] | None = None
    constraints: str = ""

    def parameter_value(self, motion: MotionConfig) -> Any:
        """Value of the parameter for a motion of a scene file. The value 0 stands for no ``end``."""
        if self.key == "hands":
            return HANDS_OF_SCENE
        value = getattr(motion, self.key)
        return 0.0 if value is None else value

    def config_value(self, value: Any, of_scene: MotionConfig) -> Any:
        """Value of the scene key for a value of the parameter. ``of_scene``: motion of the scene file."""
        if self.key == "hands":
            return of_scene.hands if value == HANDS_OF_SCENE else _hand_keys(value)
        return None if self.key == "end" and value == 0 else value


_SETTINGS = {
    "motion": _Setting(
        "file",
        Parameter.Type.STRING,
        "motion; setting it reads the file, even the same one again",
        constraints=f"built-in motion, or file ({MOTION_TITLES}) below the folder of the scene or "
        "motion_folders",
    ),
    "loop": _Setting(
        "loop",
        Parameter.Type.STRING,
        "behaviour after the last frame",
        constraints="none, repeat or continue",
    ),
    "start": _Setting(
        "start", Parameter.Type.DOUBLE, "start of the played part, seconds of the file", (0.0, MAX_SECONDS)
    ),
    "end": _Setting(
        "end",
        Parameter.Type.DOUBLE,
        "end of the played part, seconds of the file; 0: end of the file",
        (0.0, MAX_SECONDS),
        "after start",
    ),
    "mirror": _Setting("mirror", Parameter.Type.BOOL, "swap left and right"),
    "speed": _Setting(
        "speed", Parameter.Type.DOUBLE, "seconds of the file per second of the scene", (0.0, 100.0)
    ),
    "hands": _Setting(
        "hands",
        Parameter.Type.STRING,
        "pose of the hands from the next frame on",
        constraints="name of a hand pose; poses of sides, as in 'left: fist, right: point'; or "
        f"{HANDS_OF_SCENE}",
    ),
}
#: Settings that also have a parameter for all humans. Parameter ``speed`` is that of the clock.
_SHARED = tuple(name for name in _SETTINGS if name not in ("speed", "hands"))


def _hand_keys(text: str) -> tuple[dict[str, str], ...]:
    """Convert the parameter of the hands to the section ``hands`` of a scene file. The parameter is a pose,
    or one pose for each side.

    Raises:
        MotionError: The text is too long.
    """
    if len(text) > _MAX_HANDS:
        raise MotionError(f"{len(text)} characters; at most {_MAX_HANDS}", key="hands")
    keys = []
    for part in text.split(","):
        side, colon, pose = part.rpartition(":")
        keys.append({"pose": pose.strip(), **({"side": side.strip()} if colon else {})})
    return tuple(keys)


class MotionParameters:
    """Declares the parameters of all humans of a playback on a node.

    Values that the user gives at the start replace those of the scene file. Raises HumansimError if such a
    motion cannot be played.
    """

    def __init__(self, node: SceneNode, playback: Playback) -> None:
        self._playback = playback
        shared = {}
        for name in _SHARED if playback.settings else ():
            setting = _SETTINGS[name]
            shared[name] = node.described_parameter(
                name,
                setting.type,
                f"All humans (last value that they had in common): {setting.description}",
                setting.limits,
                setting.constraints,
            )
        for human, motion in playback.settings.items():
            changes = {}
            for name, setting in _SETTINGS.items():
                default = setting.parameter_value(motion) if shared.get(name) is None else shared[name]
                value = node.described_parameter(
                    f"{human}.{name}", default, setting.description, setting.limits, setting.constraints
                )
                if value != setting.parameter_value(motion):
                    changes[setting.key] = setting.config_value(value, motion)
            if changes:
                playback.change(human, **changes)
        playback.rewind()
        node.set_parameters([Parameter(name, value=value) for name, value in self._common({}).items()])

    def complete(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Add parameters that change together with the given ones: a parameter for all humans changes each
        human, and a new file resets start and end. If a type is wrong, nothing is added."""
        for parameter in parameters:
            setting = _SETTINGS.get(parameter.name.rpartition(".")[2])
            if setting is not None and parameter.type_ != setting.type:
                return list(parameters)
        out = {parameter.name: parameter for parameter in parameters}
        for name in [name for name in out if name in _SHARED]:
            for human in self._playback.settings:
                same = Parameter(f"{human}.{name}", out[name].type_, out[name].value)
                out.setdefault(same.name, same)
        for human, motion in self._playback.settings.items():
            file = out.get(f"{human}.motion")
            if file is not None and file.value != motion.file:
                defaults = self._playback.scene.config.humans[human].motion
                defaults = defaults if file.value == defaults.file else MotionConfig()
                for part in ("start", "end"):
                    value = Parameter(f"{human}.{part}", value=_SETTINGS[part].parameter_value(defaults))
                    out.setdefault(value.name, value)
        changed = {name.rpartition(".")[2] for name in out}
        for name, value in self._common({name: parameter.value for name, parameter in out.items()}).items():
            if name in changed:
                out.setdefault(name, Parameter(name, value=value))
        return list(out.values())

    def changes(self, parameters: Sequence[Parameter]) -> dict[str, dict[str, Any]]:
        """Changed motion settings by human, with the keys of the scene file. A file name that is set counts
        as a change even if it is the same, since the file may have changed."""
        changes: dict[str, dict[str, Any]] = {}
        for parameter in parameters:
            human, _, name = parameter.name.rpartition(".")
            if human not in self._playback.settings or name not in _SETTINGS:
                continue
            setting = _SETTINGS[name]
            of_scene = self._playback.scene.config.humans[human].motion
            value = setting.config_value(parameter.value, of_scene)
            if name == "motion" or value != getattr(self._playback.settings[human], setting.key):
                changes.setdefault(human, {})[setting.key] = value
        return changes

    def _common(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values of the parameters for all humans, by name. ``values`` replace the present values."""
        common = {}
        for name in _SHARED:
            each = [
                values.get(f"{human}.{name}", _SETTINGS[name].parameter_value(motion))
                for human, motion in self._playback.settings.items()
            ]
            if each and all(value == each[0] for value in each):
                common[name] = each[0]
        return common


#: Name of the parameter with the folders.
MOTION_FOLDERS = "motion_folders"
#: Largest motion file that a request may name, bytes. Reading such a file takes seconds.
MAX_BYTES = 64 << 20


@dataclass(frozen=True)
class RequestedMotions(SceneSource):
    """Finds the motions that requests name: built-in motions, and files in some folders.

    Attributes:
        allowed: Folders with files that requests may name. Symbolic links are resolved.
        named: Motions that may be anywhere, since the user has named them in the scene or at the start.
    """

    allowed: tuple[Path, ...] = ()
    named: frozenset[str] = frozenset()

    @classmethod
    def of(cls, source: SceneSource, folders: Sequence[str], named: Collection[str]) -> RequestedMotions:
        """Allow the files below the folder of a scene, and below ``folders``.

        Args:
            source: Source of the scene.
            folders: Further folders. Relative paths start from the scene's folder.
            named: Names of motions that are allowed in any folder.

        Raises:
            MotionError: A folder is missing.
        """
        allowed = [source.folder, *(source.folder / expand_user(name) for name in folders)]
        for folder in allowed:
            if not folder.is_dir():
                raise MotionError(f"{str(folder)!r} is not a folder", key=MOTION_FOLDERS)
        real = tuple(folder.resolve() for folder in allowed)
        return cls(source.path, source.folder, source.objects, allowed=real, named=frozenset(named))

    def motion(self, name: str, positions: PositionChannels) -> Motion:
        """Read a motion that a request names.

        Raises:
            MotionError: The name is not allowed, or the file cannot be read. The reason is shown on
                this machine only, as a HumansimWarning.
        """
        known = name == LIVE or name in built_in_names("motions") or is_activity(name)
        if known or name in self.objects:
            return super().motion(name, positions)
        file, part = split_motion_name(name)
        if name not in self.named:
            path = str(self._checked(file))
            # a missing file of the folders is an error for the peer; of its path only the resolved one, as
            # the folders on the way of another are not those that requests may name
            find_motion(path if "/" in file else file, self.folder)
            name = path if part is None else f"{path}#{part}"
        try:
            with hiding_quotes(lambda: (name, self.folder)):
                return super().motion(name, positions)
        except HumansimError as error:
            where = name if error.path is None else error.path
            line = "" if error.line is None else f":{error.line}"
            warn_about(f"{where}{line}", error.message)
            raise MotionError(
                f"{file!r} is not a motion that can be read; "
                "the reason is shown on the machine of the motion player"
            ) from None

    def _checked(self, file: str) -> Path:
        """Path of a file, with links resolved. Raises MotionError if requests may not name this file."""
        # a user's name after ~ would tell whether there is such a user
        path = None if file[:1] == "~" or "\0" in file else Path(os.path.realpath(self.folder / file))
        if path is None or not any(path.is_relative_to(folder) for folder in self.allowed):
            raise MotionError(
                "requests name built-in motions, and files below the folder of the scene or below folders of "
                f"the parameter {MOTION_FOLDERS}, which is set at the start"
            )
        try:
            size = path.stat().st_size
        except OSError:
            return path  # missing or unreadable: reported when it is opened
        if not path.is_file():
            raise MotionError(f"{file!r} is not a regular file")
        if size > MAX_BYTES:
            raise MotionError(
                f"{file!r} is too large for a request: {size_text(size)}; at most {size_text(MAX_BYTES)}"
            )
        return path


T = TypeVar("T")


class BackgroundWork:
    """Runs one function at a time in a thread, and waits for its result for a limited time. Since a thread
    cannot be stopped, new work is refused until a function that takes longer has ended."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._result: Future[Any] | None = None

    @property
    def is_busy(self) -> bool:
        """Whether earlier work has not ended yet."""
        return self._result is not None and not self._result.done()

    def run(self, work: Callable[[], T], meanwhile: Callable[[], object], pause: float) -> T:
        """Return the result of ``work``. Until it is ready, call ``meanwhile`` every ``pause`` seconds.

        Raises:
            RosError: The work takes too long, or earlier work has not ended.
        """
        if self.is_busy:
            raise RosError("an earlier request that took too long has not ended yet: try again later")
        result: Future[T] = Future()
        self._result = result
        threading.Thread(target=_fulfil, args=(result, work), daemon=True).start()
        end = time.monotonic() + self._seconds
        while not wait([result], timeout=pause).done:
            if time.monotonic() > end:
                raise RosError(f"it takes more than {self._seconds:g} s: nothing is changed")
            meanwhile()
        return result.result()


def _fulfil(result: Future[Any], work: Callable[[], T]) -> None:
    try:
        result.set_result(work())
    except BaseException as error:
        result.set_exception(error)
