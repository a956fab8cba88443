"""Node ``camera``: renders what one camera of a scene sees.

Subscribes to ``humans/<id>/vertices`` and ``humans/<id>/joints`` of every human and joins them by exact
stamp. Publishes the images, labels and joints of that instant with that stamp; nothing is rendered for a
topic that nobody subscribes to.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState, PointCloud2

from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.render import GLRenderer
from humansim_ros.ros import messages
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.pace import Pace
from humansim_ros.ros.qos import DATA, NEWEST
from humansim_ros.ros.runtime import run_node
from humansim_ros.rotations import Array
from humansim_ros.truth.joints import joint_surfaces, view_joints

#: Topic of each channel below the camera's name.
_IMAGE_TOPICS = {
    "rgb": "image_raw",
    "depth": "depth/image",
    "instance": "instance/image",
    "part": "part/image",
}
#: Frames that may wait for a human's message before they are given up.
_MOST_WAITING = 8
#: Periods that a frame may be behind the newest before it is skipped.
_PATIENCE = 1.5
#: Seconds without any vertices after which the still scene is shown.
_STILL_AFTER = 1.5


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
        # stamp -> (vertices by human, serialised joints by human), for frames that are not whole yet
        self._waiting: dict[int, tuple[dict[str, NDArray[np.float32]], dict[str, bytes]]] = {}
        self._pace = Pace(self.scene.period * 1e9)
        self._last = 0
        self._told = False
        self._started = self.now()
        self._whole = self.create_guard_condition(self._render_next)
        for human in self.scene.actors:
            topic = f"humans/{human}"
            self.create_subscription(
                PointCloud2, f"{topic}/vertices", partial(self._take_vertices, human), NEWEST
            )
            # as bytes: they are read only if somebody wants this camera's joints
            self.create_subscription(
                MultiDOFJointState, f"{topic}/joints", partial(self._take_joints, human), NEWEST, raw=True
            )
        self._still = self.create_timer(self.scene.period, self._show_still)
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

    def _take_vertices(self, human: str, message: PointCloud2) -> None:
        try:
            self._take(
                messages.to_nanoseconds(message.header.stamp), 0, human, messages.read_vertices(message)
            )
        except HumansimError as error:
            self.get_logger().error(f"{human}: frame skipped: {error}", throttle_duration_sec=1.0)

    def _take_joints(self, human: str, data: bytes) -> None:
        self._take(messages.serialised_stamp(data), 1, human, data)

    def _take(self, stamp: int, kind: int, human: str, part: Any) -> None:
        """Put one human's vertices (kind 0) or joints (kind 1) with the others of their stamp."""
        if stamp <= self._last or not self._pace.keeps(stamp):
            return
        self._waiting.setdefault(stamp, ({}, {}))[kind][human] = part
        if self._is_whole(stamp):
            # not at once: what else has arrived is taken first, so that a late camera sees it is late
            self._whole.trigger()
        elif len(self._waiting) > _MOST_WAITING:
            self._give_up()

    def _is_whole(self, stamp: int) -> bool:
        return all(len(parts) == len(self.scene.actors) for parts in self._waiting[stamp])

    def _give_up(self) -> None:
        stamp = min(self._waiting)
        vertices, joints = self._waiting.pop(stamp)
        missing = [human for human in self.scene.actors if human not in vertices or human not in joints]
        self.count("drops")
        self.get_logger().warn(
            f"frames wait for {', '.join(missing)}: is its skinner running?", throttle_duration_sec=5.0
        )

    def _render_next(self) -> None:
        """Render the oldest whole frame that is not late, or the newest whole one if all are."""
        whole = sorted(stamp for stamp in self._waiting if self._is_whole(stamp))
        if not whole:
            return
        patience = _PATIENCE * self.scene.period * 1e9
        newest = max(self._waiting)
        stamp = next((stamp for stamp in whole if newest - stamp <= patience), whole[-1])
        lost = sum(older < stamp for older in self._waiting)
        self._pace.lost(lost)
        vertices, serialised = self._waiting[stamp]
        self._waiting = {later: parts for later, parts in self._waiting.items() if later > stamp}
        if self._last:
            # those that the pace leaves out are drops too
            self.count("drops", round((stamp - self._last) / (self.scene.period * 1e9)) - 1)
        self._last = stamp
        start = time.monotonic()
        try:
            self._publish(stamp, vertices, lambda human: _positions(serialised[human]))
        except HumansimError as error:
            self.count("drops")
            self.get_logger().error(f"frame skipped: {error}", throttle_duration_sec=1.0)
        self._pace.worked(start, time.monotonic())
        if any(self._is_whole(later) for later in self._waiting):
            self._whole.trigger()

    def _show_still(self) -> None:
        """Until a skinner speaks, show the scene as it is at its start, so that the node alone shows
        something.
        """
        now = self.now()
        if self._last and self.scene.actors:
            self._still.cancel()
        elif now - self._started > _STILL_AFTER * 1e9 or not self.scene.actors:
            if not self._told:
                self._told = True
                self.get_logger().info(
                    "no skinner is publishing: showing the scene as it stands at its start"
                )
            states = {name: actor.at(0.0) for name, actor in self.scene.actors.items()}
            vertices = {name: state.vertices for name, state in states.items()}
            self._publish(now, vertices, lambda human: states[human].positions)

    def _publish(
        self, stamp: int, vertices: dict[str, NDArray[np.float32]], joints_of: Callable[[str], Array]
    ) -> None:
        """Render what somebody wants of this instant, and send it."""
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
        joints = {name: joints_of(name) for name in actors} if wants_joints else {}
        bodies = [actor.body(vertices[name]) for name, actor in actors.items()]
        view = self._renderer.render(bodies, self._camera, wanted)
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


def _positions(data: bytes) -> Array:
    """(J, 3) joint positions of a serialised ``joints`` message."""
    return messages.read_joints(deserialize_message(data, MultiDOFJointState)).positions[0]


def main() -> int:
    return run_node(CameraNode)


if __name__ == "__main__":
    sys.exit(main())
