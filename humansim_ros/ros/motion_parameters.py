"""Parameters of the motion player for the motions of humans: for all humans at once, and for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.parameter import Parameter

from humansim_ros.ros.node import SceneNode
from humansim_ros.scene.config import MotionConfig
from humansim_ros.scene.playback import Playback

#: Largest scene time in seconds that parameters accept.
MAX_SECONDS = 1e6


@dataclass(frozen=True)
class _Setting:
    """Parameter of a human's motion. ``key``: its key below ``motion`` in the scene file."""

    key: str
    type: Parameter.Type
    description: str
    limits: tuple[float, float] | None = None
    constraints: str = ""

    def parameter_value(self, motion: MotionConfig) -> Any:
        """Value of the parameter for a motion; 0 for an absent end."""
        value = getattr(motion, self.key)
        return 0.0 if value is None else value

    def config_value(self, value: Any) -> Any:
        """Value of the scene key for a value of the parameter."""
        return None if self.key == "end" and value == 0 else value


_SETTINGS = {
    "motion": _Setting(
        "file",
        Parameter.Type.STRING,
        "motion; setting it reads the file, even the same one again",
        constraints="built-in motion, or BVH or glTF file below the folder of the scene or motion_folders",
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
}
#: Settings with a parameter for all humans; parameter ``speed`` without a human is that of the clock.
_SHARED = tuple(name for name in _SETTINGS if name != "speed")


class MotionParameters:
    """Declares the parameters of all humans of a playback on a node.

    Parameter overrides at the start have priority over the scene file. Raises HumansimError if such a motion
    cannot be played.
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
                    changes[setting.key] = setting.config_value(value)
            if changes:
                playback.change(human, **changes)
        playback.rewind()
        node.set_parameters([Parameter(name, value=value) for name, value in self._common({}).items()])

    def complete(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Add parameters that change along: each human's with that for all, start and end with the file.

        None is added to parameters of a wrong type, which rclpy refuses.
        """
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
        """Changed motion settings by human, with the keys of the scene file.

        A motion that is set is always among them: its file may have changed.
        """
        changes: dict[str, dict[str, Any]] = {}
        for parameter in parameters:
            human, _, name = parameter.name.rpartition(".")
            if human not in self._playback.settings or name not in _SETTINGS:
                continue
            setting = _SETTINGS[name]
            value = setting.config_value(parameter.value)
            if name == "motion" or value != getattr(self._playback.settings[human], setting.key):
                changes.setdefault(human, {})[setting.key] = value
        return changes

    def _common(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values that all humans have in common, by parameter. ``values`` replace present ones."""
        common = {}
        for name in _SHARED:
            each = [
                values.get(f"{human}.{name}", _SETTINGS[name].parameter_value(motion))
                for human, motion in self._playback.settings.items()
            ]
            if each and all(value == each[0] for value in each):
                common[name] = each[0]
        return common
