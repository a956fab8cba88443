"""Run a node without an installed script: ``python -m humansim_ros.ros.nodes camera --ros-args …``."""

from __future__ import annotations

import sys

from humansim_ros.ros.nodes.executables import run
from humansim_ros.ros.parent import end_with_parent

if __name__ == "__main__":
    end_with_parent()
    sys.exit(run(sys.argv.pop(1)))
