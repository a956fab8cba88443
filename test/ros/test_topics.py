"""The table of topics: the nodes publish it and nothing else; messages are serialised to the same bytes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes
from ros_support import rclpy
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.data.messages.cdr import serialised
from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.topics import CameraTopics, scene_topics
from humansim_ros.data.messages.types import is_made
from humansim_ros.ros.graph.qos import offered_profile
from humansim_ros.scene import Frame, Needs, Scene, Simulation

pytest.importorskip("rosbags")  # of the serialiser

#: Every kind of topic: two humans, of whom one is live; moving objects of different shapes; a camera with a
#: lens and a mosaic, and one on a trajectory.
SCENE = """
rate: 20
humans:
  anna: {body: child, motion: walk}
  ben: {body: child, motion: live}
objects:
  ball: {mesh: sphere, size: [0.3, 0.3, 0.3], keyframes: moves.xml}
  seat: {mesh: chair, keyframes: moves.xml, label: true}
cameras:
  fixed:
    size: [96, 80]
    distortion: [-0.2, 0.05, 0, 0, 0]
    position: [3, 0.4, 1.4]
    look_at: [0, 0, 1]
    sensor: {encoding: bayer_rggb8}
  moving: {size: [64, 48], trajectory: way.txt, depth_sensor: {preset: realsense_d435, size: [64, 48]}}
  left:
    size: [64, 48]
    position: [3, 0.4, 1.4]
    look_at: [0, 0, 1]
    stereo: 0.1
    depth_sensor: {model: structured_light, size: [64, 48], aligned: false}
"""
MOVES = keyframes(400, 100, ball=((1, 0, 0.4), (1, 2, 0.4)), seat=((0, 0, 0), (1, 1, 0)))
#: Topics of the nodes that are about the nodes themselves.
OF_NODES = {"/rosout", "/parameter_events", "/diagnostics", "/frame_done"}


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("topics")
    (folder / "moves.xml").write_text(MOVES)
    start = Camera.look_at((3, -0.5, 1.3), (0, 0, 1))
    rotation = " ".join(map(repr, Rotation.from_matrix(start.R.T).as_quat().tolist()))
    (folder / "way.txt").write_text(f"0 3 -0.5 1.3 {rotation}\n5 3 0.5 1.3 {rotation}\n")
    (folder / "scene.yaml").write_text(SCENE)
    return folder / "scene.yaml"


@pytest.fixture(scope="module")
def scene(scene_path: Path) -> Scene:
    return Scene.load(scene_path)


@pytest.fixture(scope="module")
def frames(scene: Scene) -> list[Frame]:
    """The same frame, simulated twice, with all channels."""
    needs = Needs.of(scene_topics(scene))
    with Simulation(scene) as simulation:
        frames = [simulation.frame(3, needs) for _ in range(2)]
        for frame in frames:
            assert set(frame.depth_sensors.values())  # rendered now
        return frames


def topics_of(scene: Scene) -> dict[str, Topic[Any]]:
    return {topic.name: topic for topic in scene_topics(scene)}


def test_the_table_has_every_kind_of_topic_once(scene: Scene) -> None:
    names = [topic.name for topic in scene_topics(scene)]
    assert len(set(names)) == len(names)
    for name in (
        "humans/anna/motion",
        "humans/anna/motion/legend",
        "humans/anna/vertices",
        "humans/anna/mesh",
        "humans/ben/frame",
        "objects/ball/marker",
        "objects/seat/twist",
        "fixed/image_raw",
        "fixed/image_raw/compressed",
        "fixed/image_rect",
        "fixed/depth/image",
        "fixed/depth/image/compressedDepth",
        "fixed/depth/image_rect",
        "fixed/depth/camera_info",
        "fixed/camera_info",
        "fixed/joints",
        "fixed/joints/legend",
        "fixed/keypoints/legend",
        "fixed/body_part/image",
        "fixed/body_part/legend",
        "fixed/material/image",
        "fixed/material/legend",
        "fixed/keypoints/coco17",
        "humans/anna/keypoints/plug_in_gait",
        "fixed/extrinsics",
        "fixed/projection",
        "fixed/alpha/anna/image",
        "fixed/amodal/seat/image",
        "moving/depth_sensor/image_raw",
        "moving/depth_sensor/camera_info",
        "moving/depth_sensor/extrinsics",
        "moving/depth_sensor/points",
        "moving/aligned_depth_to_color/image_raw",
        "moving/points",
        "left/depth_sensor/image",
        "right/image_raw",
        "moving/pose",
        "moving/twist",
        "tf",
        "tf_static",
    ):
        assert name in names
    absent = {"humans/ben/motion", "fixed/pose", "moving/image_rect", "fixed/points", "left/points"}
    assert not {*absent, "right/depth_sensor/image"} & set(names)


def fields(message: Any) -> Any:
    """Content of a message as nested dictionaries and lists."""
    if hasattr(message, "get_fields_and_field_types"):
        types = message.get_fields_and_field_types()
        values = {name: getattr(message, name) for name in types}
        return {name: np.float32(v) if types[name] == "float" else fields(v) for name, v in values.items()}
    if isinstance(message, (list, tuple)):
        return [fields(each) for each in message]
    if isinstance(message, str | bytes | int | float | bool):
        return message
    numbers = np.asarray(message)
    return numbers.dtype.kind, numbers.shape, numbers.tobytes()


def test_rclpy_reads_the_bytes_of_every_topic(scene: Scene, frames: list[Frame]) -> None:
    from rclpy.serialization import deserialize_message

    for topic in scene_topics(scene):
        if is_made(topic.type):
            continue  # of tf2_msgs, which may be absent
        message = topic.message(frames[0])
        data = bytes(serialised(message, topic.type_name))
        back = deserialize_message(data, topic.type)
        assert fields(back) == fields(message), topic.name
        assert serialised(back, topic.type_name) == data, topic.name


def test_bytes_of_a_frame_are_the_same_each_time(scene: Scene, frames: list[Frame]) -> None:
    tables = [topics_of(scene), topics_of(scene)]
    for name in tables[0]:
        first, second = (
            serialised(table[name].message(frame), table[name].type_name)
            for table, frame in zip(tables, frames, strict=True)
        )
        assert first == second, name


def test_stamps_of_all_messages_with_a_header_are_those_of_the_frame(
    scene: Scene, frames: list[Frame]
) -> None:
    from humansim_ros.data.messages import to_nanoseconds

    headers = [getattr(topic.message(frames[0]), "header", None) for topic in scene_topics(scene)]
    stamps = {to_nanoseconds(header.stamp) for header in headers if header is not None}
    assert stamps == {frames[0].stamp} == {150_000_001}


def test_a_rectified_image_shows_the_rectified_depth(scene: Scene, frames: list[Frame]) -> None:
    topic = topics_of(scene)["fixed/depth/image_rect"]
    message = topic.message(frames[0])
    depth = np.frombuffer(message.data, np.float32).reshape(message.height, message.width)
    assert np.array_equal(depth, frames[0].rectified_depth["fixed"], equal_nan=True)
    assert np.isfinite(depth).any()


@pytest.fixture(scope="module")
def nodes(ros: None, scene_path: Path) -> Iterator[list[Any]]:
    from humansim_ros.ros.nodes.camera_rig import CameraRigNode
    from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
    from humansim_ros.ros.nodes.skinner import SkinnerNode

    path = rclpy.parameter.Parameter("scene", value=str(scene_path))
    rig = CameraRigNode(parameter_overrides=[path])
    skinners = [
        SkinnerNode(parameter_overrides=[path, rclpy.parameter.Parameter("human", value=name)])
        for name in ("anna", "ben")
    ]
    nodes = [MotionPlayerNode(parameter_overrides=[path]), *skinners, rig]
    yield [*nodes[:-1], *rig.nodes]
    for node in nodes:
        node.close()
        node.destroy_node()


def test_the_nodes_publish_the_topics_of_the_table(scene: Scene, nodes: list[Any]) -> None:
    publishers = {publisher.topic_name: publisher for node in nodes for publisher in node.publishers}
    table = {f"/{name}": topic for name, topic in topics_of(scene).items()}
    supported = nodes[-1]._renderer.channels
    for name, topic in list(table.items()):
        if not topic.channels <= set(supported) or is_made(topic.type):
            del table[name]
    hidden = {name for name in publishers if name.startswith("/_")}
    assert set(publishers) - OF_NODES - hidden == set(table)
    for name, topic in table.items():
        assert publishers[name].msg_type is topic.type, name
        assert publishers[name].qos_profile == offered_profile(topic), name


def test_a_camera_has_the_optical_frame_that_it_is_given(scene: Scene, frames: list[Frame]) -> None:
    for topic in CameraTopics(scene, scene.scene_cameras["moving"], "lab/eye"):
        message = topic.message(frames[0])
        if topic.name.endswith("depth_sensor/extrinsics"):
            parent_and_child = message.header.frame_id, message.child_frame_id
            assert parent_and_child == ("lab/eye", "lab/eye_depth_optical_frame")
        elif topic.name.endswith(("pose", "twist", "extrinsics")):
            assert message.header.frame_id == "map"
        elif "depth_sensor/" in topic.name:
            assert message.header.frame_id == "lab/eye_depth_optical_frame"
        elif hasattr(message, "header"):
            assert message.header.frame_id == "lab/eye", topic.name
