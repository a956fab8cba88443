"""Social navigation: drives with known answers, bodies of a scene beside SciPy, and bags of robots."""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import ROOT
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, Simulation, evaluate, record
from humansim_ros.data.bags.topics import BagMessage, BagTopic, message_types
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.data.evaluation.navigation import evaluate_navigation
from humansim_ros.data.evaluation.nearby import PeopleNearby, RobotPath, scene_nearby
from humansim_ros.data.evaluation.readers.robot_paths import is_robot_path, read_robot_path
from humansim_ros.errors import EvaluationError, HumansimWarning
from humansim_ros.types import Array

sys.path.append(str(ROOT / "tools"))
from message_mutations import mutated_bytes

SECOND = 1_000_000_000


def drive(
    people: dict[str, Array], nearest: dict[str, Array] | None = None, known: Any = True
) -> PeopleNearby:
    """A robot from (-5, 0) to (5, 0) at 1 m/s, 100 frames a second."""
    times = np.arange(0, 10 * SECOND + 1, SECOND // 100)
    places = np.column_stack([times * 1e-9 - 5, np.zeros((len(times), 2))])
    places[~np.broadcast_to(known, len(times))] = np.nan
    whole = {name: np.broadcast_to(place, (len(times), 2)) for name, place in people.items()}
    return PeopleNearby(times, places, whole, nearest, "hand-made")


def test_a_drive_past_somebody_who_stands() -> None:
    result = evaluate_navigation(drive({"anna": np.array([0.0, 1.0])}), "path", 0.3)
    anna = result.by_person["anna"]
    assert anna == result.nearest
    assert (anna.distance, anna.stamp) == (pytest.approx(1.0), 5 * SECOND)
    assert (anna.collisions, anna.clearance, anna.time_to_collision) == (None, None, None)
    personal, social = 2 * np.sqrt(1.2**2 - 1), 2 * np.sqrt(3.6**2 - 1)
    expected = {"intimate": 0, "personal": personal, "social": social - personal, "public": 10 - social}
    assert anna.spaces == pytest.approx(expected, abs=0.011)
    assert anna.compliance == 1
    path = result.path
    assert (path.seconds, path.length, path.speed, path.irregularity) == pytest.approx((10, 10, 1, 0))


def test_contacts_with_a_body_that_is_not_known_are_null() -> None:
    people = {"anna": np.array([0.0, 1.0]), "ben": np.array([0.0, 2.0])}
    result = evaluate_navigation(drive(people, {"anna": np.full(1001, 0.9)}), "path", 0.3)
    anna, ben = result.by_person["anna"], result.by_person["ben"]
    assert (anna.clearance, anna.collisions, anna.contact) == (pytest.approx(0.6), 0, 0)
    assert (ben.clearance, ben.collisions, ben.contact) == (None, None, None)
    assert (result.nearest.collisions, result.nearest.contact) == (None, None)


def test_contacts_and_time_to_collision() -> None:
    at = np.array([0.0, 0.2])
    x = np.arange(0, 1001) * 0.01 - 5
    body = np.hypot(x, 0.2) - 0.1  # a cylinder of 0.1 m
    result = evaluate_navigation(drive({"anna": at}, {"anna": body}), "path", 0.3)
    anna = result.by_person["anna"]
    assert (anna.collisions, anna.clearance) == (1, pytest.approx(-0.2))
    assert anna.contact == pytest.approx(2 * np.sqrt(0.4**2 - 0.2**2), abs=0.011)
    assert anna.time_to_collision == 0  # it drives through her
    assert anna.compliance == pytest.approx(1 - 2 * np.sqrt(0.5**2 - 0.2**2) / 10, abs=0.002)
    # somebody who comes to meet it 0.5 m beside, until both stop: the discs of 0.6 m would touch
    meeting = np.column_stack([4 - (x + 5) * 0.5, np.full(len(x), 0.5)])
    with pytest.warns(HumansimWarning, match="no pose"):
        result = evaluate_navigation(drive({"ben": meeting}, known=x < 0), "path", 0.3)
    gap = (4 - 0.5 * 4.99) - (4.99 - 5)
    expected = (gap - np.sqrt(0.6**2 - 0.5**2)) / 1.5
    assert result.by_person["ben"].time_to_collision == pytest.approx(expected, abs=1e-6)


def test_unnecessary_turns_are_counted() -> None:
    nearby = drive({"anna": np.array([0.0, 9.0])})
    nearby.places[:, 2] = 0.5 * np.sin(nearby.times * 1e-9 * 2 * np.pi / 5)  # two turns to and fro
    assert evaluate_navigation(nearby, "path", 0.3).path.irregularity == pytest.approx(8 * 0.5 / 10, abs=1e-4)
    nearby.places[:, 2] = np.linspace(0, 2.0, len(nearby.times))  # a bend that the path needs
    assert evaluate_navigation(nearby, "path", 0.3).path.irregularity == pytest.approx(0, abs=1e-9)


def test_frames_without_a_pose_are_named_and_left_out() -> None:
    times = np.arange(0, 10 * SECOND + 1, SECOND // 100)
    lost = (times > 4 * SECOND) & (times < 6 * SECOND)
    with pytest.warns(HumansimWarning, match=r"199 frames .* no pose of the robot.*: 4\.010 to 5\.990 s"):
        result = evaluate_navigation(drive({"anna": np.array([0.0, 0.5])}, known=~lost), "path", 0.3)
    assert (result.frames.without_pose, result.frames.compared) == (199, 802)
    assert result.nearest.distance == pytest.approx(np.hypot(1, 0.5))  # the nearest frames are lost
    assert (result.path.seconds, result.path.length) == pytest.approx((8, 8))
    with pytest.raises(EvaluationError, match="no pose at any of the 1001 frames"):
        evaluate_navigation(drive({"anna": np.array([0.0, 0.5])}, known=False), "path", 0.3)


def test_places_between_poses_that_are_near_in_time() -> None:
    times = np.array([0, 1, 2, 7, 8]) * SECOND // 5
    matrices = np.tile(np.eye(4), (5, 1, 1))
    matrices[:, 0, 3] = [0, 1, 2, 7, 8]
    turns = Rotation.from_euler("z", [[3.0], [3.1], [3.2], [3.3], [3.4]]).as_matrix()
    matrices[:, :3, :3] = turns
    places = RobotPath.of(times, matrices, "path").at(
        np.array([-1, 0, 1, 3, 4, 7, 15, 16, 17]) * SECOND // 10
    )
    np.testing.assert_allclose(places[:, 0], [np.nan, 0, 0.5, 1.5, 2, np.nan, 7.5, 8, np.nan])
    np.testing.assert_allclose(places[[1, 3, 7], 2], [3.0, 3.15, 3.4])


SCENE: dict[str, Any] = {
    "room": None,
    "rate": 10,
    "humans": {
        "anna": {"body": "child", "motion": {"file": "walk", "position": [0.0, -0.4]}},
        "ben": {"motion": {"file": "wave", "position": [1.0, 1.2]}},
    },
    "robot": {"path": {"points": [[-1.2, 0.0], [1.2, 0.0], [1.2, 0.9]], "speed": 1.6}},
    "cameras": {"front": {"position": [3, 0, 1], "look_at": [0, 0, 1]}},
}


def test_bodies_of_a_scene_are_those_of_the_simulation(tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump({**SCENE, "rate": 5}))
    compared = evaluate(file, f"{file}:/odom", radius=0.2)
    result, scene = compared.data, Scene.load(file)
    with Simulation(scene, channels=()) as simulation:
        frames = [simulation.frame(index) for index in range(result["frames"]["compared"])]
    top = scene.objects["robot"].mesh.vertices[:, 2].max()
    for name in scene.actors:
        states = [frame.humans[name] for frame in frames]
        robots = [frame.robot.position[:2] for frame in frames if frame.robot is not None]
        bodies = [state.vertices[state.vertices[:, 2] <= top][:, :2] for state in states]
        clearances = [cKDTree(body).query(robot)[0] - 0.2 for body, robot in zip(bodies, robots, strict=True)]
        hips = [
            state.positions[[state.joint_names.index(f"{side}_hip") for side in "lr"]] for state in states
        ]
        distances = [
            np.linalg.norm(pair.mean(axis=0)[:2] - robot) for pair, robot in zip(hips, robots, strict=True)
        ]
        own = result["by_person"][name]
        assert own["clearance"] == pytest.approx(min(clearances), abs=1e-6)
        assert own["distance"] == pytest.approx(min(distances), abs=1e-6)
        touching = np.array(clearances) <= 0
        assert own["collisions"] == (np.diff(touching.astype(int), prepend=0) > 0).sum()
    assert result["nearest"]["collisions"] >= 1
    assert result["path"]["length"] == pytest.approx(2.4 + 0.9 + np.hypot(2.4, 0.9), abs=1.6 / 5)
    assert result["radius"] == 0.2
    assert "collisions" in compared.table and "collisions" in compared.page()
    with pytest.raises(EvaluationError, match="a scene file has the topic /odom only"):
        read_robot_path(f"{file}:/tf", None)


# -- bags


def types(name: str) -> Any:
    return message_types().types[name]


def stamped(stamp: int, frame: str) -> Any:
    return types("std_msgs/msg/Header")(types("builtin_interfaces/msg/Time")(*divmod(stamp, SECOND)), frame)


def turned(yaw: float) -> Any:
    return types("geometry_msgs/msg/Quaternion")(0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))


def odometry(
    stamp: int, x: float, y: float, frame: str = "odom", yaw: float = 0.0, length: float = 1.0
) -> Any:
    rotation = turned(yaw)
    rotation.w *= length
    pose = types("geometry_msgs/msg/Pose")(types("geometry_msgs/msg/Point")(x, y, 0.0), rotation)
    zero = types("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
    twist = types("geometry_msgs/msg/Twist")(zero, zero)
    covered = types("geometry_msgs/msg/PoseWithCovariance")(pose, np.zeros(36))
    moving = types("geometry_msgs/msg/TwistWithCovariance")(twist, np.zeros(36))
    return types("nav_msgs/msg/Odometry")(stamped(stamp, frame), "base_link", covered, moving)


def tf(stamp: int, parent: str, child: str, x: float, y: float, yaw: float = 0.0) -> Any:
    moved = types("geometry_msgs/msg/Transform")(types("geometry_msgs/msg/Vector3")(x, y, 0.0), turned(yaw))
    one = types("geometry_msgs/msg/TransformStamped")(stamped(stamp, parent), child, moved)
    return types("tf2_msgs/msg/TFMessage")([one])


ODOMETRY, TF = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"


def bag_of(folder: Path, *messages: tuple[str, int, Any]) -> Path:
    kinds = {topic: content.__msgtype__ for topic, _, content in messages}
    names = list(kinds)
    with BagWriter(folder, [BagTopic(name, kind) for name, kind in kinds.items()]) as writer:
        for topic, log, content in messages:
            data = message_types().serialize_cdr(content, kinds[topic])
            writer.write([BagMessage(names.index(topic), log, data)])
    return folder


def test_transforms_lead_from_odometry_to_map(tmp_path: Path) -> None:
    half = SECOND // 2
    bag = bag_of(
        tmp_path / "bag",
        ("/tf_static", 1, tf(0, "base_footprint", "base_link", 0.1, 0.0)),
        ("/tf", 1, tf(1, "map", "odom", 10.0, 0.0, np.pi / 2)),
        ("/tf", 2, tf(1, "odom", "base_footprint", 1.0, 0.0)),
        ("/odom", 3, odometry(1, 1.0, 0.0)),
        ("/tf", half, tf(half, "map", "odom", 20.0, 0.0, np.pi / 2)),
        ("/tf", half + 1, tf(half, "odom", "base_footprint", 2.0, 0.0)),
        ("/odom", half + 2, odometry(half, 2.0, 0.0)),
    )
    assert is_robot_path(f"{bag}:/odom") and not is_robot_path(f"{bag}:/poses")
    places = read_robot_path(f"{bag}:/odom", None).places
    np.testing.assert_allclose(places, [[10, 1, np.pi / 2], [20, 2, np.pi / 2]], atol=1e-12)
    places = read_robot_path(f"{bag}:/tf", None).places  # base_link is ahead of the frame that moves
    np.testing.assert_allclose(places, [[10, 1.1, np.pi / 2], [20, 2.1, np.pi / 2]], atol=1e-12)


def test_a_clock_that_goes_back_is_refused(tmp_path: Path) -> None:
    bag = bag_of(
        tmp_path / "bag",
        *(
            ("/odom", index, odometry(stamp * SECOND, 0.0, 0.0, "map"))
            for index, stamp in enumerate((5, 6, 2, 3))
        ),
    )
    moved = [
        ("/tf", index, tf(stamp * SECOND, "map", "base_link", 0.0, 0.0))
        for index, stamp in enumerate((5, 6, 2))
    ]
    fixed = ("/tf_static", 9, tf(0, "base_link", "lidar", 0.1, 0.0))  # static ones have any stamp
    for topic, own in (("/odom", bag), ("/tf", bag_of(tmp_path / "tf", *moved, fixed))):
        back = r"goes back from 6\.000 s to 2\.000 s at pose 3"
        with pytest.raises(EvaluationError, match=back) as caught:
            read_robot_path(f"{own}:{topic}", None)
        assert (caught.value.path, caught.value.key) == (str(own), topic)


def test_paths_that_have_no_place_are_refused(tmp_path: Path) -> None:
    bag = bag_of(tmp_path / "one", ("/odom", 1, odometry(1, 0.0, 0.0)))
    with pytest.raises(EvaluationError, match="no transforms lead from 'odom' to map: record /tf"):
        read_robot_path(f"{bag}:/odom", None)
    scene = Scene.from_dict(SCENE)
    np.testing.assert_allclose(read_robot_path(f"{bag}:/odom", scene).places, [[-1.2, 0, 0]], atol=1e-12)
    with pytest.raises(EvaluationError, match="at other times than the robot"):
        scene_nearby(scene, RobotPath.of(np.array([SECOND // 2]), np.eye(4)[None], "between two frames"))
    bag = bag_of(tmp_path / "two", ("/odom", 1, odometry(1, 0.0, 0.0, "map", length=2.0)))
    with pytest.raises(EvaluationError, match="its quaternion has not length 1"):
        read_robot_path(f"{bag}:/odom", None)
    bag = bag_of(tmp_path / "three", ("/tf", 1, tf(1, "map", "camera", 0, 0)))
    with pytest.raises(EvaluationError, match="no pose of base_link"):
        read_robot_path(f"{bag}:/tf", None)


def test_transforms_in_a_loop_are_refused(tmp_path: Path) -> None:
    bag = bag_of(
        tmp_path / "loop",
        ("/odom", 1, odometry(1, 0.0, 0.0)),
        ("/tf", 1, tf(1, "base_link", "odom", 0, 0)),
        ("/tf", 2, tf(1, "odom", "base_link", 0, 0)),
    )
    for topic, frame in (("/odom", "odom"), ("/tf", "base_link")):
        with pytest.raises(EvaluationError, match=f"no transforms lead from '{frame}' to map"):
            read_robot_path(f"{bag}:{topic}", None)


def test_a_frame_with_two_parents_is_refused(tmp_path: Path) -> None:
    bag = bag_of(
        tmp_path / "two",
        ("/tf", 1, tf(1, "map", "odom", 0, 0)),
        ("/tf", 2, tf(2, "odom", "base_link", 1, 0)),
        ("/tf", 3, tf(3, "map", "base_link", 5, 0)),
        ("/tf", 4, tf(4, "map", "cup", 0, 0)),
        ("/tf", 5, tf(5, "base_link", "cup", 0, 0)),  # a cup that the robot takes
    )
    with pytest.raises(EvaluationError, match="'base_link' has two parents, 'odom' and 'map'") as caught:
        read_robot_path(f"{bag}:/tf", None)
    assert (caught.value.path, caught.value.key) == (str(bag), "/tf")


@pytest.mark.parametrize("topic", ["/odom", "/tf"])
def test_damaged_paths_are_refused_or_finite(tmp_path: Path, topic: str) -> None:
    dice, errors = random.Random(f"{topic}3"), list[EvaluationError]()
    whole = [
        ("/tf_static", tf(0, "base_footprint", "base_link", 0.1, 0.0)),
        ("/tf", tf(1, "/map", "odom", 10.0, 0.0, np.pi / 2)),
        ("/tf", tf(SECOND, "odom", "base_footprint", 1.0, 0.0)),
        ("/odom", odometry(1, 1.0, 0.0)),
        ("/odom", odometry(SECOND, 2.0, 0.0)),
    ]
    names = ["/tf_static", "/tf", "/odom"]
    kinds = {name: content.__msgtype__ for name, content in whole}
    for number in range(150):
        bag = tmp_path / str(number)
        with BagWriter(bag, [BagTopic(name, kinds[name]) for name in names]) as writer:
            for log, (name, content) in enumerate(whole):
                data = message_types().serialize_cdr(content, kinds[name])
                if dice.random() < 0.2:
                    data = mutated_bytes(data, dice)
                writer.write([BagMessage(names.index(name), log, data)])
        try:
            path = read_robot_path(f"{bag}:{topic}", None)
        except EvaluationError as error:
            errors.append(error)
        else:
            assert np.isfinite(path.places).all() and (np.diff(path.times) > 0).all()
    assert 30 < len(errors) < 120
    assert all(error.path is not None and error.key in names for error in errors)


@pytest.mark.nightly
def test_people_and_bodies_of_a_bag_are_those_of_its_scene(tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump(SCENE))
    bag, topics = tmp_path / "bag", ["/objects/robot/marker", "/odom", "/humans/*/joints"]
    record(file, bag, frames=16, topics=[*topics, "/humans/*/vertices"], jobs=1)
    robot = f"{bag}:/objects/robot/marker"
    found, expected = (evaluate(truth, robot, radius=0.2).data for truth in (bag, file))
    assert found["by_person"]["anna"]["distance"] == pytest.approx(expected["by_person"]["anna"]["distance"])
    # the truth of a bag does not know the height of the robot: no body is above it
    for name, own in found["by_person"].items():
        assert own["clearance"] <= expected["by_person"][name]["clearance"] + 1e-6
    assert evaluate(file, f"{bag}:/odom").data["nearest"] == evaluate(file, robot).data["nearest"]
    record(file, tmp_path / "joints", frames=4, topics=topics, jobs=1)
    without = evaluate(tmp_path / "joints", f"{tmp_path / 'joints'}:/objects/robot/marker").data
    assert without["radius"] == 0.3 and without["nearest"]["collisions"] is None
    with pytest.raises(EvaluationError, match="is for 3D poses; the estimate is the path of a robot"):
        evaluate(bag, robot, gate=1.0)
    with pytest.raises(EvaluationError, match="--radius: needs the path of a robot"):
        evaluate(bag, f"{bag}:/humans/*/joints", radius=1.0)
