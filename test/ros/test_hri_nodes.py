"""Nodes that publish ROS4HRI: what libhri subscribes to arrives, live and simulated people are the same.

Names, types and quality of service of the subscriptions are those of libhri 2.9 (src/hri/*.cpp).
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import ROOT, built_package, importable
from ros_support import deliver
from waiting import PATIENCE

from humansim_ros import Scene, Simulation
from humansim_ros.data import messages
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.messages import types
from humansim_ros.data.messages.camera_truth import boxes_message, joint_view_message
from humansim_ros.data.messages.images import image_message
from humansim_ros.data.messages.stacks import hri
from humansim_ros.data.messages.stacks.adapters import adapter_topics
from humansim_ros.errors import HumansimError, RosError, SceneError
from humansim_ros.ros.graph.guarded_node import GuardedNode
from humansim_ros.ros.nodes.recorder import has_message_per_frame
from humansim_ros.testing import SceneGraph

sys.path.append(str(ROOT / "tools"))
from message_mutations import mutated

SCENE = {
    "rate": 10,
    "room": None,
    "humans": {
        "anna": {"body": "adult_woman", "motion": {"file": "wave", "yaw_deg": 30}},
        "ben": {"body": "child", "motion": {"file": "stand", "position": [4.5, 0]}},
    },
    "cameras": {"front": {"size": [160, 120], "position": [2.4, 0.6, 1.5], "look_at": [0, 0, 1.0]}},
}
HRI = {**SCENE, "hri": "front"}
CHANNELS = ("rgb", "depth", "instance", "part", "amodal")


@pytest.mark.nightly
def test_a_camera_on_a_robot_sees_people_as_in_the_simulation() -> None:
    """The camera moves and has a rate of its own. Before the graph of the others: a domain has one clock."""
    camera = {
        "size": [160, 120],
        "mount": "robot",
        "position": [0, 0, 1.2],
        "look_at": [1, 0, 1.1],
        "rate": 5,
    }
    robot = {"path": {"points": [[-3, 0], [-1, 0.4]], "speed": 0.8}, "vibration": 0.002}
    scene = Scene.from_dict({**HRI, "robot": robot, "cameras": {"front": camera}})
    topics = {f"/{topic.name}": topic for topic in adapter_topics(scene)}
    names = ("/tf", "/humans/bodies/b_anna/roi", "/humans/bodies/b_anna/position")
    with SceneGraph(scene) as graph, Simulation(scene, CHANNELS) as simulation:
        received = {name: graph.subscribe(name, topics[name].type, every_frame=False) for name in names}
        graph.play(5)
        graph.spin_until(lambda: all(len(each) >= 2 for each in received.values()))
        frames = {frame.stamp: frame for frame in simulation.frames(5)}
    for name, got in received.items():
        for message in got:
            children = [each.child_frame_id for each in getattr(message, "transforms", ())]
            if name == "/tf" and "body_b_anna" not in children:
                continue  # of the robot
            ((_, expected),) = topics[name].sent(frames[stamp_of(message) or 0])
            assert message == sent(expected), name


@pytest.fixture(scope="module", autouse=True)
def _packages() -> Iterator[None]:
    with importable("hri_msgs", "tf2_msgs"):
        yield


@pytest.fixture(scope="module")
def graph() -> Iterator[SceneGraph]:
    with SceneGraph(loaded(True), namespace="lab") as graph:
        yield graph


def volatile() -> Any:
    """Profile of nearly all subscriptions of libhri."""
    from rclpy.qos import qos_profile_system_default

    return qos_profile_system_default


def latched() -> Any:
    """Profile of its subscriptions to persons and to URDFs: reliable and transient local."""
    from humansim_ros.ros.graph.qos import LATCHED

    return LATCHED


#: Topics of libhri by their type, below /humans.
VOLATILE = {
    "bodies/tracked": "hri_msgs/msg/IdsList",
    "faces/tracked": "hri_msgs/msg/IdsList",
    "persons/tracked": "hri_msgs/msg/IdsList",
    "persons/known": "hri_msgs/msg/IdsList",
    "bodies/b_anna/roi": "hri_msgs/msg/NormalizedRegionOfInterest2D",
    "bodies/b_anna/cropped": "sensor_msgs/msg/Image",
    "bodies/b_anna/skeleton2d": "hri_msgs/msg/Skeleton2D",
    "faces/f_anna/roi": "hri_msgs/msg/NormalizedRegionOfInterest2D",
    "faces/f_anna/cropped": "sensor_msgs/msg/Image",
    "faces/f_anna/landmarks": "hri_msgs/msg/FacialLandmarks",
    "persons/anna/location_confidence": "std_msgs/msg/Float32",
}
LATCHED = {
    "bodies/b_anna/urdf": "std_msgs/msg/String",
    "persons/anna/face_id": "std_msgs/msg/String",
    "persons/anna/body_id": "std_msgs/msg/String",
    "persons/anna/anonymous": "std_msgs/msg/Bool",
}
OTHERS = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/humans/bodies/b_anna/joint_states": "sensor_msgs/msg/JointState",
    "/humans/bodies/b_anna/position": "geometry_msgs/msg/PointStamped",
    "/humans/bodies/b_anna/velocity": "geometry_msgs/msg/TwistStamped",
}


def received_by_libhri(graph: SceneGraph) -> dict[str, Any]:
    return {
        **{
            f"/humans/{name}": graph.subscribe(
                f"/humans/{name}", types.message_type(kind), volatile(), every_frame=False
            )
            for name, kind in VOLATILE.items()
        },
        **{
            f"/humans/{name}": graph.subscribe(
                f"/humans/{name}", types.message_type(kind), latched(), every_frame=False
            )
            for name, kind in LATCHED.items()
        },
        **{
            name: graph.subscribe(name, types.message_type(kind), every_frame=False)
            for name, kind in OTHERS.items()
        },
    }


def sent(message: Any) -> Any:
    """A message as it arrives: float32 fields are rounded."""
    from rclpy.serialization import deserialize_message, serialize_message

    return deserialize_message(serialize_message(message), type(message))


@pytest.mark.slow
def test_what_libhri_subscribes_to_is_the_simulation(graph: SceneGraph) -> None:
    graph.play()
    assert graph.node.count_subscribers("/lab/front/image_raw") == 0  # crops cost nothing yet
    received = received_by_libhri(graph)
    graph.spin_until(lambda: graph.node.count_subscribers("/lab/front/image_raw") == 1)
    graph.play(2)
    graph.spin_until(lambda: all(received.values()), "a topic has no message")
    scene = loaded(True)
    with Simulation(scene, CHANNELS) as simulation:
        frames = {frame.stamp: frame for frame in simulation.frames(3)}
    topics = {f"/{topic.name}": topic for topic in adapter_topics(scene)}
    for name, got in received.items():
        stamp = stamp_of(got[-1]) or max(frames)  # what has no stamp is the same in all frames
        ((_, expected),) = topics[name].sent(frames[stamp])
        assert got[-1] == sent(expected), name


def stamp_of(message: Any) -> int | None:
    """Stamp of a message or its first transform, nanoseconds; None without."""
    for each in (message, *getattr(message, "transforms", ())):
        if hasattr(each, "header"):
            return messages.to_nanoseconds(each.header.stamp)
    return None


def test_lists_come_again_while_no_frame_is_played(graph: SceneGraph) -> None:
    """A node that starts while the scene is paused: its subscriptions are volatile."""
    graph.play()
    graph.forget("/humans/persons/known")
    late = graph.subscribe(
        "/humans/persons/known", types.message_type("hri_msgs/msg/IdsList"), volatile(), every_frame=False
    )
    graph.spin_until(lambda: late.arrived)
    assert late[-1].ids == ["anna", "ben"]


def test_latched_messages_are_sent_when_they_change(graph: SceneGraph) -> None:
    graph.play()
    urdf = graph.subscribe("/humans/bodies/b_anna/urdf", every_frame=False)
    graph.spin_until(lambda: urdf.arrived)
    before = urdf.arrived
    graph.play(2)
    assert urdf.arrived == before == 1


def test_hostile_messages_are_refused_and_the_next_frame_is_published(
    graph: SceneGraph, frame: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """300 messages with changed fields, as tools/fuzz_nodes.py sends them."""
    crop = graph.subscribe("/humans/bodies/b_anna/cropped", every_frame=False)
    tracked = graph.subscribe("/humans/bodies/tracked", every_frame=False)
    graph.spin_until(lambda: graph.node.count_subscribers("/lab/front/image_raw") == 1)
    (node,) = (node for node in graph._running.nodes if node.get_name() == "bridge")  # type: ignore[union-attr]
    unforeseen: list[str] = []
    monkeypatch.setattr(
        GuardedNode, "_log_fault", lambda _, source, text, unexpected: unexpected and unforeseen.append(text)
    )
    source = random.Random(4)
    for _ in range(100):
        for topic, message in frame.items():
            with suppress(HumansimError), np.errstate(over="ignore"):  # as the guard of callbacks does
                deliver(node, topic, mutated(message, source))
    assert unforeseen == []
    (stamp,) = graph.play()
    graph.spin_until(lambda: stamp_of(tracked[-1]) == stamp == stamp_of(crop[-1]))
    assert tracked[-1].ids == ["b_anna"]


# --- one node alone


@cache
def loaded(with_hri: bool) -> Scene:
    return Scene.from_dict(HRI if with_hri else SCENE)


def bridge(with_hri: bool = True, **parameters: Any) -> Any:
    from rclpy.parameter import Parameter

    from humansim_ros.ros.nodes.hri_bridge import HriBridgeNode

    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    return HriBridgeNode(loaded(with_hri), parameter_overrides=overrides)


@pytest.fixture(scope="module")
def frame() -> dict[str, Any]:
    """Messages of a frame that the bridge is made of."""
    scene = loaded(True)
    with Simulation(scene, CHANNELS) as simulation:
        simulated = simulation.frame(0)
    truth = simulated.truth["front"]
    labels, at = scene.labels, (simulated.stamp, "front_optical_frame")
    points = [(labels[name], view) for name, view in truth.keypoints(hri.HRI_KEYPOINTS).items()]
    return {
        "front/boxes": boxes_message([(labels[name], box) for name, box in truth.boxes.items()], *at),
        "front/keypoints/openpose137": joint_view_message(points, *at),
        "front/image_raw": image_message(simulated.views["front"].rgb, "rgb8", *at),
    }


def changed(message: Any, read: Any, field: str, value: Any, row: int = 3) -> Any:
    """Copy of a cloud whose points have another value in a row."""
    points: Any = np.array(read(message))
    points[field][row] = value
    return messages.points.point_cloud(points, message.header)


@pytest.mark.parametrize(
    ("field", "value"),
    [("human", 9), ("human", 2), ("joint", 4), ("joint", 65535), ("visible", 7), ("u", np.nan), ("x", 1e30)],
)
def test_keypoints_that_do_not_fit_are_refused(
    ros: None, frame: dict[str, Any], field: str, value: float
) -> None:
    node = bridge()
    topic = "front/keypoints/openpose137"
    deliver(node, topic, changed(frame[topic], messages.read_joint_view, field, value))
    assert node._counts["drops"] == 1
    deliver(node, topic, frame[topic])
    assert node._counts["drops"] == 1
    node.destroy_node()


def test_images_that_are_no_colours_are_refused(ros: None, frame: dict[str, Any]) -> None:
    node = bridge()
    pixels = np.zeros((120, 160), np.uint16)
    read = node._on_message
    from humansim_ros.data.messages.received import CAMERA_INPUTS

    for encoding, data in (("16UC1", pixels), ("rgb8", np.zeros((4, 4), np.uint8)), ("nonsense", pixels)):
        image = image_message(data, encoding, 1, "front_optical_frame")
        read("front/image_raw", CAMERA_INPUTS["image_raw"].read, image)
    assert node._counts["drops"] == 3
    node.destroy_node()


def test_a_recording_in_lockstep_waits_for_the_lists_only() -> None:
    """People who are not seen have no messages: a frame would never be whole."""
    topics = adapter_topics(loaded(True))
    awaited = [topic.name for topic in topics if has_message_per_frame(topic)]
    lists = ["bodies/tracked", "faces/tracked", "persons/tracked", "persons/known"]
    assert awaited == [f"humans/{name}" for name in lists] == [topic.name for topic in topics[-4:]]


@pytest.mark.nightly
def test_a_run_in_lockstep_records_frames_in_which_nobody_is_seen(ros: None, tmp_path: Path) -> None:
    """The camera goes away and comes back: most topics have no message meanwhile, and nobody waits."""
    here, away = "3 0 1.2 0.5 -0.5 -0.5 0.5", "3 30 1.2 0.5 -0.5 -0.5 0.5"
    (tmp_path / "way.txt").write_text(f"0 {here}\n0.3 {away}\n0.7 {away}\n1 {here}\n")
    camera = {"size": [64, 48], "trajectory": "way.txt"}
    content = {**HRI, "humans": {"anna": SCENE["humans"]["anna"]}, "cameras": {"front": camera}}
    scene = tmp_path / "scene.yaml"
    scene.write_text(yaml.safe_dump(content))
    paths = [str(ROOT), *(str(built_package(name)) for name in ("hri_msgs", "tf2_msgs"))]
    done = subprocess.run(
        [sys.executable, "-m", "humansim_ros", "run", str(scene), "--lockstep", "--frames", "12",
         "--record", str(tmp_path / "bag"), "--topics", "/humans/*,/tf"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found: dict[str, list[int]] = {}
    with BagReader(tmp_path / "bag") as reader:
        for message in reader.messages():
            found.setdefault(reader.topics[message.topic].name, []).append(message.stamp)
    stamps = [1 + k * 100_000_000 for k in range(12)]
    with Simulation(Scene.load(scene), ("instance", "amodal")) as simulation:
        seen = [frame.stamp for frame in simulation.frames(12) if frame.boxes["front"]["anna"].pixels]
    assert stamps[0] in seen and stamps[5] not in seen and stamps[-1] in seen
    for name in ("bodies/tracked", "faces/tracked", "persons/tracked", "persons/known", "anna/joints"):
        assert found[f"/humans/{name}"] == stamps, name
    assert found["/humans/bodies/b_anna/position"] == seen


def test_a_scene_without_adapters_is_published_by_the_parameter(ros: None) -> None:
    node = bridge(False, camera="front")
    names = {topic for topic, _ in node.get_publisher_names_and_types_by_node("hri_bridge", "/")}
    assert {"/humans/bodies/tracked", "/humans/bodies/b_ben/roi", "/tf"} <= names
    node.destroy_node()


@pytest.mark.parametrize(
    ("camera", "text"),
    [
        ("", r"name the camera that sees the people: --ros-args -p camera:=NAME \(front\)"),
        ("left", "no camera 'left'"),
    ],
)
def test_without_its_camera_the_node_says_what_to_do(ros: None, camera: str, text: str) -> None:
    with pytest.raises(SceneError, match=text):
        bridge(False, camera=camera)


@pytest.mark.parametrize(
    ("package", "line"), [("hri_msgs", "ros-jazzy-hri-msgs"), ("tf2_msgs", "make tf2_msgs")]
)
def test_without_the_package_the_node_names_the_line_that_installs_it(
    ros: None, monkeypatch: pytest.MonkeyPatch, package: str, line: str
) -> None:
    monkeypatch.setattr(types, "_is_message_package", lambda name: name != package)
    with pytest.raises(RosError, match=f"{package} is not installed here: sudo apt install .*{line}"):
        bridge()
