"""The processes of a scene in lockstep for a test, as ``humansim run`` starts them."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from humansim_ros.errors import RosError

#: Seconds after which a frame in lockstep waits no longer: never, because the test has a limit of its own.
NEVER = 1e6
#: Seconds in which ``humansim run`` must have ended.
_END_WITHIN = 30.0
#: Most characters of its output in an error.
_MAX_OUTPUT = 2000


class NodeProcesses:
    """``humansim run`` of a scene file.

    Args:
        path: Scene file.
        namespace: ROS namespace of the nodes.
        member: Name of the node that frames wait for besides the cameras.
    """

    nodes: Sequence[Any] = ()

    def __init__(self, path: Path, namespace: str, member: str) -> None:
        self._output = tempfile.TemporaryFile("w+")  # noqa: SIM115  # closed with the processes
        command = [sys.executable, "-m", "humansim_ros", "run", str(path), "--lockstep", "--wait-for", member]
        command += ["--timeout", str(NEVER), *(["--namespace", namespace] if namespace else [])]
        self._process = subprocess.Popen(command, stdout=self._output, stderr=subprocess.STDOUT)

    def check(self) -> None:
        """Raise RosError with the last output if the run has ended."""
        if (code := self._process.poll()) is not None:
            raise RosError(f"humansim run has ended with exit code {code}: {self.output}")

    @property
    def output(self) -> str:
        """The end of what the processes have printed."""
        self._output.seek(0)
        return self._output.read()[-_MAX_OUTPUT:].strip()

    def close(self) -> None:
        """Stop all processes."""
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_END_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._output.close()
