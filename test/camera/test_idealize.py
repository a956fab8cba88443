"""Ideal cameras and their maps compared with OpenCV; skew, which OpenCV does not have, is computed here."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_files import calibration_path
from commands import humansim
from conftest import if_shared
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from opencv_support import opencv_pixels
from scipy.linalg import rq
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.cameras.camera.ideal import Fit, Ideal, idealize, rectify
from humansim_ros.errors import CameraError, RenderError
from humansim_ros.render import GLRenderer
from humansim_ros.scene.features.room.feature import furnished_room
from humansim_ros.types import Array

SIZE = (320, 240)
LENSES = {
    "plumb_bob": (-0.31, 0.12, 0.0011, -0.0017, -0.02),
    "rational_polynomial": (0.4, 0.1, 0.0008, -0.001, 0.02, 0.62, 0.2, 0.03),
    "equidistant": (0.03, -0.012, 0.004, -0.001),
}


@st.composite
def real_cameras(draw: st.DrawFn) -> Camera:
    """Cameras of all models, with skew and any principal point, whose lens is valid in the whole image."""
    model = draw(st.sampled_from(sorted(LENSES)))
    strength = draw(st.floats(-1, 1) if model == "plumb_bob" else st.floats(0, 1))
    k = np.array(
        [
            [draw(st.floats(230, 900)), draw(st.floats(-8, 8)), draw(st.floats(120, 200))],
            [0, draw(st.floats(230, 900)), draw(st.floats(90, 150))],
            [0, 0, 1],
        ]
    )
    rotation = Rotation.random(None, draw(st.integers(0, 10_000))).as_matrix()
    t = np.array([draw(st.floats(-20, 20)) for _ in range(3)])
    return Camera(SIZE, k, rotation, t, tuple(strength * np.array(LENSES[model])), model)


def inside(pixels: Array, size: ArrayLike = SIZE) -> np.ndarray:
    return ((pixels >= 0) & (pixels <= np.subtract(size, 1))).all(axis=-1)


@settings(deadline=None, max_examples=30)
@given(real_cameras(), st.booleans(), st.booleans(), st.integers(0, 1000))
def test_a_world_point_has_the_same_ideal_pixel_by_the_ideal_camera_and_through_the_real_image(
    camera: Camera, square: bool, center: bool, seed: int
) -> None:
    ideal = idealize(camera, square, center)
    rng = np.random.default_rng(seed)
    plane = rng.uniform(-0.8, 0.8, (400, 2))
    depth = rng.uniform(0.2, 30, len(plane))
    world = (np.column_stack([plane * depth[:, None], depth]) - camera.t) @ camera.R
    real = opencv_pixels(camera, world)
    world, real = world[inside(real)], real[inside(real)]
    projected = np.column_stack([world, np.ones(len(world))]) @ ideal.camera.P.T
    projected = projected[:, :2] / projected[:, 2:]
    np.testing.assert_allclose(ideal.points_to_ideal(real), projected, atol=1e-4)
    np.testing.assert_allclose(ideal.points_to_real(projected), real, atol=1e-6)


@pytest.mark.parametrize("model", LENSES)
def test_the_map_to_the_ideal_image_agrees_with_opencv(model: str) -> None:
    camera = Camera(SIZE, K_SKEWED, np.eye(3), np.zeros(3), LENSES[model], model)
    ideal = idealize(camera, square=True)
    plain = K_SKEWED * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    judge = cv2.fisheye if model == "equidistant" else cv2
    theirs = judge.initUndistortRectifyMap(
        plain, np.array(camera.distortion), np.eye(3), ideal.camera.K, SIZE, cv2.CV_32FC1
    )
    x, y = theirs[0].astype(float), theirs[1].astype(float)
    x += K_SKEWED[0, 1] * (y - plain[1, 2]) / plain[1, 1]
    np.testing.assert_allclose(ideal.real_from_ideal, np.stack([x, y], axis=-1), atol=1e-4)


@pytest.mark.parametrize("model", LENSES)
def test_the_map_to_the_real_image_agrees_with_opencv(model: str) -> None:
    k = K_SKEWED * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    camera = Camera(SIZE, k, np.eye(3), np.zeros(3), LENSES[model], model)
    ideal = idealize(camera)
    grid = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float).reshape(-1, 1, 2)
    coefficients, stop = (
        np.array(camera.distortion),
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12),
    )
    if model == "equidistant":
        theirs = cv2.fisheye.undistortPoints(grid, k, coefficients, None, None, ideal.camera.K, stop)
    else:
        # OpenCV 4 stops early unless it is asked by another name
        undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
        theirs = undistort(grid, k, coefficients, R=None, P=ideal.camera.K, criteria=stop)
    ours = ideal.ideal_from_real.reshape(-1, 2)
    np.testing.assert_allclose(ours, theirs.reshape(-1, 2), atol=1e-4)


@pytest.mark.parametrize("model", LENSES)
def test_image_rect_agrees_with_opencv_for_r_and_p(model: str) -> None:
    k = K_SKEWED * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    turn = Rotation.from_euler("xyz", [2, -3, 1.5], degrees=True).as_matrix()
    p = np.array([[240.0, 0, 170, -31], [0, 240, 110, 0], [0, 0, 1, 0]])
    pose = Rotation.random(None, 3).as_matrix()
    camera = Camera(SIZE, k, pose, np.array([0.1, 2, 3]), LENSES[model], model, turn, p)
    judge = cv2.fisheye if model == "equidistant" else cv2
    theirs = judge.initUndistortRectifyMap(
        k, np.array(camera.distortion), turn, p[:, :3].copy(), SIZE, cv2.CV_32FC1
    )
    ours = rectify(camera)
    np.testing.assert_allclose(ours.real_from_ideal, np.stack(theirs, axis=-1), atol=1e-4)
    np.testing.assert_allclose(ours.camera.R, turn @ pose)
    np.testing.assert_allclose(ours.camera.center, camera.center)
    there = ours.points_to_real([[30.0, 200], [280, 20]])
    np.testing.assert_allclose(ours.points_to_ideal(there), [[30, 200], [280, 20]], atol=1e-6)


K_SKEWED = np.array([[250.0, 2.5, 151.0], [0, 262.0, 127.5], [0, 0, 1]])
CAMERA = Camera(SIZE, K_SKEWED, np.eye(3), np.zeros(3), LENSES["plumb_bob"])


def test_an_ideal_camera_has_no_skew_no_lens_and_the_same_pose() -> None:
    ideal = idealize(CAMERA).camera
    np.testing.assert_array_equal(ideal.K, [[250, 0, 159.5], [0, 262, 119.5], [0, 0, 1]])
    np.testing.assert_array_equal(idealize(CAMERA, center=False).camera.K[:2, 2], [151, 127.5])
    square = idealize(CAMERA, square=True).camera.K
    assert square[0, 0] == square[1, 1] == pytest.approx(np.sqrt(250 * 262))
    assert not ideal.distorted
    np.testing.assert_array_equal(ideal.R, CAMERA.R)
    np.testing.assert_array_equal(ideal.t, CAMERA.t)


def picture(pixels: Array) -> Array:
    """A smooth image as a function of the position, 0 to 200: (..., 2) -> (...)."""
    x, y = np.moveaxis(pixels, -1, 0)
    return 100 + 50 * np.sin(x / 9) + 50 * np.cos((y + x / 3) / 11)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_images_are_converted_in_both_directions(kind: type) -> None:
    grid = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float)
    ideal = idealize(CAMERA)
    exact = picture(ideal.points_to_real(grid.reshape(-1, 2)).reshape(grid.shape))
    seen = inside(ideal.real_from_ideal)
    there = ideal.to_ideal(np.rint(picture(grid)).astype(kind))
    assert there.dtype == kind
    assert np.abs(there - exact)[seen].max() < 2  # rounding, and OpenCV's steps of 1/32 pixel
    assert 0.5 < seen.mean() < 1
    assert (there[~seen & (ideal.real_from_ideal.max(axis=-1) > 400)] == 0).all()

    back = ideal.to_real(np.rint(exact).astype(kind), cv2.INTER_CUBIC)
    known = inside(ideal.ideal_from_real - 2, np.subtract(SIZE, 4))
    assert np.abs(back - picture(grid))[known].max() < 3
    colored = ideal.to_ideal(np.dstack([np.rint(picture(grid)).astype(kind)] * 3))
    np.testing.assert_array_equal(colored[..., 2], there)


def test_labels_are_not_interpolated() -> None:
    labels = np.random.default_rng(1).choice([0, 3, 900], size=SIZE[::-1]).astype(np.uint16)
    assert set(np.unique(idealize(CAMERA).to_ideal(labels, cv2.INTER_NEAREST))) == {0, 3, 900}


@pytest.mark.daily("True-equidistant")
@pytest.mark.slow
@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("center", [False, True])
def test_fit_no_black_has_no_border_and_fit_all_loses_no_pixel(model: str, center: bool) -> None:
    camera = Camera(SIZE, K_SKEWED, np.eye(3), np.zeros(3), LENSES[model], model)

    def shown(fit: Fit, zoom: float = 1.0) -> tuple[bool, bool]:
        ideal = idealize(camera, not center, center, fit)
        zoomed = replace(ideal.camera, K=ideal.camera.K * [[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])
        ideal = Ideal(camera, zoomed)
        return bool(near(ideal.real_from_ideal).all()), bool(near(ideal.ideal_from_real).all())

    assert shown("no_black")[0]
    assert not shown("no_black", 0.99)[0]  # and not a bit more than needed is cut off
    assert shown("all")[1]
    assert not shown("all", 1.01)[1]


def near(pixels: Array) -> np.ndarray:
    """Whether pixels are in the image or on its border."""
    return ((pixels > -1e-2) & (pixels < np.subtract(SIZE, 1) + 1e-2)).all(axis=-1)


@pytest.mark.parametrize("alpha", [0, 1])
def test_fits_agree_with_opencv(alpha: int) -> None:
    k = K_SKEWED * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    camera = Camera(SIZE, k, np.eye(3), np.zeros(3), LENSES["plumb_bob"])
    theirs, _ = cv2.getOptimalNewCameraMatrix(
        k, np.array(camera.distortion), SIZE, alpha, centerPrincipalPoint=True
    )
    ours = idealize(camera, fit="all" if alpha else "no_black").camera.K
    np.testing.assert_allclose(ours.diagonal(), theirs.diagonal(), rtol=0.01)  # theirs looks at 81 points


@pytest.mark.nightly
@pytest.mark.slow
def test_maps_are_finite_beyond_the_lens() -> None:
    wide = Camera(SIZE, np.diag([90.0, 90, 1]) + K_MIDDLE, np.eye(3), np.zeros(3), (0.0,) * 4, "equidistant")
    folding = Camera(SIZE, np.diag([90.0, 90, 1]) + K_MIDDLE, np.eye(3), np.zeros(3), (-0.3, 0.0))
    for camera in (wide, folding):
        ideal = idealize(camera)
        assert np.isnan(ideal.points_to_ideal([[0.0, 0.0]])).all()
        for maps in (ideal.real_from_ideal, ideal.ideal_from_real):
            assert np.isfinite(maps).all()
        assert (ideal.ideal_from_real[0, 0] > 10_000).all()
        assert ideal.to_real(np.full(SIZE[::-1], 255, np.uint8))[0, 0] == 0
    idealize(wide, fit="no_black")
    with pytest.raises(CameraError, match="too wide"):
        idealize(wide, fit="all")


K_MIDDLE = np.array([[0, 0, 159.5], [0, 0, 119.5], [0, 0, 0]])


def test_a_fit_needs_the_optical_axis_in_the_image() -> None:
    aside = Camera(SIZE, np.array([[250.0, 0, -40], [0, 250, 120], [0, 0, 1]]), np.eye(3), np.zeros(3))
    assert idealize(aside).camera.K[0, 2] == 159.5
    for fit in ("all", "no_black"):
        with pytest.raises(CameraError, match="optical axis"):
            idealize(aside, fit=fit)


def test_an_image_of_another_size_is_refused_with_both_sizes() -> None:
    for carry in (idealize(CAMERA).to_ideal, idealize(CAMERA).to_real):
        with pytest.raises(CameraError, match=r"640x480.*320x240"):
            carry(np.zeros((480, 640, 3), np.uint8))


@settings(deadline=None, max_examples=50)
@given(real_cameras(), st.floats(1e-6, 1e6), st.booleans())
def test_projection_matrices_are_decomposed_as_by_opencv_and_scipy(
    camera: Camera, scale: float, negative: bool
) -> None:
    p = camera.K @ np.hstack([camera.R, camera.t[:, None]])
    found = Camera.from_projection_matrix((-scale if negative else scale) * p, SIZE)
    theirs = cv2.decomposeProjectionMatrix(p)
    for k, r in (theirs[:2], rq(p[:, :3])):
        positive = np.diag(np.sign(np.diag(k)))
        np.testing.assert_allclose(found.K, k @ positive / abs(k[2, 2]), rtol=1e-7, atol=1e-6)
        np.testing.assert_allclose(found.R, positive @ r, atol=1e-9)
    np.testing.assert_allclose(found.center, theirs[2][:3, 0] / theirs[2][3, 0], atol=1e-7)
    assert np.linalg.det(found.R) == pytest.approx(1)
    ahead = found.center + found.R.T @ [0, 0, 1]
    assert found.project(ahead[None])[1] == pytest.approx(1)


# -- the renderer's own images, and the command


@pytest.fixture(scope="module")
def renderer() -> Iterator[GLRenderer]:
    try:
        renderer = GLRenderer(furnished_room())
    except RenderError as reason:
        pytest.skip(str(reason))
    yield renderer
    renderer.close()


@pytest.mark.daily("rational_polynomial")
@pytest.mark.slow
@pytest.mark.parametrize("model", LENSES)
def test_an_idealized_image_agrees_with_a_rendering_of_the_ideal_camera(
    renderer: GLRenderer, model: str
) -> None:
    place = Camera.look_at((3, 0, 1.8), (0, 0.5, 1))
    camera = Camera(SIZE, K_SKEWED, place.R, place.t, LENSES[model], model)
    ideal = idealize(camera, square=True)
    real, wanted = (renderer.render([], c, ("rgb",)).rgb for c in (camera, ideal.camera))
    assert real is not None
    assert wanted is not None
    made, known = ideal.to_ideal(real), inside(ideal.real_from_ideal)
    error, uncorrected = (np.abs(image.astype(float) - wanted)[known].mean() for image in (made, real))
    assert error < 0.2 * uncorrected


@pytest.mark.slow
def test_the_command_converts_images_and_reports_failures(tmp_path: Path) -> None:
    write_calibration(tmp_path / "cam.yaml", {"cam": CAMERA}, "camera_info")
    grid = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float)
    colored = np.dstack([np.rint(picture(grid + shift)) for shift in (0, 5, 9)]).astype(np.uint8)
    depth = np.rint(100 * picture(grid)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "colored.png"), colored)
    cv2.imwrite(str(tmp_path / "photo.jpg"), colored)
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    cv2.imwrite(str(tmp_path / "small.png"), colored[::2, ::2])
    (tmp_path / "broken.png").write_bytes((tmp_path / "colored.png").read_bytes()[:200])
    (tmp_path / "text.png").write_text("no image")
    names = ["small.png", "broken.png", "text.png", "none.png", "colored.png", "photo.jpg", "depth.png"]
    done = humansim(
        "camera",
        "idealize",
        tmp_path / "cam.yaml",
        *(tmp_path / name for name in names),
        "--nearest",
        "-o",
        tmp_path / "out",
    )
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if "WARN" not in line]  # OpenCV's own
    assert [line.split(": ")[:2] for line in said] == [["error", str(tmp_path / n)] for n in names[:4]]
    assert "160x120 pixels, but the camera has 320x240" in done.stderr
    ideal = idealize(read_calibration(tmp_path / "cam.yaml")["cam"])
    for name, image in (("colored.png", colored), ("depth.png", depth)):
        corrected = cv2.imread(str(tmp_path / "out" / name), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(corrected, ideal.to_ideal(image, cv2.INTER_NEAREST))
    assert cv2.imread(str(tmp_path / "out" / "photo.jpg")).shape == colored.shape
    written = read_calibration(tmp_path / "out" / "cam.yaml")["cam"]
    np.testing.assert_allclose(written.K, ideal.camera.K)
    assert not written.distorted
    assert not any((tmp_path / "out" / name).exists() for name in names[:4])


def test_the_command_does_not_overwrite_its_input(tmp_path: Path) -> None:
    write_calibration(tmp_path / "cam.yaml", {"cam": CAMERA}, "camera_info")
    before = (tmp_path / "cam.yaml").read_text()
    done = humansim("camera", "idealize", tmp_path / "cam.yaml", "-o", tmp_path)
    assert done.returncode == 2
    assert "another folder" in done.stderr
    assert (tmp_path / "cam.yaml").read_text() == before


@pytest.mark.parametrize(
    "name",
    [
        *("own_stereo.yaml", "own_human36m.json", "own_shelf.json"),
        *if_shared("usb_cam_camera_info.yaml", "human36m_camera-parameters.json", "shelf_voxelpose.json"),
    ],
)
@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
def test_calibrations_of_other_programs_are_idealized(name: str) -> None:
    for camera in list(read_calibration(calibration_path(name)).values())[:5]:
        ideal = idealize(camera)
        rng = np.random.default_rng(1)
        real = rng.uniform(0, np.subtract(camera.size, 1), (200, 2))
        points = camera.unproject(real, rng.uniform(1, 9, 200))
        np.testing.assert_allclose(ideal.camera.project(points)[0], ideal.points_to_ideal(real), atol=1e-4)
        *centre, scale = cv2.decomposeProjectionMatrix(ideal.camera.P)[2].ravel()
        np.testing.assert_allclose(np.divide(centre, scale), camera.center, atol=1e-6)
