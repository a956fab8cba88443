"""Tracks of the timeline: what they say is what the truth, the keyframes and the faults of a scene say."""

from __future__ import annotations

import json
import pickle
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labs import lab, write_estimate
from waiting import wait_until

from humansim_ros import Scene, Simulation, evaluate
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.topics import BagMessage, BagTopic, Qos
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.data.engine import run
from humansim_ros.data.evaluation.evaluation import evaluate_poses
from humansim_ros.data.evaluation.readers.estimates import read_estimates
from humansim_ros.data.evaluation.readers.pose_files import ReadOptions
from humansim_ros.data.evaluation.truth import RecordedTruth
from humansim_ros.data.recording import SceneRecording
from humansim_ros.motion.body.skeleton import body_joints
from humansim_ros.motion.files.keyframes import KeyframeTimeline, KeyframeTrack
from humansim_ros.view.sources.bag_source import BagViewSource
from humansim_ros.view.sources.tracks import (
    ArrivedFrame,
    LiveTracks,
    SceneTracks,
    Tracker,
    TrackOutline,
    TrackReader,
    Tracks,
    TrackSample,
    _Asked,
    coarse_to_fine,
    has_message,
    key_frames,
    lost_frames,
    spans_of,
)

SCENE = lab(
    10,
    {
        "left": "position: [3, 2, 1.6], look_at: [0, 0, 1], size: [160, 120], "
        "faults: {drop: {probability: 0.3}}",
        "away": "position: [3, 0, 1.6], look_at: [9, 0, 1], size: [160, 120]",
    },
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("tracks") / "lab.yaml"
    path.write_text(SCENE)
    return Scene.load(path)


def test_visibility_and_joints_are_the_published_truth(scene: Scene) -> None:
    job = SceneTracks(scene, 20, ("left", "away"))
    tracker = job.start()
    try:
        outline = tracker._worker.outline()
        sample, moved = tracker._worker.views(7), tracker._worker.motion(7)
    finally:
        tracker.close()
    with Simulation(scene, channels=("depth", "instance", "part")) as simulation:
        frame = simulation.frame(7)
    for person in ("anna", "ben"):
        body = body_joints(scene.actors[person].human.skeleton.joint_names)
        states = frame.truth["left"].joints[person].visible[body].tolist()
        expected = states.count(2) / len(states), states.count(1) / len(states)
        assert sample.seen[person]["left"] == pytest.approx(expected)
        assert expected[0] > 0.3
        assert sample.seen[person]["away"] == (0.0, 0.0)
        truth = frame.humans[person].joints[:, :3, 3]
        assert np.abs(moved.joints[person] - truth).max() < 1e-5
        assert len(outline.joints[person]) == len(truth)
    tracks = Tracks(outline)
    tracks.take("views", {7: sample})
    tracks.take("motion", {7: moved})
    table = tracks.table()
    assert table["sampled"] == [7] and table["visible"]["anna"]["away"] == [0]
    curve = tracks.curve("anna", "l_wrist")
    assert curve is not None and curve["frames"] == [7]
    number = list(outline.joints["anna"]).index("l_wrist")
    point = [curve["lines"][axis][0] for axis in "xyz"]
    assert point == pytest.approx(frame.humans["anna"].joints[number, :3, 3].tolist(), abs=1e-4)
    assert tracks.curve("anna", "tail") is None and tracks.curve("nobody", "l_wrist") is None


def test_drops_are_the_frames_without_an_image(scene: Scene) -> None:
    tracker = SceneTracks(scene, 40, ("left", "away")).start()
    drops = tracker._worker.outline().drops
    tracker.close()
    schedule = scene.scene_cameras["left"].faults
    assert schedule is not None
    lost = [index for index in range(40) if "drop" in schedule.at(index).kinds]
    assert drops == {"left": lost} and 4 < len(lost) < 24


@pytest.mark.parametrize(("loop", "expected"), [("none", [6, 36]), ("repeat", [6, 36, 66, 96])])
def test_keyframes_are_at_their_frames_in_each_round(loop: str, expected: list[int]) -> None:
    ones = np.ones((2, 3))
    track = KeyframeTrack(KeyframeTimeline(3, 23, 10.0, loop), np.array([5, 15]), ones, ones, ones)
    assert key_frames(track, 30.0, 120) == expected


def test_samples_go_from_coarse_to_fine() -> None:
    order = coarse_to_fine(1000, 120)
    assert len(order) == len(set(order)) == 120 and min(order) == 0 and max(order) == 999
    early = sorted(order[:16])  # every eighth, and the last
    assert max(np.diff(early)) < 2.2 * min(np.diff(early))
    assert sorted(coarse_to_fine(7, 120)) == list(range(7))
    assert coarse_to_fine(1, 120) == [0]


def test_people_who_come_and_go_have_several_spans() -> None:
    assert spans_of([True, True, False, True, False]) == [(0, 1), (3, 3)]
    assert spans_of([]) == []


@pytest.mark.slow
@pytest.mark.process
def test_the_tracks_of_another_source_replace_those_that_are_being_read(scene: Scene) -> None:
    found: list[tuple[int, Tracks]] = []
    begun = threading.Event()

    def publish(number: int, tracks: Tracks | str) -> None:
        assert isinstance(tracks, Tracks), tracks
        found.append((number, tracks))
        begun.set()

    reader = TrackReader(publish)
    try:
        first = reader.show(SceneTracks(scene, 500, ("left", "away")))
        reader.begin()
        assert begun.wait(120)
        second = reader.show(SceneTracks(scene, 5, ("left",)))
        reader.begin()
        assert wait_until(lambda: found[-1][0] == second and found[-1][1].is_whole)
    finally:
        reader.close()
    ours = [number for number, _ in found]
    assert ours == sorted(ours) and not any(each.is_whole for number, each in found if number == first)
    assert sorted(found[-1][1].table()["sampled"]) == list(range(5))
    assert list(found[-1][1].table()["visible"]["anna"]) == ["left"]


@pytest.mark.nightly
def test_an_unexpected_error_is_told_and_the_next_tracks_are_read(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[tuple[int, Any]] = []
    take, broken = Tracks.take, [True]

    def taken(self: Tracks, kind: str, samples: Any) -> None:
        if broken.pop():
            raise KeyError("left")
        broken.append(False)
        take(self, kind, samples)

    monkeypatch.setattr(Tracks, "take", taken)
    reader = TrackReader(lambda number, tracks: found.append((number, tracks)))
    try:
        first = reader.show(SceneTracks(scene, 5, ("left",)))
        reader.begin()
        assert wait_until(lambda: found and found[-1] == (first, "they could not be read: KeyError('left')"))
        broken.append(False)
        second = reader.show(SceneTracks(scene, 5, ("left",)))
        reader.begin()
        assert wait_until(lambda: found[-1][0] == second and found[-1][1].is_whole)
    finally:
        reader.close()


# --- bags


def tracker_of(source: BagViewSource) -> Tracker:
    job = source.tracks()
    assert job is not None
    return pickle.loads(pickle.dumps(job)).start()


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "walk"
    patterns = ["*/image_raw", "*/camera_info", "*/extrinsics", "*/joints", "*/legend"]
    run(SceneRecording.of(scene, 20, patterns, max_size=0), folder)
    return folder


def with_estimate(
    folder: Path,
    bag: Path,
    shifts: Mapping[str, tuple[str, float]],
    late: int = 0,
    left_out: Sequence[int] = (),
) -> Path:
    """A copy of the joints of a bag with an estimate: name of its people, whom they are, metres above."""
    from geometry_msgs.msg import Transform, Vector3
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import MultiDOFJointState

    from humansim_ros.data.messages import header

    kind = "sensor_msgs/msg/MultiDOFJointState"
    with BagReader(bag) as reader:
        topics = [each for each in reader.topics if each.type == kind]
        found = [
            (reader.topics[each.topic].name, each.stamp, bytes(each.data))
            for each in reader.messages([topic.name for topic in topics])
        ]
    names = [*(topic.name for topic in topics), "/tracker/poses"]
    messages = [BagMessage(names.index(name), log, data) for name, log, data in found]
    truth: dict[int, dict[str, Any]] = {}
    for name, log, data in found:
        truth.setdefault(log, {})[name.split("/")[2]] = deserialize_message(data, MultiDOFJointState)
    for number, (log, people) in enumerate(sorted(truth.items())):
        if number in left_out:
            continue
        stamp = people["anna"].header.stamp
        message = MultiDOFJointState(header=header(stamp.sec * 10**9 + stamp.nanosec + late, "map"))
        for person, (name, shift) in shifts.items():
            for joint, place in zip(people[name].joint_names, people[name].transforms, strict=True):
                point = place.translation
                message.joint_names.append(f"{person}/{joint}")
                above = Vector3(x=point.x, y=point.y, z=point.z + shift)
                message.transforms.append(Transform(translation=above))
        messages.append(BagMessage(len(topics), log + 1000, serialize_message(message)))
    listed = [*topics, BagTopic("/tracker/poses", kind, (Qos(),))]
    with BagWriter(folder, listed) as writer:
        writer.write(sorted(messages, key=lambda each: each.stamp))
    return folder


@pytest.mark.nightly
def test_tracks_of_a_bag_are_the_tracks_of_its_scene(scene: Scene, bag: Path) -> None:
    source = BagViewSource(bag)
    tracker, of_scene = tracker_of(source), SceneTracks(scene, 20, ("left", "away")).start()
    outline, expected = tracker._worker.outline(), of_scene._worker.outline()
    try:
        assert outline.frames == 20 and outline.period == 100_000_000
        assert outline.cameras == ("left", "away") or set(outline.cameras) == {"left", "away"}
        assert outline.spans == expected.spans and not outline.projected
        lost = expected.drops["left"]
        having = sorted(set(range(20)) - set(lost))
        assert outline.drops == {"left": [each for each in lost if having[0] < each < having[-1]]}
        index = having[3]
        sample, moved = tracker._worker.views(index), tracker._worker.motion(index)
        truth, true_moved = of_scene._worker.views(index), of_scene._worker.motion(index)
        assert sample.seen == truth.seen
        for person, names in expected.joints.items():
            order = [list(outline.joints[person]).index(name) for name in names]
            assert np.abs(moved.joints[person][order] - true_moved.joints[person]).max() < 1e-5
    finally:
        tracker.close()
        of_scene.close()
        source.close()


def test_without_joints_in_images_the_joints_are_projected(tmp_path: Path, bag: Path) -> None:
    with BagReader(bag) as reader:
        topics = [each for each in reader.topics if each.name not in ("/left/joints", "/away/joints")]
        found = [
            BagMessage(
                [topic.name for topic in topics].index(reader.topics[each.topic].name), each.stamp, each.data
            )
            for each in reader.messages([topic.name for topic in topics])
        ]
        with BagWriter(tmp_path / "bag", topics) as writer:
            writer.write(found)
    source = BagViewSource(tmp_path / "bag")
    tracker = tracker_of(source)
    assert set(tracker._worker.outline().projected) == {"left", "away"}
    seen = tracker._worker.views(4).seen["anna"]
    assert seen["left"][0] > 0.9 and seen["left"][1] == 0 and seen["away"] == (0.0, 0.0)
    tracker.close()
    source.close()


def test_errors_of_an_estimate_are_those_of_evaluate(tmp_path: Path, bag: Path) -> None:
    shifts = {"p7": ("anna", 0.02), "p8": ("ben", 0.05), "ghost": ("anna", 9.0)}
    path = with_estimate(tmp_path / "bag", bag, shifts, left_out=(0, 1, 8, 19))
    source = BagViewSource(path, estimate="/tracker/poses")
    tracker = tracker_of(source)
    found = tracker.work(_Asked(1, "errors"))
    tracks = Tracks(tracker._worker.outline())
    tracks.errors = found
    tracker.close()
    source.close()
    table = tracks.table()["errors"]
    assert table["frames"] == list(range(1, 20))
    for name, error in (("anna", 20.0), ("ben", 50.0)):
        assert table["values"][name] == [
            None if index in (1, 8, 19) else pytest.approx(error, abs=0.1) for index in range(1, 20)
        ]
    judge = evaluate_poses(
        RecordedTruth(path).joints, read_estimates([f"{path}:/tracker/poses"], ReadOptions())
    )
    assert judge.people.found == 2 * 16 and judge.position.mpjpe == pytest.approx(0.035, abs=1e-6)
    assert "ghost" in found.note and "p7" not in found.note


@pytest.mark.daily("topic-scene")
@pytest.mark.parametrize("truth", ["scene", "bag"])
@pytest.mark.parametrize("form", ["csv", "topic"])
def test_files_of_an_estimate_are_compared_with_a_scene_and_a_bag_as_evaluate_does(
    truth: str, form: str, tmp_path: Path, bag: Path, scene: Scene
) -> None:
    from humansim_ros.view.sources.inputs import TopicOptions, open_source

    assert scene.path is not None
    if form == "csv":
        estimate = str(tmp_path / "poses.csv")
        write_estimate(scene.path, Path(estimate), 12, {"anna": 0.02, "ben": 0.05})
    else:
        shifts = {"p_anna": ("anna", 0.02), "p_ben": ("ben", 0.05)}
        estimate = (
            f"{with_estimate(tmp_path / 'tracker', bag, shifts, left_out=range(12, 20))}:/tracker/poses"
        )
    path = {"scene": scene.path, "bag": bag}[truth]
    source = open_source(path, TopicOptions([estimate])).source
    job = source.tracks()
    assert job is not None
    tracker = pickle.loads(pickle.dumps(job)).start()
    tracks = Tracks(tracker._worker.outline())
    tracks.errors = tracker.work(_Asked(1, "errors"))
    tracker.close()
    shown = source.frame(4)
    source.close()
    table = tracks.table()["errors"]
    for name, error in (("anna", 20.0), ("ben", 50.0)):
        found = dict(zip(table["frames"], table["values"][name], strict=True))
        assert [found[index] for index in range(12)] == [pytest.approx(error, abs=0.1)] * 12
        assert shown.estimate_errors[name] == pytest.approx(error, abs=0.1) and name in shown.estimate
        assert not any(found.get(index) for index in range(12, 20))
    judge = evaluate(path, estimate).data
    assert 1000 * judge["position"]["mpjpe"] == pytest.approx(35.0, abs=0.1)


@pytest.mark.parametrize("rows", ["", "0,,,\n3,,,\n"])
def test_an_estimate_of_nobody_is_shown_with_a_note(rows: str, tmp_path: Path, scene: Scene) -> None:
    from humansim_ros.view.sources.inputs import TopicOptions, open_source

    assert scene.path is not None
    path = tmp_path / "nobody.csv"
    path.write_text(f"frame,l_knee_x,l_knee_y,l_knee_z\n{rows}")
    source = open_source(scene.path, TopicOptions([str(path)])).source
    job = source.tracks()
    assert job is not None and source.frames > 3
    tracker = pickle.loads(pickle.dumps(job)).start()
    found = tracker.work(_Asked(1, "errors"))
    assert not any(found.errors) and ("no poses" in found.note or "no person" in found.note)
    assert not source.frame(3).estimate
    tracker.close()
    source.close()


def test_an_estimate_that_is_longer_than_the_motions_is_shown_to_its_end(
    tmp_path: Path, scene: Scene
) -> None:
    from humansim_ros.data.evaluation.live import LiveOptions
    from humansim_ros.data.evaluation.pose_sequence import PoseSequence
    from humansim_ros.view.sources.scene_source import SceneViewSource
    from humansim_ros.view.sources.topic_people import Estimate

    source = SceneViewSource(scene)
    alone = source.frames
    stamps = 1 + np.arange(2 * alone) * 10**8
    poses = PoseSequence(("hip",), stamps, [{"p": np.zeros((1, 3))}] * len(stamps))
    source.estimate = Estimate(poses, LiveOptions())
    assert source.frames == 2 * alone
    source.estimate = Estimate(poses.delayed(1_700_000_000 * 10**9), LiveOptions())  # of a wall clock
    assert source.frames == alone
    job = source.tracks()
    assert job.plan is not None and "do not overlap in time" in job.plan.problem
    source.close()


@pytest.mark.parametrize(
    ("what", "estimate", "words"),
    [
        ("lab.yaml", "/tracker/poses", "only bags and graphs have topics"),
        ("lab.yaml", "poses.csv", "no such file"),
        ("lab.yaml", "boxes.json", "is detections in images"),
        ("walk", "boxes.json", "is no scene, bag or graph"),
    ],
)
def test_what_cannot_be_compared_is_refused_with_the_remedy(
    what: str, estimate: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from humansim_ros.errors import HumansimError
    from humansim_ros.view.sources.inputs import TopicOptions, open_source

    monkeypatch.chdir(tmp_path)
    Path("lab.yaml").write_text(SCENE)
    Path("boxes.json").write_text('[{"image_id": 1, "bbox": [0, 0, 1, 1], "score": 1}]')
    with pytest.raises(HumansimError, match=words):
        open_source(Path(what), TopicOptions([estimate]))


@pytest.mark.parametrize(
    ("shifts", "late", "words"),
    [
        ({"p7": ("anna", 0.02)}, 10**12, "do not overlap in time"),
        ({"p7": ("anna", 9.0)}, 0, "no person of the estimate is within 0.5 m"),
    ],
)
def test_an_estimate_that_fits_nothing_is_told_and_the_other_tracks_are_read(
    shifts: dict[str, tuple[str, float]], late: int, words: str, tmp_path: Path, bag: Path
) -> None:
    source = BagViewSource(with_estimate(tmp_path / "bag", bag, shifts, late), estimate="/tracker/poses")
    tracker = tracker_of(source)
    found = tracker.work(_Asked(1, "errors"))
    assert words in found.note and not any(found.errors)
    assert tracker._worker.motion(3).joints.keys() == {"anna", "ben"}
    tracker.close()
    source.close()


def test_a_bag_whose_end_is_broken_has_the_tracks_of_its_beginning(tmp_path: Path, bag: Path) -> None:
    whole = next(bag.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    source = BagViewSource(tmp_path / "cut.mcap")
    assert any("was not finished, or was cut" in text for text in source.messages)
    tracker = tracker_of(source)
    outline = tracker._worker.outline()
    assert 1 < outline.frames < 20 and outline.spans["anna"] == [(0, outline.frames - 1)]
    assert tracker._worker.motion(outline.frames - 1).joints.keys() == {"anna", "ben"}
    tracker.close()
    source.close()


def test_lost_frames_are_the_gaps_between_images() -> None:
    def lost(frames: Sequence[int], count: int = 12) -> list[int]:
        return lost_frames(np.isin(np.arange(count), frames))

    assert lost([2, 3, 4, 6, 7, 10]) == [5, 8, 9]
    assert lost([0, 2, 4, 8, 10]) == [6]  # every second frame has an image
    assert lost([5]) == [] and lost([]) == []
    stamps = np.array([0, 10, 20, 30])
    assert has_message(stamps, np.array([1, 14, 33]), 5).tolist() == [True, True, False, True]
    assert not has_message(stamps, np.array([], np.int64), 5).any()


def test_tracks_of_an_hour_are_thinned_out_and_say_so() -> None:
    count = 108_000
    lost = list(range(1, count, 2))
    there = [(first, first) for first in range(0, count, 2)]
    tracks = Tracks(
        TrackOutline(
            count, 33_333_333, ("a",), {"x": ("hip",)}, {"x": there}, drops={"a": lost}, most_views=60
        )
    )
    table = tracks.table()
    assert len(table["drops"]["a"]) <= 2000 and table["dropped"] == {"a": len(lost)}
    assert set(table["drops"]["a"]) <= set(lost) and max(np.diff(table["drops"]["a"])) <= 2 * count / 2000
    assert len(table["people"][0]["spans"]) <= 2000
    assert table["curves"] == 600 and table["planned"] == 60 and len(json.dumps(table)) < 50_000


# --- a running graph


def test_tracks_of_a_graph_grow_and_say_what_has_arrived() -> None:
    live = LiveTracks()
    period, lost = 50_000_000, {7, 8, 21}
    for index in range(40):
        stamp = 10**9 + index * period
        sample = None
        if live.wants_sample(stamp):
            joints = {"anna": np.full((2, 3), index, np.float32)}
            sample = TrackSample(joints, {"anna": {"left": (index / 100, 0.0)}})
        # the images of a camera are received from frame 4 on, and of the other one never
        images = {"left": index not in lost} if index >= 4 else {}
        people = frozenset(["anna"] if index < 30 else [])
        live.add(ArrivedFrame(stamp, people, images, sample, ["away"], {"anna": float(index)}))
    tracks = live.tracks(period, {"anna": ("hip", "head")}, ["left", "away"], ["away"], has_errors=True)
    table = tracks.table()
    assert table["frames"] == 40 and table["period"] == pytest.approx(0.05)
    assert table["drops"] == {"left": [7, 8, 21]}
    assert table["people"] == [{"name": "anna", "spans": [(0, 29)]}]
    assert table["sampled"] == list(range(0, 40, 5)) and table["visible"]["anna"]["left"] == table["sampled"]
    assert table["visible"]["anna"]["away"] == [None] * 8 and table["projected"] == ["away"]
    assert table["errors"] == {"frames": table["sampled"], "values": {"anna": table["sampled"]}}
    curve = tracks.curve("anna", "head")
    assert curve is not None and curve["lines"]["z"] == table["sampled"]
    # a camera that says what is occluded from frame 5 on has no projections before it
    sample = TrackSample(seen={"anna": {"left": (0.4, 0.0)}})
    other = LiveTracks()
    for index, projected in ((0, ["left"]), (5, [])):
        other.add(ArrivedFrame(index * period, frozenset(), {}, sample, projected))
    now = other.tracks(period, {"anna": ("hip",)}, ["left"]).table()
    assert now["visible"]["anna"]["left"] == [None, 40]


def test_tracks_of_a_graph_are_bounded_and_begin_again_with_a_new_run() -> None:
    live = LiveTracks()
    for index in range(20_000):  # more than ten minutes
        live.add(ArrivedFrame(10**9 + index * 33_333_333, frozenset(["anna"]), {"left": index % 2 == 0}))
    table = live.tracks(33_333_333, {"anna": ("hip",)}, ["left"]).table()
    assert 1790 < table["frames"] < 1810 and len(json.dumps(table)) < 50_000
    live.add(ArrivedFrame(5, frozenset(), {}))
    assert live.newest == 5 and live.tracks(33_333_333, {}, []).table()["frames"] == 1


def test_frames_that_the_page_did_not_follow_are_a_gap_in_the_track() -> None:
    live = LiveTracks()
    for index in [*range(10), *range(50, 60)]:
        live.add(ArrivedFrame(index * 10**8, frozenset(["anna"]), {}))
    people = live.tracks(10**8, {"anna": ("hip",)}, []).table()["people"]
    assert people[0]["spans"] == [(0, 9), (50, 59)]
