"""Node ``camera_rig``: several cameras of a scene in one process.

Each is a node of its own, ``camera_<name>``, with the topics and services of node ``camera``. They share what
costs most: one OpenGL context, one subscription to what each human and object sends, and what is worked out
of a body for one of them serves all.
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
    """Hears whole frames, and has each of its cameras show them in turn."""

    def __init__(self, **options: Any) -> None:
        super().__init__("camera_rig", **options)
        names = self._chosen()
        self._renderer = self.make_renderer()
        # a name given to the process on the command line is this node's alone
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
        self._joiner = FrameSynchronizer(self, self.show, moving)

    def _chosen(self) -> Sequence[str]:
        """The cameras of parameter ``cameras``. Raises SceneError where the scene has no such camera."""
        what = "Which cameras of the scene; empty for all"
        asked = self.described_parameter("cameras", Parameter.Type.STRING_ARRAY, what, read_only=True)
        for name in asked or ():
            if name not in self.scene.cameras:
                known = ", ".join(self.scene.cameras)
                raise SceneError(
                    f"no camera {name!r}; the scene has {known}", path=self.scene.path, key="cameras"
                )
        return list(dict.fromkeys(asked or self.scene.cameras))

    @property
    def members(self) -> Sequence[SceneNode]:
        return [self, *self.cameras]

    def show(self, instant: SceneState) -> None:
        """Have every camera render what somebody wants of this instant."""
        for camera in self.cameras:
            try:
                camera.show(instant)
            except HumansimError as error:  # the others may well show it
                camera.skipped(str(error))
        self.count("frames")
        self.report_lateness(instant.stamp)

    def close(self) -> None:
        for camera in self.cameras:
            camera.close()
            camera.destroy_node()
        self._renderer.close()


def main() -> int:
    return run_node(CameraRigNode)


if __name__ == "__main__":
    sys.exit(main())
