"""Process ``camera_rig``: several cameras of a scene, a node each, that share one OpenGL context and one
executor.

What they subscribe to is received once, and what is worked out of a body for one camera serves the next.
"""

from __future__ import annotations

import sys
from typing import Any

from rclpy.node import Node

from humansim_ros.errors import SceneError
from humansim_ros.render import GLRenderer
from humansim_ros.ros.joiner import FrameJoiner, Instant
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.runtime import run_node


class CameraRig(SceneNode):
    """The node that hears the humans for all cameras of its process."""

    def __init__(self, **options: Any) -> None:
        super().__init__("camera_rig", **options)
        wanted = self.text_parameter(
            "cameras", "", "Which cameras of the scene, with commas between; empty for all"
        )
        names = [name.strip() for name in wanted.split(",")] if wanted else list(self.scene.cameras)
        unknown = [name for name in names if name not in self.scene.cameras]
        if unknown:
            known = ", ".join(self.scene.cameras)
            raise SceneError(
                f"no camera {unknown[0]!r}; the scene has {known}", path=self.scene.path, key="cameras"
            )
        self._renderer = GLRenderer(self.scene.static_meshes)
        self.cameras = [CameraNode(name, self.scene, self._renderer, **options) for name in names]
        self._joiner = FrameJoiner(self, self._show)

    @property
    def nodes(self) -> list[Node]:
        """All nodes of this process."""
        return [self, *self.cameras]

    def close(self) -> None:
        for camera in self.cameras:
            camera.destroy_node()
        self._renderer.close()

    def _show(self, instant: Instant) -> None:
        for camera in self.cameras:
            camera.show(instant)
        self.count("frames")
        self.report_lateness(instant.stamp)


def main() -> int:
    return run_node(CameraRig)


if __name__ == "__main__":
    sys.exit(main())
