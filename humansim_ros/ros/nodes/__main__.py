"""Run a node without an installed script: ``python -m humansim_ros.ros.nodes camera --ros-args …``.

A node is imported only after its process can be stopped quietly.
"""

from __future__ import annotations

import sys
from importlib import import_module

from humansim_ros.ros.processes.stop_signals import end_process_on_stop, end_with_parent


def run(name: str) -> int:
    """Run the node of module ``name``; returns its exit code, which is 0 after a stop signal."""
    end_process_on_stop(0)
    return int(import_module(f"humansim_ros.ros.nodes.{name}").main())


def motion_player() -> int:
    """Run the motion player."""
    return run("motion_player")


def skinner() -> int:
    """Run a skinner."""
    return run("skinner")


def camera() -> int:
    """Run a camera."""
    return run("camera")


def camera_rig() -> int:
    """Run a camera rig."""
    return run("camera_rig")


def recorder() -> int:
    """Run a recorder."""
    return run("recorder")


def evaluator() -> int:
    """Run an evaluator."""
    return run("evaluator")


if __name__ == "__main__":
    end_with_parent()
    sys.exit(run(sys.argv.pop(1)))
