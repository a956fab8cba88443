"""Node ``hri_bridge``: publishes the people of a scene in the messages of ROS4HRI (docs/ros4hri.md).

This is node ``bridge`` with only the adapter ``hri``: the one of the scene, or one for parameter ``camera``.
"""

from __future__ import annotations

from typing import Any

from humansim_ros.errors import SceneError, unknown
from humansim_ros.files.yaml import Section
from humansim_ros.ros.nodes.bridge import BridgeNode
from humansim_ros.scene.config import HriConfig
from humansim_ros.scene.core import Scene


class HriBridgeNode(BridgeNode):
    """Publishes ROS4HRI. ``scene``: scene that its parameter names, if loaded already."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        super().__init__(scene, "hri_bridge", **options)

    def adapters(self) -> dict[str, Section]:
        """Return adapter ``hri`` of the scene or for parameter ``camera``. Raises SceneError without a
        camera."""
        camera = self.text_parameter("camera", "", "Camera that sees the people; empty: hri.camera")
        known = self.scene.scene_cameras
        if camera and camera not in known:
            text = unknown("camera", camera, known, "the scene")
            raise SceneError(text, path=self.scene.path, key="camera")
        config = HriConfig(camera=camera) if camera else self.scene.config.hri
        if config is None:
            text = f"name the camera that sees the people: --ros-args -p camera:=NAME ({', '.join(known)})"
            raise SceneError(text, path=self.scene.path, key="hri.camera")
        return {"hri": config}
