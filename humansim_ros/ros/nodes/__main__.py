"""``python -m humansim_ros.ros.nodes camera --ros-args …``: one node, without an installed script."""

from __future__ import annotations

import importlib
import signal
import sys

if __name__ == "__main__":
    # until the node is up, Ctrl-C just ends the process; rclpy takes over from there
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    name = sys.argv.pop(1)
    sys.exit(importlib.import_module(f"humansim_ros.ros.nodes.{name}").main())
