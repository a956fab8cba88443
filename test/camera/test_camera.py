"""The camera compared with OpenCV, and its OpenGL matrix with the rules of OpenGL."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

K = np.array([[710.0, 0, 301.5], [0, 690.0, 250.25], [0, 0, 1]])
R = Rotation.from_euler("xyz", [0.3, -0.7, 1.9]).as_matrix()
T = np.array([0.2, -0.4, 3.0])
SIZE = (640, 480)
CAMERA = Camera(SIZE, K, R, T)


@st.composite
def cameras(draw: st.DrawFn, skew: bool = False) -> Camera:
    width, height = draw(st.integers(1, 4000)), draw(st.integers(1, 4000))
    k = np.array(
        [
            [
                draw(st.floats(50, 5000)),
                draw(st.floats(-20, 20)) if skew else 0.0,
                draw(st.floats(-50, 4000)),
            ],
            [0, draw(st.floats(50, 5000)), draw(st.floats(-50, 4000))],
            [0, 0, 1],
        ]
    )
    rotation = Rotation.random(None, draw(st.integers(0, 10_000))).as_matrix()
    return Camera((width, height), k, rotation, np.array([draw(st.floats(-20, 20)) for _ in range(3)]))


def points_before(camera: Camera, seed: int = 0, count: int = 50) -> Array:
    """World points in front of a camera, computed from R and t."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.2, 30, count)
    optical = np.column_stack([rng.uniform(-1, 1, (count, 2)) * depth[:, None], depth])
    return (optical - camera.t) @ camera.R


@settings(deadline=None, max_examples=40)
@given(cameras(), st.integers(0, 1000))
def test_pixels_agree_with_opencv(camera: Camera, seed: int) -> None:
    points = points_before(camera, seed)
    theirs, _ = cv2.projectPoints(points, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, None)
    ours, depth = camera.project(points)
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-6)
    np.testing.assert_allclose(depth, (points @ camera.R.T + camera.t)[:, 2], atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(cameras(skew=True), st.integers(0, 1000))
def test_pixels_agree_with_p_also_with_skew(camera: Camera, seed: int) -> None:
    points = points_before(camera, seed)
    p = camera.K @ np.hstack([camera.R, camera.t[:, None]])
    np.testing.assert_allclose(camera.P, p)
    image = p @ np.column_stack([points, np.ones(len(points))]).T
    np.testing.assert_allclose(camera.project(points)[0], (image[:2] / image[2]).T, atol=1e-6)


def test_pixels_behind_the_camera_are_nan() -> None:
    ahead, behind = CAMERA.unproject([[100.0, 100.0]], [2.0]), CAMERA.unproject([[100.0, 100.0]], [-2.0])
    pixels, depth = CAMERA.project(np.vstack([ahead, behind]))
    np.testing.assert_allclose(pixels[0], [100, 100])
    assert np.isnan(pixels[1]).all()
    np.testing.assert_allclose(depth, [2, -2], atol=1e-12)
    assert np.isnan(CAMERA.project_optical(np.array([[0.0, 0, 0], [1, 1, 0]]))[0]).all()


@settings(deadline=None, max_examples=40)
@given(cameras(skew=True), st.integers(0, 1000))
def test_unproject_is_the_inverse_of_project(camera: Camera, seed: int) -> None:
    points = points_before(camera, seed)
    np.testing.assert_allclose(camera.unproject(*camera.project(points)), points, atol=1e-8)


def test_center_and_poses() -> None:
    np.testing.assert_allclose(R @ CAMERA.center + T, 0, atol=1e-12)
    np.testing.assert_allclose(CAMERA.world_from_optical @ CAMERA.optical_from_world, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(CAMERA.world_from_optical[:3, 3], CAMERA.center)
    np.testing.assert_allclose(CAMERA.to_optical(CAMERA.center), 0, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(cameras(skew=True), st.floats(1e-6, 1e6), st.booleans())
def test_from_projection_matrix_accepts_any_scale_and_sign(
    camera: Camera, scale: float, negative: bool
) -> None:
    p = (-scale if negative else scale) * (camera.K @ np.hstack([camera.R, camera.t[:, None]]))
    found = Camera.from_projection_matrix(p, camera.size)
    np.testing.assert_allclose(found.K, camera.K, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.R, camera.R, atol=1e-8)
    np.testing.assert_allclose(found.t, camera.t, atol=1e-7)


def test_from_projection_matrix_agrees_with_opencv() -> None:
    p = CAMERA.P * -3.7
    k, r, centre = cv2.decomposeProjectionMatrix(-p)[:3]
    found = Camera.from_projection_matrix(p, SIZE)
    np.testing.assert_allclose(found.K, k / k[2, 2], atol=1e-6)
    np.testing.assert_allclose(found.R, r, atol=1e-9)
    np.testing.assert_allclose(found.center, (centre[:3] / centre[3]).ravel(), atol=1e-9)


@settings(deadline=None, max_examples=40)
@given(st.tuples(*[st.floats(-10, 10)] * 3), st.tuples(*[st.floats(-10, 10)] * 3), st.floats(0.1, 3.0))
def test_look_at_projects_the_target_to_the_image_centre(
    position: tuple[float, float, float], target: tuple[float, float, float], fov: float
) -> None:
    if np.linalg.norm(np.subtract(position, target)[:2]) < 0.1:
        return  # straight up or down
    camera = Camera.look_at(position, target, (640, 480), fov)
    pixels, depth = camera.project(np.array([target]))
    np.testing.assert_allclose(pixels[0], [319.5, 239.5], atol=1e-6)
    np.testing.assert_allclose(depth[0], np.linalg.norm(np.subtract(position, target)))
    np.testing.assert_allclose(camera.center, position, atol=1e-9)
    assert camera.R[0, 2] == pytest.approx(0, abs=1e-12)  # image rows are level
    assert camera.R[1, 2] < 0  # image down is world down


def test_field_of_view_is_from_the_left_edge_to_the_right() -> None:
    camera = Camera.look_at((0, 0, 1), (1, 0, 1), (640, 480), np.radians(90))
    # pixel edges, half a pixel beyond the outer pixels' centres
    rays = camera.unproject([[-0.5, 239.5], [639.5, 239.5]], [1.0, 1.0]) - camera.center
    np.testing.assert_allclose(rays, [[1, 1, 0], [1, -1, 0]], atol=1e-12)


def opengl_window(clip: Array, size: tuple[int, int]) -> Array:
    """OpenGL's rule (divide by w, then glViewport and glDepthRange as they are): window x, y, z in 0..1."""
    ndc = clip[:3] / clip[3]
    width, height = size
    return np.array([(ndc[0] + 1) * width / 2, (ndc[1] + 1) * height / 2, (ndc[2] + 1) / 2])


@settings(deadline=None, max_examples=40)
@given(cameras(skew=True), st.integers(0, 1000))
def test_opengl_has_pixel_centres_at_half_integers_and_the_first_row_lowest(
    camera: Camera, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pixel = np.array([rng.integers(0, camera.size[0]), rng.integers(0, camera.size[1])])
    point = camera.unproject([pixel], [4.0])[0]
    optical = np.append(camera.R @ point + camera.t, 1.0)
    window = opengl_window(camera.opengl_clip(0.1, 100.0) @ optical, camera.size)
    np.testing.assert_allclose(window[:2], pixel + 0.5, atol=1e-6)


def test_opengl_depth_is_0_at_near_and_1_at_far_and_grows() -> None:
    clip = CAMERA.opengl_clip(0.5, 20.0)
    near, between, far = (opengl_window(clip @ [0.1, 0.2, z, 1], SIZE)[2] for z in (0.5, 3.0, 20.0))
    assert near == pytest.approx(0, abs=1e-12)
    assert far == pytest.approx(1)
    assert 0 < between < 1


def test_k_of_any_scale_and_sign_is_the_same_camera() -> None:
    for scale in (2.0, 1e-4, -1.0):
        np.testing.assert_allclose(Camera(SIZE, scale * K, R, T).K, K)


def test_a_rotation_written_with_few_digits_is_made_orthonormal() -> None:
    camera = Camera(SIZE, K, np.round(R, 4), T)
    np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(camera.R, R, atol=1e-4)


def test_a_camera_does_not_change_with_the_arrays_it_was_made_from() -> None:
    k, r, t = K.copy(), R.copy(), T.copy()
    camera = Camera(SIZE, k, r, t)
    for array in (k, r, t):
        array += 1
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_array_equal(camera.R, R)
    np.testing.assert_array_equal(camera.t, T)


MIRROR = np.diag([1.0, 1.0, -1.0])
BAD: list[tuple[str, dict[str, object], str]] = [
    ("singular K", {"K": np.diag([700.0, 0.0, 1.0])}, "K"),
    ("K of zeros", {"K": np.zeros((3, 3))}, "K"),
    ("K without its last element", {"K": np.diag([700.0, 700.0, 0.0])}, "K"),
    ("focal length lost", {"K": [[1e-9, 0, 320], [0, 700, 240], [0, 0, 1]]}, "K"),
    ("negative focal length", {"K": np.diag([-700.0, 700.0, 1.0])}, "K"),
    ("K with a negative last element", {"K": np.diag([700.0, 700.0, -1.0])}, "K"),
    ("K not triangular", {"K": K.T}, "K"),
    ("K of the wrong shape", {"K": np.eye(4)}, "K"),
    ("K with NaN", {"K": np.diag([np.nan, 700, 1])}, "K"),
    ("K of words", {"K": [["a"] * 3] * 3}, "K"),
    ("K ragged", {"K": [[1, 2], [3]]}, "K"),
    ("R scaled", {"R": 2 * R}, "R"),
    ("R mirrored", {"R": R @ MIRROR}, "R"),
    ("R sheared", {"R": R + np.eye(3) * 0.01}, "R"),
    ("R of zeros", {"R": np.zeros((3, 3))}, "R"),
    ("R infinite", {"R": np.full((3, 3), np.inf)}, "R"),
    ("t of two numbers", {"t": np.zeros(2)}, "t"),
    ("t with NaN", {"t": np.array([0, 0, np.nan])}, "t"),
    ("size zero", {"size": (0, 480)}, "size"),
    ("size negative", {"size": (640, -480)}, "size"),
    ("size huge", {"size": (10_000_000, 480)}, "size"),
    ("size broken", {"size": (640.5, 480)}, "size"),
    ("size NaN", {"size": (np.nan, 480)}, "size"),
    ("size infinite", {"size": (np.inf, 480)}, "size"),
    ("size of three", {"size": (640, 480, 3)}, "size"),
    ("size missing", {"size": None}, "size"),
    ("tilted", {"distortion": (0.1,) * 14}, "distortion"),
    ("fisheye of five", {"distortion": (0.1,) * 5, "model": "equidistant"}, "distortion"),
    ("no such lens", {"model": "telecentric"}, "model"),
    ("distortion of words", {"distortion": ("a", "b")}, "distortion"),
    ("rectification", {"rectification": np.ones((3, 3))}, "rectification"),
    ("rectified", {"rectified": np.zeros((3, 4))}, "rectified"),
    ("distortion NaN", {"distortion": (np.nan,)}, "distortion"),
]


@pytest.mark.parametrize(("change", "key"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_impossible_calibrations_are_refused_with_the_part_that_is_wrong(
    change: dict[str, object], key: str
) -> None:
    with pytest.raises(CameraError) as caught:
        Camera(**({"size": SIZE, "K": K, "R": R, "t": T} | change))  # type: ignore[arg-type]
    assert caught.value.key == key
    assert str(caught.value).startswith(f"{key}: ")


def test_zero_coefficients_are_no_distortion() -> None:
    assert Camera(SIZE, K, R, T, (0.0,) * 5).distortion == (0.0,) * 5


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"target": (1, 2, 3)}, "look_at"),
        ({"target": (1, 2, 9)}, "up"),
        ({"fov": 0.0}, "fov"),
        ({"fov": np.pi}, "fov"),
        ({"fov": np.nan}, "fov"),
        ({"position": (np.nan, 0, 0)}, "position"),
        ({"target": (0, 0)}, "look_at"),
        ({"up": (0, np.nan, 1)}, "up"),
        ({"size": (0, 0)}, "size"),
    ],
)
def test_impossible_views_are_refused(change: dict[str, object], key: str) -> None:
    with pytest.raises(CameraError) as caught:
        Camera.look_at(**({"position": (1, 2, 3), "target": (0, 0, 0)} | change))  # type: ignore[arg-type]
    assert caught.value.key == key


@pytest.mark.parametrize(
    "p",
    [
        np.zeros((3, 4)),
        np.eye(3),
        np.full((3, 4), np.nan),
        np.hstack([np.diag([1.0, 1, 0]), np.ones((3, 1))]),
    ],
    ids=["zeros", "shape", "NaN", "affine"],
)
def test_matrices_that_are_not_projections_are_refused(p: Array) -> None:
    with pytest.raises(CameraError) as caught:
        Camera.from_projection_matrix(p, SIZE)
    assert caught.value.key == "P"


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), None),
        ((-0.2, 0.05, 0.001, -0.002, 0.01), "plumb_bob"),
        ((0.02, -0.01, 0.003, 0.001), "equidistant"),
    ],
)
def test_jacobian_is_the_slope_of_the_projection(distortion: tuple[float, ...], model: str | None) -> None:
    skewed = K + np.array([[0, 1.5, 0], [0, 0, 0], [0, 0, 0]])
    camera = Camera(SIZE, skewed, R, T, distortion, model)
    points = (np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 4), (40, 3)) - T) @ R
    step = 1e-5
    slopes = [
        (camera.project(points + step * axis)[0] - camera.project(points - step * axis)[0]) / (2 * step)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(
        camera.project_jacobian(points), np.stack(slopes, axis=-1), rtol=1e-5, atol=1e-4
    )
