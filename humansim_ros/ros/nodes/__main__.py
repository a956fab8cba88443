"""Run a node without an installed script: ``python -m humansim_ros.ros.nodes camera --ros-args …``.

The module of a node is imported only after stop signals end this process without a traceback.
"""

from __future__ import annotations

import ast
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from humansim_ros.ros.processes.stop_signals import end_process_on_stop, end_with_parent


def help_text(name: str) -> str:
    """Help on a node: what it does, and how to set its parameters. The module of the node is not imported."""
    spec = find_spec(f"humansim_ros.ros.nodes.{name}")
    assert spec is not None and spec.origin is not None
    about = ast.get_docstring(ast.parse(Path(spec.origin).read_text("utf-8"))) or name
    return (
        f"usage: ros2 run humansim_ros {name} [--ros-args -p NAME:=VALUE ...]\n\n{about}\n\n"
        f"While it runs, `ros2 param list /{name}` and `ros2 param describe` show its parameters."
    )


def run(name: str) -> int:
    """Run the node of module ``name``; returns its exit code, which is 0 after a stop signal."""
    end_process_on_stop(0)
    if not {"-h", "--help"}.isdisjoint(sys.argv[1:]):
        print(help_text(name))
        return 0
    from humansim_ros.ros.processes.runtime import run_node_of

    return run_node_of(name)


#: Functions of the installed scripts.
motion_player, skinner, skinner_rig, camera, camera_rig, scanner, recorder, evaluator, bridge, hri_bridge = (
    partial(run, name)
    for name in (
        *("motion_player", "skinner", "skinner_rig", "camera", "camera_rig", "scanner"),
        *("recorder", "evaluator", "bridge", "hri_bridge"),
    )
)


if __name__ == "__main__":
    end_with_parent()
    sys.exit(run(sys.argv.pop(1)))
