"""The robot of a motion player. It receives commands or odometry, and publishes odometry and tf."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data

from humansim_ros.data import messages
from humansim_ros.data.messages import RobotTopics
from humansim_ros.errors import HumansimError
from humansim_ros.geometry import ObjectPose
from humansim_ros.ros.graph.qos import NEWEST
from humansim_ros.ros.playing.clock import Tick
from humansim_ros.ros.playing.playing import FramePlayer
from humansim_ros.ros.processes.transforms import TransformSender
from humansim_ros.scene.core import Playback, Robot, SceneState

#: After its newest odometry, a robot goes on with the same velocity for at most this time, seconds.
_MOST_AHEAD = 0.3
#: A robot has jumped if two poses are farther apart than its velocity explains by more than this distance,
#: metres.
_JUMP = 0.5


class RobotPort:
    """Moves the robot of a scene by commands or by odometry of another node, and publishes its pose.

    Args:
        node: The motion player.
        playback: Motions of the player.
        robot: The robot.
    """

    def __init__(self, node: FramePlayer, playback: Playback, robot: Robot) -> None:
        self._node, self._playback, self._robot = node, playback, robot
        self._odom: Any = None
        #: Stamp and pose of the newest odometry of another node, and of the previous one.
        self._newest: tuple[int, ObjectPose] | None = None
        self._before: tuple[int, ObjectPose] | None = None
        config = robot.config
        if config.odometry is not None:
            node.create_subscription(Odometry, config.odometry, self._on_odometry, qos_profile_sensor_data)
            return
        if robot.takes_commands:
            kind = TwistStamped if config.stamped else Twist
            node.create_subscription(kind, config.cmd_vel, self._on_command, NEWEST)
        self._topics = RobotTopics(robot)
        self._odom = node.topic_publisher(self._topics.odom)
        self._transforms = TransformSender(node, [self._topics.start, self._topics.base], node.now())

    def placed(self, tick: Tick, shown: SceneState) -> SceneState:
        """Poses of a frame. If another node sends odometry, the robot is moved to the pose in it."""
        if self._robot.config.odometry is None:
            return shown
        if self._newest is None:
            self._node.get_logger().warn(
                f"no odometry on {self._robot.config.odometry}: the robot stands at its start",
                throttle_duration_sec=5.0,
            )
            return shown
        return self._playback.with_robot(shown, self._base_at(tick.stamp), tick.pace)

    def publish(self, shown: SceneState, stamp: int) -> None:
        """Publish odometry and transform of the robot for a frame, unless another node publishes them."""
        base = shown.robot
        if self._odom is None or base is None:
            return
        self._odom.publish(self._topics.odom.build(base, stamp))
        self._transforms.send(self._topics.base.build(base, stamp))

    def _base_at(self, stamp: int) -> ObjectPose:
        """Pose of ``base_link`` at a stamp, from the odometry around it."""
        assert self._newest is not None
        if self._before is not None and self._before[0] <= stamp < self._newest[0]:
            (since, pose), (until, _) = self._before, self._newest
            return pose.moved(min(stamp - since, until - since) * 1e-9)
        since, pose = self._newest
        late = (stamp - since) * 1e-9
        if late > _MOST_AHEAD:
            self._node.get_logger().warn(
                f"the newest odometry on {self._robot.config.odometry} is {late:.2f} s old: the robot stands",
                throttle_duration_sec=5.0,
            )
            return replace(pose.moved(_MOST_AHEAD), velocity=None)
        return pose.moved(max(late, -_MOST_AHEAD))

    def _on_odometry(self, message: Odometry) -> None:
        try:
            stamp, pose = messages.read_odometry(message, self._robot)
        except HumansimError as error:
            self._node.report_skipped(f"{self._robot.config.odometry}: {error}")
            return
        self._playback.world.version += 1
        before, self._newest = self._newest, (stamp, pose)
        if before is not None and before[0] != stamp:  # else it was sent again
            self._before = before if before[0] < stamp else None
        self._look_for_jump(stamp, pose)
        self._node.playing.report(stamp)

    def _look_for_jump(self, stamp: int, pose: ObjectPose) -> None:
        """If the newest odometry is far from the previous one, log it and do not interpolate between them."""
        if self._before is None:
            return
        seconds = (stamp - self._before[0]) * 1e-9
        away = float(abs(self._before[1].moved(min(seconds, _MOST_AHEAD)).position - pose.position).max())
        if away > _JUMP:
            self._before = None  # nothing is between two places
            self._node.get_logger().warn(
                f"the odometry on {self._robot.config.odometry} jumps by {away:.1f} m, and the robot with it",
                throttle_duration_sec=5.0,
            )

    def _on_command(self, message: Any) -> None:
        try:
            command = messages.read_command(message.twist if self._robot.config.stamped else message)
        except HumansimError as error:
            self._node.report_skipped(f"{self._robot.config.cmd_vel}: {error}")
        else:
            self._playback.command(*command)
