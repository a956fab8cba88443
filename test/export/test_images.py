"""Images, depth, labels and flow: other readers give the channels of the simulation."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from export_support import SCENE, exported, small_scene

from humansim_ros import Frame, Scene, Simulation
from humansim_ros.data.formats.images import kitti_flow, millimetres

FORMATS = "images,depth-png,depth-exr,depth-npy,labels,body-parts,materials,flow-flo,flow-kitti"
CHANNELS = ("rgb", "depth", "instance", "part", "body_part", "material", "flow", "flow_hidden")
CAMERAS = ("noisy", "bent")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("images") / "out", FORMATS)


@pytest.fixture(scope="module")
def frame() -> Frame:
    with Simulation(small_scene(), CHANNELS) as simulation:
        return simulation.frame(4)


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


@pytest.mark.daily("bent")
@pytest.mark.parametrize("camera", CAMERAS)
def test_images_are_those_of_the_cameras(root: Path, frame: Frame, camera: str) -> None:
    image = read(root / "images" / camera / "000004.png")
    np.testing.assert_array_equal(image[..., ::-1], frame.views[camera].rgb)


@pytest.mark.daily("bayer_rggb8")
@pytest.mark.parametrize("encoding", ["bgr8", "mono8", "bayer_rggb8"])
def test_images_of_other_encodings_show_the_same(tmp_path: Path, encoding: str) -> None:
    text = SCENE.replace("sensor: {noise: {read_noise: 4}}", f"sensor: {{encoding: {encoding}}}")
    (tmp_path / "scene.yaml").write_text(text)
    scene = Scene.load(tmp_path / "scene.yaml")
    image = read(exported(tmp_path / "out", "images", scene, frames="0:1") / "images/noisy/000000.png")
    with Simulation(scene, ("rgb",)) as simulation:
        rgb = simulation.frame(0).views["noisy"].rgb
    np.testing.assert_array_equal(image, rgb)  # bgr8 is the order of OpenCV


def test_jpeg_images_are_near(tmp_path: Path, frame: Frame) -> None:
    root = exported(tmp_path / "out", "images", frames="4:5", image_suffix=".jpg")
    image = read(root / "images" / "bent" / "000004.jpg")[..., ::-1]
    assert np.abs(image - frame.views["bent"].rgb.astype(float)).mean() < 4


@pytest.mark.parametrize("camera", CAMERAS)
def test_depth_is_the_same_in_all_files(root: Path, frame: Frame, camera: str) -> None:
    depth = frame.views[camera].depth
    np.testing.assert_array_equal(np.load(root / f"depth-npy/{camera}/000004.npy"), depth)
    png = read(root / f"depth-png/{camera}/000004.png")
    assert png.dtype == np.uint16
    np.testing.assert_array_equal(png == 0, np.isinf(depth))
    np.testing.assert_allclose(png[png > 0] / 1000, depth[png > 0], atol=0.00051)


def test_opencv_reads_the_exr_files(root: Path, frame: Frame, tmp_path: Path) -> None:
    """In another process: OpenCV looks at the environment when it is loaded."""
    code = (
        "import sys, cv2, numpy; "
        "numpy.save(sys.argv[2], cv2.imread(sys.argv[1], cv2.IMREAD_UNCHANGED | cv2.IMREAD_ANYDEPTH))"
    )
    words = [str(root / "depth-exr/bent/000004.exr"), str(tmp_path / "depth.npy")]
    subprocess.run(
        [sys.executable, "-c", code, *words],
        check=True,
        timeout=60,
        env={**os.environ, "OPENCV_IO_ENABLE_OPENEXR": "1"},
    )
    np.testing.assert_array_equal(np.load(tmp_path / "depth.npy"), frame.views["bent"].depth)


@pytest.mark.parametrize("camera", CAMERAS)
def test_labels_have_a_legend(root: Path, frame: Frame, camera: str) -> None:
    instance = read(root / f"labels/instance/{camera}/000004.png")
    part = read(root / f"labels/part/{camera}/000004.png")
    np.testing.assert_array_equal(instance, frame.views[camera].instance)
    np.testing.assert_array_equal(part, frame.views[camera].part)
    legend = json.loads((root / "labels/labels.json").read_text())
    assert legend["instance"] == {"0": "background", "1": "anna", "2": "bert", "3": "crate"}
    assert set(map(str, np.unique(part[instance == 1]))) <= legend["part"]["anna"].keys()
    assert legend["part"]["anna"]["1"] == "HumanoidRoot"


@pytest.mark.parametrize("camera", CAMERAS)
def test_body_parts_have_the_legend_of_parts(root: Path, frame: Frame, camera: str) -> None:
    part = read(root / f"body-parts/{camera}/000004.png")
    np.testing.assert_array_equal(part, frame.views[camera].body_part)
    parts, labels = (
        json.loads((root / each / "labels.json").read_text()) for each in ("body-parts", "labels")
    )
    assert parts == labels["part"]


@pytest.mark.parametrize("camera", CAMERAS)
def test_materials_have_a_legend(root: Path, frame: Frame, camera: str) -> None:
    material = read(root / f"materials/{camera}/000004.png")
    np.testing.assert_array_equal(material, frame.views[camera].material)
    legend = json.loads((root / "materials/labels.json").read_text())
    names = {legend[str(label)] for label in np.unique(material)}
    assert {"background", "skin", "top", "bottom"} <= names


@pytest.mark.parametrize("camera", CAMERAS)
def test_opencv_reads_the_flow(root: Path, frame: Frame, camera: str) -> None:
    view = frame.views[camera]
    known = ~np.isnan(view.flow[..., 0])
    assert known.any() and not known.all()
    flo = cv2.readOpticalFlow(str(root / f"flow-flo/{camera}/000004.flo"))
    np.testing.assert_array_equal(flo[known], view.flow[known])
    assert (flo[~known] > 1e9).all()  # unknown, as Middlebury says
    for name, valid in (("occ", known), ("noc", known & (view.flow_hidden == 0))):
        image = read(root / f"flow-kitti/flow_{name}/{camera}/000004.png")
        assert image.dtype == np.uint16
        np.testing.assert_array_equal(image[..., 0] == 1, valid)
        flow = (image[..., [2, 1]].astype(float) - 2**15) / 64
        np.testing.assert_allclose(flow[valid], view.flow[valid], atol=1 / 128)


def test_depth_beyond_the_range_of_a_png_is_unknown() -> None:
    depth = np.array([[0.0004, 0.0006, 65.535, 65.536, np.inf]], np.float32)
    assert millimetres(depth).tolist() == [[0, 1, 65535, 0, 0]]


def test_flow_beyond_the_range_of_kitti_is_invalid() -> None:
    flow = np.array([[[511.9, -512.0], [512.1, 0.0], [np.nan, np.nan]]], np.float32)
    image = kitti_flow(flow, np.ones((1, 3), bool))
    assert image[0, :, 0].tolist() == [1, 0, 0]
    assert image[0, 0, 1:].tolist() == [0, round(511.9 * 64) + 2**15]


def test_videos_show_the_images(tmp_path: Path) -> None:
    text = SCENE.replace("sensor: {noise: {read_noise: 4}}", "sensor: {encoding: bayer_rggb8}")
    (tmp_path / "scene.yaml").write_text(text)
    root = exported(tmp_path / "out", "mp4", Scene.load(tmp_path / "scene.yaml"), frames="2:6")
    for camera in ("noisy", "bent"):
        video = cv2.VideoCapture(str(root / f"mp4/{camera}.mp4"))
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 4 and video.get(cv2.CAP_PROP_FPS) == 20
        for index in range(2, 6):
            image = cv2.imread(str(root / f"images/{camera}/{index:06d}.png"), cv2.IMREAD_UNCHANGED)
            if camera == "noisy":
                image = cv2.cvtColor(image, cv2.COLOR_BayerBG2BGR)
            shown = video.read()[1]
            assert np.abs(shown.astype(float) - image).mean() < 6, (camera, index)
