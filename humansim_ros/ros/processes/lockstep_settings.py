"""Settings of lockstep, as the command line, the launch file and the parameters of the player have them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, get_args

from humansim_ros.errors import RosError, printable, unknown
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


@dataclass(frozen=True)
class TimeOptions:
    """Options on how time advances. They replace values of the section ``time`` of a scene
    (docs/lockstep.md).

    All are options of ``humansim run``, with help texts, limits and units in config/command_line.json, except
    ``summary``, a file for a summary at the end. If a value is None, the value of the scene holds. Raises
    RosError for a value that is not valid.
    """

    lockstep: bool | None = None
    frames: int | None = None
    wait_for: Sequence[str] | None = None
    timeout: float | None = None
    on_timeout: str | None = None
    pace: float | None = None
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
        raise RosError(unknown("value", value, values), key=name)
