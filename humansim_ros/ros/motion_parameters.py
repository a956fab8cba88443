"""The motion player's parameters of what a scene's humans do: for all of them at once, and for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.parameter import Parameter

from humansim_ros.ros.node import SceneNode
from humansim_ros.scene.config import MotionConfig
from humansim_ros.scene.playback import Playback

#: Seconds beyond which nobody plays.
LONGEST = 1e6


@dataclass(frozen=True)
class _Setting:
    """A parameter of a human's motion: ``key`` of the scene file, type, what it is, limits."""

    key: str
    kind: Parameter.Type
    description: str
    limits: tuple[float, float] | None = None
    constraints: str = ""

    def of(self, motion: MotionConfig) -> Any:
        """The parameter's value: an end that is not said is 0."""
        value = getattr(motion, self.key)
        return 0.0 if value is None else value

    def given(self, value: Any) -> Any:
        """The scene file's value of the parameter's."""
        return None if self.key == "end" and value == 0 else value


_SETTINGS = {
    "motion": _Setting(
        "file",
        Parameter.Type.STRING,
        "which motion; setting it reads the file, the same one too",
        constraints="a motion that comes with the package, or a BVH file, from the folder of the scene file",
    ),
    "loop": _Setting(
        "loop",
        Parameter.Type.STRING,
        "what follows the last frame",
        constraints="none, repeat or continue",
    ),
    "start": _Setting(
        "start", Parameter.Type.DOUBLE, "where in the file it starts, seconds of the file", (0.0, LONGEST)
    ),
    "end": _Setting(
        "end",
        Parameter.Type.DOUBLE,
        "where in the file it ends, seconds of the file; 0: at its end",
        (0.0, LONGEST),
        "behind start",
    ),
    "mirror": _Setting("mirror", Parameter.Type.BOOL, "left and right change sides"),
    "speed": _Setting(
        "speed", Parameter.Type.DOUBLE, "seconds of the file per second of the scene", (0.0, 100.0)
    ),
}
#: Settings that can be given for all humans at once; ``speed`` alone is that of the clock.
_OF_ALL = tuple(name for name in _SETTINGS if name != "speed")
_NUMBERS = {"rate", "speed", "seek", "start", "end"}


class MotionParameters:
    """Declares the parameters of a playback's humans on a node; what is given at the start wins over the
    scene file. Raises HumansimError where that cannot be played.
    """

    def __init__(self, node: SceneNode, playback: Playback) -> None:
        self._playback = playback
        for_all = {}
        for name in _OF_ALL if playback.settings else ():
            setting = _SETTINGS[name]
            described = f"All humans (what they all had last): {setting.description}"
            for_all[name] = node.described_parameter(
                name, setting.kind, described, setting.limits, setting.constraints
            )
        for human, motion in playback.settings.items():
            changes = {}
            for name, setting in _SETTINGS.items():
                default = setting.of(motion) if for_all.get(name) is None else for_all[name]
                value = node.described_parameter(
                    f"{human}.{name}", default, setting.description, setting.limits, setting.constraints
                )
                if value != setting.of(motion):
                    changes[setting.key] = setting.given(value)
            if changes:
                playback.change(human, **changes)
        playback.rewind()
        node.set_parameters([Parameter(name, value=value) for name, value in self._common({}).items()])

    def complete(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """What else changes with parameters: each human's with that of all, and the part with the file."""
        out = {parameter.name: _as_declared(parameter) for parameter in parameters}
        for name in [name for name in out if name in _OF_ALL]:
            for human in self._playback.settings:
                same = Parameter(f"{human}.{name}", out[name].type_, out[name].value)
                out.setdefault(same.name, same)
        for human, motion in self._playback.settings.items():
            file = out.get(f"{human}.motion")
            if file is not None and file.value != motion.file:
                known = self._playback.scene.config.humans[human].motion
                known = known if file.value == known.file else MotionConfig()
                for part in ("start", "end"):
                    value = Parameter(f"{human}.{part}", value=_SETTINGS[part].of(known))
                    out.setdefault(value.name, value)
        changed = {name.rpartition(".")[2] for name in out}
        for name, held in self._common({name: parameter.value for name, parameter in out.items()}).items():
            if name in changed:
                out.setdefault(name, Parameter(name, value=held))
        return list(out.values())

    def wanted(self, parameters: Sequence[Parameter]) -> dict[str, dict[str, Any]]:
        """What parameters change of what which human does: keys of the scene file's ``motion``, by name.

        A motion that is set is always wanted: its file may have changed.
        """
        wanted: dict[str, dict[str, Any]] = {}
        for parameter in parameters:
            human, _, name = parameter.name.rpartition(".")
            if human not in self._playback.settings or name not in _SETTINGS:
                continue
            setting = _SETTINGS[name]
            value = setting.given(parameter.value)
            if name == "motion" or value != getattr(self._playback.settings[human], setting.key):
                wanted.setdefault(human, {})[setting.key] = value
        return wanted

    def _common(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """What all humans have in common, by parameter; ``values`` of parameters count before what they
        have.
        """
        common = {}
        for name in _OF_ALL:
            held = [
                values.get(f"{human}.{name}", _SETTINGS[name].of(motion))
                for human, motion in self._playback.settings.items()
            ]
            if held and all(value == held[0] for value in held):
                common[name] = held[0]
        return common


def _as_declared(parameter: Parameter) -> Parameter:
    """``2`` for ``2.0``, as people type it."""
    number = parameter.name.rpartition(".")[2] in _NUMBERS
    if number and parameter.type_ == Parameter.Type.INTEGER:
        return Parameter(parameter.name, Parameter.Type.DOUBLE, float(parameter.value))
    return parameter
