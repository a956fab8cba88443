"""Names of the humans and cameras of a scene file, read without the schema and its libraries.

``ros2 launch`` starts the nodes of a scene, and may run in a Python without the libraries of the nodes.
Humans and cameras give nodes their names.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from humansim_ros.errors import SceneError, located
from humansim_ros.files.yaml import read_yaml
from humansim_ros.scene.core import LOCKSTEP, check_node_names, right_camera, variety_names

#: Sections that add random humans, in this order, with the prefix of their names.
_RANDOM = (("variety", "person"), ("crowd", "walker"))


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
    from humansim_ros.scene.core import rig_camera_names

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
