"""Standby process: does the slow part of a start, then becomes the node that is to be started again.

``python -m humansim_ros.ros.processes.standby SCENE`` imports all nodes, loads the scene and waits for
a line on standard input: executable and ROS arguments as a JSON list. Without a line it ends.
"""

from __future__ import annotations

import json
import sys
import warnings
from importlib import import_module
from typing import TYPE_CHECKING

from humansim_ros.ros.processes.stop_signals import end_process_on_stop, end_with_parent

if TYPE_CHECKING:
    from humansim_ros.scene import Scene


def main(scene_path: str) -> int:
    """Prepare, wait, and run the node; returns its exit code."""
    nodes = {
        name: import_module(f"humansim_ros.ros.nodes.{name}")
        for name in ("motion_player", "skinner", "camera", "camera_rig", "recorder", "evaluator")
    }
    scene = _prepare(scene_path)
    line = sys.stdin.readline()
    if not line:
        return 0
    executable, *sys.argv[1:] = json.loads(line)
    return int(nodes[executable].main(scene))


def _prepare(path: str) -> Scene | None:
    """The scene with all that takes long to compute; None if it is wrong, which the node will report."""
    from humansim_ros.errors import HumansimError
    from humansim_ros.scene import Scene

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scene = Scene.load(path)
            _ = scene.static_meshes, scene.joint_surfaces
        except HumansimError:
            return None
    return scene


if __name__ == "__main__":
    end_with_parent()
    end_process_on_stop(0)
    sys.exit(main(sys.argv[1]))
