"""Send motion capture to a skinner as a suit's driver would: copy this and put your own joints in.

    humansim run my_scene.yaml --live anna
    python examples/live_mocap.py MOTION [HUMAN] [--ros-args ...]

MOTION is a built-in motion (``humansim motion list``) or a file: BVH or glTF. HUMAN is ``walker`` if absent.

Publishes sensor_msgs/MultiDOFJointState on ``humans/<HUMAN>/motion``: joint names of the suit's own,
positions in ``map`` (metres, z up, floor at 0) and, where the suit knows them, rotations. The skinner detects
which joint is which, how tall the person is and how the rotations are meant.
"""

from __future__ import annotations

import sys

import rclpy
from geometry_msgs.msg import Transform
from rclpy.node import Node
from sensor_msgs.msg import MultiDOFJointState

from humansim_ros import HumansimError, Scene


class LiveMocap(Node):
    """Plays a motion over and over."""

    def __init__(self, path: str, human: str) -> None:
        super().__init__("live_mocap")
        # in place of a suit: joints of a motion file, converted to metres, z up. Any axes of the joints' own
        # will do, as long as they stay the same
        camera = {"position": [3, 0, 1], "look_at": [0, 0, 1]}
        scene = {"room": None, "humans": {human: {"motion": path}}, "cameras": {"unused": camera}}
        self.actor = Scene.from_dict(scene).actors[human]
        self.publisher = self.create_publisher(MultiDOFJointState, f"humans/{human}/motion", 5)
        self.start = self.get_clock().now()
        self.create_timer(1 / 60, self.send)
        self.create_timer(5.0, self.report_silence)

    def send(self) -> None:
        now = self.get_clock().now()
        joints = self.actor.joint_poses(1e-9 * (now - self.start).nanoseconds)

        message = MultiDOFJointState()
        message.header.stamp = now.to_msg()
        message.header.frame_id = "map"
        message.joint_names = list(joints.names)
        for position, rotation in zip(
            joints.positions[0].tolist(), joints.rotations[0].tolist(), strict=True
        ):
            transform = Transform()
            transform.translation.x, transform.translation.y, transform.translation.z = position
            (transform.rotation.x, transform.rotation.y, transform.rotation.z, transform.rotation.w) = (
                rotation
            )
            message.transforms.append(transform)
        self.publisher.publish(message)

    def report_silence(self) -> None:
        if not self.publisher.get_subscription_count():
            topic = self.publisher.topic_name
            self.get_logger().info(f"no skinner listens to {topic}: is this human in the scene that runs?")


def main() -> None:
    rclpy.init()
    arguments = rclpy.utilities.remove_ros_args(sys.argv)[1:]
    if not arguments:
        sys.exit(__doc__)
    try:
        node = LiveMocap(arguments[0], (arguments[1:] or ["walker"])[0])
    except HumansimError as error:
        sys.exit(f"error: {error}")
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
