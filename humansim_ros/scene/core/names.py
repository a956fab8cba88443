"""Names of the humans and cameras of a scene file, read without the schema and its libraries.

``ros2 launch`` starts the nodes of a scene, and may run in a Python without the libraries of the nodes.
Humans and cameras give nodes their names.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from humansim_ros.errors import SceneError, located
from humansim_ros.files.yaml import read_yaml
from humansim_ros.scene.core.stereo import right_camera

if TYPE_CHECKING:
    from humansim_ros.scene.config.config import SceneConfig

#: Node that plays the motions of a scene.
PLAYER_NODE = "motion_player"
#: Names below ``/humans`` that ROS4HRI (REP-155) has for lists of bodies, faces and so on: a human of this
#: name would have its topics among them.
HRI_NAMES = ("bodies", "faces", "voices", "persons", "interactions", "candidate_matches")
#: Value of ``time.mode``.
LOCKSTEP = "lockstep"
#: Sections that add random humans, in this order, with the prefix of their names.
_RANDOM = (("variety", "person"), ("crowd", "walker"))
#: Node that publishes the topics of the sections ``adapters`` and ``hri``.
BRIDGE_NODE = "bridge"


def skinner_node(human: str) -> str:
    """Name of the node that skins a human. The node of a camera has the name of the camera."""
    return f"skinner_{human}"


@dataclass(frozen=True)
class SceneNames:
    """Names of humans, of all cameras with the rig, and of scanners; whether the scene plays in lockstep, and
    whether it has adapters.
    """

    humans: tuple[str, ...]
    cameras: tuple[str, ...]
    lockstep: bool = False
    scanners: tuple[str, ...] = ()
    adapters: bool = False


def read_names(path: str | os.PathLike[str]) -> SceneNames:
    """Read the names of a scene file. Raises SceneError for names that ROS does not accept, and for cameras
    and scanners with the name of another node."""
    path = Path(path)
    content, _ = read_yaml(path, SceneError, "scene")
    if not isinstance(content, dict):
        raise SceneError("this is not a scene; it needs the keys humans and cameras", path=path)
    own = _section_names(content, "cameras", path)
    pairs = (name for name in own if _is_stereo(content["cameras"][name]))
    cameras = (*_rig_names(content, path), *own, *map(right_camera, pairs))
    humans = (*_section_names(content, "humans", path), *_random_names(content, path))
    scanners = _section_names(content, "scanners", path)
    adapters = content.get("adapters")
    rows = list(adapters.values()) if isinstance(adapters, dict) else []
    has_adapters = any(each is not None for each in (*rows, content.get("hri")))
    with located(path=path):
        check_node_names(humans, cameras, scanners, has_adapters)
    time = content.get("time")
    lockstep = isinstance(time, dict) and time.get("mode") == LOCKSTEP
    return SceneNames(humans, cameras, lockstep, tuple(scanners), has_adapters)


def check_node_names(
    humans: Iterable[str], cameras: Iterable[str], scanners: Iterable[str] = (), adapters: bool = False
) -> None:
    """Raise SceneError with the key if a camera or scanner has the name of another node of its scene, or a
    human a name of :data:`HRI_NAMES`.

    Args:
        humans: Names of the humans.
        cameras: Names of the cameras.
        scanners: Names of the scanners.
        adapters: Whether there is a node for adapters.
    """
    humans = list(humans)
    if taken := [name for name in humans if name in HRI_NAMES]:
        raise SceneError(
            f"/humans/{taken[0]} has topics of ROS4HRI: give the human another name, such as {taken[0]}_1",
            key=f"humans.{taken[0]}",
        )
    nodes = {
        PLAYER_NODE: "the motion player",
        **({BRIDGE_NODE: "the adapters"} if adapters else {}),
        **{skinner_node(name): f"the skinner of {name}" for name in humans},
    }
    for kind, names in (("camera", cameras), ("scanner", scanners)):
        for name in names:
            if name in nodes:
                raise SceneError(
                    f"the node of a {kind} has its name, and {name} is the node of {nodes[name]}: "
                    f"give the {kind} another name",
                    key=f"{kind}s.{name}",
                )
            nodes[name] = f"the {kind} {name}"


def variety_names(prefix: str, count: int) -> list[str]:
    """Names of the random humans of a ``variety`` or ``crowd`` section: person_1, person_2 …"""
    return [f"{prefix}_{number}" for number in range(1, count + 1)]


def human_names(config: SceneConfig) -> list[str]:
    """Names of all humans of a scene. Raises SceneError for a random human with the name of another one."""
    names = dict.fromkeys(config.humans)
    for key, _ in _RANDOM:
        section = getattr(config, key)
        for name in () if section is None else variety_names(section.name, section.count):
            if name in names:
                raise SceneError(f"there is a human {name} already", key=f"{key}.name")
            names[name] = None
    return list(names)


def _random_names(content: Mapping[str, Any], path: Path) -> list[str]:
    names: list[str] = []
    for key, prefix in _RANDOM:
        section = content.get(key) or {}
        try:
            count = min(int(section.get("count", 0)), 1000)
            names += variety_names(str(section.get("name", prefix)), count)
        except (AttributeError, TypeError, ValueError):
            raise SceneError("must have count, a number of people", path=path, key=key) from None
    return names


def _rig_names(content: Mapping[str, Any], path: Path) -> list[str]:
    if not content.get("rig"):
        return []
    from humansim_ros.scene.core.camera import rig_camera_names

    return rig_camera_names(path)


def _is_stereo(camera: Any) -> bool:
    return isinstance(camera, dict) and camera.get("stereo") is not None


def _section_names(content: Mapping[str, Any], key: str, path: Path) -> list[str]:
    section = content.get(key) or {}
    if not isinstance(section, dict):
        raise SceneError("must map each name to its settings", path=path, key=key)
    names = [str(name) for name in section]
    for name in names:
        # names become parts of node and topic names
        if not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", name):
            raise SceneError(
                "ROS names consist of letters, digits and _ and begin with a letter",
                path=path,
                key=f"{key}.{name}",
            )
    return names
