"""Node ``bridge``: the live messages are those of a simulation, and trackers' messages are evaluated live."""

from __future__ import annotations

import math
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import adapter_scene
import numpy as np
import pytest
import ros_support
from adapter_scene import SCENE
from conftest import ROOT, built_package, importable
from waiting import PATIENCE, wait_until

sys.path.append(str(ROOT / "tools"))

from humansim_ros import Scene, Simulation
from humansim_ros.data import messages
from humansim_ros.data.messages.cameras import transform_message
from humansim_ros.data.messages.cdr import serialised
from humansim_ros.data.messages.people import read_boxes_2d, read_people
from humansim_ros.data.messages.stacks.adapters import adapter_topics
from humansim_ros.errors import EvaluationError, RosError, SceneError
from humansim_ros.testing import SceneGraph

#: Packages of the adapters; the tests of each day build one of them only.
ALL = ("vision_msgs", "people_msgs", "spencer_tracking_msgs")
#: Without scans, and with a camera on the robot that takes a picture in each second frame only.
AHEAD = {**SCENE["cameras"]["ahead"], "rate": 10}
write = partial(adapter_scene.write, scanners={}, cameras={**SCENE["cameras"], "ahead": AHEAD})
ADAPTERS = {
    "detections_2d": {},
    "detections_3d": "ahead_optical_frame",
    "people": "base_link",
    "tracked_persons": {"frame": "odom", "camera": "ahead"},
}


@pytest.fixture
def people_msgs() -> Iterator[None]:
    with importable("people_msgs"):
        yield


@pytest.fixture
def all_packages() -> Iterator[None]:
    with importable(*ALL):
        yield


def expected(scene: Scene, frames: int) -> dict[str, list[bytes]]:
    """Serialised messages of the first frames of a simulation by topic."""
    found: dict[str, list[bytes]] = {}
    with Simulation(scene, ("instance", "amodal")) as simulation:
        for index in range(frames):
            frame = simulation.frame(index)
            for topic in adapter_topics(scene):
                for _, message in topic.sent(frame) if topic.per_frame or not index else ():
                    data = bytes(serialised(message, topic.type_name))
                    found.setdefault(topic.name, []).append(data)
    return found


def check_live_messages(scene: Scene, frames: int) -> None:
    """Compare live messages with those of a simulation, but for the first stamps."""
    theirs = expected(scene, frames)
    topics = {topic.name: topic for topic in adapter_topics(scene)}
    with SceneGraph(scene) as graph:
        received = {name: graph.subscribe(name, every_frame=False) for name in topics}
        graph.play(frames)
        for name in topics:
            graph.spin_until(lambda name=name: len(received[name]) >= len(theirs[name]), name)
        for name, topic in topics.items():
            ours = {}
            for message in received[name][:]:  # a frame may be sent twice
                ours[messages.to_nanoseconds(message.header.stamp)] = message
            assert [bytes(serialised(message, topic.type_name)) for message in ours.values()] == theirs[name]


@pytest.mark.slow
def test_live_people_are_those_of_a_simulation(people_msgs: None, tmp_path: Path) -> None:
    check_live_messages(Scene.load(write(tmp_path, {"people": "base_link"})), 4)


@pytest.mark.nightly
def test_all_live_messages_are_those_of_a_simulation(all_packages: None, tmp_path: Path) -> None:
    """Also of a camera that moves, and takes a picture in each second frame only."""
    check_live_messages(Scene.load(write(tmp_path, ADAPTERS)), 6)


def make_bridge(scene: Path) -> Any:
    from rclpy.parameter import Parameter

    from humansim_ros.ros.nodes.bridge import BridgeNode

    return BridgeNode(parameter_overrides=[Parameter("scene", value=str(scene))])


def test_a_scene_without_adapters_is_refused(ros: None, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="the scene has no adapters") as caught:
        make_bridge(write(tmp_path, {}))
    assert caught.value.key == "adapters"


@pytest.mark.parametrize(
    ("adapter", "line"),
    [
        ("detections_2d", "sudo apt install ros-jazzy-vision-msgs"),
        ("people", "not released for Jazzy: git clone -b ros2 https://github.com/wg-perception/people"),
        ("tracked_persons", "not released for Jazzy: docs/people_messages.md says"),
    ],
)
def test_an_absent_package_is_refused(ros: None, tmp_path: Path, adapter: str, line: str) -> None:
    with pytest.raises(RosError, match=f"is not installed here: (it is )?{line}"):
        make_bridge(write(tmp_path, {adapter: {}}))


@pytest.mark.nightly
def test_a_run_without_the_package_ends_with_code_2(ros: None, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "humansim_ros", "run", str(write(tmp_path, {"people": {}})), "--lockstep"],
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "the message package people_msgs is not installed here" in done.stderr
    assert "Traceback" not in done.stderr and "starting" not in done.stdout


@pytest.mark.nightly
def test_a_run_records_the_adapters_and_the_evaluation_reads_them(ros: None, tmp_path: Path) -> None:
    """Processes in lockstep: the bag has each frame, and the same messages as ``humansim record``."""
    from humansim_ros import evaluate

    scene, paths = write(tmp_path, {"people": "map"}), [str(ROOT), str(built_package("people_msgs"))]
    done = subprocess.run(
        [sys.executable, "-m", "humansim_ros", "run", str(scene), "--lockstep", "--frames", "12",
         "--record", str(tmp_path / "bag"), "--topics", "/people"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    data = evaluate(scene, f"{tmp_path / 'bag'}:/people").data
    assert data["people"]["found"] == 36 and data["position"]["mpjpe"] < 1e-9
    assert data["live"]["frames"] == 12


@pytest.mark.nightly
def test_a_people_tracker_is_evaluated_live(people_msgs: None, tmp_path: Path) -> None:
    """The bridge is the tracker."""
    from test_evaluator import compute, make_evaluator

    scene = Scene.load(write(tmp_path, {"people": "map"}))
    with SceneGraph(scene) as graph:
        node = make_evaluator(topic="/people", use_sim_time=True, scene=str(scene.path))
        graph.add_node(node)
        graph.play(8)
        graph.spin_until(lambda: len(node.evaluation.estimate) >= 5)
        compute(node)
        result = node._results["total"]
        assert result.position.mpjpe < 1e-9 and result.people.found >= 10
        assert result.tracking is not None and result.tracking.idf1 == 1.0


@pytest.mark.nightly
def test_hostile_boxes_leave_the_node_running(all_packages: None, ros: None, tmp_path: Path) -> None:
    from sensor_msgs.msg import PointCloud2

    node = make_bridge(write(tmp_path, {"detections_2d": {"cameras": ["fixed"]}}))
    try:
        ros_support.deliver(node, "/fixed/boxes", PointCloud2(header=messages.header(5, "fixed")))
        ros_support.deliver(node, "/fixed/boxes", PointCloud2(width=2**31, height=2**31))
        assert node._counts["drops"] == 2
    finally:
        node.close()
        node.destroy_node()


@pytest.mark.nightly
@pytest.mark.parametrize("adapter", list(ADAPTERS))
def test_hostile_messages_of_trackers_are_refused_or_finite(
    all_packages: None, tmp_path: Path, adapter: str
) -> None:
    from message_mutations import mutated, mutated_bytes
    from rclpy.serialization import serialize_message

    from humansim_ros.data.messages.cdr import deserialised

    scene = Scene.load(write(tmp_path, {adapter: {}}))
    topic = next(each for each in adapter_topics(scene) if each.per_frame)
    with Simulation(scene, ("instance", "amodal")) as simulation:
        message = topic.message(simulation.frame(4))
    source, refused = random.Random(adapter), 0
    for _ in range(500):
        data = serialize_message(mutated(message, source))
        if source.random() < 0.3:
            data = mutated_bytes(data, source)
        try:
            content = deserialised(data, topic.type)
            if adapter == "detections_2d":
                numbers = [value for row in read_boxes_2d(content) for value in row]
            else:
                people = read_people(topic.type_name, content, None).people
                numbers = [value for pose in people for value in pose.positions.ravel() if value == value]
            assert all(abs(value) <= 1e9 or math.isinf(value) for value in numbers)
        except (EvaluationError, RosError):
            refused += 1
    assert 20 < refused < 480


@pytest.mark.nightly
def test_live_estimates_in_a_frame_of_tf_are_converted(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until the transform arrives, messages are refused with the name of the frame."""
    import rclpy

    from humansim_ros.data.evaluation.readers.pose_files import ReadOptions
    from humansim_ros.ros.graph.guarded_node import GuardedNode
    from humansim_ros.ros.processes import estimate_topics

    with importable("people_msgs", "tf2_msgs"):
        from people_msgs.msg import People, Person
        from tf2_msgs.msg import TFMessage

        monkeypatch.setattr(estimate_topics, "TFMessage", TFMessage)
        sender, node = rclpy.create_node("tracker"), GuardedNode("reader")
        publisher = sender.create_publisher(People, "/tracker", 1)
        found: list[Any] = []
        try:
            topics = estimate_topics.PoseTopics(
                node, "/tracker", ReadOptions(), lambda frame, *_: found.append(frame)
            )
            assert wait_until(lambda: topics.discover() or topics.found)
            message = People(header=messages.header(7, "laser"), people=[Person(name="a")])
            message.people[0].position.x = 2.0
            ros_support.deliver(node, "/tracker", message)
            assert topics.ignored == 1 and not found
            quarter = np.array([0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4)])
            pose = transform_message(np.array([1.0, 0.0, 0.3]), quarter, 5, "map", "laser")
            ros_support.deliver(node, "/tf_static", TFMessage(transforms=[pose]))
            ros_support.deliver(node, "/tracker", message)
            ((person,),) = (frame.people for frame in found)
            np.testing.assert_allclose(person.positions, [[1.0, 2.0, 0.3]], atol=1e-12)
            assert found[0].frame_id == "map" and publisher is not None
            topics.close()
        finally:
            node.destroy_node()
            sender.destroy_node()
