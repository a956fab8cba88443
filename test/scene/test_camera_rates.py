"""Cameras with a rate and an offset of their own: stamps, images, flow, faults, and wrong values."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from humansim_ros import Scene, Simulation
from humansim_ros.errors import SceneError
from humansim_ros.ros.playing.clock import PictureTimer
from humansim_ros.scene.config.timing import CameraTiming

#: Rates of a scene, and rates and offsets (frames of the scene) of cameras.
RATE = 30
CAMERAS = {"full": (30, 0), "half": (15, 0), "late": (15, 1), "third": (10, 1), "slow": (5, 3)}


def scene_of(cameras: dict[str, Any], **sections: Any) -> Scene:
    place = {"size": [64, 48], "position": [3, 0.4, 1.4], "look_at": [0, 0, 1]}
    return Scene.from_dict(
        {
            "rate": RATE,
            "room": None,
            "cameras": {name: place | own for name, own in cameras.items()},
            **sections,
        }
    )


def timed(**more: Any) -> dict[str, Any]:
    """The cameras, each with more keys."""
    return {name: {"rate": rate, "offset": first / RATE, **more} for name, (rate, first) in CAMERAS.items()}


@pytest.mark.parametrize("rate", [30, 29.97, 24, 7, 1000 / 3])
def test_stamps_of_pictures_are_stamps_of_the_scene_to_the_nanosecond(rate: float) -> None:
    timing = CameraTiming.of(rate, rate / 4, offset=1 / rate)
    assert (timing.step, timing.first) == (4, 1)
    for number in (0, 1, 17, 10**5, 10**7):
        frame = 1 + 4 * number
        exact = Fraction(frame) * 10**9 / Fraction(rate)
        assert abs(timing.time(number) - exact) <= Fraction(1, 2) + exact / 2**52
        assert frame in timing
        assert timing.number(frame) == timing.number(frame + 3) == number
        assert not any(frame + later in timing for later in (1, 2, 3))


def test_cameras_meet_at_equal_stamps_and_show_what_they_show_at_the_full_rate() -> None:
    people = {"anna": {"body": "child", "motion": "walk"}}
    noise = {"sensor": {"noise": {"read_noise": 4}}}
    channels = ("rgb", "depth", "instance")
    with Simulation(scene_of(timed(**noise), humans=people), channels) as simulation:
        frames = list(simulation.frames(8))
        again = simulation.frame(4)
    with Simulation(scene_of(dict.fromkeys(CAMERAS, noise), humans=people), channels) as simulation:
        whole = list(simulation.frames(8))
    for index, (frame, other) in enumerate(zip(frames, whole, strict=True)):
        assert frame.stamp == other.stamp == 1 + round(Fraction(index * 10**9, RATE))
        due = [name for name, (rate, first) in CAMERAS.items() if (index - first) % (RATE // rate) == 0]
        assert (
            [*frame.views]
            == [*frame.truth]
            == [*frame.cameras]
            == [name for name in due if index >= CAMERAS[name][1]]
        )
        for name, view in frame.views.items():
            for channel in channels:
                assert np.array_equal(getattr(view, channel), getattr(other.views[name], channel))
    assert np.array_equal(again.views["third"].rgb, frames[4].views["third"].rgb)


def test_flow_leads_to_the_next_picture_of_the_camera(tmp_path: Path) -> None:
    # two metres along -y in two seconds; z of the optical frame is -x of map
    poses = [f"{time} 3 {1 - time} 1 -0.5 -0.5 0.5 0.5" for time in (0, 2)]
    (tmp_path / "path.txt").write_text("\n".join(poses))
    own = {"size": [64, 48], "trajectory": "path.txt"}
    cameras = {"slow": {**own, "rate": 5, "offset": 3 / RATE}, "full": own}
    box = {"mesh": "box", "size": [0.6, 0.6, 0.6], "position": [0, 0.7, 1], "label": True}
    scene = {"rate": RATE, "room": None, "objects": {"box": box}, "cameras": cameras}
    with Simulation(
        Scene.from_dict(scene, tmp_path), ("depth", "instance", "flow", "flow_back")
    ) as simulation:
        frame = simulation.frame(9)
    for name, seconds in (("slow", 1 / 5), ("full", 1 / RATE)):
        view, camera = frame.views[name], frame.cameras[name]
        rows, columns = np.nonzero(view.instance)
        assert len(rows) > 100
        pixels = np.column_stack([columns, rows]).astype(float)
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.K).T
        points = (rays * view.depth[rows, columns, None] - camera.t) @ camera.R
        for flow, sign in ((view.flow, 1), (view.flow_back, -1)):
            shift = np.array([0, -sign * seconds, 0])
            moved = replace(camera, t=camera.t - camera.R @ shift)
            assert np.abs(flow[rows, columns] - (moved.project(points)[0] - pixels)).max() < 0.01


def test_faults_count_the_pictures_of_the_camera() -> None:
    faults = {"clock": {"drift_ppm": 1000}, "freeze": {"at": [[0.3, 0.5]]}, "outage": {"at": [[0.7, 0.8]]}}
    camera = scene_of({"slow": {"rate": 5, "offset": 0.1, "faults": faults}}).scene_cameras["slow"]
    assert camera.faults is not None
    found = {index: camera.faults.at(index) for index in camera.timing.frames(range(30))}
    assert [*found] == [3, 9, 15, 21, 27]  # at 0.1, 0.3, 0.5 s ...
    assert [each.stamp_error for each in found.values()] == [100_000, 300_000, 500_000, 700_000, 900_000]
    assert [index for index, each in found.items() if not each.sent] == [21]
    freezing = scene_of({"slow": {"rate": 5, "faults": {"freeze": {"at": [[0.2, 0.7]]}}}}).scene_cameras[
        "slow"
    ]
    assert freezing.faults is not None
    assert [freezing.faults.pictured(index) for index in (0, 6, 12, 18, 24)] == [0, 6, 6, 6, 24]


def test_both_eyes_of_a_stereo_pair_have_the_rate() -> None:
    cameras = scene_of({"left": {"rate": 10, "offset": 1 / RATE, "stereo": 0.1}}).scene_cameras
    assert cameras["left"].timing == cameras["right"].timing == CameraTiming(RATE, 3, 1)


def test_a_rig_has_one_rate_or_a_rate_for_each_camera(tmp_path: Path) -> None:
    pose = "matrix = [[600, 0, 319], [0, 600, 239], [0, 0, 1]]\ndistortions = [0, 0, 0, 0, 0]\n"
    pose += "rotation = [1.2, 0, 0]\n"
    sections = [
        f'[cam_{n}]\nname = "{n}"\nsize = [640, 480]\n{pose}translation = [{n}, 0, 3.0]\n' for n in (0, 1)
    ]
    (tmp_path / "rig.toml").write_text("\n".join(sections))

    def timings(**keys: Any) -> list[CameraTiming]:
        rig = {"file": "rig.toml", "unit": 1, **keys}
        scene = Scene.from_dict({"rate": RATE, "room": None, "rig": rig}, tmp_path)
        return [camera.timing for camera in scene.scene_cameras.values()]

    assert timings(rate=10) == [CameraTiming(RATE, 3)] * 2
    own = timings(rate={"0": 10, "1": 15}, offset={"0": 1 / 15})
    assert own == [CameraTiming(RATE, 3, 2), CameraTiming(RATE, 2)]
    for keys, key in (
        ({"rate": 20}, "rig.rate"),
        ({"rate": {"1": 20}}, "rig.rate.1"),
        ({"rate": {"2": 15}}, "rig.rate.2"),
        ({"rate": 15, "offset": {"0": 0.2}}, "rig.offset.0"),
    ):
        with pytest.raises(SceneError) as caught:
            timings(**keys)
        assert caught.value.key == key


@pytest.mark.parametrize(
    ("keys", "key", "remedy"),
    [
        ({"rate": 0}, "rate", "a number from 0.001 to 1000"),
        ({"rate": -5}, "rate", "a number from 0.001 to 1000"),
        ({"rate": float("nan")}, "rate", "a number from 0.001 to 1000"),
        ({"rate": 60}, "rate", "the rate of the scene, 30 Hz: give 30, or the scene"),
        ({"rate": 20}, "rate", "give 30 or 15, or the scene"),
        ({"rate": 7}, "rate", "give 7.5 or 6, or the scene"),
        ({"rate": 15, "offset": -0.1}, "offset", "a number from 0 to"),
        ({"rate": 15, "offset": 0.05}, "offset", "give 0.0333333 or 0.0666667"),
        ({"rate": 15, "offset": 2 / 30}, "offset", "at most 0.0333333"),
        ({"offset": 1 / 30}, "offset", "at most 0"),
    ],
)
def test_a_rate_or_an_offset_that_does_not_fit_is_an_error_with_the_key_and_a_remedy(
    keys: dict[str, Any], key: str, remedy: str
) -> None:
    with pytest.raises(SceneError, match=remedy) as caught:
        scene_of({"left": keys})
    assert caught.value.key == f"cameras.left.{key}"


def test_rounded_numbers_fit() -> None:
    assert CameraTiming.of(30, 3.333, 0.0333) == CameraTiming(30, 9, 1)


def test_a_picture_whose_frame_is_skipped_is_taken_in_the_next_frame() -> None:
    def taken(frames: list[int]) -> list[int]:
        timer = PictureTimer(CameraTiming(30, 3, 1))
        return [index for index in frames if timer.takes(index)]

    assert taken([*range(9)]) == [1, 4, 7]
    assert taken([0, 2, 3, 5, 6, 8, 9]) == [2, 5, 8]  # all frames of pictures are skipped
    assert taken([5, 6, 7, 8]) == [7]  # a camera that joins waits for its frame
    assert taken([4, 4, 5, 5, 7]) == [4, 4, 7]  # lockstep sends frames again
    assert taken([7, 8, 0, 1, 2]) == [7, 1]  # played again
