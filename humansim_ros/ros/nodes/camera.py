"""Node ``camera``: renders what one camera of a scene sees.

Subscribes to ``humans/<id>/vertices`` and ``humans/<id>/joints`` of every human and ``objects/<name>/marker``
of every object that moves, and joins them by exact stamp. Publishes the images, labels and joints of that
instant with that stamp; nothing is rendered for a topic that nobody subscribes to.
"""

from __future__ import annotations

import sys
from typing import Any

from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from humansim_ros.errors import SceneError
from humansim_ros.render import GLRenderer
from humansim_ros.ros import messages
from humansim_ros.ros.joiner import FrameJoiner, Instant
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA
from humansim_ros.ros.runtime import run_node
from humansim_ros.truth.joints import joint_surfaces, view_joints

#: Topic of each channel below the camera's name.
_IMAGE_TOPICS = {
    "rgb": "image_raw",
    "depth": "depth/image",
    "instance": "instance/image",
    "part": "part/image",
}


class CameraNode(SceneNode):
    """One camera with its ground truth."""

    def __init__(self, **options: Any) -> None:
        super().__init__("camera", **options)
        name = self.text_parameter("camera", "", "Which camera of the scene; empty for the first")
        name = name or next(iter(self.scene.cameras))
        if name not in self.scene.cameras:
            known = ", ".join(self.scene.cameras)
            raise SceneError(
                f"no camera {name!r}; the scene has {known}", path=self.scene.path, key="cameras"
            )
        self._name = name
        self._camera = self.scene.cameras[name]
        self._frame = messages.optical_frame(name)
        self._renderer = GLRenderer(self.scene.static_meshes)
        self._surfaces = {human: joint_surfaces(actor.human) for human, actor in self.scene.actors.items()}
        self._images = {
            channel: self.create_publisher(Image, f"{name}/{topic}", DATA)
            for channel, topic in _IMAGE_TOPICS.items()
        }
        self._info = self.create_publisher(CameraInfo, f"{name}/camera_info", DATA)
        self._joints = self.create_publisher(PointCloud2, f"{name}/joints", DATA)
        self._publish_constants()
        self._joiner = FrameJoiner(self, self.show)
        self.get_logger().info(
            f"{name}: {self._camera.size[0]}x{self._camera.size[1]} on {self._renderer.device}"
        )

    def close(self) -> None:
        self._renderer.close()

    def _publish_constants(self) -> None:
        extrinsics = messages.extrinsics_message(self._name, self._camera, self.now())
        self.publish_latched(extrinsics, f"{self._name}/extrinsics")
        self.publish_latched(messages.projection_message(self._camera), f"{self._name}/projection")
        actors = self.scene.actors.values()
        instances = {actor.name: actor.instance for actor in actors}
        self.publish_latched(messages.instance_legend(instances), f"{self._name}/instance/legend")
        for actor in actors:
            self.publish_latched(messages.part_legend(actor.human.skeleton), f"{self._name}/part/legend")
            break
        joints = {actor.name: (actor.instance, actor.human.skeleton.joint_names) for actor in actors}
        self.publish_latched(messages.joints_legend(joints), f"{self._name}/joints/legend")
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        self.publish_latched(TFMessage(transforms=[extrinsics]), "/tf_static")

    def show(self, instant: Instant) -> None:
        """Render what somebody wants of this instant, and send it."""
        stamp = instant.stamp
        channels = {c for c, publisher in self._images.items() if publisher.get_subscription_count()}
        wanted = set(channels)
        wants_joints = self._joints.get_subscription_count() > 0
        if wants_joints:
            wanted |= {"instance", "part"}
        if self._info.get_subscription_count():
            self._info.publish(messages.camera_info_message(self._camera, stamp, self._frame))
        if not wanted:
            return
        actors = self.scene.actors
        joints = {name: instant.joints_of(name) for name in actors} if wants_joints else {}
        view = self._renderer.render(instant.bodies, self._camera, wanted)
        for channel in channels:
            image = getattr(view, channel)
            encoding = messages.ENCODINGS[channel]
            self._images[channel].publish(messages.image_message(image, encoding, stamp, self._frame))
        if wants_joints:
            seen = [
                (
                    actors[name].instance,
                    view_joints(self._camera, positions, view, actors[name].instance, self._surfaces[name]),
                )
                for name, positions in joints.items()
            ]
            self._joints.publish(messages.joint_view_message(seen, stamp, self._frame))
        self.count("frames")
        self.report_lateness(stamp)


def main() -> int:
    return run_node(CameraNode)


if __name__ == "__main__":
    sys.exit(main())
