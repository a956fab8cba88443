"""ROS4HRI of a simulated camera: frames of tf, regions, keypoints, crops and ids against the truth."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation

from humansim_ros import Frame, Scene, Simulation, record
from humansim_ros.data.messages import types
from humansim_ros.data.messages.stacks import hri
from humansim_ros.data.messages.stacks.adapters import adapter_topics
from humansim_ros.errors import RosError, SceneError
from humansim_ros.types import Array

HUMANS = {
    "anna": {"body": "adult_woman", "motion": {"file": "wave", "yaw_deg": 30}},
    "ben": {"body": "tall_heavy_man", "motion": {"file": "walk", "position": [-1.2, -0.8]}},
    "turned": {"body": "child", "motion": {"file": "stand", "position": [-0.5, 1.1], "yaw_deg": 200}},
    "behind": {"body": "child", "motion": {"file": "stand", "position": [4.5, 0]}},
}
FRONT = {
    "size": [320, 240],
    "K": [[240, 0, 162], [0, 245, 118], [0, 0, 1]],
    "distortion": [-0.2, 0.05, 0.001, -0.002, 0],
    "position": [2.4, 0.6, 1.5],
    "look_at": [0, 0, 1.0],
}
SIZE = np.array([320, 240])
#: A frame, and its messages by topic.
Seen = tuple[Frame, dict[str, list[Any]]]


def scene(**changes: Any) -> Scene:
    sections = {"humans": HUMANS, "cameras": {"front": FRONT}, "hri": "front", **changes}
    return Scene.from_dict({"rate": 10, "room": None, **sections})


@pytest.fixture(scope="module")
def seen() -> Seen:
    """A frame, and all its messages by topic."""
    made = scene()
    channels = ("rgb", "depth", "instance", "part", "amodal")
    with Simulation(made, channels=channels) as simulation:
        frame = simulation.frame(8)
    topics = adapter_topics(made)
    assert all(topic.channels <= set(channels) for topic in topics)
    return frame, {topic.name: [message for _, message in topic.sent(frame)] for topic in topics}


def constants(message: str) -> dict[str, int]:
    """Constants of a definition of hri_msgs."""
    text = (ROOT / "config" / "interfaces" / "hri_msgs" / "msg" / f"{message}.msg").read_text()
    return {name: int(value) for name, value in re.findall(r"^u?int8 (\w+) ?= ?(\d+)", text, re.MULTILINE)}


def transforms(messages: dict[str, list[Any]], frame: Frame) -> dict[str, Array]:
    """Poses (4, 4) in map of all frames of tf, chained as tf2 does, from the published camera pose on."""
    camera = frame.published_cameras["front"]
    optical = np.eye(4)
    optical[:3, :3], optical[:3, 3] = camera.R.T, -camera.R.T @ camera.t
    poses = {"map": np.eye(4), "front_optical_frame": optical}
    (message,) = messages["tf"]
    for each in message.transforms:
        p, q = each.transform.translation, each.transform.rotation
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [p.x, p.y, p.z]
        assert each.child_frame_id not in poses  # one parent each
        poses[each.child_frame_id] = poses[each.header.frame_id] @ own
    return poses


def joints_of(frame: Frame, name: str) -> dict[str, Array]:
    state = frame.humans[name]
    return dict(zip(state.joint_names, state.positions, strict=True))


def pixels_of(frame: Frame, points: Array) -> Array:
    """Pixels (N, 2) of points (N, 3) in map, by OpenCV."""
    camera = frame.cameras["front"]
    lens = np.array(FRONT["distortion"], float)
    found, _ = cv2.projectPoints(
        points, cv2.Rodrigues(camera.R)[0], camera.t, np.array(FRONT["K"], float), lens
    )
    return np.asarray(found[:, 0])


def points_of(rows: Any) -> Array:
    return np.array([(row.x, row.y, row.c) for row in rows])


def test_lists_have_who_is_seen_and_who_is_known(seen: Seen) -> None:
    _, messages = seen
    ids = {name: messages[f"humans/{name}"][0].ids for name in ("bodies/tracked", "faces/tracked")}
    assert ids == {"bodies/tracked": ["b_anna", "b_ben", "b_turned"], "faces/tracked": ["f_anna", "f_ben"]}
    assert messages["humans/persons/tracked"][0].ids == ["anna", "ben", "turned"]
    assert messages["humans/persons/known"][0].ids == ["anna", "ben", "turned", "behind"]


def test_frames_of_tf_are_the_true_joints(seen: Seen) -> None:
    frame, messages = seen
    poses = transforms(messages, frame)
    assert not any("behind" in name for name in poses)
    for name in ("anna", "ben", "turned"):
        places = joints_of(frame, name)
        for side in "lr":
            for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
                pose = poses[f"{side}_{joint}_b_{name}"]
                np.testing.assert_allclose(pose[:3, 3], places[f"{side}_{joint}"], atol=1e-6)
        middle = (places["l_hip"] + places["r_hip"]) / 2
        np.testing.assert_allclose(poses[f"body_b_{name}"][:3, 3], middle, atol=1e-6)
        np.testing.assert_allclose(poses[f"p_head_b_{name}"][:3, 3], places["vt3"], atol=1e-6)


def test_a_face_is_at_the_sellion_and_looks_ahead(seen: Seen) -> None:
    frame, messages = seen
    poses = transforms(messages, frame)
    for name in ("anna", "ben"):
        points = frame.keypoint_positions["face70"][name]
        face, gaze = poses[f"face_f_{name}"], poses[f"gaze_f_{name}"]
        np.testing.assert_allclose(face[:3, 3], points[27], atol=1e-6)
        np.testing.assert_allclose(poses[f"person_{name}"], face, atol=1e-6)
        np.testing.assert_allclose(gaze[:3, 3], face[:3, 3], atol=1e-6)
        assert face[:3, 0] @ (points[30] - points[27]) > 0  # the tip of the nose is ahead
        assert face[:3, 1] @ (points[45] - points[36]) > 0.05  # the left eye is on the left
        assert face[:3, 2] @ (points[27] - points[8]) > 0.05  # the chin is below
        eyes = sum(
            joints_of(frame, name)[f"{side}_eyeball_joint_end"]
            - joints_of(frame, name)[f"{side}_eyeball_joint"]
            for side in "lr"
        )
        np.testing.assert_allclose(gaze[:3, 2], eyes / np.linalg.norm(eyes), atol=1e-6)
    # without a face, the person is at the head of the body
    np.testing.assert_allclose(poses["person_turned"], poses["head_b_turned"], atol=1e-6)


def test_regions_are_our_boxes(seen: Seen) -> None:
    frame, messages = seen
    for name in ("anna", "ben", "turned"):
        (roi,) = messages[f"humans/bodies/b_{name}/roi"]
        box = np.array([roi.xmin, roi.ymin, roi.xmax, roi.ymax]) * [*SIZE, *SIZE] - 0.5
        np.testing.assert_allclose(box, frame.boxes["front"][name].visible, atol=1e-4)
        mask = frame.views["front"].instance == frame.labels[name]
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        bounds = [columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5]
        np.testing.assert_allclose(box, bounds, atol=1e-4)
        assert roi.c == 1.0
    assert messages["humans/bodies/b_behind/roi"] == []


def test_skeleton2d_is_the_projection_of_the_joints(seen: Seen) -> None:
    """Joints are projected by OpenCV, and put in the order of the constants of hri_msgs/Skeleton2D."""
    frame, messages = seen
    codes = constants("Skeleton2D")
    assert len(codes) == 18
    for name in ("anna", "ben"):
        (message,) = messages[f"humans/bodies/b_{name}/skeleton2d"]
        rows, places = points_of(message.skeleton), joints_of(frame, name)
        assert rows.shape == (18, 3)
        truth = {
            f"{side}_{joint}".upper(): places[f"{side[0]}_{joint}"]
            for side in ("left", "right")
            for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        }
        truth["NECK"] = (places["l_shoulder"] + places["r_shoulder"]) / 2
        skin = dict(
            zip(
                ("NOSE", "LEFT_EYE", "RIGHT_EYE", "LEFT_EAR", "RIGHT_EAR"),
                frame.keypoint_positions["coco17"][name],
                strict=False,
            )
        )
        for code, place in {**truth, **skin}.items():
            pixel = rows[codes[code], :2] * SIZE - 0.5
            np.testing.assert_allclose(pixel, pixels_of(frame, place[None])[0], atol=2e-3)
        assert set(truth) | set(skin) == set(codes)
        assert set(rows[:, 2]) <= {0.5, 1.0}


def test_landmarks_are_the_points_of_the_face_in_their_order(
    seen: Seen,
) -> None:
    frame, messages = seen
    codes = constants("FacialLandmarks")
    assert len(codes) == 70
    (message,) = messages["humans/faces/f_anna/landmarks"]
    assert (message.width, message.height) == (320, 240)
    rows = points_of(message.landmarks)
    truth = pixels_of(frame, frame.keypoint_positions["face70"]["anna"])
    np.testing.assert_allclose(rows[:, :2] * SIZE - 0.5, truth, atol=2e-3)
    # anna faces the camera: her right is on the left of the image
    for code in ("EAR", "PUPIL", "EYEBROW_INSIDE", "EYE_OUTSIDE", "PROFILE_3"):
        assert rows[codes[f"RIGHT_{code}"], 0] < rows[codes[f"LEFT_{code}"], 0]
    assert rows[codes["MOUTH_OUTER_RIGHT"], 0] < rows[codes["MOUTH_OUTER_LEFT"], 0]
    heights = [rows[codes[code], 1] for code in ("SELLION", "NOSE", "MOUTH_OUTER_TOP_3", "MENTON")]
    assert heights == sorted(heights)
    for side in ("LEFT", "RIGHT"):
        assert rows[codes[f"{side}_EYE_TOP_1"], 1] < rows[codes[f"{side}_EYE_BOTTOM_1"], 1]


def test_crops_are_pixels_of_the_image(seen: Seen) -> None:
    frame, messages = seen
    image = frame.views["front"].rgb
    for name in ("anna", "ben", "turned"):
        (crop,) = messages[f"humans/bodies/b_{name}/cropped"]
        left, top, right, bottom = (frame.boxes["front"][name].visible + 0.5).round().astype(int)
        assert (crop.height, crop.width, crop.encoding) == (bottom - top, right - left, "rgb8")
        pixels = np.frombuffer(crop.data, np.uint8).reshape(crop.height, crop.width, 3)
        np.testing.assert_array_equal(pixels, image[top:bottom, left:right])


def test_faces_are_scaled_into_a_square_on_black(seen: Seen) -> None:
    frame, messages = seen
    (crop,), (roi,) = messages["humans/faces/f_anna/cropped"], messages["humans/faces/f_anna/roi"]
    assert (crop.height, crop.width, len(crop.data)) == (128, 128, 128 * 128 * 3)
    pixels = np.frombuffer(crop.data, np.uint8).reshape(128, 128, 3)
    left, top = np.floor([roi.xmin * 320, roi.ymin * 240]).astype(int)
    right, bottom = np.ceil([roi.xmax * 320, roi.ymax * 240]).astype(int)
    scale = 128 / max(right - left, bottom - top)
    margin = round((128 - (right - left) * scale) / 2)
    assert not pixels[:, : max(0, margin - 1)].any()
    part = frame.views["front"].rgb[top:bottom, left:right].reshape(-1, 3).mean(axis=0)
    filled = pixels[pixels.any(axis=2)].mean(axis=0)
    np.testing.assert_allclose(filled, part, atol=6)


@pytest.mark.parametrize("encoding", ["rgb8", "mono8", "bayer_rggb8"])
def test_crops_of_other_encodings(encoding: str) -> None:
    shape = (48, 64, 3) if encoding == "rgb8" else (48, 64)
    image = np.random.default_rng(1).integers(0, 255, shape, dtype=np.uint8)
    head = types.Header(frame_id="front_optical_frame")
    roi = np.array([3 / 64, 5 / 48, 20 / 64, 29 / 48])
    crop = hri.crop_message(image, encoding, roi, head)
    channels = 1 if encoding == "mono8" else 3
    assert (crop.width, crop.height, crop.step) == (17, 24, 17 * channels)
    assert crop.encoding == ("mono8" if encoding == "mono8" else "rgb8")
    if encoding != "bayer_rggb8":
        np.testing.assert_array_equal(
            np.frombuffer(crop.data, np.uint8).reshape(24, 17, -1).squeeze(), image[5:29, 3:20]
        )


def test_persons_join_their_body_and_face(seen: Seen) -> None:
    _, messages = seen

    def value(person: str, topic: str) -> Any:
        return messages[f"humans/persons/{person}/{topic}"][0].data

    topics = ("anonymous", "body_id", "face_id", "location_confidence")
    assert [value("anna", topic) for topic in topics] == [False, "b_anna", "f_anna", 1.0]
    assert [value("turned", topic) for topic in topics] == [False, "b_turned", "", 1.0]
    assert [value("behind", topic) for topic in topics] == [False, "", "", 0.0]
    codes = constants("IdsMatch")
    pairs = {
        ((each.id1, each.id1_type), (each.id2, each.id2_type))
        for each in messages["humans/candidate_matches"]
        if each.confidence == 1.0
    }
    body, face, person = (codes[name] for name in ("BODY", "FACE", "PERSON"))
    assert (("b_turned", body), ("turned", person)) in pairs
    assert (("f_anna", face), ("anna", person)) in pairs
    assert (("f_anna", face), ("b_anna", body)) in pairs
    assert len(pairs) == 7


def test_velocity_is_over_the_ground_in_the_axes_of_the_body(
    seen: Seen,
) -> None:
    frame, messages = seen
    (message,) = messages["humans/bodies/b_ben/velocity"]
    assert message.header.frame_id == "body_b_ben"
    v = message.twist.linear
    turned = transforms(messages, frame)["body_b_ben"][:3, :3] @ [v.x, v.y, v.z]
    state = frame.humans["ben"]
    assert state.linear is not None
    hips = [state.joint_names.index(name) for name in ("l_hip", "r_hip")]
    np.testing.assert_allclose(turned, state.linear[hips].mean(axis=0), atol=1e-9)
    assert v.x > 0.8  # he walks forward
    (position,) = messages["humans/bodies/b_ben/position"]
    camera, places = frame.cameras["front"], joints_of(frame, "ben")
    middle = camera.to_optical(((places["l_hip"] + places["r_hip"]) / 2)[None])[0]
    np.testing.assert_allclose([position.point.x, position.point.y, position.point.z], middle, atol=1e-9)


def test_names_of_urdf_joint_states_and_tf_fit(seen: Seen) -> None:
    frame, messages = seen
    (urdf,), (states,) = messages["humans/bodies/b_anna/urdf"], messages["humans/bodies/b_anna/joint_states"]
    moving = re.findall(r'<joint name="(\w+)" type="revolute"', urdf.data)
    assert sorted(moving) == sorted(states.name)
    assert len(states.position) == 20
    links = re.findall(r'<link name="(\w+)"', urdf.data)
    assert set(links) <= set(transforms(messages, frame))


@pytest.mark.parametrize(
    "name", ["bodies", "faces", "voices", "persons", "interactions", "candidate_matches"]
)
def test_a_human_with_the_name_of_a_list_is_refused(name: str) -> None:
    with pytest.raises(SceneError, match="has topics of ROS4HRI") as caught:
        scene(humans={name: HUMANS["anna"]}, adapters={})
    assert caught.value.key == f"humans.{name}"


def test_ids_that_collide_are_refused() -> None:
    made = scene(humans={"anna": HUMANS["anna"], "f_anna": HUMANS["turned"]})
    with pytest.raises(SceneError, match="id of the body or face of anna") as caught:
        adapter_topics(made)
    assert caught.value.key == "humans.f_anna"


def test_an_unknown_camera_is_named() -> None:
    with pytest.raises(SceneError, match=r"the scene has no camera 'frint'; did you mean 'front'") as caught:
        adapter_topics(scene(hri={"camera": "frint"}))
    assert caught.value.key == "hri.camera"


def test_messages_of_another_version_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """hri_msgs before 0.6 had other fields in IdsMatch."""
    old = SimpleNamespace(get_fields_and_field_types=lambda: {"face_id": "string"})
    monkeypatch.setattr(types, "_is_message_package", lambda name: name == "hri_msgs")
    monkeypatch.setattr(types, "message_type", lambda name: old)
    with pytest.raises(RosError, match=r"has no field .*: version 2.3 of hri_msgs is needed"):
        adapter_topics(scene())


def test_the_line_that_installs_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(types, "_is_message_package", lambda _: False)
    with pytest.raises(RosError, match="sudo apt install ros-jazzy-hri-msgs"):
        hri.HRI_MESSAGES.check(installed=True)


def test_a_body_without_the_bones_has_regions_and_no_frames(
    seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, _ = seen
    monkeypatch.setattr(hri.HriLinks, "of", lambda _: None)
    sent = {topic.name: topic.messages(frame, 1) for topic in adapter_topics(scene())}
    assert sent["tf"][0].transforms == []
    assert sent["humans/bodies/b_anna/roi"] and sent["humans/bodies/b_anna/cropped"]
    for topic in ("joint_states", "position", "velocity", "urdf"):
        assert sent[f"humans/bodies/b_anna/{topic}"] == []


def test_a_face_is_seen_with_three_of_its_five_points(seen: Seen) -> None:
    frame, _ = seen
    truth = frame.truth["front"]
    keypoints = truth.keypoints(hri.HRI_KEYPOINTS)["anna"]
    first = 25  # of the face in openpose137
    for hidden, face in (((68, 69), True), ((68, 69, 30), False)):
        visible = keypoints.visible.copy()
        visible[[first + number for number in hidden]] = 1
        person = hri.HriPerson(
            *("anna", None, frame.humans["anna"], truth.boxes["anna"].visible),
            *(replace(keypoints, visible=visible), np.eye(4), (320, 240)),
        )
        assert person.has_face == face


def test_a_recording_without_ros_has_messages_and_definitions(tmp_path: Path) -> None:
    """rosbags, which does not know hri_msgs, reads the messages by the definitions in the bag."""
    highlevel = pytest.importorskip("rosbags.highlevel", reason="the extra record is not installed")
    only_anna = {"humans": {"anna": HUMANS["anna"]}, "cameras": {"front": {**FRONT, "size": [64, 48]}}}
    del only_anna["cameras"]["front"]["K"], only_anna["cameras"]["front"]["distortion"]
    record(scene(**only_anna), tmp_path / "bag", frames=2, topics=["/humans/bodies/*", "/tf"], jobs=1)
    with highlevel.AnyReader([tmp_path / "bag"]) as reader:
        read = [
            (connection.topic, reader.deserialize(data, connection.msgtype))
            for connection, _, data in reader.messages()
        ]
    skeletons = [message for topic, message in read if topic == "/humans/bodies/b_anna/skeleton2d"]
    assert [len(message.skeleton) for message in skeletons] == [18, 18]
    assert [message.ids for topic, message in read if topic == "/humans/bodies/tracked"] == [["b_anna"]] * 2
    crops = [message for topic, message in read if topic == "/humans/bodies/b_anna/cropped"]
    assert len(crops) == 2 and crops[0].header.frame_id == "front_optical_frame"
    assert sum(topic == "/tf" for topic, _ in read) == 2
