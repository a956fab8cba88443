"""Tracks of the timeline: what they say is what the truth, the keyframes and the faults of a scene say."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from waiting import wait_until

from humansim_ros import Scene, Simulation
from humansim_ros.motion.keyframes import KeyframeTimeline, KeyframeTrack
from humansim_ros.view.tracks import SceneTracks, TrackReader, Tracks, coarse_to_fine, key_frames, spans_of

SCENE = """\
rate: 10
room: null
humans:
  anna: {body: adult_woman, motion: {file: walk, position: [0.6, 0.4]}}
  ben: {body: adult_man, motion: {file: wave, position: [-0.6, -0.2]}}
cameras:
  left: {position: [3, 2, 1.6], look_at: [0, 0, 1], size: [160, 120], faults: {drop: {probability: 0.3}}}
  away: {position: [3, 0, 1.6], look_at: [9, 0, 1], size: [160, 120]}
"""


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
        states = frame.truth["left"].joints[person].visible.tolist()
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
