"""The example tracker (examples/tracker) without ROS: its geometry against OpenCV, its filter against least
squares, and people of simulations.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

sys.path.insert(0, str(ROOT / "examples" / "tracker"))

from association import epipolar_distances, group_people
from cameras import Camera
from detectors import NO_FAULTS, Faults, noisy_people
from frame_buffer import FrameBuffer
from kalman import KalmanFilter
from measure import Score, TruthFrame, crossing_scene, measure, truth_frames
from tracking import Detections, Person, PixelNoise, Tracker
from triangulation import Rays, ransac

from humansim_ros.cameras import Trajectory

K = np.array([[530.0, 0, 319.5], [0, 540.0, 239.5], [0, 0, 1]])
LENSES = {
    "ideal": ("plumb_bob", ()),
    "plumb_bob": ("plumb_bob", (-0.32, 0.11, 0.002, -0.003, -0.02)),
    "rational": ("rational_polynomial", (0.4, -0.2, 1e-3, 2e-3, 0.01, 0.7, -0.1, 0.02)),
    "fisheye": ("equidistant", (-0.02, 0.005, -0.003, 0.0004)),
}


def looking(position: tuple[float, float, float], lens: str = "ideal") -> Camera:
    """Camera at a position that looks at the point (0, 0, 1)."""
    forward = np.array([0, 0, 1.0]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(K, rotation, np.array(position), *LENSES[lens])


RING = [looking((4 * np.cos(a), 4 * np.sin(a), 2.0)) for a in np.radians([0, 80, 170, 260, 310])]


def project(camera: Camera, points: Any) -> Any:
    """Pixels (N, 2) of points (N, 3) by OpenCV."""
    points = np.asarray(points, dtype=float).reshape(-1, 1, 3)
    rotation, translation = cv2.Rodrigues(camera.rotation)[0], -camera.rotation @ camera.center
    distortion = np.array(camera.distortion or [0.0] * 4)
    if camera.model == "equidistant":
        return cv2.fisheye.projectPoints(points, rotation, translation, K, distortion)[0][:, 0]
    return cv2.projectPoints(points, rotation, translation, K, distortion)[0][:, 0]


def rays(cameras: list[Camera], pixels: Any) -> Rays:
    return Rays(
        np.array([each.center for each in cameras]),
        np.array([each.rays(uv) for each, uv in zip(cameras, pixels, strict=True)]),
        np.array([each.focal_length for each in cameras]),
    )


def points_in_a_room(count: int, seed: int = 0) -> Any:
    return np.random.default_rng(seed).uniform([-1.5, -1.5, 0], [1.5, 1.5, 2], (count, 3))


@pytest.mark.parametrize("lens", LENSES)
def test_rays_go_through_the_points_that_opencv_projects(lens: str) -> None:
    camera, points = looking((3.0, -2.0, 1.5), lens), points_in_a_room(500)
    expected = (points - camera.center) / np.linalg.norm(points - camera.center, axis=1, keepdims=True)
    np.testing.assert_allclose(camera.rays(project(camera, points)), expected, atol=1e-7)


@pytest.mark.parametrize("lens", ["plumb_bob", "rational", "fisheye"])
def test_undistortion_is_that_of_opencv(lens: str) -> None:
    pixels = np.stack(np.meshgrid(np.arange(0, 640, 40.0), np.arange(0, 480, 40.0)), -1).reshape(-1, 1, 2)
    model, distortion = LENSES[lens]
    camera = Camera(K, np.eye(3), np.zeros(3), model, distortion)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    if lens == "fisheye":
        expected = cv2.fisheye.undistortPoints(pixels, K, np.array(distortion), criteria=stop)
    else:
        expected = cv2.undistortPointsIter(pixels, K, np.array(distortion), None, None, stop)
    found = camera.rays(pixels)
    np.testing.assert_allclose(found[..., :2] / found[..., 2:], expected, atol=1e-6)


def test_no_ray_belongs_to_a_pixel_that_the_lens_does_not_reach() -> None:
    strong = Camera(K, np.eye(3), np.zeros(3), "plumb_bob", (-0.5,))  # no pixel is beyond 0.54 focal lengths
    assert np.isnan(strong.rays([[2000.0, 240.0], [np.nan, 3.0]])).all()
    assert np.isfinite(strong.rays([[330.0, 240.0]])).all()


def test_two_exact_views_triangulate_to_the_points_of_opencv() -> None:
    points, pair = points_in_a_room(100), RING[:2]
    pixels = [project(camera, points) for camera in pair]
    matrices = [K @ np.column_stack([each.rotation, -each.rotation @ each.center]) for each in pair]
    homogeneous = cv2.triangulatePoints(*matrices, *(uv.T for uv in pixels))
    found = rays(pair, pixels).triangulate()
    np.testing.assert_allclose(found, (homogeneous[:3] / homogeneous[3]).T, atol=1e-8)
    np.testing.assert_allclose(found, points, atol=1e-8)


def test_noisy_views_triangulate_to_the_least_squares_of_the_angles() -> None:
    points = points_in_a_room(30)
    random = np.random.default_rng(1)
    pixels = [project(camera, points) + 2 * random.standard_normal((30, 2)) for camera in RING]
    person = rays(RING, pixels)
    for joint, found in enumerate(person.triangulate()):
        one = Rays(person.centers, person.directions[:, [joint]], person.focal_lengths)
        best = least_squares(lambda x, one=one: one.residuals(x[None])[:, 0], points[joint])
        np.testing.assert_allclose(found, best.x, atol=5e-4)  # the noise moves it by centimetres


def test_the_covariance_of_triangulated_points_is_that_of_the_noise() -> None:
    point, random = np.array([[0.3, -0.2, 1.2]]), np.random.default_rng(2)
    uv = [np.repeat(project(each, point), 4000, axis=0) for each in RING[:2]]
    person = rays(RING[:2], [pixels + 1.5 * random.standard_normal((4000, 2)) for pixels in uv])
    measured = np.cov(person.triangulate().T)
    a, _ = person.equations(np.repeat(point, 4000, axis=0), person.present)
    np.testing.assert_allclose(1.5**2 * np.linalg.inv(a.mean(axis=0)), measured, rtol=0.1, atol=3e-6)


def test_parallel_rays_and_points_behind_a_camera_give_no_point() -> None:
    person = Rays(
        np.array([[0.0, 0, 0], [0.1, 0, 0]]), np.array([[[0, 0, 1.0]], [[0, 0, 1.0]]]), np.full(2, 500.0)
    )
    assert np.isnan(person.triangulate()).all()
    apart = np.array([[[-0.6, 0, 0.8]], [[0.6, 0, 0.8]]])  # they meet behind the cameras
    assert np.isnan(Rays(person.centers, apart, person.focal_lengths).triangulate()).all()


def test_ransac_finds_false_detections() -> None:
    points, random = points_in_a_room(40), np.random.default_rng(3)
    pixels = np.array([project(camera, points) for camera in RING]) + random.standard_normal((5, 40, 2))
    false = np.zeros((5, 40), dtype=bool)
    false[random.integers(0, 5, 40), np.arange(40)] = True
    pixels[false] += random.choice([-60, 60], (40, 2))
    pixels[4, :5] = np.nan
    found, inliers = ransac(rays(RING, pixels), threshold=6.0)
    assert np.linalg.norm(found - points, axis=1).max() < 0.05
    present = np.isfinite(pixels[..., 0])
    assert not inliers[~present].any() and not inliers[false].any()
    assert inliers[present & ~false].mean() > 0.98


def test_the_predicted_point_decides_between_two_views_that_contradict_each_other() -> None:
    points = points_in_a_room(10)
    pixels = np.array([project(camera, points) for camera in RING[:2]])
    pixels[1] += [0, 80]
    found, inliers = ransac(rays(RING[:2], pixels), 6.0, points + 0.005)
    assert np.isnan(found).all()  # one view is left
    assert inliers[0].all() and not inliers[1].any()


def epipolar_line_distances(a: Camera, b: Camera, pixels_a: Any, pixels_b: Any) -> Any:
    """Pixels from points of B to the epipolar lines of points of A, by OpenCV."""
    rotation = b.rotation @ a.rotation.T
    x, y, z = b.rotation @ (a.center - b.center)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    fundamental = np.linalg.inv(K).T @ cross @ rotation @ np.linalg.inv(K)
    lines = cv2.computeCorrespondEpilines(pixels_a.reshape(-1, 1, 2), 1, fundamental)[:, 0]
    return np.abs((lines[:, :2] * pixels_b).sum(axis=1) + lines[:, 2])


def test_epipolar_distances_are_those_from_the_lines_of_opencv() -> None:
    a, b = RING[:2]
    center = np.tile([319.5, 239.5], (20, 1))
    near = center + np.random.default_rng(4).uniform(-20, 20, (20, 2))
    for pixels in near:  # people of equal joints, near the axis: there a pixel is 1 / focal length
        uv_a, uv_b = np.tile(pixels, (4, 1)), center[:4]
        found = epipolar_distances(a.center, a.rays(uv_a)[None], b.center, b.rays(uv_b)[None])[0, 0]
        expected = max(
            epipolar_line_distances(a, b, uv_a, uv_b)[0], epipolar_line_distances(b, a, uv_b, uv_a)[0]
        )
        assert found * 535 == pytest.approx(expected, rel=0.03, abs=0.01)


def test_detections_of_different_cameras_are_grouped_into_people() -> None:
    random = np.random.default_rng(5)
    people = [
        np.array([x, y, 0]) + points_in_a_room(12, 9) * [0.3, 0.3, 0.9]
        for x, y in [(0, 0), (1, 0.6), (-1, 0.4)]
    ]
    orders = [random.permutation(3) for _ in RING]
    detected = []
    for camera, order in zip(RING, orders, strict=True):
        pixels = np.array([project(camera, people[index]) for index in order])
        pixels[random.random(pixels.shape[:2]) < 0.2] = np.nan
        detected.append(camera.rays(pixels + random.standard_normal(pixels.shape)))
    detected[3] = detected[3][:0]  # a camera that sees nobody
    groups = group_people([each.center for each in RING], detected, 0.02)
    found = {frozenset(int(orders[view][index]) for view, index in group.items()) for group in groups}
    assert len(groups) == 3 and found == {frozenset({0}), frozenset({1}), frozenset({2})}
    assert all(sorted(group) == [0, 1, 2, 4] for group in groups)


def test_the_kalman_filter_is_the_least_squares_solution_of_all_frames() -> None:
    """Its last state is that of the maximum of the posterior of all states, computed at once."""
    random, dt, density, noise, steps = np.random.default_rng(6), 0.04, 3.0, 1.7, 12
    middle = np.array([0.2, -0.4, 1.0])
    kalman = KalmanFilter(1, middle, density)
    rows, values = [], []

    def add(block: Any, value: Any, step: int) -> None:
        row = np.zeros((len(block), 6 * steps))
        row[:, max(0, 6 * step) : 6 * step + block.shape[1]] = block
        rows.append(row)
        values.append(value)

    add(np.diag([1 / 2.0] * 3 + [1 / 3.0] * 3), np.r_[middle / 2.0, np.zeros(3)], 0)
    transition = np.eye(6) + np.diag([dt] * 3, 3)
    moved = density**2 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3))
    whitened = np.linalg.cholesky(np.linalg.inv(moved)).T
    for step in range(steps):
        if step:
            kalman.predict(dt)
            add(whitened @ np.hstack([-transition, np.eye(6)]), np.zeros(6), step - 1)
        seen = random.standard_normal((1 if step % 3 == 1 else 3, 3)) * 100  # sometimes singular
        value = seen @ random.standard_normal(3)
        kalman.update((seen.T @ seen)[None], (seen.T @ value)[None], noise)
        add(np.hstack([seen, np.zeros_like(seen)]) / noise, value / noise, step)
    matrix = np.vstack(rows)
    states = np.linalg.lstsq(matrix, np.concatenate(values), rcond=None)[0]
    np.testing.assert_allclose(kalman.mean[0], states[-6:], atol=1e-6)
    covariance = np.linalg.inv(matrix.T @ matrix)[-6:, -6:]
    np.testing.assert_allclose(kalman.covariance[0], covariance, atol=1e-9, rtol=1e-6)


def test_the_noise_of_detections_follows_from_residuals() -> None:
    random, estimate = np.random.default_rng(7), PixelNoise()
    for frame in range(30):
        points = points_in_a_room(20, frame)
        pixels = [project(camera, points) + 3 * random.standard_normal((20, 2)) for camera in RING[:3]]
        person = rays(RING[:3], pixels)
        found, inliers = ransac(person, estimate.threshold)
        estimate.add(person.residuals(found), inliers)
    assert estimate.deviation == pytest.approx(3.0, rel=0.1)


def test_the_faults_of_a_frame_are_the_same_every_time_and_have_their_shares() -> None:
    truth = [project(RING[0], points_in_a_room(20, seed)) for seed in range(3)]
    faults = Faults(2.0, 0.1, 0.05, 0.2, 0.5)
    frames = [noisy_people(truth, (640, 480), faults, "left", stamp) for stamp in range(400)]
    np.testing.assert_array_equal(noisy_people(truth, (640, 480), faults, "left", 7), frames[7])
    assert not np.array_equal(noisy_people(truth, (640, 480), faults, "right", 7), frames[7])
    assert np.mean([len(people) for people in frames]) == pytest.approx(3 * 0.8 + 0.5, rel=0.1)
    assert np.isnan(np.concatenate(frames)[..., 0]).mean() == pytest.approx(0.1, rel=0.1)
    first = {tuple(noisy_people(truth, (640, 480), NO_FAULTS, "left", stamp)[0, 0]) for stamp in range(20)}
    assert len(first) == 3  # the order says nothing about who it is
    assert noisy_people([], (640, 480), faults, "left", 0).shape == (0, 0, 2)


def released(buffer: FrameBuffer[str], now: float) -> list[tuple[int, str]]:
    """Stamps of the frames that are released, and what they contain."""
    frames = []
    while frame := buffer.next_frame(now):
        frames.append((frame[0], "".join(sorted(frame[1].values()))))
    return frames


def test_a_frame_waits_for_all_cameras_until_they_send_a_later_one_or_patience_ends() -> None:
    buffer: FrameBuffer[str] = FrameBuffer(0.5, "abc")
    buffer.add("a", 10, "a", 0.0)
    buffer.add("b", 10, "b", 0.1)
    assert released(buffer, 0.4) == []
    buffer.add("c", 20, "c", 0.4)  # it has dropped frame 10
    assert released(buffer, 0.4) == [(10, "ab")]
    assert released(buffer, 0.8) == []
    assert released(buffer, 1.0) == [(20, "c")]
    buffer.add("a", 20, "a", 1.1)  # too late
    assert released(buffer, 9.0) == []


def test_a_camera_that_has_died_is_not_waited_for_until_it_sends_again() -> None:
    buffer: FrameBuffer[str] = FrameBuffer(0.5, "ab")
    for stamp in range(5):
        buffer.add("a", stamp, "a", float(stamp))
        assert released(buffer, stamp + 0.4) == []
        assert released(buffer, stamp + 0.6) == [(stamp, "a")]
    buffer.add("a", 5, "a", 5.0)
    assert released(buffer, 5.0) == [(5, "a")]
    buffer.add("b", 6, "b", 6.0)
    buffer.add("a", 6, "a", 6.1)
    buffer.add("a", 7, "a", 7.0)
    assert released(buffer, 7.1) == [(6, "ab")]


def test_stamps_that_go_back_far_are_a_new_run() -> None:
    buffer: FrameBuffer[str] = FrameBuffer(0.5, "a")
    buffer.add("a", 10**10, "a", 0.0)
    assert released(buffer, 0.0) == [(10**10, "a")]
    assert not buffer.begins_new_run(10**10 - 10**8)
    assert buffer.begins_new_run(1)
    buffer.restart()
    buffer.add("a", 1, "a", 1.0)
    assert released(buffer, 1.0) == [(1, "a")]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 20), st.floats(0, 0.3)), max_size=80))
@settings(max_examples=200)
def test_frames_come_in_order_and_once_whatever_cameras_send(
    sent: list[tuple[str, int, float]],
) -> None:
    buffer: FrameBuffer[str] = FrameBuffer(0.5, "abc")
    now, stamps = 0.0, []
    for camera, stamp, pause in sent:
        now += pause
        buffer.add(camera, stamp, camera, now)
        stamps += [frame for frame, _ in released(buffer, now)]
    stamps += [frame for frame, _ in released(buffer, now + 1.0)]
    assert stamps == sorted(set(stamps)) and buffer.next_frame(1e9) is None


@pytest.fixture(scope="module")
def three_people() -> list[TruthFrame]:
    """Two seconds of three people on crossing paths, and four cameras."""
    return list(truth_frames(crossing_scene(3, 4), 60, rendered=False))


def test_points_without_noise_are_tracked_to_a_twentieth_of_a_millimetre(
    three_people: list[TruthFrame],
) -> None:
    score = measure(three_people, NO_FAULTS)
    assert score.mpjpe < 0.05
    assert (score.missed, score.false, score.switches) == (3 * 2, 0, 0)  # two frames confirm a person


@pytest.mark.parametrize(
    "lens", [{"distortion": [-0.25, 0.08, 0.001, -0.001]}, {"distortion_model": "equidistant"}]
)
def test_a_lens_and_a_moving_camera_cost_no_accuracy(lens: dict[str, Any], tmp_path: Path) -> None:
    Trajectory.orbit((0, 0, 0.9), 4.0, 2.0, 6.0).write(tmp_path / "orbit.txt")
    scene = crossing_scene(1, 3)
    moving = {"size": [640, 480], "fov_deg": 70, "trajectory": str(tmp_path / "orbit.txt")}
    scene["cameras"] = {name: {**keys, **lens} for name, keys in scene["cameras"].items()}
    scene["cameras"]["camera_0"] = {**moving, **lens}
    frames = list(truth_frames(scene, 15, rendered=False))
    first, last = (frames[index].cameras["camera_0"] for index in (0, -1))
    assert any(first.distortion) or first.model == "equidistant"
    assert np.linalg.norm(first.center - last.center) > 0.5
    assert measure(frames, NO_FAULTS).mpjpe < 0.5


def test_noise_dropped_and_false_detections_are_survived(three_people: list[TruthFrame]) -> None:
    score = measure(three_people, Faults(2.0, 0.1, 0.05, 0.1, 0.3))
    assert score.mpjpe < 25
    assert score.recall > 0.9
    assert (score.false, score.switches) == (0, 0)


def test_people_keep_their_identities_while_cameras_drop_frames(three_people: list[TruthFrame]) -> None:
    tracker, score, random = Tracker(), Score(), np.random.default_rng(8)
    for index, frame in enumerate(three_people):
        names = [name for name in frame.cameras if random.random() > 0.3]
        if 20 <= index < 30:
            names = []  # all of them, for a third of a second
        detections = {
            name: Detections(frame.cameras[name], np.array(list(frame.pixels[name].values())))
            for name in names
        }
        score.add(frame.joints, tracker.update(frame.stamp, detections))
    assert (score.switches, score.false) == (0, 0)
    assert score.mpjpe < 20


def test_nobody_is_invented_from_one_camera(three_people: list[TruthFrame]) -> None:
    tracker = Tracker()
    for frame in three_people[:10]:
        people = np.array(list(frame.pixels["camera_0"].values()))
        assert tracker.update(frame.stamp, {"camera_0": Detections(frame.cameras["camera_0"], people)}) == []


def test_a_person_who_leaves_is_forgotten_and_numbers_are_not_used_again(
    three_people: list[TruthFrame],
) -> None:
    def detections(frame: TruthFrame) -> dict[str, Detections]:
        return {
            name: Detections(camera, np.array(list(frame.pixels[name].values())))
            for name, camera in frame.cameras.items()
        }

    tracker = Tracker()
    before = [tracker.update(frame.stamp, detections(frame)) for frame in three_people[:5]][-1]
    pause = 3_000_000_000
    assert tracker.update(three_people[5].stamp + pause, {}) == []
    after = [tracker.update(frame.stamp + pause, detections(frame)) for frame in three_people[6:11]][-1]
    assert {person.identity for person in before} == {1, 2, 3}
    assert {person.identity for person in after} == {4, 5, 6}


def test_stamps_must_increase() -> None:
    tracker = Tracker()
    tracker.update(5, {})
    with pytest.raises(ValueError, match="5 is not later"):
        tracker.update(5, {})


def test_the_score_counts_errors_misses_false_people_and_switches() -> None:
    truth = {"a": np.zeros((4, 3)), "b": np.ones((4, 3))}
    score = Score()

    def person(identity: int, offset: float) -> Person:
        return Person(identity, np.full((4, 3), offset), np.zeros((4, 3)))

    score.add(truth, [person(1, 0.0), person(2, 1.01)])
    score.add(truth, [person(2, 0.0), person(3, 5.0)])
    assert (score.people, score.missed, score.false, score.switches) == (4, 1, 1, 1)
    assert score.mpjpe == pytest.approx(1e3 * np.sqrt(3) * 0.01 / 3)
    assert score.recall == pytest.approx(12 / 16)
