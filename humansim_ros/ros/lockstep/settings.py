"""Settings of lockstep: from the scene, and parameters of the motion player."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from rclpy.parameter import Parameter

from humansim_ros.bounds import MAX_FRAMES
from humansim_ros.errors import RosError, printable
from humansim_ros.ros.clock import CLOCK_SEARCH
from humansim_ros.ros.lockstep.rules import OnTimeout
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.processes.node_processes import TOPIC_PREFIX
from humansim_ros.scene.config import TimeConfig

_NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_MAX_NAME, _MAX_MEMBERS = 255, 100


@dataclass(frozen=True)
class LockstepSettings:
    """Settings of lockstep.

    Attributes:
        names: Names of nodes that report on ``frame_done``.
        topics: Topics whose messages are reports.
        timeout: Seconds after which a frame waits no longer.
        on_timeout: What happens then.
        pace: Most frames per second of the wall clock; 0: as fast as possible.
        frames: Number of frames; 0: without end.
        summary: File for a summary as JSON at the end; empty: none.
        recorder: Name of the recorder, which is among ``names`` and starts with the scene; empty: none.
        clock_search: Seconds in which another publisher of ``/clock`` is looked for before the first frame.
    """

    names: tuple[str, ...]
    topics: tuple[str, ...]
    timeout: float
    on_timeout: OnTimeout
    pace: float
    frames: int
    summary: str
    recorder: str = ""
    clock_search: float = CLOCK_SEARCH

    @classmethod
    def of_parameters(cls, node: SceneNode) -> LockstepSettings | None:
        """Declare the parameters of lockstep; None if the mode is realtime.

        Raises:
            RosError: A value is not valid.
        """
        time = node.scene.config.time
        mode = _choice(node, "mode", time.mode, ("realtime", "lockstep"), "Real time, or lockstep")
        of_scene = member_texts(time)
        description = f"Names of nodes that frames wait for, and topics as {TOPIC_PREFIX}/tracker/poses"
        members: Sequence[str] = (
            node.described_parameter(
                "wait_for", of_scene or Parameter.Type.STRING_ARRAY, description, read_only=True
            )
            or ()
        )
        timeout = node.number_parameter(
            "timeout", time.timeout, 0.1, 1e6, "Seconds after which a frame in lockstep waits no longer"
        )
        on_timeout = _choice(
            node, "on_timeout", time.on_timeout, get_args(OnTimeout), "Stop, or continue without late nodes"
        )
        description = "Most frames in lockstep per second of the wall clock; 0: as fast as possible"
        pace = node.number_parameter("pace", time.rate or 0.0, 0.0, 1000.0, description)
        description = "Number of frames in lockstep; 0: without end"
        limits = (0.0, float(MAX_FRAMES))
        frames = node.described_parameter("frames", time.frames or 0, description, limits, read_only=True)
        summary = node.text_parameter("summary", "", "JSON file for a summary of lockstep; empty: none")
        recorder = node.text_parameter("recorder", "", "Recorder that frames wait for; empty: none")
        description = "Seconds in which another publisher of /clock is looked for before the first frame"
        search = node.number_parameter("clock_search", CLOCK_SEARCH, 0.0, 60.0, description)
        names, topics = _members([*members, recorder] if recorder else members)
        if mode != "lockstep":
            return None
        stops = on_timeout == "stop"
        return cls(
            names,
            topics,
            timeout,
            "stop" if stops else "continue",
            pace,
            frames,
            summary,
            recorder,
            search,
        )


def member_texts(time: TimeConfig) -> list[str]:
    """Members of a scene as the parameter ``wait_for`` has them."""
    return [each.node or f"{TOPIC_PREFIX}{each.topic}" for each in time.wait_for]


def _members(texts: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and topics of the parameter ``wait_for``."""
    if len(texts) > _MAX_MEMBERS:
        raise RosError(f"parameter wait_for: {len(texts)} members; at most {_MAX_MEMBERS}")
    names: dict[str, None] = {}
    topics: dict[str, None] = {}
    for text in texts:
        name = text.removeprefix(TOPIC_PREFIX)
        if len(name) > _MAX_NAME or not _NAME.fullmatch(name):
            raise RosError(
                f"parameter wait_for: {printable(text, 60)!r} is neither the name of a node, such as tracker "
                f"nor a topic, such as {TOPIC_PREFIX}/tracker/poses"
            )
        (topics if text != name else names)[name] = None
    return tuple(names), tuple(topics)


def _choice(node: SceneNode, name: str, default: str, values: Sequence[str], description: str) -> str:
    """Declare a parameter with some possible values, and return its value.

    Args:
        node: The node.
        name: Name of the parameter.
        default: Value unless it is overridden.
        values: Possible values.
        description: Text of the parameter descriptor.

    Raises:
        RosError: The value is none of them.
    """
    constraints = " or ".join(values)
    value = str(node.described_parameter(name, default, description, constraints=constraints, read_only=True))
    if value not in values:
        raise RosError(f"parameter {name}: {printable(value, 80)!r} must be {constraints}")
    return value
