"""Run all nodes of a scene in one process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rclpy.parameter import Parameter

from humansim_ros.errors import RosError
from humansim_ros.ros.nodes.bridge import BridgeNode
from humansim_ros.ros.nodes.camera_rig import CameraRigNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.scanner import ScannerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.scene.core import Scene, skinner_node


class InProcessNodes:
    """Motion player, skinners, cameras, scanners and bridge of a scene, for the executor of this process.

    Args:
        scene: The scene.
        namespace: ROS namespace of the nodes.
        player: Parameters of the motion player, such as the mode.
        is_simulated: Whether all nodes except the motion player take the time from ``/clock``.
    """

    def __init__(
        self, scene: Scene, namespace: str, player: Mapping[str, Any], is_simulated: bool = True
    ) -> None:
        self._scene, self._namespace = scene, namespace
        self.nodes: list[Any] = []
        self._owners: list[Any] = []
        try:
            for name in scene.actors:
                self._add(SkinnerNode, skinner_node(name), use_sim_time=is_simulated, human=name)
            if scene.cameras:
                self._add(CameraRigNode, None, use_sim_time=is_simulated, start_scene=False)
            for name in scene.scanners:
                self._add(ScannerNode, name, use_sim_time=is_simulated, scanner=name, start_scene=False)
            if scene.config.adapter_settings:
                self._add(BridgeNode, None, use_sim_time=is_simulated)
            # last, so that all others know its topics when it sends the first frame
            self._add(MotionPlayerNode, None, **player)
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

    @property
    def has_ended(self) -> bool:
        """Whether the motion player has sent its last frame or has failed."""
        return self._owners[-1].exit_code is not None

    def check(self) -> None:
        """Raise RosError if the motion player has failed. The log of the player has the reason."""
        if self.has_ended:
            raise RosError("the motion player cannot go on: see its last log line")

    @property
    def output(self) -> str:
        """Return no output, since this process has the log itself."""
        return ""

    def close(self) -> None:
        """Destroy the nodes."""
        for node in reversed(self._owners):
            node.close()
            node.destroy_node()
