"""Which nodes a scene needs: the one list that ``humansim run`` and the launch file both start.

Only the names in the scene file are looked at here (``humansim_ros.scene`` checks the rest), so that
``ros2 launch`` needs none of the libraries that the nodes need.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from humansim_ros.errors import SceneError
from humansim_ros.io.yaml import read_yaml
from humansim_ros.scene.names import variety_names

#: In the environment of nodes whose scene has been loaded before, and its warnings told.
TOLD = "HUMANSIM_SCENE_TOLD"


@dataclass(frozen=True)
class NodeProcess:
    """One process to start: an executable of this package, the name its node gets, and its parameters."""

    executable: str
    node_name: str
    parameters: Mapping[str, str | list[str]]

    @property
    def ros_arguments(self) -> list[str]:
        """The command-line arguments that give the node its name and parameters."""
        arguments = ["--ros-args", "-r", f"__node:={self.node_name}"]
        for name, value in self.parameters.items():
            # quoted, since ROS reads a bare value as YAML: a camera called off would be a boolean
            arguments += ["-p", f"{name}:={json.dumps(value, ensure_ascii=False)}"]
        return arguments


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def scene_processes(scene_path: str | os.PathLike[str], processes: int | None = None) -> list[NodeProcess]:
    """The motion player, one skinner per human and the cameras of a scene file, spread over so many
    ``processes``: one per core if None.
    """
    path = Path(scene_path).resolve()
    content, _ = read_yaml(path, SceneError, "scene")
    if not isinstance(content, dict):
        raise SceneError("this is not a scene; it needs the keys humans and cameras", path=path)
    scene = {"scene": str(path)}
    cameras = (*_rig_names(content, path), *_names(content, "cameras", path))
    return [
        NodeProcess("motion_player", "motion_player", scene),
        *(
            NodeProcess("skinner", f"skinner_{name}", {**scene, "human": name})
            for name in (*_names(content, "humans", path), *_drawn(content, path))
        ),
        *_camera_processes(cameras, cores() if processes is None else processes, scene),
    ]


def _camera_processes(
    cameras: Sequence[str], processes: int, scene: Mapping[str, str]
) -> Iterator[NodeProcess]:
    """Cameras of one process share all they can; more processes than cores only get in each other's way."""
    number = min(max(1, processes), len(cameras))
    for i in range(number):
        own = list(cameras[i::number])
        if len(own) == 1:
            yield NodeProcess("camera", f"camera_{own[0]}", {**scene, "camera": own[0]})
        else:
            yield NodeProcess("camera_rig", f"camera_rig_{i + 1}", {**scene, "cameras": own})


def drawing_threads(processes: Sequence[NodeProcess]) -> dict[str, str]:
    """Environment in which processes that draw share the cores: Mesa without a GPU, and OpenCV, would give
    each as many threads as there are cores. Nothing where the user has said how many.
    """
    drawing = sum(process.executable in ("camera", "camera_rig") for process in processes)
    share = max(1, cores() // max(1, drawing))
    threads = {
        # 0: no thread but the one that asks. To wait for a single other one costs a tenth more
        "LP_NUM_THREADS": str(share if share > 1 else 0),
        # a second one waits with its part of the work until it gets a core
        "OPENCV_FOR_THREADS_NUM": str(share),
    }
    return {name: number for name, number in threads.items() if name not in os.environ}


def _drawn(content: Mapping[str, Any], path: Path) -> list[str]:
    """The names of the people that the scene's variety section draws."""
    section = content.get("variety") or {}
    try:
        return variety_names(str(section.get("name", "person")), min(int(section.get("count", 0)), 1000))
    except (AttributeError, TypeError, ValueError):
        raise SceneError("must say a count of people", path=path, key="variety") from None


def _rig_names(content: Mapping[str, Any], path: Path) -> list[str]:
    """The names of the cameras in the scene's calibration file."""
    if not content.get("rig"):
        return []
    from humansim_ros.scene.config import load_config  # only now, since it needs much more
    from humansim_ros.scene.rig import rig_cameras

    return list(rig_cameras(load_config(path).rig, path))


def _names(content: Mapping[str, Any], key: str, path: Path) -> list[str]:
    section = content.get(key) or {}
    if not isinstance(section, dict):
        raise SceneError("must map each name to its settings", path=path, key=key)
    names = [str(name) for name in section]
    for name in names:
        # it becomes part of node and topic names
        if not re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name):
            raise SceneError(
                "ROS names are made of letters, digits and _ and do not start with a digit",
                path=path,
                key=f"{key}.{name}",
            )
    return names
