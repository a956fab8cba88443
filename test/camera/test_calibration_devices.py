"""Calibrations of ZED, Azure Kinect and RealSense cameras, and of Blender, by the formula of each program."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from calibration_files import assert_refused, changed
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from wanted_cameras import CAMERAS, FLIP, SIZE, D, Wanted, assert_same, read

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.errors import HumansimWarning

W, H = SIZE
EIGHT = (0.41, -0.22, 1e-3, -2e-4, 0.03, 0.71, -0.01, 0.02)
POINTS = np.random.default_rng(1).uniform([-0.9, -0.6, 2.5], [0.9, 0.6, 4], (40, 3))
ZED = """[LEFT_CAM_HD]
fx=700.5
fy=701
cx=640.2
cy=360.1
k1=-0.17
k2=0.02
p1=0.0003
p2=-0.0002
k3=0.001

[RIGHT_CAM_HD]
fx=699
fy=699.5
cx=641
cy=358
k1=-0.16

[LEFT_CAM_VGA]
fx=350
fy=350
cx=336
cy=188
k1=0

[STEREO]
Baseline=119.9
TY=0.1
TZ=-0.2
CV_HD=0.003
RX_HD=-0.002
RZ_HD=0.001
"""


def test_zed_right_camera_is_a_baseline_beside_the_left_one(tmp_path: Path) -> None:
    cameras = read(tmp_path, "SN1.conf", ZED, size=(1280, 720))
    assert list(cameras) == ["LEFT_CAM_HD", "RIGHT_CAM_HD"]
    t = np.array([-0.1199, 0.0001, -0.0002])
    k = np.array([[699, 0, 641], [0, 699.5, 358], [0, 0, 1]])
    pixels = cv2.projectPoints(POINTS, np.array([-0.002, 0.003, 0.001]), t, k, np.array([-0.16, 0, 0, 0, 0]))[
        0
    ]
    assert_allclose(cameras["RIGHT_CAM_HD"].project(POINTS)[0], pixels[:, 0], atol=1e-6)
    assert cameras["RIGHT_CAM_HD"].center[0] > 0.11
    assert cameras["LEFT_CAM_HD"].distortion == (-0.17, 0.02, 0.0003, -0.0002, 0.001)
    assert list(read(tmp_path, "SN1.conf", ZED)) == ["LEFT_CAM_HD", "RIGHT_CAM_HD", "LEFT_CAM_VGA"]


def test_a_written_zed_file_reads_back_the_same_pair(tmp_path: Path) -> None:
    k = np.array([[350.0, 0, 330], [0, 351, 190], [0, 0, 1]])
    left = Camera((672, 376), k, np.eye(3), np.zeros(3), D)
    turn = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
    right = replace(left, R=turn, t=np.array([-0.12, 0.001, 0.002]))
    write_calibration(tmp_path / "a.conf", {"left": left, "right": right})
    for camera, wanted in zip(read_calibration(tmp_path / "a.conf").values(), (left, right), strict=True):
        assert_allclose(camera.project(POINTS)[0], wanted.project(POINTS)[0], atol=1e-9)


def k4a(names: tuple[str, ...] = ("depth", "color")) -> dict[str, Any]:
    cameras = []
    for index, name in enumerate(names):
        sensor = (1024, 1024) if name == "depth" else (4096, 3072)
        k1, k2, p1, p2, k3, k4, k5, k6 = EIGHT
        values = [0.501, 0.498, 0.49, 0.49 * sensor[0] / sensor[1], k1, k2, k3, k4, k5, k6, 0, 0, p2, p1]
        turn = Rotation.from_rotvec([0.1 * index, 0.002, 0.001]).as_matrix()
        purpose = (
            "CALIBRATION_CameraPurposePhotoVideo" if name == "color" else "CALIBRATION_CameraPurposeDepth"
        )
        model = "CALIBRATION_LensDistortionModelBrownConrady"
        cameras.append(
            {
                "Intrinsics": {"ModelParameterCount": 14, "ModelParameters": values, "ModelType": model},
                "Purpose": purpose,
                "Rt": {"Rotation": turn.ravel().tolist(), "Translation": [-0.032 * index, -0.002, 0.004]},
                "SensorWidth": sensor[0],
                "SensorHeight": sensor[1],
            }
        )
    return {"CalibrationInformation": {"Cameras": cameras}}


@pytest.mark.parametrize("size", [None, (1920, 1080), (2048, 1536)])
def test_azure_kinect_scales_fractions_of_the_sensor(tmp_path: Path, size: tuple[int, int] | None) -> None:
    w, h = size or (4096, 3072)
    if size is None:
        cameras = read(tmp_path, "k4a.json", k4a())
        assert list(cameras) == ["depth", "color"]
    else:
        with pytest.warns(HumansimWarning, match=r"left out, because they have no mode of \d+x\d+: depth"):
            cameras = read(tmp_path, "k4a.json", k4a(), size=size)
    full, cut = w * 0.75, (w * 0.75 - h) / 2  # 16:9 is the middle of 4:3
    f = 0.49 * w
    k = np.array([[f, 0, 0.501 * w - 0.5], [0, 0.49 * 4 / 3 * full, 0.498 * full - cut - 0.5], [0, 0, 1]])
    t = np.array([-0.032, -0.002, 0.004])
    pixels = cv2.projectPoints(POINTS, np.array([0.1, 0.002, 0.001]), t, k, np.array(EIGHT))[0][:, 0]
    assert_allclose(cameras["color"].project(POINTS)[0], pixels, atol=1e-6)


def test_a_written_azure_kinect_file_reads_back_the_same_cameras(tmp_path: Path) -> None:
    cameras = read(tmp_path, "k4a.json", k4a())
    write_calibration(tmp_path / "again.json", cameras, "k4a")
    for name, camera in read_calibration(tmp_path / "again.json").items():
        assert_allclose(camera.project(POINTS)[0], cameras[name].project(POINTS)[0], atol=1e-6)


def test_extrinsics_of_realsense_are_in_column_order(tmp_path: Path) -> None:
    turn = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix()
    stream = {"width": W, "height": H, "fx": 600, "fy": 601, "ppx": 320, "ppy": 240, "coeffs": [0.0] * 5}
    pose = {"rotation": turn.T.ravel().tolist(), "translation": [0.0147, 0.0001, 0.0003]}
    document = {"color_intrinsics": stream, "depth_intrinsics": stream, "extrinsics": pose}
    with pytest.warns(HumansimWarning, match="extrinsics: taken from depth to color"):
        cameras = read(tmp_path, "c.json", document)
    k = np.array([[600, 0, 320], [0, 601, 240], [0, 0, 1.0]])
    pixels = cv2.projectPoints(POINTS, cv2.Rodrigues(turn)[0], np.array([0.0147, 0.0001, 0.0003]), k, None)[0]
    assert_allclose(cameras["color_intrinsics"].project(POINTS)[0], pixels[:, 0], atol=1e-6)
    assert not cameras["depth_intrinsics"].t.any()


def test_the_real_realsense_file_has_its_baseline(shared_data: Path) -> None:
    with pytest.warns(HumansimWarning, match="taken from depth to color"):
        cameras = read_calibration(shared_data / "calib" / "thanhlong_camera_params.json")
    assert_allclose(
        cameras["color_intrinsics"].t, [0.014744727872312069, 3.41205632139463e-05, 0.0004029515548609]
    )


# -- Blender


def blender(c: Wanted, kind: str) -> dict[str, Any]:
    """Camera of a Blender script; its picture is the one of c."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = c.R.T @ FLIP, c.center
    aspect = c.K[0, 0] / c.K[1, 1]
    camera: dict[str, Any] = {"sensor_width": 32.0, "pixel_aspect_y": aspect}
    camera |= {"shift_x": (W / 2 - c.K[0, 2] - 0.5) / W, "shift_y": (c.K[1, 2] + 0.5 - H / 2) * aspect / W}
    if kind == "angle":
        camera["angle"] = 2 * float(np.arctan(W / 2 / c.K[0, 0]))
    else:
        camera["lens"] = c.K[0, 0] * 32.0 / W
    turn = Rotation.from_matrix(pose[:3, :3])
    if kind == "euler":
        camera |= {"location": c.center.tolist(), "rotation_euler": turn.as_euler("xyz").tolist()}
    elif kind == "quaternion":
        camera |= {"location": c.center.tolist(), "rotation_quaternion": np.roll(turn.as_quat(), 1).tolist()}
    else:
        camera["matrix_world"] = pose.tolist()
    return camera


@pytest.mark.parametrize("kind", ["lens", "angle", "euler", "quaternion"])
def test_cameras_of_blender_look_along_minus_z(tmp_path: Path, kind: str) -> None:
    document = {"render": {"resolution_x": 2 * W, "resolution_y": 2 * H, "resolution_percentage": 50}}
    document["cameras"] = {name: blender(c, kind) for name, c in CAMERAS.items()}
    assert_same(read(tmp_path, "c.json", document), (0.0,) * 5)


# -- wrong files


RESOLUTION = {"resolution_x": W, "resolution_y": H}
ONE, BY_ANGLE, TURNED = (
    {**RESOLUTION, **blender(CAMERAS["cam0"], kind)} for kind in ("lens", "angle", "quaternion")
)


def changed_k4a(path: str, value: Any) -> str:
    return changed(k4a(("color",)), f"CalibrationInformation.Cameras.0.{path}", value)


def k4a_of_one_place(count: int) -> dict[str, Any]:
    """Colour cameras with one location. The second is named after it, since ``color`` is taken."""
    content = k4a(("color",) * count)
    for camera in content["CalibrationInformation"]["Cameras"]:
        camera["Location"] = "lid"
    return content


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ZED.replace("fx=700.5", "fx=nan"), ":2: LEFT_CAM_HD.fx: a number is not finite"),
        (ZED.replace("fx=700.5\n", ""), ":1: LEFT_CAM_HD.fx: is missing"),
        (ZED.replace("Baseline", "Base"), "STEREO.Baseline: is missing"),
        (ZED.replace("CV_HD", "CV_VGA"), "STEREO.CV_HD: is missing"),
        (changed_k4a("Intrinsics.ModelParameters", [1, 2]), "ModelParameters: needs 14 numbers, not 2"),
        (changed_k4a("Intrinsics.ModelType", "Theta"), "'Theta' is not a supported lens"),
        (changed_k4a("Intrinsics.ModelParameters.10", 0.1), "a centre of distortion beside the axis"),
        (changed_k4a("SensorWidth", 0), "SensorWidth: needs a whole number above zero"),
        (changed_k4a("Rt.Rotation", [1, 2, 3]), "Rt.Rotation: needs 3 x 3 numbers, not 3"),
        (json.dumps(k4a_of_one_place(3)), "Cameras.2: there are two cameras with the name 'lid'"),
        (json.dumps({**ONE, "resolution_x": None}), "resolution_x: is missing"),
        (json.dumps({**ONE, "lens": "long"}), "lens: 'long' is not a number"),
        (json.dumps({**ONE, "sensor_width": 0}), "sensor_width: needs a sensor above zero"),
        (json.dumps({**ONE, "pixel_aspect_y": -1}), "needs pixel aspects above zero"),
        (json.dumps({**ONE, "pixel_aspect_x": 0}), "needs pixel aspects above zero"),
        (json.dumps({**BY_ANGLE, "angle": 5e-324}), "angle: must be an angle between 0 and pi radians"),
        (json.dumps({**TURNED, "rotation_quaternion": [1, 1, 0, 0]}), "rotation_quaternion: the quaternion"),
        (json.dumps({**ONE, "matrix_world": [[0] * 4] * 3 + [[0, 0, 0, 1]]}), "has an axis of length 0"),
    ],
)
def test_wrong_files_are_refused_with_their_key(tmp_path: Path, text: str, said: str) -> None:
    assert_refused(tmp_path, text, said)
