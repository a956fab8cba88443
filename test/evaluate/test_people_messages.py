"""Trackers that publish one point a person: vision_msgs, people_msgs and SPENCER, without any adapter."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from humansim_ros import Scene, Simulation, evaluate
from humansim_ros.data.bags.topics import BagMessage, BagTopic, described, message_types
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.data.evaluation.readers.estimates import bag_transforms
from humansim_ros.data.messages.cameras import extrinsics_message, transform_message
from humansim_ros.data.messages.cdr import serialised
from humansim_ros.data.messages.people import DETECTIONS_2D, MESSAGE_TYPES
from humansim_ros.data.messages.stacks.adapters import adapter_topics
from humansim_ros.data.messages.transforms import TF, Transforms, read_links
from humansim_ros.data.messages.types import made_type, readable_type
from humansim_ros.errors import EvaluationError, HumansimWarning, RosError
from humansim_ros.scene.core.frame import Frame

FRAMES = 12
SCENE: dict[str, Any] = {
    "rate": 20,
    "room": None,
    "humans": {
        "anna": {"motion": {"file": "walk", "position": [0, -1.0]}},
        "ben": {"motion": {"file": "walk_straight", "position": [-0.5, 1.0]}},
    },
    "robot": {"path": {"points": [[-2, 0], [2, 0.3]], "speed": 1.5}},
    "cameras": {"ahead": {"size": [64, 48], "mount": "robot", "position": [0, 0, 1], "look_at": [1, 0, 0.9]}},
}


LEFT = {"size": [96, 72], "position": [4, 0, 2], "look_at": [0, 0, 1], "fov_deg": 60}


def scene_with(path: Path, adapters: dict[str, Any]) -> Scene:
    path.write_text(json.dumps({**SCENE, "adapters": adapters}))
    return Scene.load(path)


def frame_of(scene: Scene, index: int) -> Frame:
    """Frame of a scene without images."""
    time = scene.frame_time(index)
    humans = {name: actor.at(time * 1e-9) for name, actor in scene.actors.items()}
    robot = scene.objects["robot"].pose_at
    assert robot is not None and scene.robot is not None
    return Frame(
        index,
        1 + time,
        humans,
        {},
        objects={"robot": robot(time * 1e-9)},
        labels=scene.labels,
        scene_time=time,
        robot=scene.robot.base_at(time * 1e-9),
        camera_poses={
            name: camera.pose(time * 1e-9) for name, camera in scene.scene_cameras.items() if camera.moves
        },
    )


def write(folder: Path, topics: dict[str, str], rows: Sequence[tuple[str, int, Any]]) -> Path:
    """Write a bag. ``rows``: topic, stamp and message."""
    names = list(topics)
    with BagWriter(folder, [described(BagTopic(name, kind)) for name, kind in topics.items()]) as writer:
        for topic, stamp, message in sorted(rows, key=lambda row: row[1]):
            data = BagMessage(names.index(topic), stamp, serialised(message, topics[topic]))
            writer.write([data])
    return folder


def bag_of(
    scene: Scene, folder: Path, change: Callable[[int, Any], Any] = lambda _, message: message, tf: str = ""
) -> Path:
    """Bag of the only adapter of a scene, as of a tracker. ``tf``: topics of tf, in which the robot is."""
    (topic,) = (each for each in adapter_topics(scene) if each.per_frame)
    topics, rows = {"/tracker": topic.type_name}, []
    for index in range(FRAMES):
        frame = frame_of(scene, index)
        rows.append(("/tracker", frame.stamp, change(index, topic.message(frame))))
        base = frame.robot
        if tf and base is not None:
            pose = transform_message(base.position, base.rotation, frame.stamp, "map", "base_link")
            rows.append((tf, frame.stamp, made_type(TF)(transforms=[pose])))
            topics[tf] = TF
    return write(folder, topics, rows)


@pytest.mark.parametrize("adapter", ["people", "tracked_persons"])
@pytest.mark.parametrize("frame_id", ["map", "base_link"])
def test_the_truth_as_an_estimate_has_no_error(tmp_path: Path, adapter: str, frame_id: str) -> None:
    scene = scene_with(tmp_path / "scene.yaml", {adapter: frame_id})
    bag = bag_of(scene, tmp_path / "bag", tf="" if frame_id == "map" else "/tf")
    data = evaluate(tmp_path / "scene.yaml", f"{bag}:/tracker").data
    assert data["position"]["mpjpe"] < 1e-9 and list(data["by_joint"]) == ["ground"]
    assert data["people"] == {
        "present": 2 * FRAMES,
        "found": 2 * FRAMES,
        "missed": 0,
        "false": 0,
        "recall": 1.0,
        "precision": 1.0,
    }
    assert {key: data["tracking"][key] for key in ("hota", "mota", "idf1", "switches")} == pytest.approx(
        {"hota": 1.0, "mota": 1.0, "idf1": 1.0, "switches": 0}
    )


def test_boxes_are_compared_at_their_middle(tmp_path: Path) -> None:
    """The error is the distance from the hips to the middle of the box, whatever the height."""
    scene = scene_with(tmp_path / "scene.yaml", {"detections_3d": {}})

    def higher(_: int, message: Any) -> Any:
        for found in message.detections:
            found.bbox.center.position.z += 5.0
        return message

    bag = bag_of(scene, tmp_path / "bag", higher)
    data = evaluate(tmp_path / "scene.yaml", f"{bag}:/tracker").data
    distances = []
    for index in range(FRAMES):
        for state in frame_of(scene, index).humans.values():
            joints = dict(zip(state.joint_names, state.positions, strict=True))
            across = (joints["l_hip"] - joints["r_hip"])[:2]
            axes = np.array([[across[1], -across[0]], across]) / np.linalg.norm(across)
            spread = state.vertices[:, :2] @ axes.T
            middle = axes.T @ (spread.min(axis=0) + spread.max(axis=0)) / 2
            distances.append(np.linalg.norm(middle - (joints["l_hip"] + joints["r_hip"])[:2] / 2))
    assert data["position"]["mpjpe"] == pytest.approx(np.mean(distances), abs=1e-6)
    assert 0.01 < data["position"]["mpjpe"] < 0.3 and data["tracking"]["idf1"] == 1.0


def test_errors_swaps_and_losses_are_counted(tmp_path: Path) -> None:
    scene = scene_with(tmp_path / "scene.yaml", {"people": {}})

    def worse(index: int, message: Any) -> Any:
        for person in message.people:
            person.position.x += 0.03
        if index >= FRAMES // 2:  # the names are changed
            first, second = message.people
            first.name, second.name = second.name, first.name
        if index == 3:
            del message.people[1]
        if index == 4:
            message.people[1].position.y += 9.0
        return message

    bag = bag_of(scene, tmp_path / "bag", worse)
    data = evaluate(tmp_path / "scene.yaml", f"{bag}:/tracker").data
    assert data["position"]["mpjpe"] == pytest.approx(0.03, abs=1e-9)
    assert (data["people"]["missed"], data["people"]["false"]) == (2, 1)
    assert data["tracking"]["switches"] == 2
    assert data["tracking"]["mota"] == pytest.approx(1 - (2 + 1 + 2) / (2 * FRAMES))


def test_a_frame_that_tf_does_not_know_is_refused(tmp_path: Path) -> None:
    scene = scene_with(tmp_path / "scene.yaml", {"people": "base_link"})
    bag = bag_of(scene, tmp_path / "bag")
    with pytest.raises(EvaluationError, match="frame_id is 'base_link', and tf has no transform") as caught:
        evaluate(tmp_path / "scene.yaml", f"{bag}:/tracker")
    assert caught.value.key == "/tracker"


def test_damaged_transforms_are_refused(tmp_path: Path) -> None:
    scene = scene_with(tmp_path / "scene.yaml", {"people": "base_link"})
    bag_of(scene, tmp_path / "bag")
    bad = transform_message(np.full(3, np.nan), np.array([0, 0, 0, 1.0]), 1, "map", "base_link")
    (topic,) = adapter_topics(scene)
    rows = [
        ("/tracker", 2, topic.message(frame_of(scene, 0))),
        ("/tf_static", 1, made_type(TF)(transforms=[bad])),
    ]
    topics = {"/tracker": topic.type_name, "/tf_static": TF}
    with pytest.raises(EvaluationError, match="a transform is not finite"):
        evaluate(tmp_path / "scene.yaml", f"{write(tmp_path / 'other', topics, rows)}:/tracker")


def link(parent: str, child: str, x: float, second: int) -> bytes:
    """Serialised message with one transform."""
    moved = transform_message(
        np.array([x, 0.0, 0.0]), np.array([0.0, 0, 0, 1]), second * 10**9, parent, child
    )
    return bytes(serialised(made_type(TF)(transforms=[moved]), TF))


def test_transforms_of_a_bag_are_all_kept_and_a_loop_leads_nowhere() -> None:
    for kept, first in ((2, 1.0), (None, 0.0)):
        transforms = Transforms(kept)
        for second in range(3):
            transforms.add(link("map", "a", second, second))
        for stamp, x in ((-(10**18), first), (0, first), (2 * 10**9 - 1, 1.0), (10**18, 2.0)):
            found = transforms.pose("/a", stamp)
            assert found is not None and (found[0][0, 3], found[1]) == (x, "map")
    for parent, child in (("b", "c"), ("c", "b")):
        transforms.add(link(parent, child, 0.0, 0))
    assert transforms.pose("b", 0) is None and transforms.pose("d", 0) is None


@pytest.mark.parametrize("little_endian", [True, False])
def test_transforms_are_read_as_rosbags_reads_them(little_endian: bool) -> None:
    """Names of all lengths: the numbers behind them are aligned to eight bytes."""
    turn = np.array([0.5, -0.5, 0.5, 0.5])
    parts = [
        transform_message(np.array([n, 0.25, -n]), turn, n * 10**9 + n, "p" * (n // 9 + 1), "c" * n)
        for n in range(1, 40)
    ]
    data = bytes(
        message_types().serialize_cdr(made_type(TF)(transforms=parts), TF, little_endian=little_endian)
    )
    theirs: Any = message_types().deserialize_cdr(data, TF)
    transforms = Transforms(kept=None)
    transforms.add(data)
    for each, (parent, child, stamp, _) in zip(theirs.transforms, read_links(data), strict=True):
        assert (parent, child) == (each.header.frame_id, each.child_frame_id)
        assert stamp == each.header.stamp.sec * 10**9 + each.header.stamp.nanosec
        place, found = each.transform.translation, transforms.pose(child, stamp)
        assert found is not None and found[1] == parent
        np.testing.assert_array_equal(found[0][:3, 3], [place.x, place.y, place.z])
    for end in range(4, len(data), 7):
        with pytest.raises(RosError, match="ends too early"):
            Transforms().add(data[:end])


def test_of_static_transforms_the_last_one_holds_for_all_times() -> None:
    """As in tf2: a StaticCache has one transform, whatever its stamp; another kind begins with nothing."""
    transforms = Transforms(kept=None)
    # x, parent, stamp and topic of each message, and x of the frame at 0 s and 9 s after it
    for x, parent, second, topic, expected in (
        (1.0, "map", 5, "/tf_static", (1, 1)),
        (2.0, "map", 7, "/tf_static", (2, 2)),
        (3.0, "map", 2, "/tf_static", (3, 3)),
        (4.0, "map", 4, "/tf", (4, 4)),
        (5.0, "map", 6, "/tf", (4, 5)),
        (6.0, "odom", 0, "/lab/tf_static", (6, 6)),
    ):
        transforms.add(link(parent, "a", x, second), topic)
        found = [transforms.pose("a", stamp) for stamp in (0, 9 * 10**9)]
        assert [(each[0][0, 3], each[1]) for each in found if each] == [(each, parent) for each in expected]


def test_only_the_frames_that_lead_to_map_are_read_from_a_bag(tmp_path: Path) -> None:
    """The transforms of other frames are not even looked at: one of them is impossible."""
    links = (("odom", "base", 1.0), ("base", "camera", 2.0), ("map", "odom", 4.0), ("map", "other", np.nan))
    with BagWriter(tmp_path / "bag", [described(BagTopic("/tf", TF))]) as writer:
        for second, each in enumerate(links):
            writer.write([BagMessage(0, second, link(*each, second))])
    found = bag_transforms(tmp_path / "bag", ["/camera"])
    pose = found.pose("camera", 0)
    assert pose is not None and (pose[0][0, 3], pose[1]) == (7.0, "map")
    assert found.pose("other", 0) is None
    with pytest.raises(EvaluationError, match="a transform is not finite") as caught:
        bag_transforms(tmp_path / "bag", ["camera", "other"])
    assert caught.value.key == "/tf"


def test_positions_in_the_frame_of_a_camera_of_a_recording(tmp_path: Path) -> None:
    """``<camera>/extrinsics``, which recordings have, is a transform, too."""
    scene = scene_with(tmp_path / "scene.yaml", {"people": "ahead_optical_frame"})
    (topic,) = adapter_topics(scene)
    topics = {"/tracker": topic.type_name, "/ahead/extrinsics": "geometry_msgs/msg/TransformStamped"}
    rows = []
    for index in range(FRAMES):
        frame = frame_of(scene, index)
        camera = scene.scene_cameras["ahead"].camera_at(frame.camera_poses["ahead"])
        pose = extrinsics_message(camera, frame.stamp, "ahead_optical_frame")
        rows += [("/tracker", frame.stamp, topic.message(frame)), ("/ahead/extrinsics", frame.stamp, pose)]
    bag = write(tmp_path / "bag", topics, rows)
    data = evaluate(tmp_path / "scene.yaml", f"{bag}:/tracker").data
    assert data["position"]["mpjpe"] < 1e-9 and data["people"]["found"] == 2 * FRAMES


def test_a_truth_without_hips_is_refused(tmp_path: Path) -> None:
    scene = scene_with(tmp_path / "scene.yaml", {"people": {}})
    bag = bag_of(scene, tmp_path / "bag")
    with pytest.raises(EvaluationError, match="the truth no hips to compare it with"):
        evaluate(tmp_path / "scene.yaml", f"{bag}:/tracker", keypoints="left_hand21")


def test_keypoints_with_hips_are_a_truth_too(tmp_path: Path) -> None:
    """The hips of COCO are the hip joints of the body."""
    scene = scene_with(tmp_path / "scene.yaml", {"people": {}})
    bag = bag_of(scene, tmp_path / "bag")
    data = evaluate(tmp_path / "scene.yaml", f"{bag}:/tracker", keypoints="coco17").data
    assert data["position"]["mpjpe"] < 1e-6


def boxes_of(tmp_path: Path, topic: str, change: Callable[[Any], Any], box: str = "visible") -> str:
    """Bag with the boxes of camera ``left`` in three frames, as of a detector; returns its topic."""
    content = {**SCENE, "cameras": {**SCENE["cameras"], "left": {**LEFT}}}
    content["adapters"] = {"detections_2d": {"cameras": ["left"], "box": box}}
    (tmp_path / "scene.yaml").write_text(json.dumps(content))
    scene = Scene.load(tmp_path / "scene.yaml")
    (row, _) = adapter_topics(scene)
    rows = []
    with Simulation(scene, ("instance", "amodal")) as simulation:
        for frame in simulation.frames(3):
            rows.append((topic, frame.stamp, change(row.message(frame))))
    return f"{write(tmp_path / 'bag', {topic: row.type_name}, rows)}:{topic}"


def test_boxes_in_images_are_compared_with_the_images_of_a_scene(tmp_path: Path) -> None:
    """The second person is lost in each message, and there is one false box with a low score."""

    def worse(message: Any) -> Any:
        assert len(message.detections) == 2
        false = message.detections[1]
        false.bbox.center.position.x += 40.0
        false.results[0].hypothesis.score = 0.1
        return message

    topic = boxes_of(tmp_path, "/left/detector", worse)
    data = evaluate(tmp_path / "scene.yaml", topic).data["boxes"]["all"]
    assert (data["present"], data["found"], data["false"]) == (6, 3, 3)
    assert data["similarity"] == pytest.approx(0.5)
    assert data["precision"]["ap"] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("topic", "change", "text"),
    [
        (
            "/detector",
            lambda m: with_frame(m, "elsewhere"),
            "no camera of frame_id 'elsewhere'",
        ),
        ("/left/detector", lambda m: at_wall_clock(m), r"the truth has no frame \d+ \(stamp 176"),
        ("/left/detector", lambda m: turned(m), "a box is rotated"),
        ("/left/detector", lambda m: turned(m, size_x=-1.0), "has a negative size"),
        ("/left/detector", lambda m: turned(m, size_y=float("nan")), "a box is not finite"),
    ],
)
def test_boxes_in_images_that_cannot_be_read_are_refused(
    tmp_path: Path, topic: str, change: Callable[[Any], Any], text: str
) -> None:
    with pytest.raises(EvaluationError, match=text) as caught:
        evaluate(tmp_path / "scene.yaml", boxes_of(tmp_path, topic, change))
    assert caught.value.key == topic


def with_frame(message: Any, frame_id: str) -> Any:
    message.header.frame_id = frame_id
    return message


def at_wall_clock(message: Any) -> Any:
    message.header.stamp.sec = 1_760_000_000
    return message


def turned(message: Any, **values: float) -> Any:
    box = message.detections[0].bbox
    for key, value in (values or {"theta": 0.3}).items():
        setattr(box.center if key == "theta" else box, key, value)
    return message


def test_a_topic_with_another_version_of_the_message_is_refused(tmp_path: Path) -> None:
    """vision_msgs 2 has other detections; the definition in the bag says so."""
    old = "std_msgs/Header header\nDetection3D[] detections\n" + "=" * 80 + "\n"
    old += "MSG: vision_msgs/Detection3D\nstd_msgs/Header header\nstring tracking_id\n"
    topic = BagTopic("/tracker", "vision_msgs/msg/Detection3DArray", (), old, "RIHS01_" + "0" * 64)
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(
        {
            name: fields
            for name, fields in get_types_from_msg(old, topic.type).items()
            if name not in store.fielddefs
        }
    )
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](0, 1), "map")
    found = store.types["vision_msgs/msg/Detection3D"](header, "7")
    message = store.types[topic.type](header, [found])
    data = BagMessage(0, 1, memoryview(store.serialize_cdr(message, topic.type)))
    with BagWriter(tmp_path / "bag", [topic]) as writer:
        writer.write([data])
    scene_with(tmp_path / "scene.yaml", {})
    with pytest.raises(EvaluationError, match="Detection3DArray is of a version that is not known here"):
        evaluate(tmp_path / "scene.yaml", f"{tmp_path / 'bag'}:/tracker")


def test_the_page_matches_people_of_one_point(tmp_path: Path) -> None:
    from humansim_ros.data.evaluation.live import LiveOptions
    from humansim_ros.data.messages.people import read_people
    from humansim_ros.view.sources.topic_people import beside_truth

    scene = scene_with(tmp_path / "scene.yaml", {"detections_3d": {}, "people": {}})
    topic = next(each for each in adapter_topics(scene) if each.name == "people")
    frame = frame_of(scene, 3)
    message = topic.message(frame)
    for person in message.people:
        person.name, person.position.x = f"track_{person.name}", person.position.x + 0.04
    truth = {name: (state.joint_names, state.positions) for name, state in frame.humans.items()}
    estimate = read_people(topic.type_name, message, None).people
    points, errors = beside_truth(estimate, truth, LiveOptions.of("", "", 1.0, "", 0.5))
    assert points.keys() == errors.keys() == {"anna", "ben"}
    assert list(errors.values()) == pytest.approx([40.0, 40.0])


@pytest.mark.parametrize("kind", [*MESSAGE_TYPES, DETECTIONS_2D])
def test_messages_without_people_are_frames_in_which_nobody_is_found(kind: str, tmp_path: Path) -> None:
    """Of every type, without a keypoint set. Markers of nobody have no stamp: the log time stands for it."""
    scene, rows = scene_with(tmp_path / "scene.yaml", {}), []
    for index in range(FRAMES):
        stamp, message = 1 + scene.frame_time(index), readable_type(kind)()
        if hasattr(message, "header"):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            message.header.frame_id = "map"
        rows.append(("/ahead/found", stamp, message))
    bag = write(tmp_path / "bag", {"/ahead/found": kind, "/none": kind}, rows)
    with pytest.warns(HumansimWarning, match="nobody is in the estimate: everybody is missed"):
        data = evaluate(tmp_path / "scene.yaml", f"{bag}:/ahead/found").data
    if kind == DETECTIONS_2D:
        assert data["images"] == FRAMES and data["keypoints"] is None
        assert data["boxes"]["all"]["found"] == data["boxes"]["all"]["false"] == 0
    else:
        assert data["frames"]["compared"] == FRAMES and data["frames"]["without_estimate"] == 0
        assert data["people"]["missed"] == 2 * FRAMES and data["people"]["recall"] == 0
        with pytest.raises(
            EvaluationError, match=r"there is no message on /none; the bag has poses on /ahead"
        ):
            evaluate(tmp_path / "scene.yaml", f"{bag}:/none")
