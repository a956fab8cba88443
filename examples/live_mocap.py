"""Send motion capture to a skinner as a suit's driver would: copy this and put your own joints in.

    python examples/live_mocap.py FILE.bvh [HUMAN] [--ros-args ...]

Publishes sensor_msgs/MultiDOFJointState on ``humans/<HUMAN>/motion``: joint names of the suit's own,
positions in ``map`` (metres, z up, floor at 0) and, where the suit knows them, rotations. The skinner finds
out by itself which joint is which, how tall the person is and how the rotations are meant. Let the motion
player leave that human alone first (ros2 param set /motion_player HUMAN.play false).
"""

from __future__ import annotations

import sys

import numpy as np
import rclpy
from geometry_msgs.msg import Transform
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import MultiDOFJointState

from humansim_ros.motion import read_bvh


class LiveMocap(Node):
    """Plays a BVH file, y up and in centimetres, over and over."""

    def __init__(self, path: str, human: str) -> None:
        super().__init__("live_mocap")
        self.motion = read_bvh(path)
        self.publisher = self.create_publisher(MultiDOFJointState, f"humans/{human}/motion", 5)
        self.frame = 0
        self.create_timer(self.motion.frame_time, self.send)

    def send(self) -> None:
        # world from file: z forward, x left, y up, centimetres; a suit's software tells its own
        axes = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        joints = self.motion.world_transforms(self.frame % self.motion.n_frames)
        positions = 0.01 * joints[:, :3, 3] @ axes.T
        # as they are: any axes of the joints' own will do, as long as they stay the same
        rotations = Rotation.from_matrix(axes @ joints[:, :3, :3]).as_quat()

        message = MultiDOFJointState()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "map"
        message.joint_names = list(self.motion.joint_names)
        for position, rotation in zip(positions.tolist(), rotations.tolist(), strict=True):
            transform = Transform()
            transform.translation.x, transform.translation.y, transform.translation.z = position
            (transform.rotation.x, transform.rotation.y, transform.rotation.z, transform.rotation.w) = (
                rotation
            )
            message.transforms.append(transform)
        self.publisher.publish(message)
        self.frame += 1


def main() -> None:
    rclpy.init()
    arguments = rclpy.utilities.remove_ros_args(sys.argv)[1:]
    if not arguments:
        sys.exit(__doc__)
    node = LiveMocap(arguments[0], (arguments[1:] or ["walker"])[0])
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
