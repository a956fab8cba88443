"""The tree of tf in a bag of ``humansim record``: poses are those of the other topics, and of the nodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros_support  # noqa: F401  # skips without ROS
import yaml
from conftest import importable
from scipy.spatial.transform import Rotation

from humansim_ros.data.engine import run
from humansim_ros.data.evaluation.readers.robot_paths import read_robot_path
from humansim_ros.data.messages.topics import scene_topics
from humansim_ros.data.messages.types import message_type
from humansim_ros.data.recording import SceneRecording
from humansim_ros.errors import SceneError
from humansim_ros.scene import Scene
from humansim_ros.testing import SceneGraph
from humansim_ros.types import Array

highlevel = pytest.importorskip("rosbags.highlevel")
FRAMES = 4
SMALL = {"size": [32, 24]}
PLACED = {**SMALL, "position": [3, 0.4, 1.4], "look_at": [0, 0, 1]}
#: Everything that has a transform, at rest, on a trajectory, and on the robot.
SCENE: dict[str, Any] = {
    "rate": 10,
    "room": None,
    "humans": {"anna": {"body": "child", "motion": {"file": "walk", "position": [0.5, 0]}}},
    "robot": {"path": {"points": [[-2, 1], [0, 3]], "speed": 1.2}},
    "cameras": {
        "still": {**PLACED, "depth_sensor": {"preset": "realsense_d435", **SMALL}, "stereo": 0.1},
        "wrong": {**PLACED, "faults": {"calibration": {"rotation": 2.0, "translation": 0.05}}},
        "moving": {**SMALL, "trajectory": "way.txt"},
        "slow": {**SMALL, "trajectory": "way.txt", "rate": 5},
        "front": {**SMALL, "mount": "robot", "position": [0.1, 0.2, 0.9], "look_at": [1.1, 0.2, 0.9]},
    },
    "scanners": {
        "wall": {"model": "hokuyo_utm30lx", "position": [2.4, -0.6, 0.3], "rotation_deg": [0, 0, 180]},
        "drone": {"model": "hokuyo_utm30lx", "trajectory": "way.txt"},
        "roof": {"model": "hokuyo_utm30lx", "mount": "robot", "position": [0, 0, 1]},
    },
}
PERSON = {"hri": {"camera": "slow"}}


def loaded(folder: Path, **others: Any) -> Scene:
    (folder / "way.txt").write_text("0 3 0 1 0.5 -0.5 -0.5 0.5\n1 3 1 1.5 0.6 -0.48 -0.384 0.512\n")
    (folder / "scene.yaml").write_text(yaml.safe_dump({**SCENE, **others}))
    return Scene.load(folder / "scene.yaml")


def recorded(scene: Scene, bag: Path, *topics: str) -> dict[str, list[tuple[int, Any]]]:
    """Messages of a recording with their log times, by topic."""
    run(SceneRecording.of(scene, FRAMES, topics), bag)
    return read(bag)


def read(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """Messages of a bag with their log times, by topic, as rosbags reads them."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with highlevel.AnyReader([bag]) as reader:
        for connection, time, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    return found


def matrix(transform: Any) -> Array:
    t, q = transform.translation, transform.rotation
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    out[:3, 3] = t.x, t.y, t.z
    return out


def stamp_of(transform: Any) -> int:
    return int(transform.header.stamp.sec) * 10**9 + int(transform.header.stamp.nanosec)


def links_at(found: dict[str, list[tuple[int, Any]]], stamp: int) -> dict[str, Any]:
    """Transforms that hold at a stamp, by child; those of ``/tf`` have just this stamp."""
    ((_, static),) = found["/tf_static"]
    moving = [each for time, message in found["/tf"] if time == stamp for each in message.transforms]
    assert {stamp_of(each) for each in moving} == {stamp}
    links = {each.child_frame_id: each for each in (*static.transforms, *moving)}
    assert len(links) == len(static.transforms) + len(moving)  # one parent each
    return links


def in_map(links: dict[str, Any], frame: str) -> Array:
    pose = np.eye(4)
    while frame != "map":
        pose, frame = matrix(links[frame].transform) @ pose, links[frame].header.frame_id
    return pose


def test_the_tree_of_a_bag_has_the_poses_of_all_extrinsics(tmp_path: Path) -> None:
    scene = loaded(tmp_path)
    found = recorded(scene, tmp_path / "bag", "/*/extrinsics", "/tf*", "/odom")
    assert len(found["/tf"]) == FRAMES and len(found["/tf_static"]) == 1
    compared, places = set[str](), dict[str, list[Array]]()
    for topic, messages in found.items():
        for stamp, message in messages:
            if not topic.endswith("/extrinsics") or topic.endswith("truth/extrinsics"):
                continue
            links = links_at(found, stamp)
            frame = message.child_frame_id
            expected = in_map(links, message.header.frame_id) @ matrix(message.transform)
            np.testing.assert_allclose(in_map(links, frame), expected, atol=1e-9)
            compared.add(frame)
            places.setdefault(frame, []).append(expected)
    names = ("still", "still_right", "wrong", "moving", "slow", "front")
    frames = {f"{name}_optical_frame" for name in names} | {f"{name}_frame" for name in scene.scanners}
    assert compared == {*frames, "still_depth_optical_frame"}
    for name, count in {"moving": FRAMES, "slow": FRAMES // 2, "front": FRAMES}.items():
        moved = places[f"{name}_optical_frame"]
        assert len(moved) == count and np.abs(moved[-1] - moved[0]).max() > 0.05
    # the calibration lies, and so does tf
    ((_, truth),) = found["/wrong/truth/extrinsics"]
    error = matrix(truth.transform) - in_map(links_at(found, 1), "wrong_optical_frame")
    assert np.abs(error).max() > 0.01


def test_static_transforms_are_latched_and_topics_without_transforms_are_absent(tmp_path: Path) -> None:
    from rosbags.rosbag2 import Reader

    recorded(loaded(tmp_path), tmp_path / "bag", "/tf*")
    with Reader(tmp_path / "bag") as reader:
        offers = {each.topic: each.ext.offered_qos_profiles for each in reader.connections}
    assert {topic: qos[0].durability.name for topic, qos in offers.items()} == {
        "/tf_static": "TRANSIENT_LOCAL",
        "/tf": "VOLATILE",
    }
    without = {"scanners": {}, "robot": None}
    still = loaded(tmp_path, cameras={"still": SCENE["cameras"]["still"]}, **without)
    moving = loaded(tmp_path, cameras={"moving": SCENE["cameras"]["moving"]}, **without)
    for scene, name in ((still, "tf_static"), (moving, "tf")):
        assert [topic.name for topic in scene_topics(scene) if topic.name.startswith("tf")] == [name]


def test_the_path_of_the_robot_is_read_from_the_bag_alone(tmp_path: Path) -> None:
    scene, bag = loaded(tmp_path), tmp_path / "bag"
    recorded(scene, bag, "/odom", "/tf*")
    assert scene.robot is not None
    expected = [scene.robot.base_at(number / SCENE["rate"]).position[:2] for number in range(FRAMES)]
    for topic in ("/odom", "/tf"):
        path = read_robot_path(f"{bag}:{topic}", None)
        np.testing.assert_allclose(path.places[:, :2], expected, atol=1e-9)


def test_people_and_robot_share_a_message_and_people_rest_with_their_camera(tmp_path: Path) -> None:
    found = recorded(loaded(tmp_path, **PERSON), tmp_path / "bag", "/tf*", "/humans/anna/joints")
    assert [time for time, _ in found["/tf"]] == [time for time, _ in found["/humans/anna/joints"]]
    for number, (_, message) in enumerate(found["/tf"]):
        children = {each.child_frame_id for each in message.transforms}
        assert {"base_link", "moving_optical_frame", "drone_frame"} <= children
        seen = {"body_b_anna", "person_anna", "slow_optical_frame"}
        assert seen & children == (seen if number % 2 == 0 else set())
    stamp = found["/tf"][2][0]
    hips = in_map(links_at(found, stamp), "body_b_anna")[:3, 3]
    joints = found["/humans/anna/joints"][2][1]
    places = dict(zip(joints.joint_names, joints.transforms, strict=True))
    left, right = (matrix(places[name])[:3, 3] for name in ("l_hip", "r_hip"))
    np.testing.assert_allclose(hips, (left + right) / 2, atol=1e-6)


def test_an_adapter_is_refused_the_name_of_a_topic_of_tf(tmp_path: Path) -> None:
    scene = loaded(tmp_path, adapters={"people": {"topic": "/tf"}})
    with pytest.raises(SceneError, match="the scene has the topic tf, too: give"):
        scene_topics(scene)


def by_frame(messages: list[tuple[int, Any]], stamped: bool) -> dict[tuple[int, str], tuple[str, Any]]:
    """Parent and pose by stamp and child frame; ``stamped``: without it, the stamp is 0."""
    return {
        (stamp_of(each) if stamped else 0, each.child_frame_id): (
            each.header.frame_id,
            matrix(each.transform).tolist(),
        )
        for _, message in messages
        for each in message.transforms
    }


def test_a_recorder_of_nodes_in_a_namespace_has_the_same_transforms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rclpy.parameter import Parameter

    from humansim_ros.ros.nodes.recorder import RecorderNode
    from humansim_ros.ros.processes import transforms

    scene, bag = loaded(tmp_path), tmp_path / "live"
    expected = recorded(scene, tmp_path / "bag", "/tf*")
    values = {"output": str(bag), "scene": str(scene.path), "topics": ["/tf*", "moving/extrinsics"]}
    parameters = [Parameter(name, value=value) for name, value in values.items()]
    with importable("tf2_msgs"), SceneGraph(scene, namespace="lab") as graph:
        monkeypatch.setattr(transforms, "TFMessage", message_type("tf2_msgs/msg/TFMessage"))
        recorder = RecorderNode(namespace="lab", parameter_overrides=parameters)
        graph.add_node(recorder)
        first = graph.play()[-1]
        graph.spin_until(lambda: graph.node.count_subscribers("/tf"))
        graph.play(FRAMES - 1)
        graph.remove_node(recorder)
        recorder.complete()
        recorder.destroy_node()
    found = read(bag)
    defaults = {topic.in_namespace("/lab") for topic in scene_topics(scene) if topic.recorded}
    assert defaults > found.keys() == {"/tf", "/tf_static", "/lab/moving/extrinsics"}
    assert by_frame(found["/tf_static"], False) == by_frame(expected["/tf_static"], False)
    sent, simulated = by_frame(found["/tf"], True), by_frame(expected["/tf"], True)
    assert len({stamp for stamp, _ in sent if stamp > first}) == FRAMES - 1
    # the recorder may have come after the first frame
    assert {key: simulated[key] for key in simulated if key in sent or key[0] > first} == sent
