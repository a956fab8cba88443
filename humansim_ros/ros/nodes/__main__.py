"""Run a node without an installed script: ``python -m humansim_ros.ros.nodes camera --ros-args …``.

A node is imported only after its process can be stopped quietly.
"""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module

from humansim_ros.ros.processes.stop_signals import end_process_on_stop, end_with_parent


def run(name: str) -> int:
    """Run the node of module ``name``; returns its exit code, which is 0 after a stop signal."""
    end_process_on_stop(0)
    return int(import_module(f"humansim_ros.ros.nodes.{name}").main())


#: Functions of the installed scripts.
motion_player, skinner, camera, camera_rig, recorder, evaluator = (
    partial(run, name)
    for name in ("motion_player", "skinner", "camera", "camera_rig", "recorder", "evaluator")
)


if __name__ == "__main__":
    end_with_parent()
    sys.exit(run(sys.argv.pop(1)))
