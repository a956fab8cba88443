"""Node ``skinner``: poses and skins one human from the motion it hears.

Subscribes to ``humans/<id>/motion``. Publishes ``humans/<id>/joints``, ``vertices`` and ``markers`` with the
same stamp, and latched ``humans/<id>/mesh``.
"""

from __future__ import annotations

import sys
from typing import Any

from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from visualization_msgs.msg import MarkerArray

from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.ros.messages import (
    MarkerMaker,
    joints_message,
    mesh_message,
    read_joints,
    to_nanoseconds,
    vertices_message,
)
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA, NEWEST
from humansim_ros.ros.runtime import run_node


class Skinner(SceneNode):
    """Turns a motion's joints into a body's joints and vertices."""

    def __init__(self, **options: Any) -> None:
        super().__init__("skinner", **options)
        name = self.text_parameter("human", "", "Which human of the scene; empty for the first")
        marker_rate = self.number_parameter(
            "marker_rate", 10.0, 0.1, 1000.0, "Most marker messages per second (they are heavy)"
        )
        name = name or next(iter(self.scene.actors), "")
        if name not in self.scene.actors:
            known = ", ".join(self.scene.actors) or "none"
            raise SceneError(f"no human {name!r}; the scene has {known}", path=self.scene.path, key="humans")
        self._actor = self.scene.actors[name]
        self._joints = self.create_publisher(MultiDOFJointState, f"humans/{name}/joints", DATA)
        self._vertices = self.create_publisher(PointCloud2, f"humans/{name}/vertices", DATA)
        self._markers = self.create_publisher(MarkerArray, f"humans/{name}/markers", DATA)
        self._marker_period = int(1e9 / marker_rate)
        self._next_marker = 0
        self._make_markers = MarkerMaker(self._actor.human)
        self.publish_latched(mesh_message(self._actor.human.mesh), f"humans/{name}/mesh")
        self.create_subscription(MultiDOFJointState, f"humans/{name}/motion", self._on_motion, NEWEST)
        self.get_logger().info(f"skinning {name} ({len(self._actor.human.mesh.vertices)} vertices)")

    def _on_motion(self, message: MultiDOFJointState) -> None:
        stamp = to_nanoseconds(message.header.stamp)
        try:
            poses = read_joints(message)
            if poses.names != self._actor.motion_names:
                raise SceneError(
                    f"the joints of this motion are not those of {self._actor.motion.motion.path}"
                )
            state = self._actor.state(poses)
        except HumansimError as error:
            self.count("drops")
            self.get_logger().error(f"frame skipped: {error}", throttle_duration_sec=1.0)
            return
        self._joints.publish(joints_message(state, stamp))
        if self._vertices.get_subscription_count():
            self._vertices.publish(vertices_message(state.vertices, stamp))
        if self._markers.get_subscription_count() and stamp >= self._next_marker:
            self._next_marker = stamp + self._marker_period
            self._markers.publish(self._make_markers(self._actor.name, self._actor.instance, state, stamp))
        self.count("frames")
        self.report_lateness(stamp)


def main() -> int:
    return run_node(Skinner)


if __name__ == "__main__":
    sys.exit(main())
