"""Move a camera of a running scene along a circle, by its pose topic.

    humansim run &
    python examples/moving_camera.py [CAMERA] [--ros-args ...]

Publishes geometry_msgs/PoseStamped on ``<CAMERA>/pose``: where its optical frame (z forward, x right,
y down) is in ``map``. The camera node renders from there, and publishes the pose as extrinsics.
"""

from __future__ import annotations

import sys

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from humansim_ros import Camera


class MovingCamera(Node):
    """Turns around the origin once in ten seconds."""

    def __init__(self, camera: str) -> None:
        super().__init__("moving_camera")
        self.publisher = self.create_publisher(PoseStamped, f"{camera}/pose", 5)
        self.start = self.get_clock().now()
        self.create_timer(1 / 30, self.send)

    def send(self) -> None:
        now = self.get_clock().now()
        angle = 2 * np.pi * (now - self.start).nanoseconds * 1e-9 / 10
        position = (3 * np.cos(angle), 3 * np.sin(angle), 1.7)
        camera = Camera.look_at(position, (0, 0, 0.9))
        message = PoseStamped()
        message.header.stamp = now.to_msg()
        message.header.frame_id = "map"
        at, turn = message.pose.position, message.pose.orientation
        at.x, at.y, at.z = camera.center.tolist()
        turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(camera.R.T).as_quat().tolist()
        self.publisher.publish(message)


def main() -> None:
    rclpy.init()
    arguments = rclpy.utilities.remove_ros_args(sys.argv)[1:]
    node = MovingCamera((arguments or ["camera_1"])[0])
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
