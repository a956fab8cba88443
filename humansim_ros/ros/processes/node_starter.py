"""Process that loads the scene of a run once, and starts each node as a copy of itself.

A fresh node needs more than a second to import its modules, and reads, matches and fits the motions of the
scene. A copy has all of this already, in memory that all copies share. ROS and OpenGL are started only in the
copies, since their threads would not be copied.

``python -m humansim_ros.ros.processes.node_starter SCENE SOCKET`` reads requests from the socket with the
number SOCKET, one JSON list in each packet: name, executable, environment variables and ROS arguments of a
node. It answers ``["started", pid]`` and, when a node ends, ``["ended", pid, exit code]``. When the socket is
closed, this process ends, and all nodes end with it.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from humansim_ros.errors import HumansimError, RosError
from humansim_ros.ros.processes.node_processes import NodeProcess
from humansim_ros.ros.processes.stop_signals import PARENT_PID, end_process_on_stop, end_with_parent

if TYPE_CHECKING:
    from humansim_ros.scene.core import Scene

#: Largest packet, bytes. The arguments of a node are shorter.
_MAX_PACKET = 1 << 18
#: Modules that nodes need and that do not start ROS. They are imported once, before nodes are started as
#: copies.
_MODULES = (
    "data.messages.topics",
    "scene.core.state",
    "scene.core.live",
    "scene.core.playback",
    "render.frame.gl",
)
#: Nodes for which the static scene need not be loaded.
_NOT_SEEING = ("motion_player", "skinner", "skinner_rig", "recorder", "evaluator", "bridge")
#: Seconds between two checks for the end of a process.
_LOOK_EVERY = 0.02


class StartedNode:
    """A running node, with those methods of ``subprocess.Popen`` that :class:`Supervisor` uses.

    Attributes:
        pid: Process id.
    """

    def __init__(self, starter: NodeStarter, pid: int) -> None:
        self._starter, self.pid = starter, pid

    def poll(self) -> int | None:
        """Exit code, or the negative number of the signal that ended the node; None while it runs."""
        return self._starter.exit_code(self.pid)

    def wait(self, timeout: float) -> int:
        """Wait for the end of the node. Returns its exit code. Raises ``subprocess.TimeoutExpired``."""
        end = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(_LOOK_EVERY)
        return code

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the node has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)


class NodeStarter:
    """Handle by which a supervisor uses the process that starts nodes. As a context manager, it ends this
    process.

    Args:
        scene: Scene file.
        environment: Environment variables of the process. If None, those of the present process.

    Attributes:
        scene: Scene file.
        process: The process.
    """

    def __init__(self, scene: str, environment: Mapping[str, str] | None = None) -> None:
        self.scene = scene
        self._environment = {**(os.environ if environment is None else environment)}
        self._environment[PARENT_PID] = str(os.getpid())
        self._codes: dict[int, int] = {}
        self._is_gone = False
        # packets arrive whole, also if a stop signal interrupts their receiver
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            self.process = subprocess.Popen(
                [sys.executable, "-m", __name__, scene, str(other.fileno())],
                env=self._environment,
                pass_fds=[other.fileno()],
                # in a session of its own: Ctrl-C reaches only the parent, which stops the nodes in order
                start_new_session=True,
            )

    @property
    def is_running(self) -> bool:
        """Whether the process can start nodes."""
        return not self._is_gone and self.process.poll() is None

    def __enter__(self) -> NodeStarter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self, node: NodeProcess, environment: Mapping[str, str]) -> StartedNode:
        """Start a node with environment variables. Raises RosError if the process has ended."""
        changed = {name: text for name, text in environment.items() if self._environment.get(name) != text}
        request = [node.node_name, node.executable, changed, *node.ros_arguments]
        try:
            self._socket.send(json.dumps(request).encode())
        except OSError:
            self._is_gone = True
        while not self._is_gone:
            if (pid := self._receive(0)) is not None:
                return StartedNode(self, pid)
        raise RosError(f"the process that starts the nodes has ended (exit code {self.process.wait()})")

    def exit_code(self, pid: int) -> int | None:
        """Exit code of a node; None while it runs. If the process that starts nodes has ended, all nodes
        count as ended."""
        try:
            while not self._is_gone:
                self._receive(socket.MSG_DONTWAIT)
        except BlockingIOError:
            return self._codes.get(pid)
        return self._codes.get(pid, -signal.SIGTERM)

    def _receive(self, flags: int) -> int | None:
        """Receive a packet from the process. If it reports that a node has started, returns the process id of
        the node."""
        try:
            packet = self._socket.recv(_MAX_PACKET, flags)
        except ConnectionError:
            packet = b""
        if not packet:
            self._is_gone = True
            return None
        kind, pid, *code = json.loads(packet)
        if kind == "started":
            return int(pid)
        self._codes[pid] = code[0]
        return None

    def close(self) -> None:
        """End the process, and all running nodes."""
        self._socket.close()
        self._is_gone = True
        self.process.kill()
        self.process.wait()


def main(scene_path: str, number: int) -> int:
    """Load the scene, and start nodes on request. Returns the exit code of this process or, in a copy, of its
    node."""
    import cv2

    cv2.setNumThreads(1)  # its threads would not be copied
    for name in _MODULES:
        import_module(f"humansim_ros.{name}")
    scene = _load(scene_path)
    starter = str(os.getpid())
    gc.freeze()  # a collection would write to the memory that the copies share
    with socket.socket(fileno=number) as requests:

        def report(*event: str | int) -> None:
            with suppress(ConnectionError):  # the supervisor is gone
                requests.send(json.dumps(event).encode())

        def report_ends(*_: Any) -> None:
            for pid, code in _ended():
                report("ended", pid, code)

        signal.signal(signal.SIGCHLD, report_ends)
        while packet := requests.recv(_MAX_PACKET):
            name, executable, environment, *arguments = json.loads(packet)
            if scene is not None and executable not in _NOT_SEEING:
                with suppress(HumansimError):  # which the node will report
                    _ = scene.static_meshes  # while the nodes before it start
            # a copy must not report its own children
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])
            pid = os.fork()
            if not pid:
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
                break
            report("started", pid)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
        else:
            return 0
    os.environ.update(environment)
    os.environ[PARENT_PID] = starter  # os.getppid() is another one if the starter has been killed meanwhile
    end_with_parent()
    os.setsid()
    with suppress(OSError):  # for top and ps; only Linux has it
        Path("/proc/self/comm").write_text(name)
    cv2.setNumThreads(-1)  # as the environment says
    sys.argv[1:] = arguments
    from humansim_ros.ros.processes.runtime import run_node_of

    return run_node_of(executable, scene)


def _ended() -> list[tuple[int, int]]:
    """Process ids and exit codes of the nodes that have ended."""
    ended: list[tuple[int, int]] = []
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return ended
        if not pid:
            return ended
        ended.append((pid, os.waitstatus_to_exitcode(status)))


def _load(path: str) -> Scene | None:
    """Load the scene, with everything that all nodes need. None if the scene is wrong: the nodes will report
    this."""
    from humansim_ros.scene.core import Scene

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scene = Scene.load(path or None)
            _ = scene.joint_surfaces
        except HumansimError:
            return None
    return scene


if __name__ == "__main__":
    end_process_on_stop(0)
    end_with_parent()
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
