"""Supervise node processes: start them, watch them, restart dead ones, and stop them together."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType

from humansim_ros.ros.graph.transport import SharedMemoryFiles, remove_dead_files
from humansim_ros.ros.processes.node_processes import WARNINGS_SHOWN, NodeProcess, render_threads
from humansim_ros.ros.processes.node_starter import NodeStarter, StartedNode
from humansim_ros.ros.processes.stop_signals import PARENT_PID

#: A helper process must stop within this time after SIGTERM, seconds.
_STOP_LIMIT = 6.0


@dataclass(frozen=True)
class EndedProcess:
    """A node process that has ended unexpectedly.

    Attributes:
        process: The process.
        code: Exit code, or the negative number of the signal that ended it.
    """

    process: NodeProcess
    code: int

    def __str__(self) -> str:
        names = self.process.visible_nodes
        how = (
            f"exit code {self.code}"
            if self.code >= 0
            else f"signal {-self.code}: {signal.strsignal(-self.code)}"
        )
        return f"node{'s' * (len(names) > 1)} {', '.join(names)} ended unexpectedly ({how})"


class Supervisor:
    """Context manager that runs node processes and stops them at its end.

    One process loads the scene and starts the nodes as copies of itself (``node_starter.py``). Nodes do not
    repeat scene warnings that the parent has shown. Nodes end when the thread that has started them ends.

    Args:
        processes: Nodes to start.
        environment: Additional environment variables of the nodes.
        starter: Process that starts nodes, and may already be loading the scene. If None, or if the process
            has ended or loads another scene, a new process is started. It ends with the nodes.
        helpers: Further processes, given as Python module and arguments. They start before the nodes, and may
            end at any time.
    """

    def __init__(
        self,
        processes: Sequence[NodeProcess],
        environment: Mapping[str, str] | None = None,
        starter: NodeStarter | None = None,
        helpers: Sequence[Sequence[str]] = (),
    ) -> None:
        self._processes = {process.node_name: process for process in processes}
        threads = render_threads(processes)
        own = {WARNINGS_SHOWN: "1", PARENT_PID: str(os.getpid())}
        self._environment = {**os.environ, **threads, **own, **(environment or {})}
        self._running: dict[str, StartedNode] = {}
        self._started: dict[str, float] = {}
        self._commands = [[sys.executable, "-m", *helper] for helper in helpers]
        self._helpers: list[subprocess.Popen[bytes]] = []
        self._starter = starter
        self._shared_memory = SharedMemoryFiles()

    def __enter__(self) -> Supervisor:
        try:
            # in a session of its own: Ctrl-C reaches only the parent, which stops the nodes in order
            self._helpers = [
                subprocess.Popen(command, env=self._environment, start_new_session=True)
                for command in self._commands
            ]
            for name in self._processes:
                self._start_node(name)
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

    @property
    def _all(self) -> list[StartedNode | subprocess.Popen[bytes]]:
        return [*self._helpers, *self._running.values()]

    def dead(self) -> EndedProcess | None:
        """A process that has ended unexpectedly; None if all processes run."""
        self._shared_memory.note(process.pid for process in self._all)
        for name, process in self._running.items():
            code = process.poll()
            if code is not None:
                return EndedProcess(self._processes[name], code)
        return None

    def wait(
        self,
        until: float | None = None,
        respawn: bool = False,
        is_end: Callable[[EndedProcess], bool] = lambda _: False,
        on_restart: Callable[[], object] = lambda: None,
    ) -> EndedProcess | None:
        """Wait until a process ends unexpectedly, or until the monotonic time ``until``.

        Args:
            until: Monotonic seconds. If None, there is no limit.
            respawn: Whether processes that have ended are started again. This is not done after wrong input
                or a time-out, nor too often (:class:`RestartPolicy`).
            is_end: Function that returns whether a process has ended as intended, so that all others end,
                too.
            on_restart: Called when a process has died and will be started again, and when it is started.

        Returns:
            The process that has ended, or None at ``until``.
        """
        policies = {name: RestartPolicy() for name in self._processes}
        starts: dict[str, float] = {}
        while until is None or time.monotonic() < until:
            while dead := self.dead():
                name, now = dead.process.node_name, time.monotonic()
                if not respawn or dead.code in dead.process.final_codes or is_end(dead):
                    return dead
                delay = policies[name].delay(now - self._started[name])
                if delay is None:
                    return dead
                on_restart()
                self._shared_memory.remove([self._running.pop(name).pid])
                starts[name] = now + delay
                when = f"in {delay:g} s" if delay else "now"
                with suppress(OSError):  # of a terminal that is gone, or a full disk
                    print(f"{dead}; started again {when}", file=sys.stderr)
            for name in [name for name, start in starts.items() if start <= time.monotonic()]:
                del starts[name]
                self._start_node(name)
                on_restart()
            time.sleep(0.1)
        return None

    def stop(self) -> None:
        """Send SIGTERM to all nodes, then SIGKILL to those that still run. After a stop signal, SIGKILL
        follows at once. Nodes with ``stops_last`` are stopped after the others have ended."""
        pids = [process.pid for process in self._all]
        last = {process.pid for name, process in self._running.items() if self._processes[name].stops_last}
        self._shared_memory.note(pids, now=True)
        try:
            if last:
                self._send(signal.SIGTERM, last)
            self._send(signal.SIGTERM)
        finally:
            self._send(signal.SIGKILL)
            if self._starter is not None:
                self._starter.close()
            self._shared_memory.remove(pids)
            remove_dead_files()  # of nodes that were killed while they started

    def _send(self, number: signal.Signals, but: Collection[int] = ()) -> None:
        """Send a signal to all running processes, except those in ``but``, and wait for their end."""
        alive = [each for each in self._all if each.poll() is None and each.pid not in but]
        for process in alive:
            process.send_signal(number)
        limits = {process.pid: self._processes[name].stop_limit for name, process in self._running.items()}
        sent = time.monotonic()
        for process in alive:
            deadline = sent + limits.get(process.pid, _STOP_LIMIT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - time.monotonic()))

    def _start_node(self, name: str) -> None:
        process = self._processes[name]
        self._started[name] = time.monotonic()
        self._running[name] = self._start(process)

    def _start(self, process: NodeProcess) -> StartedNode:
        """Start a node. If there is no running process that starts nodes, start that first."""
        scene = str(next(iter(self._processes.values())).parameters.get("scene", ""))
        if self._starter is None or not self._starter.is_running or self._starter.scene != scene:
            if self._starter is not None:
                self._starter.close()
            self._starter = NodeStarter(scene, self._environment)
        return self._starter.start(process, self._environment)


#: Seconds before each restart in a series: the first, the second, and so on. After the last restart, the node
#: is given up.
_DELAYS = (0.0, 0.5, 1.0, 2.0, 4.0)
#: If a node dies after it has run for this time, seconds, a new series begins.
_LONG_RUN = 30.0


class RestartPolicy:
    """Decides how long to wait before a node that died is started again. The delay grows with each death in a
    series. After too many deaths, the node is given up."""

    def __init__(self) -> None:
        self._deaths = 0

    def delay(self, ran: float) -> float | None:
        """Record that a node died after ``ran`` seconds. Returns the seconds until its restart; None to give
        it up."""
        self._deaths = 1 if ran >= _LONG_RUN else self._deaths + 1
        return _DELAYS[self._deaths - 1] if self._deaths <= len(_DELAYS) else None
