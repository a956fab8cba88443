"""Wrong calibrations: what is published differs from the camera, whose truth stays exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from render_scenes import renderer_or_skip
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.scene import Frame, Scene, Simulation

RATE = 10.0
CAMERA: dict[str, Any] = {"size": [160, 120], "position": [3, 0.4, 1.4], "look_at": [0, 0, 1], "fov_deg": 50}


@pytest.fixture(autouse=True)
def _renderer() -> None:
    renderer_or_skip().close()


def scene(calibration: dict[str, Any], seed: int = 1, **camera: Any) -> Scene:
    faults = {"faults": {"calibration": calibration, "seed": seed}} if calibration else {}
    return Scene.from_dict(
        {
            "rate": RATE,
            "room": None,
            "humans": {"anna": {"body": "child", "motion": "walk"}},
            "cameras": {"left": {**CAMERA, **camera, **faults}, "right": {**CAMERA, **faults}},
        }
    )


def frame(index: int, calibration: dict[str, Any], **options: Any) -> Frame:
    with Simulation(scene(calibration, **options), ("depth", "instance", "part")) as simulation:
        return simulation.frame(index)


def angle(one: Camera, other: Camera) -> float:
    """Degrees between the rotations of two cameras."""
    return float(np.degrees(Rotation.from_matrix(one.R @ other.R.T).magnitude()))


def test_a_constant_error_is_in_what_is_published_and_not_in_the_truth() -> None:
    wrong = frame(4, {"rotation": 2, "translation": 0.05, "focal": 0.03})
    exact = frame(4, {})
    for name in ("left", "right"):
        true, published = wrong.cameras[name], wrong.published_cameras[name]
        np.testing.assert_array_equal(true.P, exact.cameras[name].P)
        assert angle(true, published) == pytest.approx(2, abs=1e-9)
        assert np.linalg.norm(true.center - published.center) == pytest.approx(0.05, abs=1e-12)
        focal = published.K[0, 0] / true.K[0, 0] - 1
        assert abs(focal) == pytest.approx(0.03, abs=1e-12)
        assert published.K[1, 1] / true.K[1, 1] - 1 == pytest.approx(focal, abs=1e-12)
        np.testing.assert_array_equal(published.K[:2, 2], true.K[:2, 2])
        told = wrong.faults[name].kinds["calibration"]
        assert told == pytest.approx({"rotation": 2, "translation": 0.05, "focal": focal}, abs=1e-9)
    np.testing.assert_array_equal(wrong.views["left"].depth, exact.views["left"].depth)
    np.testing.assert_array_equal(wrong.joints["left"]["anna"].pixels, exact.joints["left"]["anna"].pixels)
    directions = [
        wrong.published_cameras[name].center - wrong.cameras[name].center for name in ("left", "right")
    ]
    assert abs(np.dot(*directions)) < 0.99 * 0.05**2  # each camera has its own error


def test_a_drift_moves_the_camera_and_not_what_is_published() -> None:
    drift = {"drift": {"rotation": 60, "translation": 0.6}}  # 1 degree and 10 mm a second
    with Simulation(scene(drift), ("rgb", "depth", "instance", "part")) as simulation:
        frames = [simulation.frame(index) for index in (0, 10, 20)]
    with Simulation(scene({}), ("depth",)) as simulation:
        exact = simulation.frame(0)
    for seconds, each in enumerate(frames):
        true, published = each.cameras["left"], each.published_cameras["left"]
        np.testing.assert_allclose(published.P, exact.cameras["left"].P, rtol=1e-12)
        assert angle(true, published) == pytest.approx(seconds, abs=1e-6)
        assert np.linalg.norm(true.center - published.center) == pytest.approx(0.01 * seconds, abs=1e-9)
        told = each.faults["left"].kinds["calibration"]
        assert told == pytest.approx(
            {"rotation": seconds, "translation": 0.01 * seconds, "focal": 0}, abs=1e-6
        )
    last = frames[-1]
    # all of it is that of a camera that stands where the true one is
    true = last.cameras["left"]
    there = {key: CAMERA[key] for key in ("size", "fov_deg")} | {"R": true.R.tolist(), "t": true.t.tolist()}
    config = scene({}).config.model_dump(exclude_unset=True) | {"cameras": {"left": there}}
    with Simulation(Scene.from_dict(config), ("rgb", "depth", "instance", "part")) as simulation:
        placed = simulation.frame(20)
    for channel in ("rgb", "depth", "instance", "part"):
        np.testing.assert_array_equal(
            *(getattr(each.views["left"], channel) for each in (last, placed)), err_msg=channel
        )
    np.testing.assert_allclose(
        last.joints["left"]["anna"].pixels, placed.joints["left"]["anna"].pixels, atol=1e-9
    )
    assert not np.array_equal(frames[0].views["left"].rgb, last.views["left"].rgb)


def test_error_and_drift_together_are_told_as_their_difference() -> None:
    both = frame(20, {"rotation": 3, "translation": 0.1, "drift": {"rotation": 90, "translation": 1.5}})
    true, published = both.cameras["left"], both.published_cameras["left"]
    told = both.faults["left"].kinds["calibration"]
    assert told["rotation"] == pytest.approx(angle(true, published), abs=1e-9)
    assert told["translation"] == pytest.approx(np.linalg.norm(true.center - published.center), abs=1e-12)


def test_another_seed_has_another_error() -> None:
    centers = [
        scene({"translation": 0.1}, seed)
        .scene_cameras["left"]
        .published_at(scene({}).scene_cameras["left"].pose(0))
        .center
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(centers[0], centers[1])
    assert not np.allclose(centers[0], centers[2])


def test_the_rectified_image_is_that_of_the_published_calibration_and_rectified_depth_true() -> None:
    lens = {"distortion": [-0.3, 0.1]}
    wrong, exact = (scene(each, **lens).scene_cameras["left"] for each in ({"focal": 0.2}, {}))
    image = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    assert not np.array_equal(wrong.rectify(image), exact.rectify(image))
    assert wrong.rectified is not None and exact.rectified is not None
    np.testing.assert_array_equal(wrong.rectified.camera.K, exact.rectified.camera.K)
    scale = wrong.published.K[0, 0] / exact.whole.K[0, 0]
    np.testing.assert_allclose(
        wrong.published.rectified_projection[[0, 1], [0, 1]],
        scale * exact.whole.rectified_projection[[0, 1], [0, 1]],
    )


def test_the_published_p_of_a_stereo_camera_keeps_its_baseline() -> None:
    stereo = {"rectified": [[150, 0, 80, -15], [0, 150, 60, 0], [0, 0, 1, 0]]}
    published = scene({"focal": 0.1}, **stereo).scene_cameras["left"].published.rectified_projection
    assert published[0, 0] != 150
    assert published[0, 3] / published[0, 0] == pytest.approx(-0.1)
    assert published[0, 2] == 80
