"""Supervision of node processes, for ``humansim run``: start, watch and stop them together."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import TracebackType

from humansim_ros.ros.processes import WARNINGS_SHOWN, NodeProcess, render_threads

_PR_SET_PDEATHSIG = 1
#: Seconds that a node has to stop after SIGTERM, and again after SIGINT.
_STOP_LIMIT = 4.0


class Supervisor:
    """Context manager that runs node processes and stops them at its end.

    Nodes do not repeat scene warnings; the parent has shown them.
    """

    def __init__(
        self, processes: Sequence[NodeProcess], environment: Mapping[str, str] | None = None
    ) -> None:
        self._processes = list(processes)
        threads = render_threads(processes)
        self._environment = {**os.environ, **threads, WARNINGS_SHOWN: "1", **(environment or {})}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._helpers: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Supervisor:
        try:
            for process in self._processes:
                self._running[process.node_name] = self._start(
                    "humansim_ros.ros.nodes", process.executable, *process.ros_arguments
                )
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by node name."""
        return {name: process.pid for name, process in self._running.items()}

    def start_helper(self, module: str, *arguments: str) -> None:
        """Start a Python module as a process that may end at any time; it is stopped with the nodes."""
        self._helpers.append(self._start(module, *arguments))

    def dead(self) -> tuple[str, int] | None:
        """Name and exit code of a node that has ended unexpectedly; None while all run."""
        for name, process in self._running.items():
            code = process.poll()
            if code is not None:
                return name, code
        return None

    def wait(self, until: float | None = None) -> tuple[str, int] | None:
        """Wait until a node ends unexpectedly, or until the monotonic time ``until``.

        Returns:
            Name and exit code of the node, or None at ``until``.
        """
        while until is None or time.monotonic() < until:
            dead = self.dead()
            if dead:
                return dead
            time.sleep(0.1)
        return None

    def stop(self) -> None:
        """Send SIGTERM to all nodes, then SIGINT and SIGKILL to nodes that still run.

        Both stop a node in order. SIGTERM first, because SIGINT prints a traceback while Python starts.
        """
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGKILL):
            processes = [*self._helpers, *self._running.values()]
            alive = [process for process in processes if process.poll() is None]
            for process in alive:
                with suppress(ProcessLookupError):
                    process.send_signal(number)
            deadline = time.monotonic() + _STOP_LIMIT
            for process in alive:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, deadline - time.monotonic()))

    def _start(self, module: str, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            env=self._environment,
            # in a session of its own: Ctrl-C reaches only the parent, which stops the nodes in order
            start_new_session=True,
            preexec_fn=_die_with_parent,
        )


def _die_with_parent() -> None:
    """In the child: request SIGTERM if the parent dies without stopping it (Linux)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
