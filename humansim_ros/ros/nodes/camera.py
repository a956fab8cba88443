"""Node ``camera``: renders what one camera of a scene sees.

Subscribes to ``humans/<id>/vertices`` and ``humans/<id>/joints`` of every human, ``objects/<name>/marker`` of
every object that moves, and its own ``pose`` if a trajectory moves it, and joins them by exact stamp.
Publishes the images, labels and joints of that instant with that stamp; nothing is rendered for a topic that
nobody subscribes to. As a driver it has ``camera_info``, ``set_camera_info`` and ``camera_info_url``
(docs/lenses.md).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image

from humansim_ros.errors import CameraError, SceneError
from humansim_ros.render import AdjacentFrame
from humansim_ros.render.channels import comparing_with
from humansim_ros.ros import messages
from humansim_ros.ros.camera_calibration import PublishedCalibration, calibration_of
from humansim_ros.ros.camera_pose import CameraPosePublisher
from humansim_ros.ros.camera_publishers import ImagePublishers, TruthPublishers, needed
from humansim_ros.ros.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA
from humansim_ros.ros.runtime import run_node
from humansim_ros.scene import Scene
from humansim_ros.scene.camera import SceneCamera
from humansim_ros.scene.capture import Exposure, capture
from humansim_ros.scene.state import SceneState

#: Channels that are known only when the next frame is.
_FORWARD, _BACKWARD = comparing_with("next_frame"), comparing_with("previous_frame")


class CameraNode(SceneNode):
    """One camera with its ground truth.

    As one of a rig it is given its ``name``, the ``scene`` and the ``renderer``, all of which it shares with
    the other cameras of the process, and every frame, by :meth:`show`.
    """

    def __init__(
        self, name: str = "", scene: Scene | None = None, renderer: Any = None, **options: Any
    ) -> None:
        super().__init__(f"camera_{name}" if name else "camera", scene, **options)
        self._camera = self._chosen(name)
        name = self._camera.name
        self._frame = messages.optical_frame(name)
        self._shared = renderer is not None
        self._renderer = renderer if self._shared else self.make_renderer()
        drawn = self._renderer.channels
        self._outlets = ImagePublishers(self, name, self._camera.encoding, self.scene.labels, drawn)
        self._before: tuple[int, Exposure] | None = None
        self._rect = None
        if self._camera.rectified is not None:
            self._rect = self.create_publisher(Image, f"{name}/image_rect", DATA)
        self._info = self.create_publisher(CameraInfo, f"{name}/camera_info", DATA)
        self._people = TruthPublishers(self, name)
        self._calibration = PublishedCalibration(self, name, self._camera.whole, self._camera.region)
        if url := self.text_parameter(
            "published_info_url",
            "",
            "Calibration file that camera_info says, whatever the lens; empty: the truth",
        ):
            self._calibration.say(calibration_of(url, name), url)
        self._where = CameraPosePublisher(self, self._camera)
        self._publish_legends()
        if not self._shared:
            self._joiner = FrameSynchronizer(self, self.show, [name] if self._camera.moves else [])
        width, height = self._camera.camera.size
        self.get_logger().info(f"{name}: {width}x{height} on {self._renderer.device}")

    def _chosen(self, name: str) -> SceneCamera:
        name = name or self.text_parameter("camera", "", "Which camera of the scene; empty for the first")
        url = self.text_parameter(
            "camera_info_url", "", "Calibration file of the lens to render with; empty: as the scene says"
        )
        name = name or next(iter(self.scene.cameras))
        if name not in self.scene.cameras:
            known = ", ".join(self.scene.cameras)
            raise SceneError(
                f"no camera {name!r}; the scene has {known}", path=self.scene.path, key="cameras"
            )
        camera = self.scene.scene_cameras[name]
        if not url:
            return camera
        try:
            return camera.with_calibration(calibration_of(url, name))
        except CameraError as error:
            raise CameraError(error.message, path=error.path or url, line=error.line, key=error.key) from None

    def close(self) -> None:
        if not self._shared:
            self._renderer.close()

    def _publish_legends(self) -> None:
        name, actors = self._camera.name, self.scene.actors.values()
        self.publish_latched(messages.instance_legend(self.scene.labels), f"{name}/instance/legend")
        for actor in actors:
            self.publish_latched(messages.part_legend(actor.human.skeleton), f"{name}/part/legend")
            break
        joints = {actor.name: (actor.instance, actor.human.skeleton.joint_names) for actor in actors}
        legend = messages.joints_legend(joints, self.scene.object_labels)
        self.publish_latched(legend, f"{name}/joints/legend")

    def show(self, instant: SceneState) -> None:
        """Render what somebody wants of this instant, and where the frame before has gone, and send it."""
        stamp = instant.stamp
        shot = self._where.shot(instant)
        channels = self._outlets.wanted()
        before, self._before = self._before, (stamp, shot) if channels & (_FORWARD | _BACKWARD) else None
        if before is None:
            self._send_instant(instant, shot, channels - _FORWARD - _BACKWARD)
            return
        here, there = shot.neighbour(self._camera), before[1].neighbour(self._camera)
        self._send_instant(instant, replace(shot, previous_frame=there), channels - _FORWARD)
        self._send_forward_flow(channels & _FORWARD, *before, here)

    def _send_instant(self, instant: SceneState, shot: Exposure, channels: set[str]) -> None:
        stamp = instant.stamp
        wanted = set(channels)
        of_people = self._people.subscribed()
        wants_rect = self._rect is not None and self._rect.get_subscription_count() > 0
        wanted |= needed(of_people)
        if wants_rect:
            wanted |= {"rgb"}
        if self._info.get_subscription_count():
            self._info.publish(self._calibration.message(stamp))
        if not wanted:
            return
        view = capture(self._renderer, self._camera, shot, wanted, stamp)
        self._outlets.send(view, channels, stamp)
        if self._rect is not None and wants_rect and view.rgb is not None:
            encoding = self._camera.encoding.replace("bayer_rggb8", "rgb8")
            self._send(self._rect, self._camera.rectify(view.rgb), encoding, stamp)
        truth = instant.camera_truth(self._camera.at(shot.pose_at(0.0)), view)
        self._people.send(of_people, truth, stamp)
        self.count("frames")
        self.report_lateness(stamp)

    def _send_forward_flow(
        self, channels: set[str], stamp: int, shot: Exposure, next_frame: AdjacentFrame
    ) -> None:
        """Send where everything of the frame before has gone, with that frame's stamp."""
        if channels:
            view = capture(
                self._renderer, self._camera, replace(shot, next_frame=next_frame), channels, stamp
            )
            self._outlets.send(view, channels, stamp)

    def _send(self, publisher: Any, image: NDArray[Any], encoding: str, stamp: int) -> None:
        publisher.publish(messages.image_message(image, encoding, stamp, self._frame))


def main() -> int:
    return run_node(CameraNode)


if __name__ == "__main__":
    sys.exit(main())
