"""Node ``camera_rig``: several cameras of a scene in one process.

Each camera is a node, ``camera_<name>``, with the topics and services of node ``camera``. The cameras share
one OpenGL context, the subscriptions to humans and objects, and all cached results of the renderer.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from rclpy.parameter import Parameter

from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.ros.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.runtime import run_node
from humansim_ros.scene.state import SceneState


class CameraRigNode(SceneNode):
    """Receives complete frames and passes each of them to its cameras in turn."""

    def __init__(self, **options: Any) -> None:
        super().__init__("camera_rig", **options)
        names = self._select_cameras()
        self._renderer = self.make_renderer()
        # a node name from the command line is for this node only
        self.cameras = [
            CameraNode(
                name,
                self.scene,
                self._renderer,
                cli_args=["--ros-args", "-r", f"__node:=camera_{name}"],
                **options,
            )
            for name in names
        ]
        moving = [name for name in names if name in self.scene.moving_cameras]
        self._synchronizer = FrameSynchronizer(self, self.publish_frame, moving)

    def _select_cameras(self) -> Sequence[str]:
        """Cameras of parameter ``cameras``. Raises SceneError for a camera that the scene does not have."""
        description = "Cameras of the scene; empty: all"
        requested = self.described_parameter(
            "cameras", Parameter.Type.STRING_ARRAY, description, read_only=True
        )
        for name in requested or ():
            if name not in self.scene.cameras:
                known = ", ".join(self.scene.cameras)
                raise SceneError(
                    f"no camera {name!r}; the scene has {known}", path=self.scene.path, key="cameras"
                )
        return list(dict.fromkeys(requested or self.scene.cameras))

    @property
    def nodes(self) -> Sequence[SceneNode]:
        """This node and its cameras."""
        return [self, *self.cameras]

    def publish_frame(self, state: SceneState) -> None:
        """Render and publish the subscribed channels of all cameras."""
        for camera in self.cameras:
            try:
                camera.publish_frame(state)
            except HumansimError as error:  # the other cameras may be able to render it
                camera.report_skipped(str(error))
        self.count("frames")
        self.report_lateness(state.stamp)

    def close(self) -> None:
        """Close all cameras and free the renderer."""
        for camera in self.cameras:
            camera.close()
            camera.destroy_node()
        self._renderer.close()


def main() -> int:
    """Run the node; returns its exit code."""
    return run_node(CameraRigNode)


if __name__ == "__main__":
    sys.exit(main())
