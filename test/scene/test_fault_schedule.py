"""Faults of cameras: the schedule, the pictures of a simulation, and errors of settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from render_scenes import renderer_or_skip

from humansim_ros.cameras import write_calibration
from humansim_ros.errors import SceneError
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.config.camera_config import FaultsConfig
from humansim_ros.scene.core.faults import NO_FAULTS, FaultSchedule, FrameFaults

FRAMES = 4000
RATE = 20.0
PERIOD = 50_000_000
CAMERA = "{size: [64, 48], position: [3, 0.4, 1.4], look_at: [0, 0, 1]"


def schedule(camera: str = "left", **settings: Any) -> FaultSchedule:
    return FaultSchedule(FaultsConfig.model_validate(settings), camera, RATE)


def frames(count: int = FRAMES, camera: str = "left", **settings: Any) -> list[FrameFaults]:
    made = schedule(camera, **settings)
    return [made.at(index) for index in range(count)]


def scene(faults: str = "", rate: float = RATE) -> str:
    key = f", faults: {faults}" if faults else ""
    return (
        f"rate: {rate}\nroom: null\nhumans: {{anna: {{body: child, motion: walk}}}}\n"
        f"cameras:\n  left: {CAMERA}{key}}}\n"
    )


def test_a_camera_without_faults_sends_each_image_once_at_its_stamp() -> None:
    assert all(each == NO_FAULTS for each in frames(20))
    assert NO_FAULTS.sent == (0,) and NO_FAULTS.stamp(5) == 5


EVERYTHING: dict[str, Any] = {
    "drop": {"probability": 0.05, "frames": [1, 3]},
    "freeze": {"probability": 0.02, "duration": [0.1, 0.3]},
    "outage": {"probability": 0.01, "duration": [0.2, 0.4]},
    "late": {"probability": 0.3, "delay": [0, 0.2]},
    "out_of_order": 0.1,
    "duplicate": 0.1,
    "clock": {"offset": 0.01, "jitter": 0.001},
}


def test_a_frame_has_the_same_faults_in_any_order_and_other_seeds_and_cameras_have_others() -> None:
    forward = frames(300, **EVERYTHING)
    alone = [schedule(**EVERYTHING).at(index) for index in reversed(range(300))]
    assert forward == alone[::-1]
    assert {kind for each in forward for kind in each.kinds} == set(EVERYTHING)
    assert forward != frames(300, seed=1, **EVERYTHING)
    assert forward != frames(300, "right", **EVERYTHING)
    times = schedule(**EVERYTHING)
    assert [times.at_time(index * PERIOD) for index in range(300)] == forward


@pytest.mark.daily("lengths0-0.1")
@pytest.mark.parametrize(("lengths", "share"), [([1, 1], 0.1), ([3, 3], 1 - 0.9**3)])
def test_the_share_of_lost_frames_follows_from_probability_and_length(
    lengths: list[int], share: float
) -> None:
    lost = [not each.sent for each in frames(drop={"probability": 0.1, "frames": lengths})]
    assert np.mean(lost) == pytest.approx(share, abs=0.03)
    assert lost == ["drop" in each.kinds for each in frames(drop={"probability": 0.1, "frames": lengths})]


def test_an_outage_and_a_freeze_last_from_the_first_time_to_the_second() -> None:
    dead = [index for index, each in enumerate(frames(20, outage={"at": [[0.2, 0.35]]})) if not each.sent]
    assert dead == [4, 5, 6]
    shown = [index - each.picture for index, each in enumerate(frames(10, freeze={"at": [[0.2, 0.35]]}))]
    assert shown == [0, 1, 2, 3, 4, 4, 4, 7, 8, 9]


def test_a_random_freeze_shows_the_picture_at_its_start_for_its_duration() -> None:
    made = frames(freeze={"probability": 0.01, "duration": [0.25, 0.25]})
    starts = {index - each.picture for index, each in enumerate(made) if each.picture}
    assert len(starts) == pytest.approx(0.01 * FRAMES, rel=0.5)
    assert max(each.picture for each in made) == 4
    assert all(made[start].picture == 0 for start in starts)


def test_late_images_stay_in_order_and_none_is_early() -> None:
    made = frames(late={"probability": 0.5, "delay": [0.02, 0.3]})
    delays = np.array([each.sent[0] for each in made])
    assert (delays >= 0).all() and (delays <= 300_000_000).all()
    assert (np.diff(np.arange(FRAMES) * PERIOD + delays) >= 0).all()
    assert {each.kinds["late"]["seconds"] == each.sent[0] * 1e-9 for each in made if each.sent[0]} == {True}
    constant = frames(20, late={"delay": [0.07, 0.07]})
    assert {each.sent for each in constant} == {(70_000_000,)}


def test_an_image_out_of_order_is_sent_right_after_the_later_ones() -> None:
    made = frames(out_of_order={"probability": 0.1, "frames": 2})
    held = [index for index, each in enumerate(made) if "out_of_order" in each.kinds]
    assert len(held) == pytest.approx(0.1 * FRAMES, rel=0.2)
    assert {made[index].sent for index in held} == {(2 * PERIOD + 1,)}


def test_a_duplicate_follows_its_image() -> None:
    made = frames(duplicate=0.25)
    twice = [each for each in made if len(each.sent) == 2]
    assert len(twice) == pytest.approx(0.25 * FRAMES, rel=0.2)
    assert {each.sent for each in twice} == {(0, 1)}


def test_a_wrong_clock_has_offset_drift_and_jitter() -> None:
    exact = schedule(clock={"offset": -0.02, "drift_ppm": 100})
    assert exact.at(0).stamp_error == -20_000_000
    assert exact.at(1000).stamp_error == -20_000_000 + 50 * 100_000
    assert exact.at(0).stamp(1) == 1  # a stamp before 1970, or of zero, is not valid
    errors = np.array([each.stamp_error for each in frames(clock={"jitter": 0.003})])
    assert errors.mean() == pytest.approx(0, abs=200_000)
    assert errors.std() == pytest.approx(3_000_000, rel=0.05)


@pytest.mark.parametrize(
    ("faults", "key", "text"),
    [
        ("{drop: 2}", "drop.probability", "from 0 to 1"),
        (
            "{drop: {probability: 0.1, frames: [3, 1]}}",
            "drop.frames",
            "smaller number first: [1, 3]",
        ),
        ("{freeze: {at: [[5, 3]]}}", "freeze.at", "ends after it starts"),
        ("{outage: {duration: [1, 2]}}", "outage", "give a probability, or the times"),
        ("{late: {delay: [0, 9]}}", "late.delay.1", "from 0 to 5"),
        ("{drops: 0.1}", "drops", "did you mean `drop`"),
        ("{duplicate: true}", "duplicate", "found true"),
    ],
)
def test_wrong_settings_are_named_with_line_and_key(tmp_path: Path, faults: str, key: str, text: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(scene(faults))
    with pytest.raises(SceneError) as caught:
        Scene.load(path)
    assert (caught.value.line, caught.value.key) == (5, f"cameras.left.faults.{key}")
    assert text in caught.value.message


def test_a_frozen_camera_shows_the_picture_of_its_start_and_the_truth_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    channels = ("rgb", "depth", "instance", "part", "amodal")
    whole = []
    for faults in ("", "{freeze: {at: [[0.1, 0.2]]}, drop: 0.5, late: {delay: [0.1, 0.2]}}"):
        path.write_text(scene(faults))
        renderer_or_skip().close()
        with Simulation(Scene.load(path), channels) as simulation:
            whole.append(list(simulation.frames(5)))
    for index, (true, faulty) in enumerate(zip(*whole, strict=True)):
        for channel in channels[1:-1]:
            np.testing.assert_array_equal(
                getattr(true.views["left"], channel), getattr(faulty.views["left"], channel)
            )
        assert true.stamp == faulty.stamp
        np.testing.assert_array_equal(
            true.joints["left"]["anna"].pixels, faulty.joints["left"]["anna"].pixels
        )
        shown = whole[0][{3: 2}.get(index, index)].views["left"].rgb
        np.testing.assert_array_equal(faulty.views["left"].rgb, shown)
    assert not np.array_equal(whole[0][2].views["left"].rgb, whole[0][3].views["left"].rgb)
    assert not whole[0][0].faults


def test_a_rig_gives_its_faults_to_all_of_its_cameras(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(scene())

    write_calibration(tmp_path / "rig.toml", Scene.load(tmp_path / "scene.yaml").cameras)
    made = Scene.from_dict(
        {"room": None, "rig": {"file": "rig.toml", "faults": {"drop": 0.5}}}, folder=tmp_path
    )
    assert all(camera.faults is not None for camera in made.scene_cameras.values())
