"""Run a node without an installed script: ``python -m humansim_ros.ros.nodes camera --ros-args …``."""

from __future__ import annotations

import importlib
import signal
import sys

if __name__ == "__main__":
    # Ctrl-C ends the process while the node starts; run_node installs its own handlers
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    name = sys.argv.pop(1)
    sys.exit(importlib.import_module(f"humansim_ros.ros.nodes.{name}").main())
