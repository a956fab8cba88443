"""What a camera node says of its calibration: ``camera_info``, and ``set_camera_info`` to say otherwise.

A real camera's lens does not change when somebody calibrates it anew: only what its driver says of it does.
So it is here: pictures and truth are always those of the lens that is rendered.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo

from humansim_ros.camera import Camera
from humansim_ros.camera.calibration import read_calibration, resolve_url, write_calibration
from humansim_ros.camera.region import Region
from humansim_ros.errors import CameraError, HumansimError
from humansim_ros.ros.messages import camera_info_message, optical_frame, read_camera_info
from humansim_ros.ros.node import SceneNode


def calibration_of(url: str, name: str) -> Camera:
    """The camera of a calibration file or URL that has one. ``name``: what ${NAME} stands for. Raises
    CameraError.
    """
    path = resolve_url(url, name)
    cameras = read_calibration(path)
    if len(cameras) > 1:
        raise CameraError(f"there are {len(cameras)} cameras in this file, a driver has one", path=path)
    return next(iter(cameras.values()))


class PublishedCalibration:
    """What ``<camera>/camera_info`` says, and the service ``<camera>/set_camera_info``.

    What the service is given is said from then on, and written where drivers keep it,
    ``$ROS_HOME/camera_info/<camera>.yaml``; it changes no lens.
    """

    def __init__(self, node: SceneNode, name: str, camera: Camera, region: Region) -> None:
        self._node = node
        self._name = name
        self._lens = camera
        self._region = region
        self._said = camera
        node.create_service(SetCameraInfo, f"{name}/set_camera_info", self._on_set)

    def message(self, stamp: int) -> CameraInfo:
        """``camera_info`` of a frame."""
        return camera_info_message(self._said, stamp, optical_frame(self._name), self._region)

    def say(self, camera: Camera, source: str | None = None) -> None:
        """Say something else than the truth. CameraError where it is of another image size."""
        if camera.size != self._lens.size:
            (w, h), (width, height) = camera.size, self._lens.size
            message = f"this calibration is for {w}x{h} pixels, the camera has {width}x{height}"
            raise CameraError(message, path=source)
        self._said = camera

    def _on_set(self, request: Any, response: Any) -> Any:
        info: CameraInfo = request.camera_info
        try:
            camera = read_camera_info(info)
            self.say(camera)
        except HumansimError as error:
            response.success, response.status_message = False, str(error)
            return response
        home = os.environ.get("ROS_HOME") or str(Path.home() / ".ros")
        path = Path(home) / "camera_info" / f"{self._name}.yaml"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_calibration(path, {self._name: camera})
        except (OSError, HumansimError) as error:
            response.success, response.status_message = False, f"used, but not kept: {error}"
            return response
        response.success = True
        response.status_message = (
            f"camera_info says so from now on, kept in {path}; what is rendered keeps its lens"
        )
        self._node.get_logger().info(f"{self._name}: {response.status_message}")
        return response
