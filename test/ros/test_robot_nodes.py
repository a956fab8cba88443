"""A robot through the nodes: commands and odometry move its cameras, and hostile messages do not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np
import pytest
import ros_support  # noqa: F401  # claims a domain before rclpy is imported
from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation

from humansim_ros.data import messages
from humansim_ros.scene import Scene, Simulation
from humansim_ros.testing import SceneGraph

#: Seconds between frames.
PERIOD = 0.05
MOUNT = {"mount": "robot", "position": [0.1, 0.2, 0.9], "look_at": [1.1, 0.2, 0.9], "size": [80, 60]}


def scene(robot: dict[str, Any]) -> Scene:
    humans = {"anna": {"motion": {"file": "walk", "position": [2.0, 0.0]}}}
    cameras = {"front": MOUNT}
    return Scene.from_dict({"room": None, "rate": 20, "humans": humans, "robot": robot, "cameras": cameras})


@pytest.fixture
def start(ros: None) -> Iterator[Callable[[dict[str, Any]], SceneGraph]]:
    graphs = []

    def make(robot: dict[str, Any]) -> SceneGraph:
        graphs.append(SceneGraph(scene(robot), namespace="rob"))
        return graphs[-1]

    yield make
    for graph in graphs:
        graph.close()


def send(graph: SceneGraph, publisher: Any, message: Any) -> None:
    """Publish a message as soon as the player subscribes, and let the player read it."""
    graph.spin_until(lambda: publisher.get_subscription_count() > 0)
    publisher.publish(message)
    ends = [graph.node.get_clock().now().nanoseconds + 300_000_000]
    graph.spin_until(lambda: graph.node.get_clock().now().nanoseconds > ends[0])


def position(message: Any) -> np.ndarray:
    place = message.pose.pose.position if isinstance(message, Odometry) else message.pose.position
    return np.array([place.x, place.y, place.z])


def test_commands_move_the_robot_and_its_camera(start: Any) -> None:
    graph = start({"timeout": 60.0})
    odom, pose = graph.subscribe("odom"), graph.subscribe("front/pose")
    commands = graph.node.create_publisher(Twist, "cmd_vel", 10)
    first = graph.play(1)[0]
    np.testing.assert_allclose(position(pose.at(first)), [0.1, 0.2, 0.9])
    send(graph, commands, Twist(linear=Vector3(x=0.6), angular=Vector3(z=0.4)))
    send(graph, commands, Twist(linear=Vector3(x=math.nan)))
    for number, stamp in enumerate(graph.play(4), 1):
        yaw = 0.4 * number * PERIOD
        base = 0.6 / 0.4 * np.array([math.sin(yaw), 1 - math.cos(yaw), 0])
        np.testing.assert_allclose(position(odom.at(stamp)), base, atol=1e-9)
        c, s = math.cos(yaw), math.sin(yaw)
        np.testing.assert_allclose(
            position(pose.at(stamp)),
            [base[0] + 0.1 * c - 0.2 * s, base[1] + 0.1 * s + 0.2 * c, 0.9],
            atol=1e-9,
        )
        assert odom.at(stamp).twist.twist.linear.x == pytest.approx(0.6)


def test_images_on_a_path_are_the_images_of_simulation(start: Any) -> None:
    robot = {
        "path": {"points": [[-2, 0], [0, 0.5]], "speed": 1.2},
        "vibration": {"position": 0.002, "rotation_deg": 0.3},
    }
    graph = start(robot)
    topics = {name: graph.subscribe(name) for name in ("front/image_raw", "front/depth/image", "odom")}
    stamps = graph.play(3)
    with Simulation(graph.scene, channels=("rgb", "depth")) as simulation:
        for index, stamp in enumerate(stamps):
            frame = simulation.frame(index)
            rgb = messages.read_image(topics["front/image_raw"].at(stamp))
            np.testing.assert_array_equal(rgb, frame.views["front"].rgb)
            depth = messages.read_image(topics["front/depth/image"].at(stamp))
            np.testing.assert_array_equal(depth, frame.views["front"].depth)
            base = messages.read_odometry(topics["odom"].at(stamp), graph.scene.robot)[1]
            np.testing.assert_allclose(base.position, frame.robot.position, atol=1e-9)


def test_tf_leads_from_the_map_over_the_robot_to_its_camera(start: Any, tf: dict[str, list[Any]]) -> None:
    graph = start({"path": {"points": [[-2, 1], [0, 3]], "speed": 1.2}})
    extrinsics = graph.subscribe("front/extrinsics")
    stamp = graph.play(3)[-1]
    links = {each.child_frame_id: each for sent in (*tf["/tf_static"], *tf["/tf"]) for each in sent}
    assert messages.to_nanoseconds(links["base_link"].header.stamp) == stamp
    chain, frame = np.eye(4), "front_optical_frame"
    while frame != "map":
        chain, frame = matrix(links[frame].transform) @ chain, links[frame].header.frame_id
    np.testing.assert_allclose(chain, matrix(extrinsics.at(stamp).transform), atol=1e-9)
    assert sorted(links) == ["base_link", "front_optical_frame", "odom"]


def matrix(transform: Any) -> np.ndarray:
    t, q = transform.translation, transform.rotation
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    out[:3, 3] = t.x, t.y, t.z
    return out


class TestOdometryOfAnotherNode:
    ROBOT: ClassVar = {"odometry": "state", "position": [1.0, 0.0], "yaw_deg": 90}

    def odometry(self, stamp: int, x: float, speed: float = 0.0) -> Odometry:
        message = Odometry(header=messages.header(stamp, "odom"), child_frame_id="base_link")
        message.pose.pose.position.x, message.pose.pose.orientation.w = x, 1.0
        message.twist.twist.linear.x = speed
        return message

    def test_it_moves_the_camera_in_step(self, start: Any) -> None:
        graph = start(self.ROBOT)
        pose = graph.subscribe("front/pose")
        state = graph.node.create_publisher(Odometry, "state", 10)
        first = graph.play(1)[0]
        np.testing.assert_allclose(position(pose.at(first)), [0.8, 0.1, 0.9], atol=1e-9)
        # half a period old: it is moved at its velocity
        send(graph, state, self.odometry(first + round(0.5e9 * PERIOD), 0.4, 0.8))
        second = graph.play(1)[0]
        np.testing.assert_allclose(position(pose.at(second)), [0.8, 0.52, 0.9], atol=1e-9)

    def test_the_pose_of_a_stamp_holds_when_a_later_one_is_sent_again(self, start: Any) -> None:
        graph = start(self.ROBOT)
        pose = graph.subscribe("front/pose")
        state = graph.node.create_publisher(Odometry, "state", 10)
        period = round(1e9 * PERIOD)
        first = graph.play(1)[0]
        for frames, x in ((1, 0.1), (2, 0.3), (2, 0.3)):
            send(graph, state, self.odometry(first + frames * period, x))
        second = graph.play(1)[0]
        np.testing.assert_allclose(position(pose.at(second)), [0.8, 0.2, 0.9], atol=1e-9)

    def test_a_jump_is_followed_and_wrong_messages_are_not(self, start: Any) -> None:
        graph = start(self.ROBOT)
        pose = graph.subscribe("front/pose")
        state = graph.node.create_publisher(Odometry, "state", 10)
        stamp = graph.play(1)[0]
        send(graph, state, self.odometry(stamp + 1, 0.2))
        send(graph, state, self.odometry(stamp + 2, 7.0))
        send(graph, state, self.odometry(stamp + 3, math.inf))
        stamp = graph.play(1)[0]
        np.testing.assert_allclose(position(pose.at(stamp)), [0.8, 7.1, 0.9], atol=1e-6)

    def test_it_stands_a_moment_after_the_last_odometry(self, start: Any) -> None:
        graph = start(self.ROBOT)
        pose = graph.subscribe("front/pose")
        state = graph.node.create_publisher(Odometry, "state", 10)
        send_at = graph.play(1)[0]
        send(graph, state, self.odometry(send_at, 0.0, 1.0))
        last = graph.play(12)[-1]
        np.testing.assert_allclose(position(pose.at(last)), [0.8, 0.4, 0.9], atol=1e-9)
