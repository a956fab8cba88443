"""Binning and regions of interest: images agree with CameraInfo as image_geometry reads it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("sensor_msgs", reason="ROS 2 is not installed (pip install '.[ros]')")

from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.camera import Region
from humansim_ros.data.messages.cameras import camera_info_message
from humansim_ros.errors import CameraError, HumansimError
from humansim_ros.scene import Frame, Scene, Simulation

LENSES = {
    "ideal": "fov_deg: 60",
    "bent": "K: [[290, 2.5, 163.2], [0, 271, 112.8], [0, 0, 1]], distortion: [-0.33, 0.11, 0.001, -0.002]",
}
#: x, y, width and height of the region; binning along x and y.
REGIONS = {
    "whole": "",
    "binned": ", binning: [3, 2]",
    "part": ", roi: {x: 91, y: 30, width: 141, height: 161}",
    "both": ", roi: {x: 51, y: 20, width: 203, height: 200}, binning: [2, 3]",
}
NAMES = [f"{lens}_{region}" for lens in LENSES for region in REGIONS]
SCENE = """\
room: null
humans:
  anna: {motion: {file: walk, position: [0.0, -0.5], loop: continue}}
objects:
  slab: {size: [0.1, 8, 8], position: [-1.5, 0, 1.5], rotation_deg: [0, 20, 25]}
cameras:
""" + "".join(
    f"  {lens}_{region}: {{size: [320, 240], position: [3, 1, 1.6], look_at: [0, 0.1, 1], {see}{part}}}\n"
    for lens, see in LENSES.items()
    for region, part in REGIONS.items()
)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Scene, Frame]]:
    path = tmp_path_factory.mktemp("region") / "scene.yaml"
    path.write_text(SCENE)
    simulation = Simulation(Scene.load(path))
    yield simulation.scene, simulation.frame(3)
    simulation.close()


def info_of(scene: Scene, name: str) -> Any:
    camera = scene.scene_cameras[name]
    return camera_info_message(camera.whole, 1, "optical", camera.region)


def image_geometry_pixels(info: Any, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels (N, 2) of points (N, 3) in the optical frame, computed from CameraInfo only."""
    lens, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.array(info.d))
    sensor = np.column_stack([lens.reshape(-1, 2), np.ones(len(points))]) @ np.reshape(info.k, (3, 3))[:2].T
    return (sensor - (info.roi.x_offset, info.roi.y_offset)) / (
        max(info.binning_x, 1),
        max(info.binning_y, 1),
    )


def image_geometry_rays(info: Any, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions (N, 3), z = 1, of the rays of pixels (N, 2)."""
    sensor = pixels * (max(info.binning_x, 1), max(info.binning_y, 1)) + (
        info.roi.x_offset,
        info.roi.y_offset,
    )
    homogeneous = np.hstack([sensor, np.ones((len(pixels), 1))])
    seen = np.linalg.solve(np.reshape(info.k, (3, 3)), homogeneous.T).T
    rays = seen.copy()
    for _ in range(40):  # until the lens takes them to where they are seen
        lens, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.array(info.d))
        rays[:, :2] += seen[:, :2] - lens.reshape(-1, 2)
    return rays


@pytest.mark.slow
def test_camera_info_describes_the_whole_sensor_and_the_region(shown: tuple[Scene, Frame]) -> None:
    scene, frame = shown
    for name in NAMES:
        info, whole = info_of(scene, name), info_of(scene, f"{name.split('_')[0]}_whole")
        assert (info.width, info.height) == (320, 240)
        for matrix in ("k", "d", "r", "p"):
            np.testing.assert_array_equal(getattr(info, matrix), getattr(whole, matrix))
    info = info_of(scene, "bent_both")
    assert (info.binning_x, info.binning_y) == (2, 3)
    roi = info.roi
    assert (roi.x_offset, roi.y_offset, roi.width, roi.height) == (51, 20, 203, 200)
    sizes = {"whole": (320, 240), "binned": (106, 120), "part": (141, 161), "both": (101, 66)}
    for name in NAMES:
        view = frame.views[name]
        for image in (view.rgb, view.depth, view.instance, view.part):
            assert image is not None and image.shape[1::-1] == sizes[name.split("_")[1]]


@pytest.mark.daily("ideal_both", "bent_part", "bent_binned", "bent_both")
@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_pixel_shows_the_surface_on_its_ray(shown: tuple[Scene, Frame], name: str) -> None:
    """The slab is a plane, so the depth of each pixel follows from its ray by CameraInfo."""
    scene, frame = shown
    depth, camera = frame.views[name].depth, frame.cameras[name]
    assert depth is not None
    rows, columns = np.nonzero((frame.views[name].instance == 0) & np.isfinite(depth))
    assert len(rows) > 0.5 * depth.size
    turn = (
        cv2.Rodrigues(np.array([0, 0, np.radians(25)]))[0]
        @ cv2.Rodrigues(np.array([0, np.radians(20), 0]))[0]
    )
    normal, middle = turn[:, 0], np.array([-1.5, 0, 1.5]) + 0.05 * turn[:, 0]

    def plane_depth(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = image_geometry_rays(info_of(scene, name), pixels)
        return ((middle - camera.center) @ normal) / (rays @ camera.R @ normal)

    pixels = np.column_stack([columns, rows]).astype(float)
    expected = plane_depth(pixels)
    assert np.abs(depth[rows, columns] - expected).max() < 2e-3
    # as a share of the difference to the next pixel
    off = np.abs(depth[rows, columns] - expected) / np.abs(plane_depth(pixels + np.array([1, 0])) - expected)
    assert np.percentile(off, 90) < 0.1


@pytest.mark.parametrize("name", NAMES)
def test_joints_are_where_image_geometry_projects_them_and_on_their_body(
    shown: tuple[Scene, Frame], name: str
) -> None:
    scene, frame = shown
    joints, view = frame.joints[name]["anna"], frame.views[name]
    expected = image_geometry_pixels(info_of(scene, name), joints.optical)
    np.testing.assert_allclose(joints.pixels, expected, atol=1e-6)
    columns, rows = np.rint(expected[(joints.visible == 2) & (joints.behind > 0)]).astype(int).T
    assert len(rows) > 8
    assert (view.instance[rows, columns] == 1).all()


@pytest.mark.parametrize("lens", LENSES)
def test_a_region_is_a_crop_of_the_whole_image(shown: tuple[Scene, Frame], lens: str) -> None:
    _, frame = shown
    whole, part = frame.views[f"{lens}_whole"], frame.views[f"{lens}_part"]
    cut = np.s_[30:191, 91:232]
    np.testing.assert_array_equal(part.instance, whole.instance[cut])
    np.testing.assert_array_equal(part.part, whole.part[cut])
    np.testing.assert_allclose(part.depth, whole.depth[cut], atol=2e-5)
    assert whole.instance is not None and part.rgb is not None and whole.rgb is not None
    person = (whole.instance[cut] > 0).astype(np.uint8)
    outline = cv2.morphologyEx(person, cv2.MORPH_GRADIENT, np.ones((3, 3))) > 0
    different = np.abs(part.rgb.astype(int) - whole.rgb[cut]).max(axis=2)
    assert different[~outline].max() <= 2
    assert np.mean(different[~outline] > 0) < 0.01
    assert different[outline].mean() < 1


def test_the_rectified_projection_is_that_of_the_region(shown: tuple[Scene, Frame]) -> None:
    scene, _ = shown
    for name in NAMES:
        camera, info = scene.scene_cameras[name], info_of(scene, name)
        point = np.array([0.21, -0.13, 1.0, 1.0])
        x, y, w = np.reshape(info.p, (3, 4)) @ point
        sensor = np.array([x, y]) / w - (info.roi.x_offset, info.roi.y_offset)
        x, y, w = camera.camera.rectified_projection @ point
        np.testing.assert_allclose([x / w, y / w], sensor / camera.region.binning, atol=1e-9)
        # an ideal camera stays one, whichever part of it is sent
        assert (camera.rectified is None) == name.startswith("ideal")


@pytest.mark.parametrize(
    ("words", "key", "message"),
    [
        ("roi: {x: 100, y: 0, width: 221, height: 240}", "roi", "not within 320x240"),
        ("roi: {x: 0, y: 240, width: 320, height: 1}", "roi", "not within 320x240"),
        ("roi: {x: -1, y: 0, width: 20, height: 20}", "roi.x", "0 or more"),
        ("roi: {x: 0, y: 0, width: 0, height: 20}", "roi.width", "above 0"),
        ("roi: {x: 0, y: 0, width: 20}", "roi.height", "this key is missing"),
        ("binning: [0, 1]", "binning", "must be between 1 and the image size"),
        ("binning: [1, 241]", "binning", "must be between 1 and the image size"),
        ("binning: [2, 3], roi: {width: 20, height: 2}", "binning", "must be between 1 and the image size"),
        ("binning: [2]", "binning.1", "two whole numbers"),
        ("binning: 2", "binning", "give two whole numbers"),
    ],
)
def test_a_region_outside_the_sensor_is_refused_with_its_key(
    tmp_path: Path, words: str, key: str, message: str
) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(
        f"cameras:\n  left: {{size: [320, 240], position: [3, 1, 1.6], look_at: [0, 0, 1], {words}}}\n"
    )
    with pytest.raises(HumansimError, match=message) as caught:
        Scene.load(path)
    assert caught.value.path == str(path)
    assert caught.value.key == f"cameras.left.{key}"
    assert caught.value.line is not None


def test_regions_of_cameras_made_in_python_are_checked() -> None:
    camera = Camera.look_at((3, 0, 1), (0, 0, 1), (64, 48))
    assert Region().of(camera) is camera
    for region in (
        Region((0, 0, 65, 48)),
        Region((-1, 0, 5, 5)),
        Region(None, (1, 49)),
        Region((1, 1, 0, 3)),
    ):
        with pytest.raises(CameraError):
            region.of(camera)
