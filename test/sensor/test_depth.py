"""Depth sensors on surfaces whose depth is known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from humansim_ros.cameras import Camera, DepthSensor, DepthSensorConfig
from humansim_ros.cameras.sensor.depth import Surfaces, aligned, metres, points_of
from humansim_ros.errors import CameraError, SceneError
from humansim_ros.scene.config.config import check_config

Values = NDArray[Any]
SIZE = (320, 240)
F, CX, CY = 300.0, 158.0, 121.0
K = ((F, 0.0, CX), (0.0, F, CY), (0.0, 0.0, 1.0))
X, Y = np.meshgrid((np.arange(SIZE[0]) - CX) / F, (np.arange(SIZE[1]) - CY) / F)


def sensor(model: str, **keys: Any) -> DepthSensor:
    keys = {"size": SIZE, "K": K, "range": (0.1, 60.0)} | keys
    return DepthSensor(DepthSensorConfig.model_validate({"model": model, **keys}), "camera")


def plane(distance: float, degrees: float = 0.0, around: float = 30.0) -> tuple[Values, Values]:
    """Depth of a plane that the optical axis meets at a distance, and the angle of each ray to its normal.

    ``degrees``: between the axis and the normal; ``around``: direction of the tilt in the image.
    """
    tilt, turn = np.radians([degrees, around])
    normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    across = normal[0] * X + normal[1] * Y + normal[2]
    depth = np.where(across > 0, distance * normal[2] / across, np.inf)
    angle = np.arccos(np.clip(across / np.sqrt(X**2 + Y**2 + 1), 0, 1))
    return depth.astype(np.float32), angle


def reflecting(light: float, shape: tuple[int, int] = SIZE[::-1]) -> NDArray[np.uint8]:
    """Grey image with a reflectivity in the infrared, which is the square root of its linear light."""
    light = light**2
    value = 12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055
    return np.full((*shape, 3), np.rint(255 * value), np.uint8)


def errors(depth: Values, measured: NDArray[np.uint16]) -> Values:
    """Errors in metres, NaN where nothing is measured."""
    return np.where(measured > 0, 0.001 * measured - depth, np.nan)


@pytest.mark.parametrize("degrees", [0, 30, 60, 75])
def test_the_angle_to_a_plane_is_exact(degrees: float) -> None:
    depth, angle = plane(2.0, degrees)
    rays = np.stack([X, Y, np.sqrt(1 + X**2 + Y**2)]).astype(np.float32)
    found = Surfaces.of(depth, np.array(K), rays).angle
    near = np.isfinite(depth) & (depth < 8)
    np.testing.assert_allclose(found[near], angle[near], atol=0.01)


@pytest.mark.parametrize(("distance", "degrees"), [(0.6, 0), (1.0, 30), (1.5, 60), (2.5, 10), (3.0, 45)])
def test_structured_light_has_the_noise_of_nguyen(distance: float, degrees: float) -> None:
    depth, angle = plane(distance, degrees)
    away = np.pi / 2 - angle
    with np.errstate(all="ignore"):
        expected = 0.0012 + 0.0019 * (depth - 0.4) ** 2 + 1e-4 / np.sqrt(depth) * (angle / away) ** 2
    for step in (0.0, 0.125):
        light = sensor("structured_light", disparity_step=step, baseline=0.3)
        error = errors(depth, light.measure(depth, 1))
        sure = np.isfinite(error) & (depth < 2 * distance) & (angle < np.radians(70))
        assert sure.mean() > 0.3
        assert (error[sure] / expected[sure]).std() == pytest.approx(1, abs=0.04)
        # rounding to steps and to millimetres has an error of its own where the depth is the same everywhere
        assert abs(error[sure].mean()) < 0.0005 + 0.02 * expected[sure].mean()


def test_lateral_noise_of_structured_light_moves_edges() -> None:
    """A pixel k pixels left of the last near one sees the far surface with the probability P(x > k + 0.5)."""
    depth, _ = plane(1.0)
    depth[:, 160:] = 3.0
    measured = metres(sensor("structured_light", disparity_step=0).measure(depth, 5))
    far = measured > 2
    for column in range(157, 163):
        expected = norm.sf((159.5 - column) / 0.8)
        assert far[:, column].mean() == pytest.approx(expected, abs=4 * np.sqrt(0.25 / SIZE[1]))
    assert not far[:, :150].any() and far[:, 170:].all()


@pytest.mark.parametrize("degrees", [0, 40])
def test_stereo_noise_grows_with_the_square_of_the_depth(degrees: float) -> None:
    depth, _ = plane(2.0, degrees)
    camera = sensor("active_stereo", disparity_noise=0.1, disparity_step=0, baseline=0.06)
    error = errors(depth, camera.measure(depth, 1))
    sure = np.isfinite(error) & (depth < 3)
    sigma = depth**2 * 0.1 / (F * 0.06)
    assert (error[sure] / sigma[sure]).std() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("model", ["structured_light", "active_stereo"])
def test_disparities_are_multiples_of_the_step(model: str) -> None:
    depth, _ = plane(2.0, 40)
    measured = sensor(model, disparity_step=0.125, baseline=0.06).measure(depth, 1)
    seen = (measured > 0) & (depth < 3)
    disparity = F * 0.06 / (0.001 * measured[seen])
    rounding = disparity * 0.0005 / (0.001 * measured[seen])
    assert (np.abs(disparity / 0.125 - np.rint(disparity / 0.125)) * 0.125 <= 1.01 * rounding).all()
    # the disparity is 6 to 15 pixels
    assert len(np.unique(measured[seen])) < 9 / 0.125


@pytest.mark.parametrize("model", ["structured_light", "active_stereo"])
def test_the_shadow_of_the_baseline_is_as_wide_as_the_difference_of_disparities(model: str) -> None:
    near, far, baseline = 1.0, 2.5, 0.08
    depth = np.full(SIZE[::-1], far, np.float32)
    depth[60:180, 140:200] = near
    light = sensor(model, baseline=baseline, noise=0, disparity_step=0, range=(0.8, 5))
    own = light.camera_at(np.eye(3), np.zeros(3))
    other = light.second_camera(own)
    assert other is not None
    assert other.center == pytest.approx([baseline, 0, 0])
    margin = other.size[0] - SIZE[0]
    assert (margin > 0) == (model == "structured_light")
    second = np.full((SIZE[1], other.size[0]), far, np.float32)
    left, right = (np.rint(x - F * baseline / near + margin) for x in (140, 200))
    second[60:180, int(left) : int(right)] = near
    hole = light.measure(depth, 1, second) == 0
    width = F * baseline * (1 / near - 1 / far)
    shadow = hole[60:180, 60:]
    assert np.abs(shadow.sum(axis=1) - width).max() <= 1
    columns = 60 + np.flatnonzero(shadow.any(axis=0))
    assert columns.max() == 139 and columns.min() == pytest.approx(140 - width, abs=1)
    # the right imager does not see the left edge of the image; a projector lights it
    outside = hole[:50]
    expected = 0 if model == "structured_light" else F * baseline / far
    assert np.abs(outside.sum(axis=1) - expected).max() <= 1


@pytest.mark.parametrize("light", [1.0, 0.5, 0.1])
@pytest.mark.parametrize("distance", [1.0, 3.0])
def test_time_of_flight_noise_depends_on_the_light_that_returns(light: float, distance: float) -> None:
    depth, angle = plane(distance, 30)
    camera = sensor("time_of_flight", sigma=0.004, background=0.1, dark=0.001)
    error = errors(depth, camera.measure(depth, 1, colours=reflecting(light)))
    along = np.sqrt(1 + X**2 + Y**2)
    signal = light * np.cos(angle) / (depth * along) ** 2
    sigma = 0.004 * np.sqrt(signal + 0.1) / signal / along
    sure = np.isfinite(error)
    assert sure.mean() > 0.9
    assert (error[sure] / sigma[sure]).std() == pytest.approx(1, abs=0.03)
    assert abs((error[sure] / sigma[sure]).mean()) < 0.03


def test_an_azure_kinect_deviates_by_at_most_17_mm_up_to_3_5_m() -> None:
    """Of surfaces with the least reflectivity of its range, 15 %, as Microsoft specifies it."""
    keys = {"size": SIZE, "K": K}
    camera = DepthSensor(DepthSensorConfig.model_validate({"preset": "azure_kinect_nfov", **keys}))
    middle = np.s_[100:140, 140:180]
    for distance in (1.0, 2.0, 3.5):
        depth = np.full(SIZE[::-1], distance, np.float32)
        error = errors(depth, camera.measure(depth, 1, colours=reflecting(0.15)))[middle]
        assert np.isfinite(error).all()
        assert error.std() <= 0.0175


def test_time_of_flight_has_flying_pixels_at_edges_only() -> None:
    depth = np.full(SIZE[::-1], 2.0, np.float32)
    depth[:, 160:] = 1.5
    measured = metres(sensor("time_of_flight", noise=0, dark=0).measure(depth, 1))
    flying = (measured > 1.51) & (measured < 1.99)
    assert flying[:, 159:161].all()
    assert not flying[:, :158].any() and not flying[:, 162:].any()


def test_distances_beyond_the_ambiguity_begin_again() -> None:
    depth = np.full(SIZE[::-1], 6.0, np.float32)
    along = np.sqrt(1 + X**2 + Y**2)
    camera = sensor("time_of_flight", noise=0, dark=0, ambiguity=5.0, range=(0.3, 5))
    measured = metres(camera.measure(depth, 1))
    expected = (6.0 * along - 5.0) / along
    np.testing.assert_allclose(measured, expected, atol=0.004)


@pytest.mark.parametrize(
    ("model", "light", "distance", "seen"),
    [
        ("active_stereo", 0.02, 2.0, False),
        ("active_stereo", 0.1, 2.0, True),
        ("time_of_flight", 0.15, 1.5, True),
        ("time_of_flight", 0.15, 2.0, False),
        ("structured_light", 0.02, 2.0, True),
    ],
)
def test_dark_surfaces_are_holes(model: str, light: float, distance: float, seen: bool) -> None:
    keys = {} if model == "structured_light" else {"dark": 0.05}
    depth = np.full(SIZE[::-1], distance, np.float32)
    measured = sensor(model, **keys).measure(depth, 1, colours=reflecting(light))
    assert (measured[100:140, 140:180] > 0).all() == seen


@pytest.mark.parametrize("model", ["structured_light", "active_stereo", "time_of_flight"])
def test_grazing_surfaces_empty_pixels_and_far_ones_are_holes(model: str) -> None:
    depth, angle = plane(2.0, 60)
    depth[:20] = np.inf
    measured = sensor(model, grazing_deg=70, range=(0.5, 6), noise=0).measure(depth, 1)
    sure = np.abs(angle - np.radians(70)) > 0.02
    inside = (angle < np.radians(70)) & (depth > 0.51) & (depth < 5.8)
    outside = (angle > np.radians(70)) | (depth < 0.49) | (depth > 6.2)
    edge = np.s_[23:]
    assert (measured[edge] > 0)[(sure & inside)[edge]].all()
    assert not measured[outside & sure].any() and not measured[:20].any()


def test_noise_depends_on_seed_name_and_time() -> None:
    depth, _ = plane(2.0, 30)

    def measured(stamp: int = 1, name: str = "a", seed: int = 0) -> bytes:
        config = DepthSensorConfig.model_validate({"preset": "kinect_v1", "K": K, "size": SIZE, "seed": seed})
        return DepthSensor(config, name).measure(depth, stamp).tobytes()

    others = {measured(2), measured(name="b"), measured(seed=1)}
    assert measured() == measured()
    assert len(others | {measured()}) == 4


# --- points and alignment


def test_points_are_those_of_depth_image_proc() -> None:
    levels = np.arange(SIZE[0] * SIZE[1], dtype=np.uint16).reshape(SIZE[::-1]) % 4000
    rays = np.stack([X.ravel(), Y.ravel()])
    points = points_of(metres(levels), rays)
    for u, v in ((0, 0), (1, 0), (200, 7), (319, 239)):
        z = np.float32(levels[v, u]) * np.float32(0.001)
        expected = [(u - CX) * z / F, (v - CY) * z / F, z] if levels[v, u] else [np.nan] * 3
        np.testing.assert_allclose(points[v, u], expected, rtol=1e-6)


def camera(k: Any = K, size: tuple[int, int] = SIZE, x: float = 0.0, **lens: Any) -> Camera:
    return Camera(size, np.array(k), np.eye(3), np.array([-x, 0.0, 0.0]), **lens)


RAYS = np.stack([X.ravel(), Y.ravel()])


@pytest.mark.daily("0.6", "1.0")
@pytest.mark.parametrize("scale", [0.6, 1.0, 2.3])
def test_aligned_depth_of_a_plane_is_its_depth_in_the_other_camera(scale: float) -> None:
    """With any ratio of the resolutions, a surface that faces the cameras has no gaps."""
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    k = np.diag([scale, scale, 1]) @ np.array(K)
    other = camera(k, size, 0.05, distortion=(-0.05, 0.01))
    levels = np.full(SIZE[::-1], 2000, np.uint16)
    result = aligned(levels, RAYS, camera(), other)
    # the same point of the plane, seen by the depth camera
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = other.rays(np.dstack([u, v]))
    x, y = (2 * rays[..., 0] + 0.05) / 2 * F + CX, rays[..., 1] * F + CY
    inside = (x > 1) & (x < SIZE[0] - 2) & (y > 1) & (y < SIZE[1] - 2)
    outside = (x < -1) | (x > SIZE[0]) | (y < -1) | (y > SIZE[1])
    assert (result[inside] == 2000).mean() > 0.999
    assert not result[outside].any()


def test_aligned_depth_of_a_turned_camera_is_along_the_other_axis() -> None:
    turn = np.radians(6)
    r = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
    own = Camera(SIZE, np.array(K), r, np.zeros(3))
    other = camera()
    # a plane z = 3 of the other camera: n . X = 3 in the frame of the depth camera
    n = r @ np.array([0, 0, 1.0])
    depth = 3 / (n[0] * X + n[1] * Y + n[2])
    result = aligned(np.rint(1000 * depth).astype(np.uint16), RAYS, own, other)
    seen = result[40:200, 10:310]
    assert (seen > 0).mean() > 0.97  # gaps where footprints do not touch
    assert np.abs(seen[seen > 0].astype(float) - 3000).max() <= 1


def test_aligned_depth_shows_the_nearest_surface_and_nothing_behind_its_edge() -> None:
    """A camera 10 cm to the right sees a strip of the wall that the near surface hides from the sensor."""
    levels = np.full(SIZE[::-1], 3000, np.uint16)
    levels[:, 100:200] = 1000
    result = aligned(levels, RAYS, camera(), camera(x=0.1))
    row = result[120]
    near, far = F * 0.1 / 1.0, F * 0.1 / 3.0
    assert set(np.flatnonzero(row == 1000)) == set(range(100 - round(near), 200 - round(near)))
    hidden = range(200 - round(near), 200 - round(far))
    assert not row[list(hidden)].any()
    assert (row[200 - round(far) : SIZE[0] - round(far)] == 3000).all()
    assert (result == row).all()


# --- settings


@pytest.mark.parametrize(
    ("keys", "key", "message"),
    [
        ({}, "depth_sensor", "give a preset"),
        ("kinect", "depth_sensor.preset", "did you mean 'kinect_v"),
        ({"preset": "kinect_v1", "range": [0, 4]}, "depth_sensor.range.0", "from 0.01"),
        ({"preset": "kinect_v1", "range": [4, 0.8]}, "depth_sensor.range", "nearest depth"),
        ({"preset": "kinect_v1", "range": [1, 100]}, "depth_sensor.range.1", "65.535"),
        ({"preset": "kinect_v1", "model": "active_stereo"}, "depth_sensor", "structured_light"),
        ({"model": "time_of_flight", "baseline": 0.1}, "depth_sensor", "baseline goes with"),
        ({"model": "active_stereo", "baseline": None}, "depth_sensor", "needs baseline"),
        ({"model": "active_stereo", "K": K, "fov_deg": 60}, "depth_sensor", "give one of them"),
    ],
)
def test_impossible_settings_name_the_key(keys: Any, key: str, message: str) -> None:
    scene = {"cameras": {"eye": {"position": [3, 0, 1], "look_at": [0, 0, 1], "depth_sensor": keys}}}
    with pytest.raises(SceneError, match=message) as caught:
        check_config(scene)
    assert caught.value.key == f"cameras.eye.{key}"


def test_a_projector_must_light_the_image() -> None:
    with pytest.raises(CameraError, match="give a farther nearest depth") as caught:
        sensor("structured_light", K=((6000, 0, 0), (0, 6000, 0), (0, 0, 1)), range=(0.01, 1))
    assert caught.value.key == "range"


@pytest.mark.parametrize("size", [[0, 10], [9000, 10]])
def test_an_impossible_image_size_is_refused(size: list[int]) -> None:
    with pytest.raises(CameraError) as caught:
        sensor("time_of_flight", size=size)
    assert caught.value.key == "size"
