"""Calibration files of all formats, compared with OpenCV or with formulas in this file."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_files import CALIBRATIONS, calibration_path
from conftest import if_shared
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera, read_calibration, resolve_url
from humansim_ros.cameras.formats import Z_UP_FROM_FILE, load_calibration
from humansim_ros.errors import CameraError, HumansimWarning
from humansim_ros.types import Array

pytestmark = pytest.mark.filterwarnings("ignore:.*image size is not in the file")

K = np.array([[700.0, 0, 310], [0, 690, 245], [0, 0, 1]])
R = Rotation.from_euler("xyz", [1.8, 0.2, -0.4]).as_matrix()
T = np.array([0.3, -0.2, 4.0])
#: Points (N, 3) that a camera of R and T sees.
POINTS = (np.random.default_rng(3).uniform([-1, -1, 3], [1, 1, 5], (20, 3)) - T) @ R


def written(tmp_path: Path, name: str, text: str) -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def numbers(values: Array) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


def theirs(points: Array, r: Array, t: Array, k: Array, d: Array | None = None) -> Array:
    return np.asarray(cv2.projectPoints(points, cv2.Rodrigues(r)[0], t, k, d)[0][:, 0])


def assert_sees(camera: Camera, pixels: Array, points: Array = POINTS) -> None:
    assert_allclose(camera.project(points)[0], pixels, atol=1e-6)


# -- files of other programs


@pytest.mark.parametrize("name", CALIBRATIONS)
@pytest.mark.filterwarnings("ignore:.*belongs to an image of about 1280x960")
def test_cameras_of_a_file_are_those_that_it_was_written_from(name: str) -> None:
    cameras, known = read_calibration(calibration_path(name)), CALIBRATIONS[name].cameras
    assert list(cameras) == list(known)
    for key, truth in known.items():
        camera = cameras[key]
        assert camera.size == truth.size
        assert_allclose(camera.center, truth.center, atol=1e-9)
        points = truth.center + np.random.default_rng(1).uniform([-1, -1, 3], [1, 1, 5], (20, 3)) @ truth.R
        lens = np.array(truth.distortion or [0.0] * 5)
        assert_sees(camera, theirs(points, truth.R, truth.t, truth.K, lens), points)
        if truth.projection is not None:
            assert_allclose(camera.rectified_projection, truth.projection, atol=1e-9)
            assert_allclose(camera.rectification_matrix, truth.rectification, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "form", "count", "first", "size"),
    [
        *(
            (
                name,
                each.form,
                len(each.cameras),
                next(iter(each.cameras)),
                next(iter(each.cameras.values())).size,
            )
            for name, each in CALIBRATIONS.items()
        ),
        *if_shared(
            ("anipose_uwupose.toml", "anipose", 2, "A", (1920, 1080)),
            ("campus_voxelpose.json", "shelf", 3, "0", (360, 288)),
            ("human36m_camera-parameters.json", "human36m", 44, "S1_54138969", (1000, 1002)),
            ("image_common_calib5.ini", "ini", 1, "mono_left", (640, 480)),
            ("image_common_calib8.ini", "ini", 1, "mono_left", (640, 480)),
            ("openvins_euroc_radtan_kalibr.yaml", "kalibr", 2, "cam0", (752, 480)),
            ("pose2sim_calib.toml", "anipose", 4, "int_cam0_img", (3840, 2160)),
            ("qualisys_pose2sim.qca.txt", "qualisys", 4, "cam01", (1088, 1920)),
            ("raspicam_camerav1_1280x720.yaml", "camera_info", 1, "camerav1_1280x720", (1280, 720)),
            ("raspicam_camerav2_1280x960.yaml", "camera_info", 1, "camerav2_1280x960", (1280, 960)),
            ("raspicam_camerav2_1640x1232.yaml", "camera_info", 1, "camerav2_1640x1232", (1640, 1232)),
            ("raspicam_camerav2_410x308.yaml", "camera_info", 1, "camerav2_410x308", (410, 308)),
            ("shelf_4dassociation.json", "4dassociation", 5, "0", (1032, 776)),
            ("shelf_voxelpose.json", "shelf", 5, "0", (1032, 776)),
            ("templeSR_par.txt", "middlebury", 16, "templeSR0001", (640, 480)),
            ("usb_cam_camera_info.yaml", "camera_info", 1, "test_camera", (640, 480)),
        ),
    ],
)
def test_formats_of_files_are_detected_by_content(
    tmp_path: Path, name: str, form: str, count: int, first: str, size: tuple[int, int]
) -> None:
    anonymous = tmp_path / "calibration"
    shutil.copy(calibration_path(name), anonymous)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        calibration = load_calibration(anonymous)
    # one file has the K of another image size
    mislabelled = [
        str(w.message) for w in caught if "belongs to an image of about 1280x960" in str(w.message)
    ]
    assert bool(mislabelled) == name.endswith("1640x1232.yaml")
    assert calibration.format is not None and calibration.format.name == form
    assert len(calibration.cameras) == count
    assert next(iter(calibration.cameras)) == first
    assert calibration.cameras[first].size == size


@pytest.mark.parametrize(
    ("file", "length"),
    [
        *(("own_5.ini", 5), ("own_8.ini", 8), ("own_stereo.yaml", 5)),
        *if_shared(
            ("image_common_calib5.ini", 5), ("image_common_calib8.ini", 8), ("usb_cam_camera_info.yaml", 5)
        ),
    ],
)
def test_lens_and_stereo_matrices_are_those_of_the_file(file: str, length: int) -> None:
    (camera,) = read_calibration(calibration_path(file)).values()
    text = calibration_path(file).read_text()
    said = [
        float(w)
        for w in text.replace(",", " ").replace("[", " ").replace("]", " ").split()
        if w[-1:].isdigit()
    ]
    at = said.index(camera.distortion[0])
    assert list(camera.distortion) == said[at : at + length]
    rectified = camera.rectified_projection
    assert list(rectified.ravel()) == said[-12:]
    rectification = np.reshape(said[-21:-12] if file.endswith("ini") else said[-23:-14], (3, 3))
    assert_allclose(camera.rectification_matrix, rectification, atol=2e-6)  # rounded in the file


@pytest.mark.parametrize("file", ["own_human36m.json", *if_shared("human36m_camera-parameters.json")])
def test_human36m_projects_as_opencv_does_with_the_files_own_numbers(file: str) -> None:
    path = calibration_path(file)
    data, cameras = json.loads(path.read_text()), read_calibration(path)
    for name in ("S1_54138969", "S9_60457274"):
        subject, serial = name.split("_")
        inner, outer = data["intrinsics"][serial], data["extrinsics"][subject][serial]
        r, t = np.array(outer["R"]), np.array(outer["t"]).ravel()
        points = (np.random.default_rng(1).uniform([-900, -900, 4100], [900, 900, 5900], (30, 3)) - t) @ r
        k, d = np.array(inner["calibration_matrix"]), np.array(inner["distortion"])
        assert_sees(cameras[name], theirs(points, r, t, k, d), points / 1000)
        assert 1 < cameras[name].center[2] < 2  # on a stand, z up


@pytest.mark.parametrize("file", ["own_shelf.json", *if_shared("shelf_voxelpose.json")])
def test_shelf_in_two_formats_has_the_same_camera_positions(tmp_path: Path, file: str) -> None:
    path = calibration_path(file)
    data, cameras = json.loads(path.read_text()), read_calibration(path, size=(1032, 776))
    blocks = []
    for scale, (name, c) in zip((1, -1, 1e-3, 7, -20), data.items(), strict=True):
        k = np.array([[c["fx"], 0, c["cx"]], [0, c["fy"], c["cy"]], [0, 0, 1]])
        p = scale * k @ np.array(c["R"]) @ np.column_stack([np.eye(3), -np.array(c["T"])])  # x = R (X - T)
        blocks.append(f"# {name} 1032x776\n" + "\n".join(map(numbers, p)))
        assert_allclose(cameras[name].center * 1000, np.ravel(c["T"]), atol=1e-9)
    others = read_calibration(written(tmp_path, "P.txt", "\n\n".join(blocks)), unit=0.001)
    assert list(others) == list(cameras)
    for name, camera in cameras.items():
        assert others[name].size == camera.size
        assert np.linalg.norm(others[name].center - camera.center) < 1e-4
        points = camera.center + np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (20, 3)) @ camera.R
        assert_allclose(others[name].project(points)[0], camera.project(points)[0], atol=0.01)


@pytest.mark.parametrize("file", ["own_middlebury_par.txt", *if_shared("templeSR_par.txt")])
def test_middlebury_cameras_all_look_at_the_temple(file: str) -> None:
    path = calibration_path(file)
    cameras = read_calibration(path)
    for line, (name, camera) in zip(path.read_text().splitlines()[1:], cameras.items(), strict=True):
        image, *words = line.split()
        assert image == f"{name}.png"
        k, r, t = np.split(np.array(list(map(float, words))), [9, 18])
        points = (POINTS @ R.T + T - t) @ r.reshape(3, 3)  # before this camera
        assert_sees(camera, theirs(points, r.reshape(3, 3), t, k.reshape(3, 3)), points)
    # the point nearest to all optical axes: a robot moved the camera around the model at 57 cm
    away = [np.eye(3) - np.outer(camera.R[2], camera.R[2]) for camera in cameras.values()]
    centers = [camera.center for camera in cameras.values()]
    middle = np.linalg.solve(sum(away), sum(a @ c for a, c in zip(away, centers, strict=True)))
    for side, center in zip(away, centers, strict=True):
        assert np.linalg.norm(side @ (middle - center)) < 0.012
        assert np.linalg.norm(middle - center) == pytest.approx(0.57, abs=0.01)


# -- formats


def test_p_is_decomposed_as_by_opencv(tmp_path: Path) -> None:
    k = np.array([[700.0, 3.5, 310], [0, 690, 245], [0, 0, 1]])
    p = -2.5 * k @ np.column_stack([R, T])
    (camera,) = read_calibration(
        written(tmp_path, "cam7.P", "CONTOUR\n" + "\n".join(map(numbers, p)))
    ).values()
    k_cv, r_cv, center = cv2.decomposeProjectionMatrix(-p)[:3]
    assert_allclose(camera.K, k_cv / k_cv[2, 2], atol=1e-9)
    assert_allclose(camera.R, r_cv, atol=1e-12)
    assert_allclose(camera.center, (center[:3] / center[3])[:, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("{0}\n{1}\n{2}\n\n{0}\n{1}\n{2}\n", ["0", "1"]),
        ("P0: {0} {1} {2}\nP1: {0} {1} {2}\n", ["P0", "P1"]),
        ("# left\n{0}\n{1}\n{2}\n# right\n{0}\n{1}\n{2}\n", ["left", "right"]),
        ("left:\n{0}\n{1}\n{2}\nright:\n{0}\n{1}\n{2}\n", ["left", "right"]),
        ("[{0}; {1}; {2}]\n[{0}; {1}; {2}]", ["0", "1"]),
    ],
)
def test_several_projection_matrices_in_any_layout(tmp_path: Path, text: str, names: list[str]) -> None:
    rows = [numbers(values) for values in K @ np.column_stack([R, T])]
    cameras = read_calibration(written(tmp_path, "p.txt", text.format(*rows)), size=(640, 480))
    assert list(cameras) == names
    for camera in cameras.values():
        assert_sees(camera, theirs(POINTS, R, T, K))


@pytest.mark.parametrize("lens", ["0", "-0.3 0.1 0.001", "-0.3 0.1 0.001 0.002 0.05 0.1 0.2 0.3"])
def test_krtd_is_k_r_t_and_opencvs_coefficients(tmp_path: Path, lens: str) -> None:
    text = "\n\n".join(["\n".join(map(numbers, K)), "\n".join(map(numbers, R)), numbers(T), lens])
    cameras = read_calibration(written(tmp_path, "gym.krtd", text), size=(640, 480))
    assert list(cameras) == ["gym"]
    d = [float(word) for word in lens.split()]
    d += [0.0] * (8 - len(d))
    assert_sees(cameras["gym"], theirs(POINTS, R, T, K, np.array(d)))


def test_panoptic_is_in_centimetres_with_y_down(tmp_path: Path) -> None:
    d = [-0.2, 0.1, 0.001, -0.002, 0.03]
    camera = {"name": "00_03", "type": "hd", "resolution": [1920, 1080], "panel": 0, "node": 3, "distCoef": d}
    camera |= {"K": K.tolist(), "R": np.eye(3).tolist(), "t": [[0.0], [100.0], [300.0]]}
    path = written(tmp_path, "c.json", json.dumps({"calibDataSource": "x", "cameras": [camera]}))
    ours = read_calibration(path)["00_03"]
    assert ours.size == (1920, 1080)
    # its centre is at y = -100 cm in the file, which is a metre up; it looks along the file's z, map's y
    assert_allclose(ours.center, [0, -3, 1], atol=1e-12)
    in_file = np.random.default_rng(2).uniform(-80, 80, (20, 3))
    in_map = np.column_stack([in_file[:, 0], in_file[:, 2], -in_file[:, 1]]) / 100
    assert_sees(ours, theirs(in_file, np.eye(3), np.array([0, 100.0, 300]), K, np.array(d)), in_map)


@pytest.mark.parametrize("up", sorted(Z_UP_FROM_FILE))
def test_the_up_axis_of_the_file_becomes_z(tmp_path: Path, up: str) -> None:
    path = written(tmp_path, "p.txt", "\n".join(map(numbers, K @ np.column_stack([R, T]))))
    as_it_is, turned = (next(iter(read_calibration(path, up=u, unit=0.5).values())) for u in ("z", up))
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    # a step up in the file is seen like a step up in the world
    assert_allclose(turned.R @ [0, 0, 1], as_it_is.R @ axis, atol=1e-12)
    assert_allclose(turned.center[2], as_it_is.center @ axis, atol=1e-12)
    assert np.linalg.det(Z_UP_FROM_FILE[up]) == pytest.approx(1)
    assert_allclose(turned.t, T / 2)


def colmap(tmp_path: Path, camera: str, name: str = "left.png") -> Path:
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    written(tmp_path, "cameras.txt", f"# Camera list\n\n7 {camera}\n")
    images = f"# two lines each\n12 {numbers(np.array([w, x, y, z, *T]))} 7 {name}\n1.5 2 -1 3 4 8\n"
    return written(tmp_path, "images.txt", images + f"13 {numbers(np.array([w, x, y, z, *T]))} 7 b/c.jpg\n\n")


@pytest.mark.parametrize(
    ("model", "parameters", "d"),
    [
        ("SIMPLE_PINHOLE", "700 310.5 245.5", []),
        ("PINHOLE", "700 690 310.5 245.5", []),
        ("SIMPLE_RADIAL", "700 310.5 245.5 -0.2", [-0.2, 0, 0, 0]),
        ("RADIAL", "700 310.5 245.5 -0.2 0.1", [-0.2, 0.1, 0, 0]),
        ("OPENCV", "700 690 310.5 245.5 -0.2 0.1 0.001 0.002", [-0.2, 0.1, 0.001, 0.002]),
        (
            "FULL_OPENCV",
            "700 690 310.5 245.5 -0.2 0.1 0.001 0.002 0.05 0.1 0.2 0.3",
            [-0.2, 0.1, 0.001, 0.002, 0.05, 0.1, 0.2, 0.3],
        ),
        ("SIMPLE_RADIAL_FISHEYE", "700 310.5 245.5 -0.02", [-0.02, 0, 0, 0]),
        ("RADIAL_FISHEYE", "700 310.5 245.5 -0.02 0.01", [-0.02, 0.01, 0, 0]),
        ("OPENCV_FISHEYE", "700 690 310.5 245.5 -0.02 0.01 0.003 0.002", [-0.02, 0.01, 0.003, 0.002]),
    ],
)
def test_colmap_models_are_those_of_opencv_shifted_by_half_a_pixel(
    tmp_path: Path, model: str, parameters: str, d: list[float]
) -> None:
    colmap(tmp_path, f"{model} 640 480 {parameters}")
    k = K.copy()
    k[1, 1] = 690 if "690" in parameters else 700
    rvec = cv2.Rodrigues(R)[0]
    expected = theirs(POINTS, R, T, k, np.array(d))
    if "FISHEYE" in model:
        expected = cv2.fisheye.projectPoints(POINTS[:, None], rvec, T, k, np.array(d))[0][:, 0]
    for path in (tmp_path, tmp_path / "cameras.txt", tmp_path / "images.txt"):
        cameras = read_calibration(path)
        assert list(cameras) == ["left", "b/c"]
        assert_sees(cameras["left"], expected)


def test_colmap_cameras_without_images_are_at_the_origin(tmp_path: Path) -> None:
    colmap(tmp_path, "PINHOLE 640 480 700 690 310.5 245.5")
    (tmp_path / "images.txt").unlink()
    camera = read_calibration(tmp_path)["7"]
    assert_sees(camera, theirs(POINTS @ R.T + T, np.eye(3), np.zeros(3), K), POINTS @ R.T + T)


KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [700, 690, 310, 245]
  distortion_model: radtan
  distortion_coeffs: [-0.2, 0.1, 0.001, 0.002]
  resolution: [640, 480]
cam1:
  T_cn_cnm1: [[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [700, 690, 310, 245]
  distortion_model: equidistant
  distortion_coeffs: [-0.02, 0.01, 0.003, 0.002]
  resolution: [640, 480]
cam2:
  T_cn_cnm1: [[1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [700, 690, 310, 245]
  distortion_model: none
  distortion_coeffs: []
  resolution: [640, 480]
"""


def test_transforms_of_a_kalibr_chain_are_composed(tmp_path: Path) -> None:
    cameras = read_calibration(written(tmp_path, "camchain.yaml", KALIBR))
    assert list(cameras) == ["cam0", "cam1", "cam2"]
    # by hand: cam1 has x1 = -y0 + 0.1, y1 = x0, so that its centre is at y0 = 0.1; cam2 is 0.2 from it on x1
    assert_allclose(cameras["cam0"].center, [0, 0, 0], atol=1e-12)
    assert_allclose(cameras["cam1"].center, [0, 0.1, 0], atol=1e-12)
    assert_allclose(cameras["cam2"].center, [0, 0.3, 0], atol=1e-12)
    assert_allclose(cameras["cam2"].to_optical([1, 2, 3]), [-1.7, 1, 3], atol=1e-12)
    assert [camera.model for camera in cameras.values()] == ["plumb_bob", "equidistant", "plumb_bob"]
    d = np.array([-0.2, 0.1, 0.001, 0.002])
    points = POINTS @ R.T + T
    assert_sees(cameras["cam0"], theirs(points, np.eye(3), np.zeros(3), K, d), points)


def test_the_imu_of_kalibr_is_the_world_frame_if_present(tmp_path: Path) -> None:
    imu = "  T_cam_imu: [[1, 0, 0, 0], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]\n"
    text = KALIBR.replace("cam1:", imu + "cam1:")
    cameras = read_calibration(written(tmp_path, "camchain-imucam.yaml", text))
    assert_allclose(cameras["cam0"].center, [0, -3, 2], atol=1e-12)
    # the other cameras still follow the chain
    assert_allclose(cameras["cam1"].to_optical([0, 0, 0]), [-2 + 0.1, 0, 3], atol=1e-12)


def test_a_cam_file_of_the_thesis_has_the_view_direction_of_blender(tmp_path: Path) -> None:
    # Blender's camera looks along its -z: turned by 90 degrees about x, then z, that is -x
    text = "C=3.0,0.0,0.5\nf=1\nR=90.0,0.0,90.0\nk=1:1\nsize=640x480\nformat=png\n"
    camera = read_calibration(written(tmp_path, "corner.cam", text))["corner"]
    assert camera.size == (640, 480)
    assert_allclose(camera.center, [3, 0, 0.5], atol=1e-12)
    # f = 1 is 90 degrees across; left of it is -y
    pixels, _ = camera.project([[0, 0, 0.5], [0, -3, 0.5], [0, 0, 1.5]])
    assert_allclose(pixels, [[319.5, 239.5], [-0.5, 239.5], [319.5, 239.5 - 320 / 3]], atol=1e-9)


MESSAGE = """header:
  stamp: {sec: 1, nanosec: 2}
  frame_id: left_optical_frame
height: 480
width: 640
distortion_model: rational_polynomial
d: [0.1, 0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6]
k:
- 700.0
- 0.0
- 310.0
- 0.0
- 690.0
- 245.0
- 0.0
- 0.0
- 1.0
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [650.0, 0.0, 320.0, -65.0, 0.0, 650.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""


def test_output_of_ros2_topic_echo_is_read(tmp_path: Path) -> None:
    ros1 = MESSAGE
    for key in "dkrp":
        ros1 = ros1.replace(f"\n{key}:", f"\n{key.upper()}:")
    for text in (MESSAGE, ros1):
        camera = read_calibration(written(tmp_path, "echo.yaml", text))["left"]
        assert camera.model == "rational_polynomial" and camera.distortion[7] == 0.6
        assert_allclose(camera.K, K)
        assert camera.rectified_projection[0, 3] == -65


def test_a_message_with_region_of_interest_gives_the_full_image_with_a_warning(tmp_path: Path) -> None:
    path = written(tmp_path, "echo.yaml", MESSAGE.replace("binning_x: 0", "binning_x: 2"))
    with pytest.warns(HumansimWarning, match="binning"):
        read_calibration(path)


@pytest.mark.parametrize("name", ["fisheye", "equidistant"])
def test_fisheye_is_equidistant(tmp_path: Path, name: str) -> None:
    text = MESSAGE.replace("rational_polynomial", name).replace(", 0.3, 0.4, 0.5, 0.6]", "]")
    assert read_calibration(written(tmp_path, "f.yaml", text))["left"].model == "equidistant"


# -- OpenCV's own files

D = np.array([[-0.2, 0.1, 0.001, 0.002, 0.05]])


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_files_that_opencv_writes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"camera{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", 640), ("image_height", 480), ("flags", 0), ("rms", 1e-5)):
        storage.write(key, value)
    storage.write("calibration_time", "Fri Nov  1 12:00:00")
    for key, matrix in (
        ("camera_matrix", K),
        ("distortion_coefficients", D.T),
        ("R", R),
        ("T", T[:, None] * 100),
    ):
        storage.write(key, matrix)
    storage.write("image_points", np.random.default_rng(0).random((8, 54, 2), np.float32))
    storage.release()
    camera = read_calibration(path, unit=0.01)["camera"]
    assert camera.size == (640, 480)
    assert_sees(camera, theirs(POINTS, R, T, K, D))


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_a_stereo_pair_that_opencv_rectified(tmp_path: Path, suffix: str) -> None:
    rotation = cv2.Rodrigues(np.array([0.01, 0.05, -0.02]))[0]
    t = np.array([[-0.12], [0.003], [0.001]])
    r1, r2, p1, p2, q = cv2.stereoRectify(K, D, K, D, (640, 480), rotation, t)[:5]
    halves = {
        "intrinsics": {"M1": K, "D1": D, "M2": K, "D2": D},
        "extrinsics": {"R": rotation, "T": t, "R1": r1, "R2": r2, "P1": p1, "P2": p2, "Q": q},
    }
    for half, matrices in halves.items():
        storage = cv2.FileStorage(str(tmp_path / f"{half}{suffix}"), cv2.FILE_STORAGE_WRITE)
        for key, matrix in matrices.items():
            storage.write(key, matrix)
        storage.release()
    for half in halves:
        cameras = read_calibration(tmp_path / f"{half}{suffix}", size=(640, 480))
        assert list(cameras) == ["1", "2"]
        points = POINTS @ R.T + T
        assert_sees(cameras["1"], theirs(points, np.eye(3), np.zeros(3), K, D), points)
        assert_sees(cameras["2"], theirs(points, rotation, t, K, D), points)
        assert_allclose(cameras["2"].rectified_projection, p2)
        assert_allclose(cameras["2"].rectification_matrix, r2, atol=1e-9)
    assert list(read_calibration(tmp_path, size=(640, 480))) == ["1", "2"]  # the two files are one rig


def test_a_rig_of_easymocap_is_in_two_files(tmp_path: Path) -> None:
    intri, extri = (
        cv2.FileStorage(str(tmp_path / f"{n}.yml"), cv2.FILE_STORAGE_WRITE) for n in ("intri", "extri")
    )
    for name, shift in (("01", 0.0), ("02", 1.0)):
        intri.write(f"K_{name}", K)
        intri.write(f"dist_{name}", D)
        extri.write(f"R_{name}", cv2.Rodrigues(R)[0])
        extri.write(f"T_{name}", T[:, None] + shift)
    intri.release()
    extri.release()
    cameras = read_calibration(tmp_path / "intri.yml", size=(640, 480))
    assert list(cameras) == ["01", "02"]
    assert_sees(cameras["02"], theirs(POINTS, R, T + 1, K, D))


@pytest.mark.parametrize(
    ("extra", "model"),
    [
        ("fisheye_model: 1", "equidistant"),
        ("distortion_model: equidistant", "equidistant"),
        ("camera_model: fisheye", "equidistant"),
        ("fisheye_model: 0", "plumb_bob"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*4 coefficients are taken for plumb_bob")
def test_four_coefficients_of_opencv_are_a_fisheye_only_if_the_file_says_so(
    tmp_path: Path, extra: str, model: str
) -> None:
    text = f"%YAML:1.0\n---\nK: [700, 0, 310, 0, 690, 245, 0, 0, 1]\nD: [0.1, 0.01, 1e-05, 2.e-6]\n{extra}\n"
    (camera,) = read_calibration(written(tmp_path, "f.yml", text), size=(640, 480)).values()
    assert camera.model == model and camera.distortion[:4] == (0.1, 0.01, 1e-5, 2e-6)


# -- sizes, folders, URLs


def test_the_size_is_given_or_that_of_an_image_or_assumed(tmp_path: Path) -> None:
    par = f"1\na.png {numbers(K)} {numbers(R)} {numbers(T)}\n"
    path = written(tmp_path, "par.txt", par)
    with pytest.warns(HumansimWarning, match="640x480 is assumed"):
        assert read_calibration(path)["a"].size == (640, 480)
    assert read_calibration(path, size=(600, 500))["a"].size == (600, 500)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((470, 650), np.uint8))
    assert read_calibration(path)["a"].size == (650, 470)  # the image is there
    cv2.imwrite(str(tmp_path / "b.jpg"), np.zeros((471, 651), np.uint8))
    assert read_calibration(path, image=tmp_path / "b.jpg")["a"].size == (651, 471)


def test_a_folder_is_a_rig(tmp_path: Path) -> None:
    written(tmp_path, "a.yaml", MESSAGE)
    written(tmp_path, "b.yaml", MESSAGE)
    written(tmp_path, "c.cam", "C=1,2,3\nf=1\nR=0,0,0\nsize=640x480\n")
    written(tmp_path, "notes.txt", "do not forget the tripod\n")
    with pytest.warns(HumansimWarning) as caught:
        calibration = load_calibration(tmp_path)
    assert list(calibration.cameras) == ["a", "b", "c"]
    assert calibration.sizes == dict.fromkeys("abc", (640, 480))
    said = [str(warning.message).removeprefix(f"{tmp_path}/") for warning in caught]
    assert said == [
        "notes.txt: is not a known calibration format: ignored",
        "a.yaml: there are several cameras left; this one is renamed to a",
        "b.yaml: there are several cameras left; this one is renamed to b",
    ]
    written(tmp_path, "d.ini", "[image]\n")
    with pytest.raises(CameraError, match=r"d.ini: image.width: is missing"):
        read_calibration(tmp_path)


def test_urls_are_resolved_as_by_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "ros"))
    (tmp_path / "share" / "my_robot").mkdir(parents=True)
    assert resolve_url("package://my_robot/cal/left.yaml") == tmp_path / "share/my_robot/cal/left.yaml"
    assert resolve_url("file:///a/${NAME}.yaml", "left") == Path("/a/left.yaml")
    assert resolve_url("file://${ROS_HOME}/x.yaml") == tmp_path / "ros/x.yaml"
    assert resolve_url("", "left") == tmp_path / "ros/camera_info/left.yaml"
    assert resolve_url("package://humansim_ros/config/scenes/demo.yaml").is_file()
    monkeypatch.delenv("ROS_HOME")
    assert resolve_url("", "left") == Path.home() / ".ros/camera_info/left.yaml"
    path = written(tmp_path / "share" / "my_robot", "left.yaml", MESSAGE)
    assert list(read_calibration("package://my_robot/left.yaml")) == list(read_calibration(f"file://{path}"))


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("http://example.org/a.yaml", "only file:// and package://"),
        ("file://a.yaml", "absolute path"),
        ("package://my_robot", "package://<package>/<file"),
        ("package://../x", "package://<package>/<file"),
        ("package://no_such_package/a.yaml", "no package no_such_package"),
        ("file:///${HOME}/a.yaml", "HOME"),
        ("file:///${NAME}.yaml", "NAME"),
    ],
)
def test_urls_that_cannot_be_resolved_are_explained(url: str, reason: str) -> None:
    with pytest.raises(CameraError, match=reason):
        resolve_url(url)
