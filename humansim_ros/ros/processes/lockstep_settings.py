"""Settings of lockstep: one list for the command line, the launch file and the parameters of the player."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, NamedTuple, get_args

from humansim_ros.errors import MAX_FRAMES, RosError, printable
from humansim_ros.ros.processes.lockstep_rules import OnTimeout
from humansim_ros.scene.core import LOCKSTEP

if TYPE_CHECKING:
    from humansim_ros.scene.config import TimeConfig

#: Prefix of a topic among the members of lockstep. Members without the prefix are names of nodes.
TOPIC_PREFIX = "topic:"
#: Name of the node of ``SceneGraph``, which reports every frame, even one that no camera captures.
TEST_NODE = "humansim_test"
#: Value of a ROS parameter.
ParameterValue = str | bool | float | list[str]
#: Time of the search for another publisher of ``/clock`` before the first frame, seconds.
CLOCK_SEARCH = 2.0
_NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_MAX_NAME, _MAX_MEMBERS = 255, 100
REALTIME = "realtime"


class Setting(NamedTuple):
    """A setting of lockstep.

    Attributes:
        help: Description without a full stop.
        low: Smallest value of a number.
        high: Largest value of a number.
    """

    help: str
    low: float = 0.0
    high: float = 0.0


#: The settings by name. A scene has them in its section ``time``, with the name ``rate`` for ``pace``.
SETTINGS = {
    "frames": Setting("Number of frames in lockstep", 1, MAX_FRAMES),
    "wait_for": Setting(
        f"Nodes that frames in lockstep wait for besides the cameras, and topics as {TOPIC_PREFIX}/NAME"
    ),
    "timeout": Setting("Longest time that a frame in lockstep waits, seconds", 0.1, 1e6),
    "on_timeout": Setting("After the timeout: stop, or continue without the nodes that are late"),
    "pace": Setting("Most frames per second in lockstep", 0.01, 1000.0),
}


@dataclass(frozen=True)
class TimeOptions:
    """Options on how time advances. They replace values of the section ``time`` of a scene
    (docs/lockstep.md).

    If a value is None, the value of the scene holds. Raises RosError for a value that is not valid.

    Attributes:
        lockstep: Whether time advances in lockstep. If False, in real time.
        wait_for: Names of nodes that frames wait for, and topics after ``topic:``.
        timeout: Seconds after which a frame waits no longer.
        on_timeout: ``stop`` or ``continue``.
        pace: Most frames per second of the wall clock.
        frames: Number of frames.
        summary: File for a summary at the end.
    """

    lockstep: bool | None = None
    wait_for: Sequence[str] | None = None
    timeout: float | None = None
    on_timeout: str | None = None
    pace: float | None = None
    frames: int | None = None
    summary: str | None = None

    def __post_init__(self) -> None:
        read_members(self.wait_for or ())
        if self.on_timeout is not None:
            check_choice("on_timeout", self.on_timeout, get_args(OnTimeout))

    @property
    def parameters(self) -> dict[str, ParameterValue]:
        """Parameters of the motion player."""
        mode = None if self.lockstep is None else LOCKSTEP if self.lockstep else REALTIME
        wait_for = None if self.wait_for is None else list(self.wait_for)
        values = {**asdict(self), "mode": mode, "wait_for": wait_for}
        del values["lockstep"]
        return {name: value for name, value in values.items() if value is not None}


#: Launch arguments of :class:`TimeOptions`. An empty argument stands for the value of the scene.
TIME_ARGUMENTS = {
    "lockstep": "true: send the next frame when all nodes have finished this one; false: real time",
    **{name: setting.help for name, setting in SETTINGS.items()},
    "wait_for": f"{SETTINGS['wait_for'].help}, separated by commas",
}


def time_options(arguments: Mapping[str, str]) -> TimeOptions:
    """Options from launch arguments. RosError names a wrong argument."""
    given = {name: text.strip() for name, text in arguments.items() if text.strip()}
    return TimeOptions(
        lockstep=true_or_false("lockstep", given["lockstep"]) if "lockstep" in given else None,
        wait_for=[each.strip() for each in given["wait_for"].split(",")] if "wait_for" in given else None,
        timeout=_number("timeout", given),
        on_timeout=given.get("on_timeout"),
        pace=_number("pace", given),
        frames=whole_number("frames", given.get("frames", "")),
    )


def whole_number(name: str, text: str) -> int | None:
    """Read a launch argument that is a whole number from 1, or empty. RosError names a wrong argument."""
    if not text.strip():
        return None
    if not text.strip().isdecimal() or int(text) < 1:
        raise RosError(f"launch argument {name} must be a whole number from 1, or empty, not {text!r}")
    return int(text)


def true_or_false(name: str, text: str) -> bool:
    """Read a launch argument that is true or false. RosError names a wrong argument."""
    word = text.strip().lower()
    if word not in ("true", "false"):
        raise RosError(f"launch argument {name} must be true or false, not {text!r}")
    return word == "true"


def _number(name: str, arguments: Mapping[str, str]) -> float | None:
    """Number from a launch argument; None for an empty argument. Raises RosError."""
    if name not in arguments:
        return None
    try:
        return float(arguments[name])
    except ValueError:
        raise RosError(f"launch argument {name} must be a number, not {arguments[name]!r}") from None


def member_texts(time: TimeConfig) -> list[str]:
    """Convert the members that a scene names to the form of the parameter ``wait_for``."""
    return [each.node or f"{TOPIC_PREFIX}{each.topic}" for each in time.wait_for]


def read_members(texts: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Divide a setting ``wait_for`` into names of nodes and topics. Raises RosError for any other text."""
    if len(texts) > _MAX_MEMBERS:
        raise RosError(f"wait_for: {len(texts)} members; at most {_MAX_MEMBERS}")
    names: dict[str, None] = {}
    topics: dict[str, None] = {}
    for text in texts:
        name = text.removeprefix(TOPIC_PREFIX)
        if len(name) > _MAX_NAME or not _NAME.fullmatch(name):
            raise RosError(
                f"wait_for: '{printable(text, 60)}' is neither the name of a node, such as tracker, "
                f"nor a topic, such as {TOPIC_PREFIX}/tracker/poses"
            )
        (topics if text != name else names)[name] = None
    return tuple(names), tuple(topics)


def topic_name(setting: str, text: str) -> str:
    """Return the value of a setting that must be the name of a topic. Raises RosError for any other text."""
    if len(text) > _MAX_NAME or not _NAME.fullmatch(text):
        raise RosError(f"{setting}: '{printable(text, 60)}' is no name of a topic, such as /tracker/poses")
    return text


def check_choice(name: str, value: str, values: Sequence[str]) -> None:
    """Raise RosError if the value of a setting is not one of ``values``."""
    if value not in values:
        raise RosError(f"{name}: '{printable(value, 80)}' must be {' or '.join(values)}")
