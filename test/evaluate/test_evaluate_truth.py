"""Truth of scenes and of bags, and topics of bags as estimates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluate_support import NAMES, PERIOD, changed, walking

from humansim_ros import Scene
from humansim_ros.cameras.camera.rigs import Trajectory
from humansim_ros.data.bags.topics import BagMessage, BagTopic, message_types
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.data.evaluation.evaluation import evaluate_poses
from humansim_ros.data.evaluation.export_truth import open_truth
from humansim_ros.data.evaluation.joint_names import set_of_names
from humansim_ros.data.evaluation.pose_sequence import PoseSequence
from humansim_ros.data.evaluation.readers.estimates import read_bag_topic
from humansim_ros.data.evaluation.readers.pose_files import ReadOptions
from humansim_ros.data.evaluation.truth import (
    RecordedTruth,
    SceneTruth,
    camera_counts,
    with_camera_counts,
)
from humansim_ros.errors import BagError, EvaluationError, HumansimWarning
from humansim_ros.people import KeypointLocator, keypoint_set
from humansim_ros.scene.config import FIRST_STAMP

SCENE = {
    "room": None,
    "rate": 25,
    "humans": {
        "anna": {"body": "adult_woman", "motion": "walk"},
        "bert": {"motion": {"file": "wave", "position": [1, 1]}},
    },
    "cameras": {"front": {"position": [4, 0, 1.5], "look_at": [0, 0, 1]}},
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_dict(SCENE)


def test_truth_of_a_scene_is_that_of_its_frames(scene: Scene) -> None:
    truth = SceneTruth(scene).poses((FIRST_STAMP + 10 * PERIOD, FIRST_STAMP + 14 * PERIOD))
    assert truth.times.tolist() == [FIRST_STAMP + k * PERIOD for k in range(9, 15)]
    for time, people in zip(truth.times.tolist(), truth.people, strict=True):
        for name, actor in scene.actors.items():
            expected = actor.at((time - FIRST_STAMP) * 1e-9).positions
            np.testing.assert_allclose(people[name], expected, atol=1e-9)


def test_truth_of_many_frames_is_computed_in_blocks(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    span = (FIRST_STAMP, FIRST_STAMP + 20 * PERIOD)
    whole = SceneTruth(scene).poses(span)
    monkeypatch.setattr("humansim_ros.data.evaluation.truth._BLOCK", 7)
    parts = SceneTruth(scene).poses(span)
    for one, other in zip(whole.people, parts.people, strict=True):
        np.testing.assert_allclose(one["anna"], other["anna"], atol=1e-12)


@pytest.mark.parametrize("name", ["coco17"])
def test_keypoints_of_a_scene_are_those_of_its_frames(scene: Scene, name: str) -> None:
    truth = SceneTruth(scene).poses((FIRST_STAMP, FIRST_STAMP + PERIOD), keypoints=keypoint_set(name))
    assert truth.names == keypoint_set(name).names
    for person, actor in scene.actors.items():
        state = actor.at(PERIOD * 1e-9)
        locator = KeypointLocator.of(actor.human, keypoint_set(name))
        expected = locator.positions(state.positions, state.vertices)
        np.testing.assert_allclose(truth.people[1][person], expected, atol=1e-9)
        np.testing.assert_allclose(
            truth.people[1][person][truth.names.index("left_knee")],
            state.positions[state.joint_names.index("l_knee")],
        )


def test_errors_by_the_number_of_cameras(tmp_path: Path) -> None:
    """One camera sees the whole person, a second one the legs; a third one flies around."""
    Trajectory.orbit((0, 0, 1), radius=2.0, height=0.6, period=1.0).write(tmp_path / "way.txt")
    cameras = {
        "whole": {"size": [100, 100], "position": [9, 0, 1], "look_at": [0, 0, 1]},
        "legs": {"size": [100, 60], "position": [3, 0, 0.4], "look_at": [0, 0, 0.4]},
        "drone": {"size": [60, 40], "fov_deg": 60, "trajectory": str(tmp_path / "way.txt")},
    }
    scene = Scene.from_dict(SCENE | {"cameras": cameras})
    truth = SceneTruth(scene).poses((FIRST_STAMP, FIRST_STAMP + 4 * PERIOD))
    truth = changed(truth, lambda frame, person, joints: joints if person == "bert" else None)
    worse = changed(truth, lambda frame, person, joints: joints + np.array([0, 0, 0.01 * (1 + frame)]))
    result = with_camera_counts(evaluate_poses(truth, worse), scene)
    errors: dict[int, list[float]] = {}
    for frame, (time, people) in enumerate(zip(truth.times.tolist(), truth.people, strict=True)):
        placed = [
            camera.camera_at(camera.pose((time - FIRST_STAMP) * 1e-9))
            for camera in scene.scene_cameras.values()
        ]
        for joint in people["bert"]:
            count = 0
            for camera in placed:
                optical = camera.R @ joint + camera.t
                x, y, w = camera.K @ optical
                width, height = camera.size
                count += (
                    w > 0
                    and abs(x / w + 0.5 - width / 2) < width / 2
                    and (abs(y / w + 0.5 - height / 2) < height / 2)
                )
            errors.setdefault(count, []).append(0.01 * (1 + frame))
    assert len(errors) >= 3
    assert {int(count): score.joints for count, score in result.by_cameras.items()} == {
        count: len(own) for count, own in errors.items()
    }
    for count, own in errors.items():
        assert result.by_cameras[str(count)].mpjpe == pytest.approx(np.mean(own))
    assert camera_counts(scene, truth.times[:1], np.full((1, 2, 3), np.nan)).tolist() == [[0, 0]]


def test_a_comparison_that_matches_nobody_has_no_errors_by_cameras(scene: Scene) -> None:
    truth = SceneTruth(scene).poses((FIRST_STAMP, FIRST_STAMP + 3 * PERIOD))
    far = changed(truth, lambda frame, person, joints: joints + 100.0)
    result = with_camera_counts(evaluate_poses(truth, far, offset=0.0), scene)
    assert result.by_cameras == {} and not len(result.errors)


def test_the_set_of_an_estimate_is_found_by_its_names() -> None:
    found = set_of_names(["nose", "left_hip"])
    assert found is not None and found.name == "coco17"
    assert set_of_names(["left_hip", "right_hip"]) is None  # joints of bodies
    assert set_of_names(["nose", "tail"]) is None


def test_times_of_a_wall_clock_are_not_those_of_a_scene(scene: Scene) -> None:
    now = 1_790_000_000_000_000_000
    with pytest.raises(EvaluationError, match=r"--truth: the times .* stamped with a wall clock\? Record"):
        SceneTruth(scene).poses((now, now + PERIOD))
    with pytest.raises(EvaluationError, match="stamped with a wall clock"):
        SceneTruth(scene).poses((FIRST_STAMP, now))


def test_a_scene_without_people_or_with_live_ones_has_no_truth() -> None:
    with pytest.raises(EvaluationError, match="there are no people in it: record a bag"):
        SceneTruth(Scene.from_dict(SCENE | {"humans": {}})).poses((1, 2))
    live = Scene.from_dict(SCENE | {"humans": {"anna": {"motion": "live"}}})
    with pytest.raises(EvaluationError, match="anna is moved live: record a bag"):
        SceneTruth(live).poses((1, 2))


def test_a_folder_is_no_truth(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="--truth: neither a scene file nor a bag"):
        open_truth(tmp_path)


def write_bag(
    folder: Path, sequences: dict[str, tuple[str, PoseSequence]], late: int = 0, frame: str = "map"
) -> Path:
    """Bag of joints (MultiDOFJointState) and poses (PoseArray) of people on topics ``{person}``.

    ``late``: nanoseconds from a stamp to its log time. ``frame``: frame_id of the messages.
    """
    types = message_types().types
    point, vector = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Vector3"]
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    transform, whole = types["geometry_msgs/msg/Transform"], types["geometry_msgs/msg/Pose"]
    topics: dict[str, str] = {}
    messages: list[tuple[str, int, Any]] = []
    for pattern, (kind, sequence) in sequences.items():
        for time, people in zip(sequence.times.tolist(), sequence.people, strict=True):
            if "{}" not in pattern:
                topics.setdefault(pattern, kind)
                joints = np.concatenate([*people.values(), np.zeros((0, 3))])
                poses = [whole(point(*row), turn) for row in joints.tolist()]
                messages.append((pattern, time, types[kind](header(time, frame), poses)))
                continue
            for person, joints in people.items():
                topics.setdefault(pattern.format(person), kind)
                transforms = [transform(vector(*row), turn) for row in joints.tolist()]
                content = types[kind](header(time, frame), list(sequence.names), transforms, [], [])
                messages.append((pattern.format(person), time, content))
    order = list(topics)
    with BagWriter(folder, [BagTopic(name, kind) for name, kind in topics.items()]) as writer:
        for name, time, message in messages:
            data = message_types().serialize_cdr(message, topics[name])
            writer.write([BagMessage(order.index(name), time + late, data)])
    return folder


JOINTS, POSES = "sensor_msgs/msg/MultiDOFJointState", "geometry_msgs/msg/PoseArray"


def header(stamp: int, frame: str) -> Any:
    time = message_types().types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return message_types().types["std_msgs/msg/Header"](time, frame)


def test_truth_and_estimate_of_one_bag(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(0, 0.01, (len(NAMES), 3))
    estimate = changed(walking(), lambda frame, person, joints: joints + noise if frame != 3 else None)
    bag = write_bag(
        tmp_path / "bag",
        {
            "/humans/{}/joints": (JOINTS, walking()),
            "/tracker/{}/pose": (JOINTS, estimate),
            "/tracker/poses": (POSES, estimate),
        },
    )
    truth = RecordedTruth(bag).joints
    assert set(truth.people[0]) == {"anna", "bert"} and truth.names == NAMES
    source = open_truth(bag)
    assert (source.period, source.start) == (PERIOD, 1)
    with pytest.raises(EvaluationError, match=r"no topic /humans/<id>/keypoints/coco17\. Record it as well"):
        source.poses((0, 1), 0.0, keypoint_set("coco17"))
    named = read_bag_topic(bag, "/tracker/*/pose", ReadOptions()).sequence()
    result = evaluate_poses(truth, named)
    assert result.position.mpjpe == pytest.approx(np.linalg.norm(noise, axis=1).mean())
    assert result.people.missed == 2 and result.tracking is not None
    unnamed = read_bag_topic(bag, "/tracker/poses", ReadOptions(names=NAMES)).sequence()
    assert len(unnamed.times) == 50 and unnamed.people[3] == {}  # an empty message is a frame
    result = evaluate_poses(truth, unnamed)
    assert result.position.mpjpe == pytest.approx(np.linalg.norm(noise, axis=1).mean())
    assert result.tracking is None


def test_latency_and_losses_of_a_bag(tmp_path: Path) -> None:
    estimate = changed(walking(), lambda frame, _, joints: joints if frame not in (7, 48, 49) else None)
    some = [index for index, each in enumerate(estimate.people) if each or index == 7]
    estimate = replace(estimate, times=estimate.times[some], people=[estimate.people[i] for i in some])
    topics = {"/humans/{}/joints": (JOINTS, walking()), "/tracker/{}/pose": (JOINTS, estimate)}
    for name, late in (("lockstep", 0), ("live", 80_000_000), ("other clock", 10**18)):
        bag = write_bag(tmp_path / name, topics, late)
        result = evaluate_poses(
            RecordedTruth(bag).joints, read_bag_topic(bag, "/tracker/*/pose", ReadOptions()).sequence()
        )
        assert result.live is not None
        assert (result.live.lost, result.live.after, result.live.frames) == (1, 2, 47)
        assert result.live.lost_share == 1 / 48 and result.live.rate == pytest.approx(25 * 46 / 47)
        assert (result.live.latency is not None) == (name == "live")
        if result.live.latency is not None:
            assert result.live.latency.median == result.live.latency.p99 == pytest.approx(0.08)


def test_another_frame_is_told(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", {"/tracker/poses": (POSES, walking(3))}, frame="odom")
    with pytest.warns(HumansimWarning, match=r"bag:/tracker/poses: frame_id is 'odom', and is taken as map"):
        read_bag_topic(bag, "/tracker/poses", ReadOptions(names=NAMES))


def test_one_person_a_message_on_one_topic(tmp_path: Path) -> None:
    anna = replace(walking(5), people=[{"anna": each["anna"]} for each in walking(5).people])
    bag = write_bag(tmp_path / "bag", {"/tracker/poses": (POSES, anna)})
    sequence = read_bag_topic(bag, "/tracker/poses", ReadOptions(names=NAMES)).sequence()
    assert sequence.has_identities and [set(each) for each in sequence.people] == [{"1"}] * 5


def test_topics_that_hold_no_poses(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag, [BagTopic("/human/pose", "geometry_msgs/msg/PoseStamped")]) as writer:
        writer.write([BagMessage(0, 1, b"\0\1\0\0")])
    with pytest.raises(EvaluationError, match="no topic /human/poses; did you mean '/human/pose'"):
        read_bag_topic(bag, "/human/poses", ReadOptions())
    with pytest.raises(EvaluationError, match="PoseStamped holds no poses of people; known are sensor_msgs"):
        read_bag_topic(bag, "/human/pose", ReadOptions())
    with pytest.raises(EvaluationError, match=r"the bag has no truth: no topic /humans/<id>/joints"):
        RecordedTruth(bag)
    with pytest.raises(BagError, match="there is no such bag"):
        read_bag_topic(tmp_path / "none.mcap", "/x", ReadOptions())


def test_a_damaged_message_is_an_error(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", [BagTopic("/poses", POSES)]) as writer:
        writer.write([BagMessage(0, 1, b"\0\1\0\0\xff\xff")])
    with pytest.raises(EvaluationError, match=r"bag: /poses: a message cannot be read"):
        read_bag_topic(tmp_path / "bag", "/poses", ReadOptions(names=NAMES))
