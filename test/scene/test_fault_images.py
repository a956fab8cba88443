"""Faults of the pictures of cameras: triggered late, flicker, exposure steps, dirt."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from render_scenes import renderer_or_skip

from humansim_ros.files.reading.images import decode_srgb
from humansim_ros.scene import Frame, Scene, Simulation
from humansim_ros.scene.config.camera_config import FaultsConfig
from humansim_ros.scene.core.faults import FaultSchedule

RATE = 20.0
CHANNELS = ("rgb", "depth", "instance", "part")
SIZE = (96, 72)
BODY = {"anna": {"body": "child", "motion": "run"}}


@pytest.fixture(autouse=True)
def _renderer() -> None:
    renderer_or_skip().close()


def scene(faults: dict[str, Any], sensor: dict[str, Any] | None = None, people: Any = None) -> Scene:
    camera = {"size": list(SIZE), "position": [3, 0.4, 1.4], "look_at": [0, 0, 1], "sensor": sensor or {}}
    if faults:
        camera["faults"] = faults
    humans = BODY if people is None else people
    config = {"rate": RATE, "room": None, "humans": humans, "cameras": {"left": camera}}
    return Scene.from_dict(config)


def frame(index: int, faults: dict[str, Any], **options: Any) -> Frame:
    with Simulation(scene(faults, **options), CHANNELS) as simulation:
        return simulation.frame(index)


def light(index: int, faults: dict[str, Any], **options: Any) -> NDArray[np.float64]:
    """Linear light (H, W, 3) of a picture with faults, relative to the picture without."""
    seen, clean = (
        decode_srgb(frame(index, each, **options).views["left"].rgb / 255) for each in (faults, {})
    )
    return np.asarray(seen / clean, dtype=float)


def same_truth(one: Frame, other: Frame) -> bool:
    views = one.views["left"], other.views["left"]
    images = all(
        np.array_equal(*(getattr(view, name) for view in views), equal_nan=name == "depth")
        for name in CHANNELS[1:]
    )
    joints = (each.joints["left"]["anna"].pixels for each in (one, other))
    return images and np.array_equal(*joints, equal_nan=True) and one.stamp == other.stamp


def test_a_camera_that_is_triggered_late_sees_a_later_instant_and_the_truth_is_of_the_stamp() -> None:
    late, clean = frame(10, {"trigger_delay": 0.05}), frame(10, {})
    assert same_truth(late, clean)
    following = frame(11, {}).views["left"].rgb.astype(int)  # one period is 0.05 s

    def difference(other: NDArray[Any]) -> float:
        return float(np.abs(late.views["left"].rgb.astype(int) - other).mean())

    assert difference(following) < 0.35 * difference(clean.views["left"].rgb.astype(int))
    early = frame(11, {"trigger_delay": -0.05}).views["left"].rgb.astype(int)
    assert np.abs(early - clean.views["left"].rgb).mean() < np.abs(early - following).mean()
    assert late.faults["left"].kinds["trigger_delay"] == {"seconds": 0.05}


def test_the_exposure_of_a_late_trigger_is_blurred_as_a_whole() -> None:
    sensor = {"exposure_time": 0.02, "samples": 4}
    late, clean = (
        frame(10, faults, sensor=sensor).views["left"].rgb for faults in ({"trigger_delay": 0.03}, {})
    )
    assert not np.array_equal(late, clean)


def test_the_jitter_of_a_trigger_has_its_standard_deviation() -> None:
    schedule = FaultSchedule(
        FaultsConfig.model_validate({"trigger_delay": {"delay": 0.01, "jitter": 0.004}}), "left", RATE
    )
    delays = np.array([schedule.at(index).trigger_delay for index in range(2000)])
    assert delays.mean() == pytest.approx(0.01, abs=4e-4)
    assert delays.std() == pytest.approx(0.004, rel=0.06)
    assert np.abs(delays).max() <= 0.1


def test_flicker_makes_bands_with_a_rolling_shutter_and_beats_with_a_global_one() -> None:
    faults = {"flicker": {"frequency": 107, "depth": 0.3}, "seed": 3}
    row_time = 0.0002
    sensor = {"rolling_shutter": row_time, "samples": 2, "response": "linear"}
    empty: dict[str, Any] = {}
    with Simulation(scene(faults, sensor, empty), ("rgb",)) as simulation:
        seen = [each.views["left"].rgb[:, 0, 1].astype(float) for each in simulation.frames(3)]
    with Simulation(scene({}, sensor, empty), ("rgb",)) as simulation:
        clean = simulation.frame(0).views["left"].rgb[:, 0, 1].astype(float)
    rows = (np.arange(SIZE[1]) - (SIZE[1] - 1) / 2) * row_time
    phase = None
    for index, column in enumerate(seen):
        ratio = column / clean
        if phase is None:
            waves = np.column_stack([np.cos(2 * np.pi * 107 * rows), np.sin(2 * np.pi * 107 * rows)])
            cosine, sine = np.linalg.lstsq(waves, ratio - 1, rcond=None)[0]
            phase = np.arctan2(-sine, cosine)
            assert np.hypot(cosine, sine) == pytest.approx(0.3, abs=0.01)
        expected = 1 + 0.3 * np.cos(2 * np.pi * 107 * (index / RATE + rows) + phase)
        np.testing.assert_allclose(ratio, expected, atol=0.02)
    ratios = [light(index, faults, people=empty)[0, 0, 1] for index in range(5)]
    expected = 1 + 0.3 * np.cos(2 * np.pi * 107 * np.arange(5) / RATE + phase)
    np.testing.assert_allclose(ratios, expected, atol=0.02)


def test_flicker_of_a_whole_period_within_the_exposure_is_not_seen() -> None:
    sensor = {"exposure_time": 0.01, "samples": 2}
    ratio = light(3, {"flicker": {"frequency": 100, "depth": 0.8}}, sensor=sensor, people={})
    np.testing.assert_allclose(ratio, 1)


def test_all_cameras_with_a_seed_see_the_same_lamp() -> None:
    config = FaultsConfig.model_validate({"flicker": {"frequency": 90}, "seed": 5})
    times = np.linspace(0, 1, 50)
    left, right = (FaultSchedule(config, name, RATE).lamp(times) for name in ("left", "right"))
    np.testing.assert_array_equal(left, right)
    other = FaultSchedule(config.model_copy(update={"seed": 6}), "left", RATE).lamp(times)
    assert not np.allclose(left, other)


@pytest.mark.nightly
def test_the_exposure_steps_and_stays_until_the_next_step() -> None:
    config = FaultsConfig.model_validate({"exposure_steps": {"probability": 0.02, "stops": [-2, 0.5]}})
    schedule = FaultSchedule(config, "left", RATE)
    stops = np.array([schedule.at(index).stops for index in range(9000)])
    steps = np.nonzero(np.diff(stops))[0]
    assert len(steps) == pytest.approx(0.02 * 9000, rel=0.25)
    assert stops[0] == 0 and stops[: steps[0] + 1].any() == 0
    assert -2 <= stops.min() < -1.8 and 0.3 < stops.max() <= 0.5
    assert FaultSchedule(config, "left", RATE).at(8999) == schedule.at(8999)


def test_a_step_of_the_exposure_scales_the_light() -> None:
    config = {"exposure_steps": {"probability": 1, "stops": [-1, -1]}}
    ratio = light(2, config, people={})
    np.testing.assert_allclose(ratio, 0.5, atol=0.02)
    assert same_truth(frame(2, config), frame(2, {}))


def test_dirt_takes_light_at_the_same_places_in_each_frame() -> None:
    faults = {"dirt": {"spots": 3, "size": [0.2, 0.4], "opacity": 0.6}, "seed": 2}
    first, later = (light(index, faults, people={})[..., 1] for index in (0, 7))
    np.testing.assert_array_equal(first, later)
    schedule = scene(faults).scene_cameras["left"].faults
    assert schedule is not None
    expected = schedule.transmission(SIZE)
    np.testing.assert_allclose(first, expected, atol=0.03)
    assert expected is not None and expected.min() < 0.41 and 0.05 < (expected < 1).mean() < 0.6
    larger = schedule.transmission((4 * SIZE[0], 4 * SIZE[1]))
    assert larger is not None
    smaller = larger.reshape(SIZE[1], 4, SIZE[0], 4).mean(axis=(1, 3))
    np.testing.assert_allclose(smaller, expected, atol=0.03)  # the same spots in an image of any size
    others = FaultSchedule(schedule.config, "right", RATE).transmission(SIZE)
    assert not np.array_equal(others, expected)


@pytest.mark.parametrize("encoding", ["bgr8", "mono8", "bayer_rggb8"])
def test_each_encoding_has_the_faults_of_the_light(encoding: str) -> None:
    faults = {"exposure_steps": {"probability": 1, "stops": [-2, -2]}, "dirt": 4}
    sensor = {"encoding": encoding, "response": "linear"}
    seen, clean = (
        frame(0, each, sensor=sensor, people={}).views["left"].rgb.astype(float) for each in (faults, {})
    )
    schedule = scene(faults).scene_cameras["left"].faults
    assert schedule is not None
    dirt = schedule.transmission(SIZE)
    assert dirt is not None
    expected = clean * 0.25 * (dirt if clean.ndim == 2 else dirt[..., None])
    np.testing.assert_allclose(seen, expected, atol=1)


def test_a_frozen_picture_has_the_faults_of_its_start() -> None:
    faults = {
        "freeze": {"at": [[0.1, 0.3]]},
        "trigger_delay": {"jitter": 0.02},
        "exposure_steps": {"probability": 1},
        "flicker": {"frequency": 33},
    }
    with Simulation(scene(faults), ("rgb",)) as simulation:
        first, last = simulation.frame(2), simulation.frame(5)
    np.testing.assert_array_equal(first.views["left"].rgb, last.views["left"].rgb)
    told = [each.faults["left"].kinds for each in (first, last)]
    for kind in ("trigger_delay", "exposure_steps", "flicker"):
        assert told[0][kind] == told[1][kind]
    assert told[1]["freeze"] == {"frames": 3.0}


WRONG = [
    ({"trigger_delay": 0.3}, "from -0.1 to 0.1"),
    ({"trigger_delay": {}}, "give a delay or a jitter"),
    ({"calibration": {}}, "give a rotation, a translation"),
    ({"calibration": {"focal_length": 0.1}}, "did you mean `focal`"),
    ({"flicker": {"depth": 0.2}}, "frequency"),
    ({"exposure_steps": {"probability": 0.1, "stops": [2, 1]}}, "smaller number first: [1, 2]"),
    ({"dirt": {"spots": 5, "size": [0, 1]}}, "above 0"),
]


@pytest.mark.parametrize(("faults", "text"), WRONG)
def test_wrong_settings_are_named_with_their_key(faults: dict[str, Any], text: str) -> None:
    from humansim_ros.errors import SceneError

    with pytest.raises(SceneError) as caught:
        scene(faults)
    assert f"cameras.left.faults.{next(iter(faults))}" in f"{caught.value.key}"
    assert text in str(caught.value)
