"""The nodes of a scene in lockstep for a test: in its process, or as ``humansim run`` starts them."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter

from humansim_ros.errors import RosError
from humansim_ros.ros.nodes.camera_rig import CameraRigNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.scene import Scene
from humansim_ros.scene.names import skinner_node

#: Seconds after which a frame in lockstep waits no longer: never, because the test has a limit of its own.
_NEVER = 1e6
#: Seconds in which ``humansim run`` must have ended.
_END_WITHIN = 30.0
#: Most characters of its output in an error.
_MAX_OUTPUT = 2000


class InProcessNodes:
    """Motion player, skinners and cameras of a scene in this process.

    Args:
        scene: The scene.
        namespace: ROS namespace of the nodes.
        member: Name of the node that frames wait for besides the cameras.
    """

    def __init__(self, scene: Scene, namespace: str, member: str) -> None:
        self._scene, self._namespace = scene, namespace
        self.nodes: list[Any] = []
        self._owners: list[Any] = []
        try:
            for name in scene.actors:
                self._add(SkinnerNode, skinner_node(name), use_sim_time=True, human=name)
            if scene.cameras:
                self._add(CameraRigNode, None, use_sim_time=True, start_scene=False)
            # last, so that all others know its topics when it sends the first frame
            self._add(
                MotionPlayerNode, None, mode="lockstep", wait_for=[member], timeout=_NEVER, clock_search=0.0
            )
        except BaseException:
            self.close()
            raise

    def _add(self, kind: Any, name: str | None, **parameters: Any) -> None:
        node = kind(
            scene=self._scene,
            namespace=self._namespace,
            parameter_overrides=[Parameter(key, value=value) for key, value in parameters.items()],
            **({"cli_args": ["--ros-args", "-r", f"__node:={name}"]} if name else {}),
        )
        self._owners.append(node)
        self.nodes += node.nodes

    def check(self) -> None:
        """Raise RosError if the motion player cannot go on; its log has the reason."""
        if self._owners[-1].exit_code is not None:
            raise RosError("the motion player cannot go on: see its last log line")

    @property
    def output(self) -> str:
        """Nothing: the log is that of the test."""
        return ""

    def close(self) -> None:
        """Destroy the nodes."""
        for node in reversed(self._owners):
            node.close()
            node.destroy_node()


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
        command += ["--timeout", str(_NEVER), *(["--namespace", namespace] if namespace else [])]
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
