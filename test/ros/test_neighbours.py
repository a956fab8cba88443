"""Other nodes in the domain whose messages mix with those of a node."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ros_support import Client, write_scene

from humansim_ros.ros.graph import graph as neighbours
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.ros.processes.runtime import make_executor


class Suite:
    """Nodes of a scene with a client, and the lines of their log."""

    def __init__(self, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
        self.scene, self._capfd, self.log = write_scene(folder), capfd, ""
        self.client = Client("neighbour", make_executor())
        self.nodes: list[Any] = []

    def start(self, kind: type, namespace: str = "home", name: str = "", **parameters: str) -> Any:
        from rclpy.parameter import Parameter

        given = [
            Parameter(key, value=value) for key, value in {"scene": str(self.scene), **parameters}.items()
        ]
        arguments = ["--ros-args", "-r", f"__node:={name}"] if name else []
        self.nodes.append(kind(parameter_overrides=given, namespace=namespace, cli_args=arguments))
        self.client.executor.add_node(self.nodes[-1])
        return self.nodes[-1]

    def warnings(self) -> list[str]:
        self.log += self._capfd.readouterr().err
        return [line for line in self.log.splitlines() if "another node" in line]

    def checks(self, node: Any, count: int) -> None:
        """Spin until a node has looked at the graph some times."""
        done: list[None] = []
        check = node.neighbours.check
        timer = node.create_timer(0.02, lambda: (check(), done.append(None)))
        assert self.client.spin_until(lambda: len(done) >= count)
        node.destroy_timer(timer)


@pytest.fixture
def suite(
    ros: None, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Suite]:
    monkeypatch.setattr(neighbours, "_SEEN_FOR", 0.05)
    made = Suite(tmp_path, capfd)
    yield made
    for node in made.nodes:
        node.destroy_node()
    made.client.close()


def test_a_second_suite_is_named_once_with_its_topics(suite: Suite) -> None:
    first = suite.start(MotionPlayerNode)
    suite.checks(first, 2)  # alone
    suite.start(MotionPlayerNode)
    assert suite.client.spin_until(suite.warnings)
    suite.checks(first, 10)
    (line,) = suite.warnings()
    assert "another node is called /home/motion_player and publishes /home/humans/" in line
    assert "ROS_DOMAIN_ID or namespace" in line


def test_a_killed_node_of_which_the_middleware_still_knows_is_not_named(suite: Suite) -> None:
    suite.start(MotionPlayerNode)
    restarted = suite.start(MotionPlayerNode)
    suite.nodes[0].neighbours._named.add("/home/motion_player")
    suite.checks(restarted, 20)
    assert suite.warnings() == []


def test_a_suite_that_stays_is_named_by_the_one_that_started_later(
    suite: Suite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(neighbours, "_DEAD_FOR", 0.2)
    suite.start(MotionPlayerNode)
    second = suite.start(MotionPlayerNode)
    suite.nodes[0].neighbours._named.add("/home/motion_player")
    assert suite.client.spin_until(suite.warnings)
    assert second.neighbours._named == {"/home/motion_player"}


def test_a_suite_in_another_namespace_is_not_named(suite: Suite) -> None:
    nodes = [suite.start(kind, space) for space in ("one", "two") for kind in (MotionPlayerNode, SkinnerNode)]
    for node in nodes:
        suite.checks(node, 5)
    assert suite.warnings() == []


def test_the_camera_processes_of_a_suite_do_not_name_each_other(suite: Suite) -> None:
    cameras = [suite.start(CameraNode, name=name, camera=name) for name in ("left", "right")]
    for camera in cameras:
        suite.checks(camera, 10)
    assert suite.warnings() == []
    for camera in cameras:
        camera.close()


def test_a_bag_beside_a_suite_is_named(suite: Suite) -> None:
    """That is: a node of any name with a topic of the suite."""
    from sensor_msgs.msg import TimeReference

    player = suite.start(MotionPlayerNode)
    suite.client.node.create_publisher(TimeReference, "/home/scene_time", 1)
    assert suite.client.spin_until(suite.warnings)
    suite.checks(player, 5)
    (line,) = suite.warnings()
    assert "another node, /neighbour, publishes /home/scene_time: " in line


def test_two_senders_of_a_motion_are_both_named_whatever_they_send(suite: Suite) -> None:
    from sensor_msgs.msg import MultiDOFJointState

    skinner = suite.start(SkinnerNode)
    suits = [Client(f"suit_{number}") for number in (1, 2)]
    for suit in suits:
        suit.node.create_publisher(MultiDOFJointState, "/home/humans/first/motion", 1)
    assert suite.client.spin_until(lambda: len(suite.warnings()) >= 2)
    suite.checks(skinner, 5)
    assert len(suite.warnings()) == 2
    assert all(f"/suit_{number}" in suite.log for number in (1, 2))
    for suit in suits:
        suit.close()
