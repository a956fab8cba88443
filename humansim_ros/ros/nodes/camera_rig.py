"""Node ``camera_rig``: several cameras of a scene in one process.

Each camera is a node with the same name, topics, services and diagnostics as in its own process. The cameras
share one OpenGL context, the subscriptions to humans and objects, and all cached results of the renderer. The
node that receives the frames for all cameras has a hidden name.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.parameter import Parameter

from humansim_ros.errors import SceneError, unknown
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.ros.processes.node_processes import RIG_NODE
from humansim_ros.ros.processes.runtime import run_node
from humansim_ros.scene.core import Scene, SceneState


class CameraRigNode(SceneNode):
    """Receives complete frames and passes each of them to its cameras in turn."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        super().__init__(RIG_NODE, scene, **options)
        names = self._select_cameras()
        self._renderer = self.make_renderer()
        # a node name from the command line is for this node only
        self.cameras = [
            CameraNode(
                name,
                self.scene,
                self._renderer,
                cli_args=["--ros-args", "-r", f"__node:={name}"],
                **options,
            )
            for name in names
        ]
        moving = [name for name in names if name in self.scene.moving_cameras]
        self._synchronizer = FrameSynchronizer(self, self.publish_frame, self.cameras, moving)

    def _select_cameras(self) -> Sequence[str]:
        """Cameras of parameter ``cameras``. Raises SceneError for a camera that the scene does not have."""
        description = "Cameras of the scene; empty: all"
        requested = self.described_parameter(
            "cameras", Parameter.Type.STRING_ARRAY, description, read_only=True
        )
        for name in requested or ():
            if name not in self.scene.cameras:
                text = unknown("camera", name, self.scene.cameras, "the scene")
                raise SceneError(text, path=self.scene.path, key="cameras")
        return list(dict.fromkeys(requested or self.scene.cameras))

    @property
    def nodes(self) -> Sequence[SceneNode]:
        """This node and its cameras."""
        return [self, *self.cameras]

    def publish_frame(self, state: SceneState) -> None:
        """Render and publish the subscribed channels of all cameras."""
        for camera in self.cameras:
            with camera.skip_frame_on_error():  # the other cameras may be able to render it
                camera.publish_frame(state)

    def count(self, counter: str, number: int = 1) -> None:
        """Add to a counter of all cameras, since an event of a frame concerns each of them."""
        for camera in self.cameras:
            camera.count(counter, number)

    def report_time(self, milliseconds: float, event: str) -> None:
        """Record a time for all cameras."""
        for camera in self.cameras:
            camera.report_time(milliseconds, event)

    def _publish_diagnostics(self) -> None:
        """Do nothing, since the cameras publish diagnostics themselves."""

    def complete(self) -> None:
        """Send the images that simulated faults have delayed."""
        for camera in self.cameras:
            camera.complete()

    def close(self) -> None:
        """Close all cameras and free the renderer."""
        for camera in self.cameras:
            camera.close()
            camera.destroy_node()
        self._renderer.close()


def main(scene: Scene | None = None) -> int:
    """Run the node; returns its exit code. ``scene``: scene that its parameter names, if loaded already."""
    return run_node(lambda: CameraRigNode(scene=scene))
