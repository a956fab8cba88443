"""Keypoints in space from noisy 2D points with outliers, and views with exchanged sides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from photographs.studio import ring, studio_cameras

from humansim_ros.cameras import Camera, write_calibration
from humansim_ros.errors import HumansimWarning, PhotographError
from humansim_ros.geometry import transform
from humansim_ros.people import KEYPOINT_SETS, KeypointLocator, keypoint_set, load_human
from humansim_ros.people.keypoints.sets import KeypointSet
from humansim_ros.photographs import read_views
from humansim_ros.photographs.triangulation import front_distance, triangulate, triangulate_photos
from humansim_ros.photographs.views import write_points

COCO = keypoint_set("coco17")
SHELF = list(studio_cameras("shelf").values())
Points = NDArray[np.float64]


def body_points(keypoints: KeypointSet = COCO, seed: int = 0, human: str = "adult_woman") -> Points:
    """Keypoints (K, 3) of a standing person with bent limbs, facing anywhere, in ``map``."""
    body, rng = load_human(human), np.random.default_rng(seed)
    skeleton = body.skeleton
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(skeleton), 1))
    for bone in ("shoulder", "elbow", "hip", "knee"):
        for side in "lr":
            turns[skeleton.bone(f"{side}_{bone}"), :3] = rng.uniform(-0.3, 0.3, 3)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    yaw = rng.uniform(-np.pi, np.pi)
    facing = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    to_map = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    posed = skeleton.pose(turns, transform(facing @ to_map, np.zeros(3)))
    joints = skeleton.joint_transforms(posed)[:, :3, 3]
    return KeypointLocator.of(body, keypoints).positions(joints, body.pose(posed))


def seen(
    cameras: Sequence[Camera], body: Points, noise: float = 2.0, outliers: float = 0.0, seed: int = 0
) -> tuple[Points, NDArray[np.bool_]]:
    """Points (V, K, 3) as of a detector, and (V, K) which of them are wrong."""
    rng = np.random.default_rng(seed)
    points, wrong = np.ones((len(cameras), len(body), 3)), np.zeros((len(cameras), len(body)), bool)
    for view, camera in enumerate(cameras):
        pixels = camera.project(body)[0]
        low, high = pixels.min(axis=0) - 30, pixels.max(axis=0) + 30
        wrong[view] = rng.random(len(body)) < outliers
        noisy = pixels + rng.normal(0, noise, pixels.shape)
        points[view, :, :2] = np.where(wrong[view, :, None], rng.uniform(low, high, pixels.shape), noisy)
    return points, wrong


def exchange(points: Points, views: Sequence[int], keypoints: KeypointSet = COCO) -> Points:
    exchanged = points.copy()
    for view in views:
        exchanged[view] = points[view, list(keypoints.mirrored)]
    return exchanged


def test_exact_points_through_a_lens_give_exact_positions() -> None:
    body = body_points()
    points, _ = seen(list(ring(4).values()), body, noise=0)
    found = triangulate(list(ring(4).values()), points, COCO)
    np.testing.assert_allclose(found.positions, body, atol=1e-6)
    assert found.inliers.all() and not found.swapped.any() and found.errors.max() < 1e-4


def test_two_ideal_cameras_agree_with_opencv() -> None:
    cameras = [Camera.look_at((3, y, 1.2), (0, 0, 0.9)) for y in (-1.0, 1.5)]
    body = body_points()
    points, _ = seen(cameras, body, noise=0.5)
    found = triangulate(cameras, points, COCO)
    left, right = (points[view, :, :2].T for view in (0, 1))
    expected = cv2.triangulatePoints(cameras[0].P, cameras[1].P, left, right)
    measured = ~np.isnan(found.positions[:, 0])
    assert measured.sum() >= 15
    np.testing.assert_allclose(found.positions[measured], (expected[:3] / expected[3]).T[measured], atol=2e-3)


def test_the_refined_position_has_the_least_squared_distance_in_the_images() -> None:
    cameras, body = list(ring(4).values()), body_points()
    points, _ = seen(cameras, body)
    found = triangulate(cameras, points, COCO)

    def cost(positions: Points) -> Points:
        errors = [
            camera.project(positions)[0] - own[:, :2] for camera, own in zip(cameras, points, strict=True)
        ]
        return np.where(found.inliers[..., None], errors, 0).__pow__(2).sum(axis=(0, 2))

    for step in np.vstack([np.eye(3), -np.eye(3)]) * 1e-3:
        assert (cost(found.positions + step) > cost(found.positions)).all()


@pytest.mark.daily("shelf-20%", "four-10%")
@pytest.mark.parametrize(
    ("cameras", "outliers", "mean", "worst"),
    [
        pytest.param(SHELF, 0.1, 8, 30, id="shelf-10%"),
        pytest.param(SHELF, 0.2, 8, 40, id="shelf-20%"),
        pytest.param(SHELF, 0.3, 15, 100, id="shelf-30%"),
        pytest.param(list(ring(8).values()), 0.3, 12, 60, id="eight-30%"),
        pytest.param(list(ring(4).values()), 0.1, 14, 60, id="four-10%"),
    ],
)
def test_positions_are_right_in_spite_of_outliers(
    cameras: list[Camera], outliers: float, mean: float, worst: float
) -> None:
    """Millimetres; 2 pixels of noise. ``worst``: 98 % of the keypoints are nearer."""
    errors = []
    for seed in range(6):
        body = body_points(seed=seed)
        points, _ = seen(cameras, body, outliers=outliers, seed=seed)
        errors.append(np.linalg.norm(triangulate(cameras, points, COCO).positions - body, axis=1) * 1000)
    known = ~np.isnan(errors)
    assert known.mean() > 0.93
    assert np.nanmedian(errors) < mean and np.nanpercentile(errors, 98) < worst


@pytest.mark.parametrize("noise", [0.3, 2.0, 6.0])
def test_the_limit_of_outliers_follows_from_the_noise(noise: float) -> None:
    cameras = list(ring(8).values())
    points, wrong = seen(cameras, body_points(), noise, 0.0)
    far = np.zeros_like(wrong)
    far[0, 5:11] = True
    points[0, 5:11, 0] += 12 * noise
    found = triangulate(cameras, points, COCO)
    assert found.inliers[~far].mean() > 0.97
    assert found.inliers[far].mean() == 0


def test_equal_input_gives_equal_output() -> None:
    points, _ = seen(SHELF, body_points(), outliers=0.2)
    first, second = (triangulate(SHELF, points, COCO) for _ in range(2))
    for name in ("positions", "inliers", "errors", "swapped"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_many_views_are_tried_in_a_drawn_number_of_pairs() -> None:
    cameras, body = list(ring(24).values()), body_points()
    points, _ = seen(cameras, body, outliers=0.2)
    found = triangulate(cameras, points, COCO)
    assert np.linalg.norm(found.positions - body, axis=1).max() < 0.03


def test_a_keypoint_that_one_view_sees_has_no_position() -> None:
    cameras = list(ring(4).values())
    points, _ = seen(cameras, body_points())
    points[1:, 9] = 0
    found = triangulate(cameras, points, COCO)
    assert np.isnan(found.positions).any(axis=1).nonzero()[0].tolist() == [9]
    assert not found.inliers[:, 9].any() and np.isnan(found.errors[:, 9]).all()


def test_two_wrong_points_that_agree_by_chance_do_not_make_a_long_arm() -> None:
    """The left wrist is wrong in all views, but two of them show the same place a metre above the head."""
    cameras, body = list(ring(4).values()), body_points()
    points, _ = seen(cameras, body, noise=0.5)
    wrist = COCO.index("left_wrist")
    points[:, wrist, 2] = [1, 1, 0, 0]
    for view in (0, 1):
        points[view, wrist, :2] = cameras[view].project(body[[COCO.index("nose")]] + (0, 0, 0.6))[0][0]
    found = triangulate(cameras, points, COCO)
    assert np.isnan(found.positions[wrist]).all()
    assert np.isfinite(np.delete(found.positions, wrist, axis=0)).all()


#: Sets of a hand or a face, whose sides do not tell how a person stands.
PARTS = {"left_hand21", "right_hand21", "face68", "face70", "face468"}


@pytest.mark.daily("views2-body25", "views0-body25")
@pytest.mark.parametrize("name", sorted(KEYPOINT_SETS.keys() - PARTS))
@pytest.mark.parametrize("views", [(), (2,), (0, 3)])
def test_views_with_exchanged_sides_are_found_and_exchanged_back(name: str, views: tuple[int, ...]) -> None:
    keypoints = keypoint_set(name)
    body = body_points(keypoints)
    points, _ = seen(SHELF, body, outliers=0.1)
    found = triangulate(SHELF, exchange(points, views, keypoints), keypoints)
    assert np.flatnonzero(found.swapped).tolist() == list(views)
    np.testing.assert_array_equal(found.points, points)
    assert np.nanmedian(np.linalg.norm(found.positions - body, axis=1)) < 0.012


@pytest.mark.daily("views2")
@pytest.mark.parametrize("views", [(0,), (1,), (0, 1)])
def test_the_face_decides_which_of_two_views_is_exchanged(views: tuple[int, ...]) -> None:
    cameras = [list(ring(8).values())[number] for number in (0, 2)]
    for seed in range(3):  # in bodies whose left and right are apart in both images
        body = body_points(seed=seed)
        points, _ = seen(cameras, body, noise=1.0, seed=seed)
        found = triangulate(cameras, exchange(points, views), COCO)
        assert np.flatnonzero(found.swapped).tolist() == list(views)


def test_the_front_of_the_body_is_in_front_of_its_back() -> None:
    for keypoints in (each for each in KEYPOINT_SETS.values() if each.has_body):
        body = body_points(keypoints)
        ahead = front_distance(body, keypoints)
        if keypoints.name != "h36m17":  # it has neither a face nor toes
            assert ahead > 0.1
        assert front_distance(body[list(keypoints.mirrored)], keypoints) == pytest.approx(-ahead, rel=0.01)


def views_file(folder: Path, cameras: dict[str, Camera], frames: Sequence[Points]) -> Path:
    write_calibration(folder / "calibration.toml", cameras)
    lines = ["calibration: calibration.toml", "views:"]
    for view, name in enumerate(cameras):
        write_points(folder / f"{name}.json", COCO, [points[view] for points in frames])
        lines.append(f"  {name}: {{points: {name}.json}}")
    path = folder / "views.yaml"
    path.write_text("\n".join(lines))
    return path


def test_a_warning_names_view_and_frames_with_exchanged_sides(tmp_path: Path) -> None:
    cameras = ring(4)
    points, _ = seen(list(cameras.values()), body_points(), noise=1.0)
    frames = [exchange(points, (1,)), points, exchange(points, (1, 2))]
    photos = read_views(views_file(tmp_path, cameras, frames))
    with pytest.warns(HumansimWarning) as warned:
        found = triangulate_photos(photos)
    texts = [str(each.message) for each in warned]
    assert [text for text in texts if "exchanged in view view_2, frames 0, 2:" in text]
    assert [text for text in texts if "exchanged in view view_3, frame 2:" in text]
    assert len(texts) == 2
    assert [np.flatnonzero(each.swapped).tolist() for each in found] == [[1], [], [1, 2]]


def test_parts_that_are_cut_off_in_all_views_are_named_and_the_rest_is_kept(tmp_path: Path) -> None:
    cameras = ring(4)
    points, _ = seen(list(cameras.values()), body_points(), noise=1.0)
    points[:, 13:] = 0
    photos = read_views(views_file(tmp_path, cameras, [points]))
    with pytest.warns(HumansimWarning, match=r"left_knee, right_knee, left_ankle, right_ankle") as warned:
        (found,) = triangulate_photos(photos)
    assert len(warned) == 1
    assert np.isfinite(found.positions[:13]).all() and np.isnan(found.positions[13:]).all()


def test_one_view_only_is_refused(tmp_path: Path) -> None:
    cameras = dict(list(ring(4).items())[:1])
    points, _ = seen(list(cameras.values()), body_points())
    with pytest.raises(PhotographError, match=r"views\.yaml: views: one view only \(view_1\).*two views"):
        triangulate_photos(read_views(views_file(tmp_path, cameras, [points])))
    with pytest.raises(PhotographError, match="two views"):
        triangulate(list(cameras.values()), points, COCO)


def test_views_that_share_no_keypoint_are_refused(tmp_path: Path) -> None:
    cameras = ring(4)
    points, _ = seen(list(cameras.values()), body_points())
    for view in range(4):
        points[view, np.arange(17) % 4 != view] = 0
    with pytest.raises(PhotographError, match=r"no keypoint is seen by two views.*view_1 5, view_2 4"):
        triangulate_photos(read_views(views_file(tmp_path, cameras, [points])))


def test_a_frame_without_points_is_named(tmp_path: Path) -> None:
    cameras = ring(4)
    points, _ = seen(list(cameras.values()), body_points(), noise=1.0)
    photos = read_views(views_file(tmp_path, cameras, [points, np.zeros_like(points), points]))
    with pytest.warns(HumansimWarning, match="no keypoint has a place in frame 1"):
        found = triangulate_photos(photos)
    assert np.isnan(found[1].positions).all()
