"""Rigs: poses, coverage, and stereo pairs compared with OpenCV and ROS."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import SphericalVoronoi
from scipy.spatial.distance import pdist, squareform

from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.errors import CameraError

TARGET = np.array([0.5, -1.0, 1.1])
OPTICS = Optics((640, 480), np.radians(50))
BARREL = Optics((640, 480), np.radians(80), (-0.25, 0.08, 0.0, 0.0, -0.01))
FISHEYE = Optics((640, 480), np.radians(170), (0.02, -0.005, 0.001, 0.0), "equidistant")


def centers(cameras: dict[str, Camera]) -> np.ndarray:
    return np.array([camera.center for camera in cameras.values()])


@pytest.mark.daily("ideal")
@pytest.mark.parametrize("optics", [OPTICS, BARREL, FISHEYE], ids=["ideal", "barrel", "fisheye"])
def test_all_cameras_see_the_target_at_the_centre_and_are_upright(optics: Optics) -> None:
    rigs = (
        Rig(TARGET, 4, 1.8, optics, 0.3).ring(8),
        Rig(TARGET, 4, 1.8, optics, 0.3).grid(3, 4, 0.6),
        Rig(TARGET, 4, optics=optics, start=0.3).dome(30),
    )
    for cameras in rigs:
        assert list(cameras) == [f"camera_{number}" for number in range(1, len(cameras) + 1)]
        for camera in cameras.values():
            np.testing.assert_allclose(camera.project(TARGET[None])[0], [[319.5, 239.5]], atol=1e-6)
            assert camera.R[1, 2] < 0 == pytest.approx(camera.R[0, 2], abs=1e-12)


def test_the_field_of_view_is_that_through_the_lens() -> None:
    for optics in (OPTICS, BARREL, FISHEYE):
        camera = optics.camera((0, 0, 1), (1, 0, 1))
        edges = [[-0.5, 239.5], [639.5, 239.5]]
        if camera.model == "equidistant":
            rays = cv2.fisheye.undistortPoints(
                np.array([edges]), camera.K, np.array(camera.distortion)
            ).reshape(-1, 2)
        else:
            rays = cv2.undistortPoints(np.array([edges]), camera.K, np.array(camera.distortion)).reshape(
                -1, 2
            )
        seen = np.arctan(rays[:, 0])
        assert seen[1] - seen[0] == pytest.approx(optics.fov, abs=2e-3)  # OpenCV stops early
        assert camera.K[0, 0] == camera.K[1, 1]


def test_a_ring_is_round_and_even() -> None:
    places = centers(Rig(TARGET, 4, 1.8, OPTICS, np.pi / 2).ring(8)) - TARGET
    np.testing.assert_allclose(places[0], [0, 4, 0.7], atol=1e-12)
    np.testing.assert_allclose(places[2], [-4, 0, 0.7], atol=1e-12)  # to the left
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1]), 4)
    neighbours = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)
    np.testing.assert_allclose(neighbours, neighbours[0])


def test_a_grid_is_a_wall_of_rows_and_columns() -> None:
    places = centers(Rig(TARGET, 4, 1.8, OPTICS).grid(2, 3, 0.5)).reshape(2, 3, 3)
    np.testing.assert_allclose(places[0, 0], [4.5, -0.5, 2.05])  # seen from the target: top, left
    np.testing.assert_allclose(places[0, 1] - places[0, 0], [0, -0.5, 0], atol=1e-12)
    np.testing.assert_allclose(places[1, 0] - places[0, 0], [0, 0, -0.5], atol=1e-12)
    np.testing.assert_allclose(places.mean((0, 1)), [4.5, -1, 1.8])


def test_a_dome_gives_every_camera_the_same_share_of_the_half_sphere() -> None:
    directions = (centers(Rig(TARGET, 3, optics=OPTICS).dome(60)) - TARGET) / 3
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    assert (directions[:, 2] > 0).all()
    # with its mirror image below, a whole sphere
    areas = SphericalVoronoi(np.vstack([directions, -directions])).calculate_areas()
    assert areas.sum() == pytest.approx(4 * np.pi)
    assert np.abs(areas[:60] / areas.mean() - 1).max() < 0.35
    nearest = (squareform(pdist(directions)) + 9 * np.eye(60)).min(axis=1)
    assert nearest.min() > 0.7 * np.sqrt(2 * np.pi / 60)


@pytest.mark.parametrize("optics", [OPTICS, BARREL], ids=["ideal", "barrel"])
def test_depth_from_a_stereo_pair_as_computed_by_ros_is_exact(optics: Optics) -> None:
    cameras = Rig(TARGET, 4, 1.5, optics, 0.7).stereo(0.2)
    left, right = cameras["left"], cameras["right"]
    np.testing.assert_allclose(left.R, right.R)
    np.testing.assert_allclose(left.R @ (right.center - left.center), [0.2, 0, 0], atol=1e-12)
    np.testing.assert_allclose(
        (left.center + right.center)[:2] / 2, TARGET[:2] + 4 * np.array([np.cos(0.7), np.sin(0.7)])
    )
    p_left, p_right = left.rectified_projection, right.rectified_projection
    fx = p_left[0, 0]
    assert p_right[0, 3] == pytest.approx(-fx * 0.2)
    assert not p_left[:, 3].any()
    np.testing.assert_array_equal(p_left[:, :3], p_right[:, :3])

    points = TARGET + np.random.default_rng(3).uniform(-0.8, 0.8, (50, 3))
    rectified = []
    for camera, p in ((left, p_left), (right, p_right)):
        raw, _ = camera.project(points)
        np.testing.assert_array_equal(camera.rectification_matrix, np.eye(3))
        undistorted = cv2.fisheye if camera.model == "equidistant" else cv2
        done = undistorted.undistortPoints(
            raw[:, None], camera.K, np.array(camera.distortion), R=np.eye(3), P=p[:, :3]
        )
        rectified.append(done[:, 0])
    # both see a point in the same row, and disparity is fx baseline / depth in the left frame
    np.testing.assert_allclose(rectified[0][:, 1], rectified[1][:, 1], atol=0.05)
    disparity = rectified[0][:, 0] - rectified[1][:, 0]
    depth = left.to_optical(points)[:, 2]
    np.testing.assert_allclose(-p_right[0, 3] / disparity, depth, rtol=2e-3)
    # P of the right one takes points of the left frame to the right image
    image = p_right @ np.column_stack([left.to_optical(points), np.ones(50)]).T
    np.testing.assert_allclose((image[:2] / image[2]).T, rectified[1], atol=0.05)


def test_the_pair_of_opencvs_own_rectification_is_the_same() -> None:
    cameras = Rig(TARGET, 4, 1.5, OPTICS).stereo(0.2)
    left, right = cameras["left"], cameras["right"]
    none = np.zeros(5)
    turn, shift = right.R @ left.R.T, right.t - right.R @ left.R.T @ left.t
    r1, r2, _, p2, *_ = cv2.stereoRectify(left.K, none, right.K, none, (640, 480), turn, shift[:, None])
    np.testing.assert_allclose(r1, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(r2, np.eye(3), atol=1e-9)
    assert p2[0, 3] / p2[0, 0] == pytest.approx(right.rectified_projection[0, 3] / right.K[0, 0])


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Rig(TARGET, 4, 1.8, OPTICS).ring(0), None),
        (lambda: Rig(TARGET, 4, 1.8, OPTICS).ring(10**9), None),
        (lambda: Rig(TARGET, -1, 1.8, OPTICS).ring(4), "radius"),
        (lambda: Rig(TARGET, np.nan, 1.8, OPTICS).ring(4), "radius"),
        (lambda: Rig(TARGET, 4, np.inf, OPTICS).ring(4), "position"),
        (lambda: Rig((0, 0), 4, 1.8, OPTICS).ring(4), "look_at"),
        (lambda: Rig(TARGET, 4, 1.8, OPTICS).grid(-2, -3, 0.5), None),
        (lambda: Rig(TARGET, 4, 1.8, OPTICS).grid(2, 3, 0), "spacing"),
        (lambda: Rig(TARGET, 4, 1.8, OPTICS).stereo(-0.1), "baseline"),
        (lambda: Rig(TARGET, 4, 1.8, OPTICS).stereo(9.0), None),  # the target is in neither image
        (lambda: Rig(TARGET, 4, optics=Optics(fov=np.radians(200))).dome(4), "fov"),
        (lambda: Rig(TARGET, 4, optics=Optics(fov=np.radians(150), distortion=(-0.4,))).dome(4), "fov"),
        (lambda: Rig(TARGET, 4, optics=Optics(size=(0, 5))).dome(4), "size"),
        (lambda: Rig(TARGET, 4, optics=Optics(model="pinhole")).dome(4), "model"),
        (lambda: Rig(TARGET, 4, optics=Optics(distortion=(np.nan,))).dome(4), "distortion"),
    ],
)  # fmt: skip
def test_impossible_rigs_are_refused(make, key: str | None) -> None:
    with pytest.raises(CameraError) as caught:
        make()
    assert caught.value.key == key
