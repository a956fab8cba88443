"""Tracker of the tests: it sends the truth back. ``--fault`` NAME in the cases whose scene has a word."""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import suppress
from pathlib import Path

import rclpy
from sensor_msgs.msg import MultiDOFJointState


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("topic")
    parser.add_argument("scene")
    parser.add_argument("--fault", default="")
    parser.add_argument("--where", default="")
    options = parser.parse_args()
    fault = options.fault if options.where in Path(options.scene).read_text() else ""
    if fault == "dies":
        print("the tracker has no camera")
        sys.exit(3)
    rclpy.init()
    node = rclpy.create_node("fake_tracker")
    poses = node.create_publisher(MultiDOFJointState, options.topic, 10)

    def answer(message: MultiDOFJointState) -> None:
        message.joint_names = [f"anna/{name}" for name in message.joint_names]
        if fault == "is slow":
            time.sleep(1.0)
        if fault != "is silent":
            poses.publish(message)

    node.create_subscription(MultiDOFJointState, "/humans/anna/joints", answer, 10)
    with suppress(KeyboardInterrupt):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
