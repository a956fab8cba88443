"""Node ``camera_rig``: several cameras of a scene in one process.

The cameras share one OpenGL context, the subscriptions to humans and objects, and all cached results of the
renderer.
"""

from __future__ import annotations

from typing import Any

from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.nodes.rig import RigNode
from humansim_ros.ros.processes.node_processes import RIG_NODE
from humansim_ros.scene.core import Scene, SceneState


class CameraRigNode(RigNode):
    """Receives complete frames and passes each of them to its cameras in turn: those of parameter
    ``cameras``."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        super().__init__(RIG_NODE, scene, **options)
        names = self.chosen("cameras", self.scene.cameras)
        self._renderer = self.make_renderer()
        for name in names:
            self.members.append(CameraNode(name, self.scene, self._renderer, **self.options_of(name)))
        moving = [name for name in names if name in self.scene.moving_cameras]
        self._synchronizer = FrameSynchronizer(self, self.publish_frame, self.members, moving)

    def publish_frame(self, state: SceneState) -> None:
        """Render and publish the subscribed channels of all cameras."""
        for camera in self.members:
            with camera.skip_frame_on_error():  # the other cameras may be able to render it
                camera.publish_frame(state)

    def count(self, counter: str, number: int = 1) -> None:
        """Add to a counter of all cameras, since an event of a frame concerns each of them."""
        for camera in self.members:
            camera.count(counter, number)

    def report_time(self, milliseconds: float, event: str) -> None:
        """Record a time for all cameras."""
        for camera in self.members:
            camera.report_time(milliseconds, event)

    def complete(self) -> None:
        """Send the images that simulated faults have delayed."""
        for camera in self.members:
            camera.complete()

    def close(self) -> None:
        """Close all cameras and free the renderer."""
        super().close()
        self._renderer.close()
