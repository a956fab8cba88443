"""Published calibration of a camera node: topic ``camera_info`` and service ``set_camera_info``.

The published calibration may differ from the lens, as with a real camera: to calibrate it anew does not
change its lens. Images and ground truth always show the rendered lens.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo

from humansim_ros.camera import Camera
from humansim_ros.camera.calibration import read_calibration, resolve_url, write_calibration
from humansim_ros.errors import CameraError, HumansimError, printable
from humansim_ros.messages import read_camera_info
from humansim_ros.ros.node import SceneNode
from humansim_ros.scene.camera import SceneCamera


def read_single_camera(url: str, name: str) -> Camera:
    """Read a calibration file or URL with one camera. ``name``: replaces ``${NAME}``.

    Raises:
        CameraError: The file has several cameras, or none that can be read.
    """
    path = resolve_url(url, name)
    cameras = read_calibration(path)
    if len(cameras) > 1:
        raise CameraError(f"there are {len(cameras)} cameras in this file, a driver has one", path=path)
    return next(iter(cameras.values()))


class PublishedCalibration:
    """Content of ``<camera>/camera_info``, and the service ``<camera>/set_camera_info``.

    The service replaces the content and writes it where camera drivers do, to
    ``$ROS_HOME/camera_info/<camera>.yaml``.

    Attributes:
        published: Calibration of the whole sensor in ``<camera>/camera_info``.
        beside_truth: That beside images of ground truth, such as depth: the true one until it is replaced.
    """

    def __init__(self, node: SceneNode, camera: SceneCamera) -> None:
        self._node = node
        self._name = name = camera.name
        self._rendered = self.beside_truth = camera.whole
        self.published = camera.published
        node.create_service(SetCameraInfo, f"{name}/set_camera_info", self._on_set)

    def replace(self, camera: Camera, source: str | None = None) -> None:
        """Publish another calibration. Raises CameraError naming ``source`` for another image size."""
        if camera.size != self._rendered.size:
            (w, h), (width, height) = camera.size, self._rendered.size
            message = f"this calibration is for {w}x{h} pixels, the camera has {width}x{height}"
            raise CameraError(message, path=source)
        self.published = self.beside_truth = camera

    def _on_set(self, request: Any, response: Any) -> Any:
        info: CameraInfo = request.camera_info
        try:
            camera = read_camera_info(info)
            self.replace(camera)
        except HumansimError as error:
            response.success, response.status_message = False, printable(str(error))
            return response
        home = os.environ.get("ROS_HOME") or str(Path.home() / ".ros")
        path = Path(home) / "camera_info" / f"{self._name}.yaml"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_calibration(path, {self._name: camera})
        except (OSError, HumansimError) as error:
            response.success, response.status_message = False, f"published, but not saved: {error}"
            return response
        response.success = True
        response.status_message = (
            f"camera_info is replaced and saved to {path}; images are rendered with the same lens as before"
        )
        self._node.get_logger().info(f"{self._name}: {response.status_message}")
        return response
