"""Messages of the robot: odometry and commands."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from humansim_ros.data.messages import parts
from humansim_ros.data.messages.cameras import rigid_pose
from humansim_ros.data.messages.headers import header, to_nanoseconds
from humansim_ros.data.messages.types import Odometry, Twist
from humansim_ros.errors import RosError, printable, within_bounds
from humansim_ros.geometry import ObjectPose, Velocity, multiply_quaternions, quaternion_to_matrix
from humansim_ros.scene.core import Robot


def odometry_message(robot: Robot, base: ObjectPose, stamp: int) -> Odometry:
    """Build ``odom``: pose of ``base_link`` relative to the start of the robot, and its velocity in these
    axes.

    The values are the true ones, so the covariances are 0.

    Args:
        robot: The robot.
        base: Pose and velocity of ``base_link`` in ``map``.
        stamp: Nanoseconds.
    """
    config, pose = robot.config, in_odometry(robot, base)
    message = Odometry(header=header(stamp, config.odom_frame), child_frame_id=config.base_frame)
    message.pose.pose = parts.pose(pose.position, pose.rotation)
    if base.velocity is not None:
        turn = quaternion_to_matrix(base.rotation).T
        message.twist.twist = parts.twist(turn @ base.velocity.linear, turn @ base.velocity.angular)
    return message


def in_odometry(robot: Robot, base: ObjectPose) -> ObjectPose:
    """Convert the pose of ``base_link`` from ``map`` (``base``) to the frame of the odometry."""
    start = robot.start
    back = start.rotation * (-1, -1, -1, 1)
    position = quaternion_to_matrix(back) @ (base.position - start.position)
    return ObjectPose(position, multiply_quaternions(back, base.rotation))


def read_odometry(message: Odometry, robot: Robot) -> tuple[int, ObjectPose]:
    """Read odometry from another node. Returns the stamp, and pose and velocity of ``base_link`` in ``map``.

    Raises:
        RosError: A number is not finite or out of range, the orientation is no rotation, or the message has
            the wrong frame.
    """
    config = robot.config
    if message.child_frame_id not in ("", config.base_frame):
        raise RosError(
            f"odometry of the frame {printable(message.child_frame_id, 80)!r}: robot.base_frame is "
            f"{config.base_frame!r}"
        )
    position, rotation = rigid_pose(message.pose.pose, "a robot's odometry")
    moving = message.twist.twist
    linear, angular = (np.array(parts.xyz(part)) for part in (moving.linear, moving.angular))
    if not within_bounds([*linear, *angular]):
        raise RosError("the velocity of a robot's odometry is not finite, or above 1000 km/s")
    turn = quaternion_to_matrix(rotation)
    base = ObjectPose(position, rotation, velocity=Velocity(turn @ linear, turn @ angular))
    start = replace(robot.start, velocity=Velocity(np.zeros(3), np.zeros(3)))
    return to_nanoseconds(message.header.stamp), start.carry(base)


def read_command(message: Twist) -> tuple[float, float]:
    """Forward speed (m/s) and turn rate to the left (rad/s) of a command. Raises RosError unless finite."""
    speed, turn = float(message.linear.x), float(message.angular.z)
    if not (math.isfinite(speed) and math.isfinite(turn)):
        raise RosError(f"linear.x is {speed:g} and angular.z is {turn:g}: both must be finite")
    return speed, turn
