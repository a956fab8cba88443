"""Lens distortion compared with OpenCV, and its valid radius."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from opencv_support import opencv_pixels
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.lens import MODELS, Lens
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

SIZE = (640, 480)
#: Calibrations of real cameras (of ROS drivers), and a made-up fisheye.
REAL = {
    "usb": Lens.of((-0.361976, 0.110510, 0.001014, 0.000505, 0.0)),
    "raspicam": Lens.of((0.1644274736, -0.2717244716, -0.0028679463, -9.697821e-05, 0.0)),
    "mono": Lens.of((0.189544, -0.018229, -0.000630, 0.000054, -0.000212, 0.543582, -0.027892, 0.0)),
    "fisheye": Lens.of((-0.013, 0.021, -0.0031, 0.0004), "equidistant"),
}


@st.composite
def lenses(draw: st.DrawFn) -> Lens:
    """Lenses of each model with realistic coefficients."""
    model = draw(st.sampled_from(sorted(MODELS)))
    largest = {"k1": 0.4, "k2": 0.2, "p1": 0.01, "p2": 0.01, "k3": 0.05, "k4": 0.4, "k5": 0.1, "k6": 0.02}
    if model == "equidistant":
        largest = {"k1": 0.1, "k2": 0.05, "k3": 0.02, "k4": 0.005}
    return Lens.of([draw(st.floats(-largest[name], largest[name])) for name in MODELS[model]], model)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Cameras with a lens that is valid up to at least 30 degrees."""
    lens = draw(lenses())
    assume(lens.valid_radius > np.tan(np.radians(30)))
    fx, fy = draw(st.floats(300, 1200)), draw(st.floats(300, 1200))
    skew = draw(st.sampled_from([0.0, 0.0, 7.5]))
    k = np.array([[fx, skew, draw(st.floats(200, 440))], [0, fy, draw(st.floats(150, 330))], [0, 0, 1]])
    rotation = Rotation.random(None, draw(st.integers(0, 10_000))).as_matrix()
    t = np.array([draw(st.floats(-5, 5)) for _ in range(3)])
    return Camera(SIZE, k, rotation, t, lens.coefficients, lens.model)


def seen_points(camera: Camera, seed: int, count: int = 60) -> Array:
    """World points within the valid radius of the lens, computed from R and t."""
    rng = np.random.default_rng(seed)
    angle = np.arctan(camera.lens.valid_radius) * 0.98 * np.sqrt(rng.uniform(0, 1, count))
    turn, depth = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.3, 20, count)
    optical = np.stack([np.tan(angle) * np.cos(turn), np.tan(angle) * np.sin(turn), np.ones(count)], axis=1)
    return (optical * depth[:, None] - camera.t) @ camera.R


@settings(deadline=None, max_examples=40)
@given(cameras(), st.integers(0, 1000))
def test_distorted_pixels_agree_with_opencv(camera: Camera, seed: int) -> None:
    points = seen_points(camera, seed)
    np.testing.assert_allclose(
        camera.project(points)[0], opencv_pixels(camera, points), rtol=1e-11, atol=1e-6
    )


@settings(deadline=None, max_examples=40)
@given(cameras(), st.integers(0, 1000))
def test_rays_of_pixels_are_the_points_that_opencv_projects_there(camera: Camera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([-0.5, -0.5], [639.5, 479.5], (60, 2))
    points = camera.unproject(pixels, rng.uniform(0.5, 10, 60))
    seen = np.isfinite(points[:, 0])
    np.testing.assert_allclose(opencv_pixels(camera, points[seen]), pixels[seen], atol=1e-4)


@pytest.mark.parametrize("name", REAL)
def test_undistorted_points_agree_with_opencv(name: str) -> None:
    lens, plane = REAL[name], np.eye(3)
    # its iteration for polynomials ends early, but is accurate near the axis
    reach, off = (1.2, 1e-9) if lens.model == "equidistant" else (0.25, 1e-6)
    fallen = lens.distort(np.random.default_rng(3).uniform(-reach / 2, reach / 2, (200, 2)))
    undistort = cv2.fisheye.undistortPoints if lens.model == "equidistant" else cv2.undistortPoints
    theirs = undistort(fallen[:, None], plane, np.array(lens.coefficients))[:, 0]
    np.testing.assert_allclose(lens.undistort(fallen), theirs, atol=off)


@settings(deadline=None, max_examples=40)
@given(cameras(), st.integers(0, 1000))
def test_unproject_recovers_every_visible_point(camera: Camera, seed: int) -> None:
    points = seen_points(camera, seed)
    pixels, depth = camera.project(points)
    again, _ = camera.project(camera.unproject(pixels, depth))
    np.testing.assert_allclose(again, pixels, atol=1e-4)
    inside = np.hypot(*(camera.to_optical(points)[:, :2] / depth[:, None]).T) < 0.9 * camera.lens.valid_radius
    np.testing.assert_allclose(camera.unproject(pixels, depth)[inside], points[inside], atol=1e-4)


@settings(deadline=None, max_examples=40)
@given(lenses(), st.integers(0, 1000))
def test_within_its_valid_radius_a_lens_never_folds(lens: Lens, seed: int) -> None:
    """The distortion is one-to-one: with the angle of a ray, its distorted radius by OpenCV increases."""
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    r = np.tan(np.linspace(0.001, np.arctan(lens.valid_radius) * 0.999, 400))
    points = np.stack([r * np.cos(turn), r * np.sin(turn), np.ones_like(r)], axis=1)
    camera = Camera(SIZE, np.eye(3), np.eye(3), np.zeros(3), lens.coefficients, lens.model)
    way = np.diff(opencv_pixels(camera, points), axis=0)
    assert (way @ points[0, :2] > 0).all()


def test_the_valid_radius_is_exact() -> None:
    # r (1 - r^2 / 3) turns back where 1 = r^2
    lens = Lens.of((-1 / 3,))
    assert lens.valid_radius == pytest.approx(1.0, abs=1e-6)
    assert np.isfinite(lens.distort([[0.999, 0.0]])).all()
    assert np.isnan(lens.distort([[1.001, 0.0], [0.0, 5.0]])).all()
    assert np.isnan(lens.undistort([[0.67, 0.0]])).all(), "no ray falls beyond 2/3"
    np.testing.assert_allclose(
        lens.undistort([[0.66, 0.0]])[0, 0] * (1 - lens.undistort([[0.66, 0]])[0, 0] ** 2 / 3), 0.66
    )


def test_a_zero_of_the_denominator_limits_the_valid_radius() -> None:
    assert Lens.of((0, 0, 0, 0, 0, -0.25, 0, 0), "rational_polynomial").valid_radius < 2.0


@pytest.mark.parametrize("name", REAL)
def test_points_behind_the_camera_or_beyond_the_lens_have_no_pixel(name: str) -> None:
    lens = REAL[name]
    k = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    camera = Camera(SIZE, k, np.eye(3), np.zeros(3), lens.coefficients, lens.model)
    beyond = lens.valid_radius * 1.01
    points = np.array(
        [[0, 0, -1.0], [0.3, 0.2, -1], [0.3, 0.2, 0], [0, 0, 0], [beyond, 0, 1], [0, -beyond * 2, 2]]
    )
    pixels, depth = camera.project(points)
    assert np.isnan(pixels).all()
    np.testing.assert_array_equal(depth, points[:, 2])


@pytest.mark.parametrize("name", REAL)
def test_skew_works_after_the_lens(name: str) -> None:
    lens = REAL[name]
    k = np.array([[400.0, 25, 320], [0, 380, 240], [0, 0, 1]])
    camera = Camera(SIZE, k, np.eye(3), np.zeros(3), lens.coefficients, lens.model)
    x, y = lens.distort([[0.3, -0.2]])[0]
    np.testing.assert_allclose(
        camera.project([[0.3, -0.2, 1.0]])[0][0], [400 * x + 25 * y + 320, 380 * y + 240]
    )


@pytest.mark.parametrize(
    ("coefficients", "model", "expected"),
    [
        ((), None, ("plumb_bob", 5)),
        ((0.1, 0.2, 0, 0), None, ("plumb_bob", 5)),
        ((0.1, 0.2, 0, 0, 0.1), None, ("plumb_bob", 5)),
        ((0.1, 0, 0, 0, 0, 0.2, 0, 0), None, ("rational_polynomial", 8)),
        ((0.1, 0.2, 0, 0, 0.1, *[0] * 9), None, ("plumb_bob", 5)),
        ((0.1,), "rational_polynomial", ("rational_polynomial", 8)),
        ((0.1, 0.2), "equidistant", ("equidistant", 4)),
    ],
)
def test_the_number_of_coefficients_decides_the_model(
    coefficients: tuple[float, ...], model: str | None, expected: tuple[str, int]
) -> None:
    lens = Lens.of(coefficients, model)
    assert (lens.model, len(lens.coefficients)) == expected


def test_a_fisheye_without_coefficients_still_distorts() -> None:
    camera = Camera(SIZE, np.diag([300.0, 300, 1]), np.eye(3), np.zeros(3), (0.0,) * 4, "equidistant")
    assert camera.distorted
    # the angle itself, times the focal length
    np.testing.assert_allclose(camera.project([[1.0, 0, 1]])[0][0], [300 * np.pi / 4, 0])


def test_twelve_coefficients_are_refused_with_the_name_of_their_model() -> None:
    with pytest.raises(CameraError, match="thin prism"):
        Lens.of((0.1,) * 12)


def test_camera_info_shows_the_ideal_camera() -> None:
    k = np.array([[410.0, 3, 301], [0, 402, 251], [0, 0, 1]])
    camera = Camera(SIZE, k, np.eye(3), np.zeros(3), (-0.3, 0.1, 0, 0, 0))
    np.testing.assert_array_equal(
        camera.rectified_projection, [[410, 0, 319.5, 0], [0, 402, 239.5, 0], [0, 0, 1, 0]]
    )
    straight = Camera(SIZE, np.triu(k) * [[1, 0, 1], [1, 1, 1], [1, 1, 1]], np.eye(3), np.zeros(3))
    np.testing.assert_array_equal(straight.rectified_projection[:, :3], straight.K)
