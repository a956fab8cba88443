"""Graph of a scene for the tests of users: every frame arrives, in any context, and errors name topics."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from ros_support import rclpy

from humansim_ros.data import messages
from humansim_ros.errors import RosError
from humansim_ros.scene import Scene, Simulation
from humansim_ros.testing import SceneGraph

SCENE = {
    "rate": 20,
    "room": None,
    "humans": {"anna": {"body": "child", "motion": "walk"}},
    "cameras": {"left": {"size": [32, 24], "position": [4, 0, 1.5], "look_at": [0, 0, 1]}},
}
JOINTS = "/lab/humans/anna/joints"


def stamp_of(frame: int) -> int:
    return 1 + frame * 50_000_000


def make_tracker(seconds: float = 0.0, every: int = 1, answers: Any = None, **options: Any) -> Any:
    """A node that answers every image, or some of them, with its header, after some seconds.

    Args:
        seconds: Time that it needs.
        every: Number of images of which it answers the last one.
        answers: Quality of service of its answers.
        options: Options of the node.
    """
    from geometry_msgs.msg import PoseArray
    from sensor_msgs.msg import Image

    node = rclpy.create_node("tracker", namespace="lab", **options)
    poses = node.create_publisher(PoseArray, "poses", answers or 10)
    seen = []

    def on_image(image: Image) -> None:
        time.sleep(seconds)
        seen.append(image)
        if len(seen) % every == 0:
            poses.publish(PoseArray(header=image.header))

    node.create_subscription(Image, "left/image_raw", on_image, 1)
    return node


@contextmanager
def spinning(node: Any) -> Iterator[None]:
    """Spin a node in a thread of its own."""
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    ended = threading.Event()

    def spin() -> None:
        while not ended.is_set():
            executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        executor.remove_node(node)
        executor.shutdown()


@pytest.fixture(scope="module")
def graph(humansim_domain: int) -> Iterator[SceneGraph]:
    with SceneGraph(Scene.from_dict(SCENE), namespace="lab") as graph:
        yield graph


def test_collected_frames_are_the_first_frames_of_simulation() -> None:
    with SceneGraph(Scene.from_dict(SCENE), namespace="/lab") as graph:
        tracker = make_tracker()
        graph.add_node(tracker)
        truth = graph.subscribe("humans/anna/joints")
        images = graph.subscribe("left/image_raw")
        poses = graph.collect("poses", 5)
        scene = graph.scene
    assert [messages.to_nanoseconds(each.header.stamp) for each in poses] == [*map(stamp_of, range(5))]
    simulation = Simulation(scene)
    for number, message in enumerate(poses):
        frame = simulation.frame(number)
        joints = messages.read_joints(truth.at(message))
        np.testing.assert_array_equal(joints.positions[0], frame.humans["anna"].positions)
        assert bytes(images.at(message).data) == frame.views["left"].rgb.tobytes()
    simulation.close()
    with pytest.raises(RosError, match=f"{JOINTS}: no message with stamp 7 ns among 5"):
        truth.at(7)


def test_a_slow_tracker_in_a_thread_of_its_own_gets_every_frame(graph: SceneGraph) -> None:
    """Its queue holds one image."""
    tracker = make_tracker(seconds=0.1)
    with spinning(tracker):
        first = graph.play()[0]
        poses = graph.collect("/lab/poses", 6)
    stamps = [messages.to_nanoseconds(each.header.stamp) for each in poses]
    assert stamps == [first + stamp_of(frame) - 1 for frame in range(1, 7)]
    graph.forget("poses")
    tracker.destroy_node()


def test_a_tracker_that_answers_some_frames_is_collected_without_waiting(graph: SceneGraph) -> None:
    tracker = make_tracker(every=3)
    graph.add_node(tracker)
    poses = graph.collect("poses", 2, every_frame=False)
    stamps = [messages.to_nanoseconds(each.header.stamp) for each in poses]
    assert stamps[1] - stamps[0] == 3 * 50_000_000
    graph.forget("poses")
    graph.remove_node(tracker)
    tracker.destroy_node()


def test_best_effort_answers_and_topics_without_stamps_are_found(graph: SceneGraph) -> None:
    from rclpy.qos import qos_profile_sensor_data
    from std_msgs.msg import Bool

    tracker = make_tracker(answers=qos_profile_sensor_data)
    flags = tracker.create_publisher(Bool, "found", 10)
    graph.add_node(tracker)
    frames = graph.subscribe("scene_time")
    sent = iter(range(100))

    def on_frame(_: Any) -> None:
        flags.publish(Bool(data=next(sent) % 2 == 0))

    tracker.create_subscription(type(graph.wait_for("scene_time")), "scene_time", on_frame, 10)
    assert len(graph.collect("poses", 3)) == 3
    graph.forget("poses")
    assert [type(each) for each in graph.collect("found", 3)] == [Bool] * 3
    assert len(frames) >= 6
    for topic in ("found", "scene_time"):
        graph.forget(topic)
    graph.remove_node(tracker)
    tracker.destroy_node()


def test_latched_messages_come_without_a_frame(graph: SceneGraph) -> None:
    before = graph.play()
    assert graph.wait_for("left/extrinsics").child_frame_id == "left_optical_frame"
    assert graph.play()[0] - before[0] == 50_000_000


def test_an_exception_of_a_tracker_ends_the_test(graph: SceneGraph) -> None:
    node = rclpy.create_node("broken")
    image = type(graph.collect("left/image_raw", 1)[0])

    def on_image(_: Any) -> None:
        raise ZeroDivisionError("of the tracker")

    node.create_subscription(image, "/lab/left/image_raw", on_image, 10)
    graph.add_node(node)
    with pytest.raises(ZeroDivisionError, match="of the tracker"):
        graph.play()
    graph.remove_node(node)
    node.destroy_node()
    graph.play()  # the graph is as before


def test_a_node_that_never_answers_is_named_with_its_topic(
    graph: SceneGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    from geometry_msgs.msg import PoseArray

    def error_of(**options: bool) -> str:
        """Error of a topic without a message, within a limit in which the camera draws its image."""
        for limit in (0.5, 5.0, 50.0):
            monkeypatch.setattr(graph, "limit", limit)
            with pytest.raises(RosError) as caught:
                graph.collect("poses", 2, **options)
            if "not finished" not in str(caught.value):
                break
        return str(caught.value)

    silent = rclpy.create_node("silent", namespace="lab")
    silent.create_publisher(PoseArray, "poses", 10)
    expected = r"frame \d+: no message on /lab/poses from /lab/silent .*within \S+ s \(ROS domain \d+\)"
    assert re.search(expected, error_of())
    assert "no message on /lab/poses from /lab/silent" in error_of(every_frame=False)
    graph.forget("poses")
    silent.destroy_node()
    with pytest.raises(RosError, match="no node publishes /lab/humans/anna/joint; similar topics: " + JOINTS):
        graph.collect("humans/anna/joint", 1)
    with pytest.raises(RosError, match=r"no node publishes /a/b/c; is its node added \(add_node\)\?"):
        graph.wait_for("/a/b/c")


def test_a_node_of_another_context_takes_part_if_it_is_in_the_same_domain(graph: SceneGraph) -> None:
    from rclpy.context import Context

    own, other = Context(), Context()
    rclpy.init(context=own)
    rclpy.init(context=other, domain_id=graph.domain % 99 + 1)
    stranger = make_tracker(context=other)
    with pytest.raises(RosError, match=r"the node tracker is in ROS domain .* fixture humansim_domain"):
        graph.add_node(stranger)
    stranger.destroy_node()
    other.shutdown()
    tracker = make_tracker(context=own)
    graph.add_node(tracker)
    assert len(graph.collect("poses", 3)) == 3
    graph.forget("poses")
    graph.remove_node(tracker)
    tracker.destroy_node()
    own.shutdown()


def test_a_scene_in_memory_has_no_processes() -> None:
    with pytest.raises(RosError, match="write it to a file"):
        SceneGraph(Scene.from_dict(SCENE), processes=True)
