"""Run ``python -m humansim_ros.cli``: the ``humansim`` command without an installed script."""

from __future__ import annotations

import atexit
import gc
import sys

from humansim_ros.ros.processes import StopRequest, end_process_on_stop


def main() -> int:
    """Run the command. A stop signal ends it without a traceback, even while modules are imported."""
    end_process_on_stop()
    atexit.register(gc.freeze)  # the end of the process needs no search for garbage, which takes 0.2 s
    from humansim_ros.cli.main import main

    stop = StopRequest()
    return main(stopped=lambda: stop.number)


if __name__ == "__main__":
    sys.exit(main())
