"""Truth in the messages of other people stacks, and people who are read from such messages."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from adapter_scene import write
from conftest import ROOT
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, Simulation
from humansim_ros.data import messages
from humansim_ros.data.bags.topics import is_defined, message_types
from humansim_ros.data.messages import types
from humansim_ros.data.messages.camera_truth import boxes_message
from humansim_ros.data.messages.cdr import serialised
from humansim_ros.data.messages.people import DETECTIONS_2D, GROUND, MESSAGE_TYPES, read_people
from humansim_ros.data.messages.received import received_frame
from humansim_ros.data.messages.stacks.adapters import ADAPTERS, adapter_topics
from humansim_ros.data.messages.stacks.people_messages import SPENCER_MSGS, VISION_MSGS
from humansim_ros.data.messages.topics import scene_topics
from humansim_ros.errors import EvaluationError, RosError, SceneError
from humansim_ros.scene.config.config import AdaptersConfig
from humansim_ros.scene.core.frame import Frame
from humansim_ros.scene.truth import standing

ALL = {
    "detections_2d": {},
    "detections_3d": "base_link",
    "people": "base_link",
    "tracked_persons": {"frame": "fixed_optical_frame", "camera": "fixed"},
}


def topics_of(scene: Scene, adapters: dict[str, Any]) -> dict[str, Any]:
    config = scene.config.model_copy(update={"adapters": AdaptersConfig.model_validate(adapters)})
    return {topic.name: topic for topic in adapter_topics(replace(scene, config=config))}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene.load(write(tmp_path_factory.mktemp("scene"), ALL))


@pytest.fixture(scope="module")
def frames(scene: Scene) -> Iterator[Callable[[int], Frame]]:
    with Simulation(scene, ("instance", "amodal")) as simulation:
        known: dict[int, Frame] = {}

        def frame(index: int) -> Frame:
            if index not in known:
                known[index] = simulation.frame(index)
                _ = known[index].boxes
            return known[index]

        yield frame


def xyz(point: Any) -> Any:
    return np.array([point.x, point.y, point.z])


def turned(rotation: Any) -> Rotation:
    return Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w])


def hips(frame: Frame, name: str) -> Any:
    """Point on the floor below the hips."""
    state = frame.humans[name]
    joints = dict(zip(state.joint_names, state.positions, strict=True))
    x, y, _ = (joints["l_hip"] + joints["r_hip"]) / 2
    return np.array([x, y, 0.0])


# --- packages


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Detection2DArray", "214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968"),
        ("Detection3DArray", "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018"),
        ("LabelInfo", "3d37df4015cdf660cc851c51897f2acd957e1ca6205ba0a99aebffb9406b0783"),
        ("VisionClass", "1e4a11f0fed50b5623cb8ff26ca0e37952a48a9c074d16f804b44e9164c2037a"),
    ],
)
def test_definitions_have_the_hashes_of_ros(name: str, expected: str) -> None:
    """The hashes are from the code that rosidl generates of vision_msgs 4."""
    assert is_defined(f"vision_msgs/msg/{name}")
    assert message_types().hash_rihs01(f"vision_msgs/msg/{name}") == f"RIHS01_{expected}"


@pytest.mark.parametrize("package", types.MESSAGE_PACKAGES.values())
def test_all_fields_that_are_written_are_defined(package: types.MessagePackage) -> None:
    for name, fields in package.fields.items():
        assert is_defined(f"{package.name}/msg/{name}")
        known = types.made_type(f"{package.name}/msg/{name}").get_fields_and_field_types()
        assert set(fields.split()) <= known.keys()


def test_a_row_for_each_key_of_the_section() -> None:
    assert list(ADAPTERS) == [*AdaptersConfig.model_fields, "hri"]
    for name, row in ADAPTERS.items():
        assert (row.type in (*MESSAGE_TYPES, DETECTIONS_2D)) == (name != "hri")


def test_the_documents_have_all_rows() -> None:
    page = (ROOT / "docs" / "people_messages.md").read_text()
    for name, row in ADAPTERS.items():
        assert f"| `{name}` | `/{row.topic}` | {row.type.replace('/msg/', '/')}" in page


def test_an_absent_package_is_refused_with_the_line_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(types, "_is_message_package", lambda _: False)
    with pytest.raises(RosError, match=r"vision_msgs is not installed.*apt install ros-jazzy-vision-msgs"):
        VISION_MSGS.check(installed=True)
    unknown = types.MessagePackage("no_such_msgs", "1", "sudo apt install it", {"Message": "field"})
    with pytest.raises(RosError, match=r"no_such_msgs is not installed here: sudo apt install it"):
        unknown.check(installed=False)


@pytest.mark.parametrize("lacks", ["Pose2D", "Detection2D.id"])
def test_another_version_is_refused(lacks: str, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """vision_msgs 3 has no Pose2D; vision_msgs 2 has tracking_id in place of id."""
    message, _, field = lacks.partition(".")

    def installed(full_name: str) -> Any:
        name = full_name.rpartition("/")[2]
        if name == message and not field:
            raise RosError(f"the package vision_msgs that is installed here has no message {name}")
        fields = dict.fromkeys(VISION_MSGS.fields[name].split(), "")
        if name == message:
            fields.pop(field)
        return SimpleNamespace(get_fields_and_field_types=lambda: fields)

    monkeypatch.setattr(types, "_is_message_package", lambda _: True)
    monkeypatch.setattr(types, "message_type", installed)
    with pytest.raises(RosError, match=rf"{field or message}: version 4.1 of vision_msgs is needed"):
        topics_of(scene, {"detections_2d": {}})


# --- settings


@pytest.mark.parametrize(
    ("adapters", "key", "text"),
    [
        ({"people": {"frame": "base_lnk"}}, "adapters.people.frame", "did you mean 'base_link'"),
        (
            {"people": "world"},
            "adapters.people.frame",
            "there are map, odom, base_link, fixed_op",
        ),
        ({"detections_2d": {"cameras": ["left"]}}, "adapters.detections_2d.cameras", "no camera 'left'"),
        (
            {"tracked_persons": {"camera": "left"}},
            "adapters.tracked_persons.camera",
            "no camera 'left'; there are fixed",
        ),
        ({"detections_2d": {"cameras": []}}, "adapters.detections_2d.cameras", "at least one"),
        ({"people": {"frame": "a b"}}, "adapters.people.frame", "a frame of tf"),
        ({"peple": {}}, "adapters.peple", "did you mean `people`"),
        ({"people": {"topic": "odom"}}, "adapters.people.topic", "the scene has the topic odom, too"),
        ({"people": {"topic": "/clock"}}, "adapters.people.topic", "the scene has the topic clock, too"),
        (
            {"people": {"topic": "a"}, "detections_3d": {"topic": "/a"}},
            "adapters.people.topic",
            "adapters.detections_3d has the topic a, too: give adapters.people another 'topic'",
        ),
        (
            {"people": {}, "detections_3d": {"topic": "people"}},
            "adapters.detections_3d.topic",
            "adapters.people has the topic people, too: give adapters.detections_3d another 'topic'",
        ),
        (
            {"detections_2d": {"topic": "a"}, "people": {"topic": "fixed/a/label_info"}},
            "adapters.people.topic",
            "adapters.detections_2d has the topic fixed/a/label_info, too",
        ),
    ],
)
def test_wrong_settings_are_refused(tmp_path: Path, adapters: dict[str, Any], key: str, text: str) -> None:
    with pytest.raises(SceneError, match=text) as caught:
        scene_topics(Scene.load(write(tmp_path, adapters)))
    assert caught.value.key == key and caught.value.path is not None and caught.value.line


def test_a_scene_without_adapters_has_the_topics_that_it_had(tmp_path: Path) -> None:
    with_them = scene_topics(Scene.load(write(tmp_path, ALL)))
    names = [topic.name for topic in scene_topics(Scene.load(write(tmp_path, {})))]
    tf = ["tf_static", "tf"]
    assert names[-2:] == [topic.name for topic in with_them[-2:]] == tf
    assert [topic.name for topic in with_them][: len(names) - 2] == names[:-2]
    assert len(with_them) == len(names) + 8


# --- content


def test_people_are_below_their_hips_in_the_axes_of_the_robot(
    frames: Callable[[int], Frame], scene: Scene
) -> None:
    """``odom`` of the scene has the pose of base_link, without the vibration of its body."""
    frame, topic = frames(12), topics_of(scene, ALL)["people"]
    message = topic.message(frame)
    assert message.header.frame_id == "base_link"
    assert messages.to_nanoseconds(message.header.stamp) == frame.stamp
    base = frame.robot
    assert base is not None
    back = Rotation.from_quat(base.rotation).inv()
    assert [person.name for person in message.people] == ["anna", "ben", "away"]
    for person in message.people:
        expected = back.apply(hips(frame, person.name) - base.position)
        np.testing.assert_allclose(xyz(person.position), expected, atol=1e-9)
        assert person.reliability == 1 and dict(zip(person.tagnames, person.tags, strict=True)) == {
            "instance": str(frame.labels[person.name])
        }


def test_velocities_are_over_the_ground_in_the_axes_of_the_frame(
    frames: Callable[[int], Frame], scene: Scene
) -> None:
    """Differences of positions in ``map``, turned: the own motion of the robot is not in them."""
    frame, topic = frames(12), topics_of(scene, ALL)["people"]
    base = frame.robot
    assert base is not None and base.velocity is not None and np.linalg.norm(base.velocity.linear) > 1
    back, seconds, step = Rotation.from_quat(base.rotation).inv(), frame.scene_time * 1e-9, 1e-3
    for person in topic.message(frame).people:
        states = [scene.actors[person.name].at(seconds + side * step) for side in (-1, 1)]
        early, late = (standing(state).position for state in states)
        np.testing.assert_allclose(xyz(person.velocity), back.apply((late - early) / (2 * step)), atol=2e-3)
    assert np.linalg.norm(xyz(topic.message(frame).people[0].velocity)) > 0.5


def test_tracks_have_pose_and_turning_in_the_axes_of_a_camera(
    frames: Callable[[int], Frame], scene: Scene
) -> None:
    frame = frames(12)
    camera, seconds, step = scene.scene_cameras["fixed"].camera, frame.scene_time * 1e-9, 1e-3
    message = topics_of(scene, ALL)["spencer/perception/tracked_persons"].message(frame)
    assert message.header.frame_id == "fixed_optical_frame"
    assert [track.track_id for track in message.tracks] == [frame.labels[name] for name in frame.humans]
    for name, track in zip(frame.humans, message.tracks, strict=True):
        np.testing.assert_allclose(
            xyz(track.pose.pose.position), camera.R @ hips(frame, name) + camera.t, atol=1e-9
        )
        forward = camera.R.T @ turned(track.pose.pose.orientation).apply([1.0, 0.0, 0.0])
        state = frame.humans[name]
        joints = dict(zip(state.joint_names, state.positions, strict=True))
        across = joints["l_hip"] - joints["r_hip"]
        np.testing.assert_allclose(
            forward, np.cross([*across[:2], 0], [0, 0, 1]) / math.hypot(*across[:2]), atol=1e-9
        )
        turns = [standing(scene.actors[name].at(seconds + side * step)).rotation for side in (-1, 1)]
        yaws = Rotation.from_quat(turns).as_euler("zyx")[:, 0]
        turning = camera.R.T @ xyz(track.twist.twist.angular)
        np.testing.assert_allclose(turning, [0, 0, (yaws[1] - yaws[0]) / (2 * step)], atol=2e-3)
        assert not np.any(track.pose.covariance) and not np.any(track.twist.covariance)
        assert track.age.sec * 10**9 + track.age.nanosec == frame.scene_time
        assert track.is_matched is not track.is_occluded
    occluded = {name: track.is_occluded for name, track in zip(frame.humans, message.tracks, strict=True)}
    assert occluded == {"anna": False, "ben": False, "away": True}


def test_a_velocity_that_is_unknown_is_not_set(frames: Callable[[int], Frame], scene: Scene) -> None:
    frame = frames(12)
    still = {name: replace(state, linear=None, angular=None) for name, state in frame.humans.items()}
    frame = replace(frame, humans=still)
    topics = topics_of(scene, ALL)
    for track in topics["spencer/perception/tracked_persons"].message(frame).tracks:
        assert [track.twist.covariance[place] > 99_999 for place in range(0, 36, 7)] == [True] * 6
    for person in topics["people"].message(frame).people:
        assert not xyz(person.velocity).any() and person.tags[person.tagnames.index("velocity")] == "unknown"


@pytest.mark.parametrize("frame_id", ["map", "ahead_optical_frame", "lidar_frame", "odom"])
def test_boxes_enclose_their_bodies_in_any_frame(
    frames: Callable[[int], Frame], scene: Scene, frame_id: str
) -> None:
    frame = frames(12)
    message = topics_of(scene, {"detections_3d": frame_id})["detections_3d"].message(frame)
    for found in message.detections:
        vertices = frame.humans[found.id].vertices.astype(float)
        if frame_id == "ahead_optical_frame":
            vertices = frame.cameras["ahead"].to_optical(vertices)
        elif frame_id != "map":
            robot = frame.objects["robot"]
            start = scene.robot
            assert start is not None
            pose = robot if frame_id == "lidar_frame" else start.start
            vertices = Rotation.from_quat(pose.rotation).inv().apply(vertices - pose.position)
            if frame_id == "lidar_frame":
                vertices = vertices - [0.2, 0, 0.4]
        own = turned(found.bbox.center.orientation).inv().apply(vertices - xyz(found.bbox.center.position))
        half = xyz(found.bbox.size) / 2
        np.testing.assert_allclose([own.min(axis=0), own.max(axis=0)], [-half, half], atol=1e-6)
        (hypothesis,) = found.results
        assert (hypothesis.hypothesis.class_id, hypothesis.hypothesis.score) == ("person", 1.0)
        np.testing.assert_array_equal(xyz(hypothesis.pose.pose.position), xyz(found.bbox.center.position))


@pytest.mark.parametrize("kind", ["visible", "whole"])
def test_detections_in_images_are_our_boxes(frames: Callable[[int], Frame], scene: Scene, kind: str) -> None:
    frame = frames(12)
    message = topics_of(scene, {"detections_2d": {"box": kind}})["fixed/detections_2d"].message(frame)
    assert message.header.frame_id == "fixed_optical_frame"
    boxes = frame.boxes["fixed"]
    assert [found.id for found in message.detections] == ["anna", "ben"]  # nothing of the third is seen
    for found in message.detections:
        left, top, right, bottom = getattr(boxes[found.id], kind)
        centre, width, height = found.bbox.center.position, found.bbox.size_x, found.bbox.size_y
        own = [centre.x - width / 2, centre.y - height / 2, centre.x + width / 2, centre.y + height / 2]
        np.testing.assert_allclose(own, [left, top, right, bottom], rtol=1e-6)


def test_labels_of_detections_are_sent_once(frames: Callable[[int], Frame], scene: Scene) -> None:
    topic = topics_of(scene, ALL)["fixed/detections_2d/label_info"]
    assert topic.latched and not topic.per_frame
    message = topic.message(frames(12))
    assert [(each.class_id, each.class_name) for each in message.class_map] == [(0, "person")]


def test_all_messages_can_be_written_to_bags(frames: Callable[[int], Frame], scene: Scene) -> None:
    for topic in topics_of(scene, ALL).values():
        message = topic.message(frames(12))
        data = bytes(serialised(message, topic.type_name))
        back = message_types().deserialize_cdr(data, topic.type_name)
        assert bytes(serialised(back, topic.type_name)) == data


# --- frames from messages


def test_boxes_that_are_received_give_the_same_message(frames: Callable[[int], Frame], scene: Scene) -> None:
    from humansim_ros.data.messages.received import CAMERA_INPUTS

    frame = frames(12)
    topic = topics_of(scene, ALL)["fixed/detections_2d"]
    sent = boxes_message(
        [(frame.labels[name], box) for name, box in frame.boxes["fixed"].items()], 5, "fixed_optical_frame"
    )
    content = CAMERA_INPUTS["boxes"][1](sent, scene)
    received = received_frame(frame.stamp, None, {"fixed": {"boxes": content}}, scene)
    ours, theirs = (
        bytes(serialised(topic.build(each, frame.stamp), topic.type_name)) for each in (received, frame)
    )
    assert ours == theirs


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("instance", 1, "two have one label"),
        ("instance", 900, "a box has label 900"),
        ("left", math.nan, "is not finite"),
        ("kind", 9, "kind 9"),
    ],
)
def test_boxes_that_lie_are_refused(
    frames: Callable[[int], Frame], scene: Scene, field: str, value: float, text: str
) -> None:
    from humansim_ros.data.messages.camera_truth import BOX_POINT
    from humansim_ros.data.messages.received import CAMERA_INPUTS

    frame = frames(12)
    boxes = [(frame.labels[name], box) for name, box in frame.boxes["fixed"].items()]
    message = boxes_message(boxes, 5, "fixed_optical_frame")
    rows = np.frombuffer(bytes(message.data), BOX_POINT).copy()
    rows[field][1] = value
    message.data = rows.tobytes()
    with pytest.raises(RosError, match=text):
        CAMERA_INPUTS["boxes"][1](message, scene)
    message = boxes_message(boxes[:1], 5, "fixed_optical_frame")
    with pytest.raises(RosError, match="no box of ben"):
        CAMERA_INPUTS["boxes"][1](message, scene)


# --- reading


def test_people_are_read_from_all_messages(frames: Callable[[int], Frame], scene: Scene) -> None:
    frame = frames(12)
    adapters = {"detections_3d": {}, "people": {}, "tracked_persons": {}}
    for name, topic in topics_of(scene, adapters).items():
        if topic.latched:
            continue
        read = read_people(topic.type_name, topic.message(frame), None)
        assert (read.stamp, read.frame_id, len(read.people)) == (frame.stamp, "map", 3)
        for person, (own, state) in zip(read.people, frame.humans.items(), strict=True):
            assert person.names == (GROUND,)
            assert person.person == (str(frame.labels[own]) if "spencer" in name else own)
            if name != "detections_3d":
                np.testing.assert_allclose(person.positions[0], hips(frame, own), atol=1e-9)
            else:
                middle = state.vertices.mean(axis=0)
                assert np.linalg.norm(person.positions[0] - middle) < 0.3


def detections(*rows: tuple[str, str | None]) -> Any:
    message = VISION_MSGS.message("Detection3DArray")(header=messages.header(5, "map"))
    for name, class_id in rows:
        found = VISION_MSGS.message("Detection3D")(id=name)
        if class_id is not None:
            certain = VISION_MSGS.message("ObjectHypothesis")(class_id=class_id, score=0.5)
            found.results = [VISION_MSGS.message("ObjectHypothesisWithPose")(hypothesis=certain)]
        message.detections.append(found)
    return message


def test_detections_of_other_classes_are_not_people() -> None:
    message = detections(("1", "person"), ("2", "car"), ("3", "Pedestrian"), ("4", None), ("", "0"))
    read = read_people("vision_msgs/msg/Detection3DArray", message, None)
    assert [(pose.person, pose.score) for pose in read.people] == [
        *(("1", 0.5), ("3", 0.5), ("4", None), (None, 0.5))
    ]


def test_ids_that_collide_are_refused() -> None:
    with pytest.raises(EvaluationError, match="person '7' has two poses in a message"):
        read_people("vision_msgs/msg/Detection3DArray", detections(("7", "person"), ("7", "person")), None)


@pytest.mark.parametrize("first", [0.0, np.nan])
def test_a_position_with_a_great_variance_is_not_set(first: float) -> None:
    track = SPENCER_MSGS.message("TrackedPerson")(track_id=4)
    track.pose.covariance[0], track.pose.covariance[7] = first, 1e6
    message = SPENCER_MSGS.message("TrackedPersons")(header=messages.header(5, "map"), tracks=[track])
    (pose,) = read_people("spencer_tracking_msgs/msg/TrackedPersons", message, None).people
    assert np.isnan(pose.positions).all()


def test_messages_of_another_version_are_refused() -> None:
    old = SimpleNamespace(id="", results=[SimpleNamespace(id="person", score=1.0)])
    message = SimpleNamespace(header=messages.header(5, "map"), detections=[old])
    with pytest.raises(EvaluationError, match="Detection3DArray is of a version that is not known here"):
        read_people("vision_msgs/msg/Detection3DArray", message, None)
