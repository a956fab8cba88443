"""Process that finishes a bag when the process that writes it is killed.

``python -m humansim_ros.bags.guardian FOLDER`` waits for the end of its standard input, a pipe that the
writing process holds open. A writer that closes its bag stops its guardian before.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import humansim_ros
from humansim_ros.bags.recovery import finish_bag, is_finished, lock_bag
from humansim_ros.errors import BagError


class Guardian:
    """The guardian of a bag, as the process sees it that writes the bag."""

    def __init__(self, folder: Path) -> None:
        sources = [str(Path(humansim_ros.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        try:
            self._process: subprocess.Popen[bytes] | None = subprocess.Popen(
                [sys.executable, "-m", __name__, folder],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                # not reached by Ctrl-C and by the end of the terminal
                start_new_session=True,
                cwd="/",
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sources))},
            )
        except OSError:  # no memory or no process left: the bag can still be continued
            self._process = None

    def finish(self) -> None:
        """Let the guardian finish the bag now, which must be unlocked."""
        if self._process is not None:
            self._process.communicate()
            self._process = None

    def stop(self) -> None:
        """End the guardian: the bag is finished."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


def main() -> None:
    """Wait for the end of the writing process, and finish its bag."""
    folder = Path(sys.argv[1])
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    while os.read(0, 1):
        pass
    # a bag that another process continues already, or that is gone, needs no guardian
    with suppress(BagError, OSError):
        lock = lock_bag(folder)
        if not is_finished(folder):
            finish_bag(folder)
        os.close(lock)


if __name__ == "__main__":
    main()
