"""Calibration files of more programs, written here from random cameras and judged by OpenCV.

Each file has the keys, the order, the direction and the unit of its program.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from wanted_cameras import CAMERAS, FISHEYE, SIZE, D, Wanted, assert_same, read

from humansim_ros.cameras import read_calibration
from humansim_ros.cli.camera import Reading
from humansim_ros.errors import CameraError, HumansimWarning
from humansim_ros.types import Array

W, H = SIZE


def numbers(values: Any, between: str = " ") -> str:
    return between.join(repr(float(value)) for value in np.ravel(values))


def rows(matrix: Array) -> str:
    return "; ".join(numbers(row) for row in matrix)


def c2w(c: Wanted) -> Array:
    return np.asarray(np.linalg.inv(np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]])))


def w2c(c: Wanted) -> Array:
    return np.asarray(np.linalg.inv(c2w(c)))


def quaternion(r: Array) -> list[float]:
    """Quaternion w, x, y, z."""
    return [float(q) for q in np.roll(Rotation.from_matrix(r).as_quat(), 1)]


def matrix(key: str, values: Array) -> str:
    """Matrix of OpenCV in YAML."""
    two = np.atleast_2d(values)
    shape = f"   rows: {two.shape[0]}\n   cols: {two.shape[1]}\n   dt: d\n"
    return f"{key}: !!opencv-matrix\n{shape}   data: [ {numbers(two, ', ')} ]\n"


def focal(c: Wanted) -> tuple[float, float, float, float]:
    return c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]


def each(text: Callable[[int, str, Wanted], str]) -> str:
    return "".join(text(index, name, c) for index, (name, c) in enumerate(CAMERAS.items()))


# -- text and tables


def kitti() -> str:
    head = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
    return head + each(
        lambda i, name, c: (
            f"S_0{i}: {numbers(SIZE)}\nK_0{i}: {numbers(c.K)}\nD_0{i}: {numbers(D)}\n"
            f"R_0{i}: {numbers(c.R)}\nT_0{i}: {numbers(c.t)}\nS_rect_0{i}: 600 300\n"
            f"R_rect_0{i}: {numbers(np.eye(3))}\nP_rect_0{i}: {numbers(np.eye(3, 4) * 500)}\n"
        )
    )


def skeletool() -> str:
    def k(c: Wanted) -> Array:
        k = np.eye(4)
        k[:3, :3] = c.K
        return k

    def pose(c: Wanted) -> Array:
        pose = w2c(c) @ np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # y up
        pose[:3, 3] *= 1000
        return pose

    return "Skeletool Camera Calibration File V1.0\n" + each(
        lambda i, name, c: (
            f"name          {name}\n  sensor      10 10\n  size        {W} {H}\n  animated    0\n"
            f"  intrinsic   {numbers(k(c))} \n  extrinsic   {numbers(pose(c))} \n  radial      0\n"
        )
    )


def captury() -> str:
    def camera(i: int, name: str, c: Wanted) -> str:
        turned = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # map -> y up
        right, down, _ = c.R @ turned.T
        fx, fy, cx, cy = focal(c)
        width, height = 6.4, 4.8
        return (
            f"camera\t{name}\tcam_{name}\n\tframe\t0\n\t\tsensorSize\t{width}\t{height}\t# in mm\n"
            f"\t\tfocalLength\t{float(fx * width / W)!r}\t# in mm\n\t\tpixelAspect\t{float(fy / fx)!r}\n"
            f"\t\tcenterOffset\t{float(cx - W / 2) * width / W!r}\t{float(cy - H / 2) * height / H!r}\t# mm\n"
            f"\t\tdistortionModel\tOpenCV\n\t\tdistortion\t\t{numbers(D)}\n"
            f"\t\t\torigin\t{numbers(turned @ c.center * 1000, chr(9))}\n"
            f"\t\t\tup\t{numbers(-down, chr(9))}\n\t\t\tright\t{numbers(right, chr(9))}\n"
        )

    return "tc camera calibration v0.3\n" + each(camera)


def callab(scale: float = 1000.0) -> str:
    return "# DLR-RMC camera calibration file by DLR CalLab.\nversion=2\norigin=center\n" + each(
        lambda i, name, c: (
            f"\ncamera.{i}.R=[ {rows(c.R.T)}]\ncamera.{i}.T=[ {numbers(c.center * scale)}]\n"
            + "".join(
                f"camera.{i}.{k}= {d}\n" for k, d in zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True)
            )
            + f"camera.{i}.A=[ {rows(c.K)}]\ncamera.{i}.width= {W}\ncamera.{i}.height= {H}\n"
        )
    )


def callab_of_one() -> str:
    """One camera has no number, and the origin of its pixels may be the corner."""
    text = callab(1.0).split("\n\n")[1].replace("camera.0.", "camera.")
    for side in CAMERAS["cam0"].K[:2, 2]:
        text = text.replace(f" {float(side)!r};", f" {float(side) + 0.5!r};")
    return f"# CalLab\nversion=2\norigin=corner\n\n{text}\ncamera.rmsInt= 0.2\n"


def ini(between: str = " = ", end: str = "") -> Callable[[], str]:
    def text() -> str:
        c = CAMERAS["cam0"]
        flat = dict(zip(("fx", "fy", "cx", "cy"), focal(c), strict=True))
        flat |= dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))
        flat |= dict(zip(("rx", "ry", "rz"), cv2.Rodrigues(c.R)[0].ravel(), strict=True))
        flat |= dict(zip(("tx", "ty", "tz"), c.t, strict=True))
        values = {**flat, "width": W, "height": H}
        return "# camera\n" + "".join(f"{key}{between}{value!s}{end}\n" for key, value in values.items())

    return text


def sections() -> str:
    return each(
        lambda i, name, c: (
            f"[{name}]\nimage_width = {W}\nimage_height = {H}\ncamera_matrix = {numbers(c.K)}\n"
            f"dist_coeffs = {numbers(D, ', ')}\nrvec = {numbers(cv2.Rodrigues(c.R)[0], ', ')}\n"
            f"tvec = {numbers(c.t, ', ')}\nlens = pinhole\n"
        )
    )


def toml() -> str:
    c = CAMERAS["cam0"]
    k = ",\n     ".join(str([float(x) for x in row]) for row in c.K)
    return (
        f'camera_name = "cam0"\nimage_size = [{W}, {H}]\nK = [{k}]\ndist = {list(D)}\n'
        f"rvec = [{numbers(cv2.Rodrigues(c.R)[0], ', ')}]\ntvec = [{numbers(c.t, ', ')}]\n"
    )


def table(between: str, comment: str = "", pose: str = "rvec") -> Callable[[], str]:
    def text() -> str:
        turn = "rx ry rz" if pose == "rvec" else "qw qx qy qz"
        head = f"name width height fx fy cx cy k1 k2 p1 p2 k3 {turn} tx ty tz".split()

        def row(c: Wanted) -> list[Any]:
            turned = cv2.Rodrigues(c.R)[0].ravel() if pose == "rvec" else quaternion(c.R)
            return [W, H, *focal(c), *D, *turned, *c.t]

        lines = [comment + between.join(head)]
        lines += [between.join([name, *map(str, row(c))]) for name, c in CAMERAS.items()]
        return "\n".join(lines) + "\n"

    return text


def printed() -> str:
    """What print of NumPy arrays gives."""
    c = CAMERAS["cam0"]
    return (
        f"Image size: {W} x {H}\nCamera matrix:\n{np.array2string(c.K, precision=17)}\n"
        f"Distortion coefficients:\n{np.array2string(np.array([D]), precision=17)}\n"
        f"rvec:\n{np.array2string(cv2.Rodrigues(c.R)[0], precision=17)}\n"
        f"tvec:\n{np.array2string(c.t[:, None], precision=17)}\n"
    )


def rows_under(end: str) -> str:
    c = CAMERAS["cam0"]
    parts = {"image_size": np.array(SIZE), "K": c.K, "D": np.array(D), "R": c.R, "t": c.t}
    return "".join(
        f"{key}{end}\n" + "\n".join(numbers(row) for row in np.atleast_2d(value)) + "\n"
        for key, value in parts.items()
    )


def prox() -> str:
    c = CAMERAS["cam0"]
    parts = {"c": focal(c)[2:], "f": focal(c)[:2], "k": D, "camera_mtx": c.K.tolist()}
    return json.dumps({**parts, "view_mtx": w2c(c)[:3].tolist()})


def blue_c() -> str:
    c = CAMERAS["cam0"]
    flat = {f"R{i + 1}{j + 1}": c.R[i, j] for i in range(3) for j in range(3)}
    flat |= {f"t{i + 1}1": c.t[i] for i in range(3)}
    flat |= {f"K{i + 1}{j + 1}": c.K[i, j] for i in range(3) for j in range(3)}
    flat |= {f"kc{i + 1}": D[i] for i in range(4)}
    return "".join(f"{key} = {value!s}\n" for key, value in flat.items())


def stephi() -> str:
    c = CAMERAS["cam0"]
    p = c.R.T @ np.linalg.inv(c.K)
    flat = {f"C{i + 1}": c.center[i] for i in range(3)}
    flat |= {f"P{i + 1}{j + 1}": p[i, j] for i in range(3) for j in range(3)}
    return "".join(f"{key} = {value!s} \n" for key, value in flat.items())


def argus(kind: str) -> Callable[[], str]:
    def row(i: int, name: str, c: Wanted) -> str:
        fx, fy, cx, cy = focal(c)
        values: list[Any] = {
            "clicker": [i + 1, fx, W, H, cx, cy, fy / fx, *D],
            "camera": [i + 1, fx, cx, cy, fy / fx, *D],
            "sba": [fx, cx, cy, fy / fx, 0.0, *D, *quaternion(c.R), *c.t],
        }[kind]
        return " ".join(map(str, values)) + "\n"

    return lambda: each(row)


# -- YAML


def opencv_file(text: str) -> str:
    return "%YAML:1.0\n---\n" + text


def mccalib() -> str:
    def camera(i: int, name: str, c: Wanted) -> str:
        own = matrix("camera_matrix", c.K) + matrix("distortion_vector", np.array(D))
        own += f"distortion_type: 0\ncamera_group: 0\nimg_width: {W}\nimg_height: {H}\n"
        own += matrix("camera_pose_matrix", c2w(c))
        return f"{name}:\n" + "".join(f"   {line}\n" for line in own.splitlines())

    return opencv_file("nb_camera: 3\n" + each(camera))


def okvis() -> str:
    return "%YAML:1.0\ncameras:\n" + each(
        lambda i, name, c: (
            f"     - {{T_SC:\n        [{numbers(c2w(c), ', ')}],\n        image_dimension: [{W}, {H}],\n"
            f"        distortion_coefficients: [{numbers((*D, 0, 0, 0), ', ')}],\n"
            "        distortion_type: radialtangential8,\n"
            f"        focal_length: [{numbers(focal(c)[:2], ', ')}],\n"
            f"        principal_point: [{numbers(focal(c)[2:], ', ')}]}}\n\n"
        )
    )


def euroc(i: int = 0, model: str = "radial-tangential", d: tuple[float, ...] = D[:4], more: str = "") -> str:
    c = CAMERAS[f"cam{i}"]
    return (
        f"# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam{i}\n{more}"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers(c2w(c), ', ')}]\nrate_hz: 20\n"
        f"resolution: [{W}, {H}]\ncamera_model: pinhole\n"
        f"intrinsics: [{numbers(focal(c), ', ')}] #fu, fv, cu, cv\n"
        f"distortion_model: {model}\ndistortion_coefficients: [{numbers(d, ', ')}]\n"
    )


def jarvis() -> str:
    c = CAMERAS["cam0"]
    return opencv_file(
        matrix("intrinsicMatrix", c.K.T)
        + matrix("distortionCoefficients", np.array(D))
        + matrix("R", c.R.T)
        + matrix("T", c.t[:, None])
    )


def stella(d: tuple[float, ...] = D, model: str = "perspective") -> tuple[str, Array, Array]:
    """Text of a stereo camera, and R and t of the right camera."""
    left, right = CAMERAS["cam0"], CAMERAS["cam1"]
    r, t = Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix(), np.array([-0.12, 0.001, -0.002])
    r1, r2, p1, p2, *_ = cv2.stereoRectify(left.K, np.zeros(5), right.K, np.zeros(5), SIZE, r, t)
    fx, cx, cy = p1[0, 0], p1[0, 2], p1[1, 2]
    text = (
        f'Camera:\n  name: "rig"\n  setup: "stereo"\n  model: "perspective"\n  fx: {fx}\n  fy: {fx}\n'
        f"  cx: {cx}\n  cy: {cy}\n  k1: 0.0\n  k2: 0.0\n  p1: 0.0\n  p2: 0.0\n  k3: 0.0\n  fps: 20.0\n"
        f"  cols: {W}\n  rows: {H}\n  focal_x_baseline: {-p2[0, 3]}\n  depth_threshold: 40\n"
        f'  color_order: "Gray"\nStereoRectifier:\n  model: "{model}"\n'
    )
    for side, c, turn in (("left", left, r1), ("right", right, r2)):
        text += f"  K_{side}: [{numbers(c.K, ', ')}]\n  D_{side}: [{numbers(d, ', ')}]\n"
        text += f"  R_{side}: [{numbers(turn, ', ')}]\n"
    return text, r, t


# -- JSON and XML


def interhand() -> dict[str, Any]:
    return {
        "0": {
            "campos": {name: (c.center * 1000).tolist() for name, c in CAMERAS.items()},
            "camrot": {name: c.R.tolist() for name, c in CAMERAS.items()},
            "focal": {name: list(focal(c)[:2]) for name, c in CAMERAS.items()},
            "princpt": {name: list(focal(c)[2:]) for name, c in CAMERAS.items()},
        }
    }


def aria(model: str = "KannalaBrandtK3") -> dict[str, Any]:
    def camera(name: str, c: Wanted) -> dict[str, Any]:
        w, x, y, z = quaternion(c.R.T)
        return {
            "Calibrated": True,
            "Projection": {"Params": [*focal(c), *FISHEYE], "Description": "", "Name": model},
            "T_Device_Camera": {"Translation": c.center.tolist(), "UnitQuaternion": [w, [x, y, z]]},
            "SerialNumber": "",
            "Label": name,
        }

    return {
        "utc_timestamp_ns": -1,
        "ImuCalibrations": [{"Label": "imu-left"}],
        "ImageSizes": [list(SIZE)] * 3,
        "CameraCalibrations": [camera(name, c) for name, c in CAMERAS.items()],
    }


def rich() -> str:
    c = CAMERAS["cam0"]
    parts = {"CameraMatrix": w2c(c)[:3], "Intrinsics": c.K, "Distortion": np.array(D)[:, None]}
    return (
        '<?xml version="1.0"?>\n<opencv_storage>\n'
        + "".join(
            f'<{key} type_id="opencv-matrix"><rows>{m.shape[0]}</rows><cols>{m.shape[1]}</cols><dt>d</dt>'
            f"<data>\n{numbers(m)}</data></{key}>\n"
            for key, m in parts.items()
        )
        + "</opencv_storage>\n"
    )


def calibu(kind: str, d: tuple[float, ...], turn: Array | None = None) -> str:
    turn = np.eye(3) if turn is None else turn

    def camera(i: int, name: str, c: Wanted) -> str:
        pose = c2w(c)[:3]
        pose[:, :3] = pose[:, :3] @ turn.T
        axes = "".join(
            f"<{axis}> [ {numbers(column, '; ')} ] </{axis}>"
            for axis, column in zip(("right", "down", "forward"), turn.T, strict=True)
        )
        return (
            f'<camera><camera_model name="{name}" index="{i}" serialno="0" type="calibu_fu_fv_u0_v0{kind}" '
            f'version="8"><width> {W} </width><height> {H} </height><!-- RDF -->{axes}'
            f"<params> [ {numbers((*focal(c), *d), '; ')} ] </params></camera_model>"
            f"<pose><T_wc> [ {'; '.join(numbers(row, ', ') for row in pose)} ] </T_wc></pose></camera>\n"
        )

    return f"<rig>\n{each(camera)}</rig>\n"


def flydra(d: tuple[float, ...] = D[:4], scale: float = 1.0, shift: float = 0.0) -> str:
    def camera(i: int, name: str, c: Wanted) -> str:
        p = c.K @ np.column_stack([c.R, c.t / scale])
        lens = dict(zip(("fc1", "fc2", "cc1", "cc2"), focal(c), strict=True))
        lens["cc1"] += shift
        lens |= {**dict(zip(("k1", "k2", "p1", "p2"), d, strict=True)), "alpha_c": 0.0}
        return (
            f"<single_camera_calibration><cam_id>{name}</cam_id>"
            f"<calibration_matrix>{rows(p / p[2, 3])}</calibration_matrix><resolution>{W} {H}</resolution>"
            f"<scale_factor>{scale}</scale_factor><non_linear_parameters>"
            + "".join(f"<{key}>{value}</{key}>" for key, value in lens.items())
            + "</non_linear_parameters></single_camera_calibration>\n"
        )

    return f"<multi_camera_reconstructor>\n{each(camera)}</multi_camera_reconstructor>\n"


# -- files of several cameras or of several files


def realsense_text(d: tuple[float, ...] = (0.0,) * 5) -> str:
    """Depth, which is cam0, and color in two modes, which is cam1."""
    depth, color = CAMERAS["cam0"], CAMERAS["cam1"]
    pose = w2c(color) @ c2w(depth)

    def mode(stream: str, c: Wanted, scale: int, lens: str, formats: str) -> str:
        fx, fy, cx, cy = (value * scale for value in focal(c))
        coefficients = numbers(d, "  \t")
        return (
            f' Intrinsic of "{stream}" / {W * scale}x{H * scale} / {{{formats}}}\n'
            f"  Width:      \t{W * scale}\n  Height:     \t{H * scale}\n"
            f"  PPX:        \t{cx}\n  PPY:        \t{cy}\n"
            f"  Fx:         \t{fx}\n  Fy:         \t{fy}\n  Distortion: \t{lens}\n"
            f"  Coeffs:     \t{coefficients}  \n  FOV (deg):  \t69.39 x 42.52\n\n"
        )

    return (
        "Device info: \n    Name                          : \tIntel RealSense D435\n"
        "Stream Profiles supported by Stereo Module\n Supported modes:\n    stream  resolution  format \n"
        "    Depth\t  848x480\t@ 30Hz\t   Z16\n    Depth\t  640x480\t@ 6Hz\t   Z16\n"
        "Intrinsic Parameters:\n\n"
        + mode("Depth", depth, 1, "Brown Conrady", "Z16")
        + mode("Color", color, 1, "Inverse Brown Conrady", "YUYV/RGB8")
        + mode("Color", color, 2, "Inverse Brown Conrady", "YUYV/RGB8")
        + 'Motion Intrinsic Parameters:\n\nMotion Intrinsic of "Gyro"\t  MOTION_XYZ32F\n'
        "  Bias Variances:  \t0\t0\t0\n"
        "Extrinsic Parameters:\n\n"
        'Extrinsic from "Depth"\t  To\t  "Depth" :\n Rotation Matrix:\n   1  0  0\n   0  1  0\n   0  0  1\n\n'
        " Translation Vector: 0  0  0  \n\n"
        'Extrinsic from "Depth"\t  To\t  "Color" :\n Rotation Matrix:\n'
        + "".join(f"   {numbers(row, '  ')}\n" for row in pose[:3, :3])
        + f"\n Translation Vector: {numbers(pose[:3, 3], '  ')}  \n\n"
        'Extrinsic from "Color"\t  To\t  "Depth" :\n Rotation Matrix:\n   1  0  0\n   0  1  0\n   0  0  1\n\n'
        " Translation Vector: 9  9  9  \n"
    )


def write_nuscenes(folder: Path) -> None:
    cameras = [
        {
            "token": f"t{name}",
            "sensor_token": f"s{name}",
            "translation": c.center.tolist(),
            "rotation": quaternion(c.R.T),
            "camera_intrinsic": c.K.tolist(),
        }
        for name, c in CAMERAS.items()
    ]
    lidar = {**cameras[0], "token": "l", "sensor_token": "sl", "camera_intrinsic": []}
    (folder / "calibrated_sensor.json").write_text(json.dumps([lidar, *cameras]))
    sensors = [{"token": f"s{name}", "channel": name, "modality": "camera"} for name in CAMERAS]
    (folder / "sensor.json").write_text(json.dumps(sensors))


def write_selfcal(folder: Path, d: tuple[float, ...] = D[:4], octave: bool = False) -> None:
    """Folder of MultiCamSelfCal; Octave writes a header."""
    (folder / "camera_order.txt").write_text("\n".join(CAMERAS) + "\n")
    (folder / "Res.dat").write_text(f"{W} {H}\n" * len(CAMERAS))
    (folder / "points.dat").write_text("1 2 3\n")
    for i, c in enumerate(CAMERAS.values(), 1):
        p = c.K @ np.column_stack([c.R, c.t]) * 1.7
        head = (
            "# Created by Octave 3.8\n# name: Pmat\n# type: matrix\n# rows: 3\n# columns: 4\n"
            if octave
            else ""
        )
        text = head + "\n".join("   " + numbers(row, "   ") for row in p) + "\n"
        (folder / f"camera{i}.Pmat.cal").write_text(text)
        (folder / f"basename{i}.cal").write_text(stephi())
        rad = [f"K{j + 1}{k + 1} = {c.K[j, k]:f}" for j in range(3) for k in range(3)]
        (folder / f"basename{i}.rad").write_text(
            "\n".join([*rad, "", *(f"kc{j + 1} = {x}" for j, x in enumerate(d))])
        )


def storage(parts: dict[str, Array]) -> str:
    return (
        '<?xml version="1.0"?>\n<opencv_storage>\n'
        + "".join(
            f"<{key}>\n  {numbers(value)}</{key}>\n"
            if key in ("rvec", "tvec")
            else f'<{key} type_id="opencv-matrix"><rows>{len(value)}</rows>'
            f"<cols>{value.size // len(value)}</cols>"
            f"<dt>f</dt><data>\n{numbers(value)}</data></{key}>\n"
            for key, value in parts.items()
        )
        + "</opencv_storage>\n"
    )


def write_wildtrack(folder: Path) -> list[str]:
    """Folder of WildTrack; returns the files of the undistorted images, as a shell lists them."""
    for part in ("intrinsic_original", "intrinsic_zero", "extrinsic"):
        (folder / part).mkdir()
    for name, c in CAMERAS.items():
        intrinsics = {"camera_matrix": c.K, "distortion_coefficients": np.array([D])}
        zero = {**intrinsics, "distortion_coefficients": np.zeros((1, 5))}
        pose = {"rvec": cv2.Rodrigues(c.R)[0], "tvec": c.t * 100}
        (folder / "intrinsic_original" / f"intr_{name}.xml").write_text(storage(intrinsics))
        (folder / "intrinsic_zero" / f"intr_{name}.xml").write_text(storage(zero))
        (folder / "extrinsic" / f"extr_{name}.xml").write_text(storage(pose))
    return [str(f) for part in ("intrinsic_zero", "extrinsic") for f in sorted((folder / part).iterdir())]


# -- tests

S = {"size": SIZE}
M, MM = {"unit": 1.0}, {"unit": 0.001}
MANY: dict[str, tuple[str, Callable[[], Any], dict[str, Any], tuple[float, ...], bool]] = {
    "Skeletool": ("camera.calibration", skeletool, {}, (0, 0, 0, 0, 0), False),
    "Captury": ("live.calib", captury, S, D, False),
    "sections of an INI file": ("c.ini", sections, M, D, False),
    "table with commas": ("c.csv", table(","), M, D, False),
    "table with semicolons": ("c.csv", table("; "), M, D, False),
    "table with tabs": ("c.tsv", table("\t"), M, D, False),
    "table with blanks": ("c.txt", table("  ", "# "), M, D, False),
    "table with quaternions": ("c.csv", table(",", pose="q"), M, D, False),
    "MC-Calib": ("calibrated_cameras_data.yml", mccalib, M, D, False),
    "InterHand2.6M": ("camera.json", interhand, S, (0, 0, 0, 0, 0), False),
    "Aria": ("online_calibration.jsonl", aria, {}, FISHEYE, True),
    "Calibu poly3": (
        "rig.xml",
        lambda: calibu("_k1_k2_k3", (D[0], D[1], D[4])),
        {},
        (D[0], D[1], 0, 0, D[4]),
        False,
    ),
    "Calibu kb4": ("rig.xml", lambda: calibu("_kb4", FISHEYE), {}, FISHEYE, True),
    "Calibu in robot axes": (
        "rig.xml",
        lambda: calibu("_k1_k2", D[:2], np.roll(np.eye(3), 1, 0)),
        {},
        (*D[:2], 0, 0, 0),
        False,
    ),
    "flydra": ("cal.xml", flydra, {}, D[:4], False),
    "flydra in mm": ("cal.xml", lambda: flydra(scale=0.001), {}, D[:4], False),
}


@pytest.mark.parametrize("program", MANY)
@pytest.mark.filterwarnings("ignore:.*taken as")
def test_cameras_of_a_program_project_as_opencv_does(tmp_path: Path, program: str) -> None:
    file, content, options, d, fisheye = MANY[program]
    assert_same(read(tmp_path, file, content(), **options), d, fisheye)


#: Files of numbers or of numbered cameras: their names are other ones.
NUMBERED: dict[str, tuple[str, Callable[[], Any], dict[str, Any], list[str], tuple[float, ...]]] = {
    "KITTI raw": ("calib_cam_to_cam.txt", kitti, {}, ["00", "01", "02"], D),
    "CalLab": ("c.cal", callab, MM, ["0", "1", "2"], D),
    "OKVIS": ("okvis.yaml", okvis, {}, ["0", "1", "2"], D),
    "Argus sba": ("cal-sba-profile.txt", argus("sba"), S | M, ["1", "2", "3"], D),
}


@pytest.mark.parametrize("program", NUMBERED)
def test_numbered_cameras_of_a_program_project_as_opencv_does(tmp_path: Path, program: str) -> None:
    file, content, options, names, d = NUMBERED[program]
    cameras = read(tmp_path, file, content(), **options)
    assert list(cameras) == names
    assert_same(dict(zip(CAMERAS, cameras.values(), strict=True)), d)


SINGLE: dict[str, tuple[str, Callable[[], str], tuple[float, ...]]] = {
    "key = value": ("c.txt", ini(), D),
    "key: value": ("c.cfg", ini(": "), D),
    "key value": ("c.txt", ini(" "), D),
    "key, value": ("c.csv", ini(","), D),
    "rows under keys": ("c.txt", lambda: rows_under(":"), D),
    "rows under bare keys": ("c.txt", lambda: rows_under(""), D),
    "key = value;": ("c.txt", ini(" = ", ";"), D),
    "TOML": ("c.toml", toml, D),
    "printed arrays": ("c.txt", printed, D),
    "blue-c": ("c.cal", blue_c, D[:4]),
    "MultiCamSelfCal .cal": ("c.cal", stephi, (0, 0, 0, 0)),
    "EuRoC": ("cam0/sensor.yaml", euroc, D[:4]),
    "Kimera": ("LeftCameraParams.yaml", lambda: opencv_file(euroc(more="camera_id: left_cam\n")), D[:4]),
    "JARVIS": ("Camera_T.yaml", jarvis, D),
    "CalLab of one camera": ("c.cal", callab_of_one, D),
    "PROX": ("Color.json", prox, D),
    "RICH": ("000.xml", rich, D),
}


@pytest.mark.parametrize("program", SINGLE)
@pytest.mark.filterwarnings("ignore:.*taken as")
def test_one_camera_of_a_program_projects_as_opencv_does(tmp_path: Path, program: str) -> None:
    file, content, d = SINGLE[program]
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (camera,) = read(tmp_path, file, content(), size=SIZE, unit=1.0).values()
    wanted = CAMERAS["cam0"]
    assert_allclose(camera.project(wanted.points())[0], wanted.pixels(d), atol=1e-4)


@pytest.mark.parametrize("octave", [False, True])
def test_a_folder_of_multicamselfcal_is_a_rig(tmp_path: Path, octave: bool) -> None:
    write_selfcal(tmp_path, octave=octave)
    assert_same(read_calibration(tmp_path), D[:4])
    one = read_calibration(tmp_path / "camera2.Pmat.cal")
    assert list(one) == ["cam1"]


def test_cameras_of_nuscenes_have_the_names_of_their_channels(tmp_path: Path) -> None:
    write_nuscenes(tmp_path)
    assert_same(read_calibration(tmp_path / "calibrated_sensor.json", size=SIZE), (0, 0, 0, 0))


def test_wildtrack_is_read_as_a_folder_and_as_pairs(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    files = write_wildtrack(tmp_path)
    none = (0, 0, 0, 0)
    options: dict[str, Any] = {"size": SIZE, "unit": 0.01}
    assert_same(read_calibration(tmp_path, **options), none)
    reading = Reading("640x480", None, 0.01, None)
    assert_same(reading.cameras(files), none)
    assert_same(reading.cameras([*files[:3], *files[:2:-1]]), none)
    (alone,) = read_calibration(files[0], **options).values()
    assert_allclose(alone.center, CAMERAS["cam0"].center, atol=1e-6)
    assert not recwarn


def test_a_folder_of_euroc_has_a_folder_for_each_camera(tmp_path: Path) -> None:
    for i, name in enumerate(CAMERAS):
        (tmp_path / name).mkdir()
        (tmp_path / name / "sensor.yaml").write_text(euroc(i))
        (tmp_path / name / "data.txt").write_text("1403636579763555584 1403636579763555584.png\n")
    (tmp_path / "imu0").mkdir()
    (tmp_path / "imu0" / "sensor.yaml").write_text(
        "sensor_type: imu\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1]\n"
    )
    with pytest.warns(HumansimWarning, match="imu0/sensor.yaml: is not a known calibration format: ignored"):
        assert_same(read_calibration(tmp_path), D[:4])


@pytest.mark.parametrize(("model", "d"), [("perspective", D), ("fisheye", FISHEYE)])
def test_stereo_of_stella_has_the_pose_of_its_rectification(
    tmp_path: Path, model: str, d: tuple[float, ...]
) -> None:
    text, r, t = stella(d, model)
    cameras = read(tmp_path, "stella.yaml", text)
    assert list(cameras) == ["left", "right"]
    assert_allclose(cameras["right"].R, r, atol=1e-6)
    assert_allclose(cameras["right"].t, t, atol=1e-6)
    for name, wanted in (("left", "cam0"), ("right", "cam1")):
        assert_allclose(cameras[name].K, CAMERAS[wanted].K)
        assert_allclose(cameras[name].distortion[: len(d)], d)
        assert (cameras[name].model == "equidistant") == (model == "fisheye")


def test_streams_of_rs_enumerate_devices_are_seen_from_the_depth_camera(tmp_path: Path) -> None:
    cameras = read(tmp_path, "d435.txt", realsense_text())
    assert list(cameras) == ["Depth_640x480", "Color_640x480", "Color_1280x960"]
    depth, color = CAMERAS["cam0"], CAMERAS["cam1"]
    points = color.points()
    seen = cameras["Color_640x480"].project(points @ depth.R.T + depth.t)[0]
    assert_allclose(seen, color.pixels((0, 0, 0, 0)), atol=1e-5)
    assert list(read(tmp_path, "d435.txt", realsense_text(), size=(1280, 960))) == ["Color_1280x960"]
    with pytest.warns(HumansimWarning, match="inverse brown conrady is taken for plumb_bob"):
        cameras = read(tmp_path, "d435.txt", realsense_text(D))
    assert_allclose(cameras["Color_640x480"].distortion, D)


@pytest.mark.parametrize("kind", ["clicker", "camera"])
def test_profiles_of_argus_are_intrinsics(tmp_path: Path, kind: str) -> None:
    cameras = read(tmp_path, "profile.txt", argus(kind)(), size=SIZE)
    assert list(cameras) == ["1", "2", "3"]
    for camera, wanted in zip(cameras.values(), CAMERAS.values(), strict=True):
        assert camera.size == SIZE
        assert_allclose(camera.K, wanted.K)
        assert_allclose(camera.distortion, D)


@pytest.mark.parametrize(
    "more", ["Tr: ", "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: ", "R_rect 1 0 0 0 1 0 0 0 1\nTr_velo_cam "]
)
def test_transforms_beside_the_matrices_of_kitti_are_no_cameras(tmp_path: Path, more: str) -> None:
    c = CAMERAS["cam0"]
    p = [c.K @ np.column_stack([np.eye(3), [-0.5 * i, 0, 0]]) for i in range(4)]
    text = "".join(f"P{i}: {numbers(p[i])}\n" for i in range(4)) + f"{more}{numbers(np.eye(3, 4))}\n"
    cameras = read(tmp_path, "calib.txt", text, size=SIZE)
    assert list(cameras) == ["P0", "P1", "P2", "P3"]
    assert_allclose(cameras["P3"].center, [1.5, 0, 0], atol=1e-9)


def test_a_lens_with_another_k_than_p_is_fitted(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match="cam0: a lens with another K than P is written as"):
        cameras = read(tmp_path, "cal.xml", flydra(shift=3.0))
    for name, c in CAMERAS.items():
        normal = c.points() @ c.R.T + c.t
        straight = (normal / normal[:, 2:]) @ c.K.T
        k = c.K + np.array([[0, 0, 3.0], [0, 0, 0], [0, 0, 0]])
        bent = cv2.projectPoints(straight @ np.linalg.inv(k).T, np.zeros(3), np.zeros(3), k, np.array(D[:4]))[
            0
        ]
        assert_allclose(cameras[name].project(c.points())[0], bent[:, 0], atol=0.5)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.json", aria("FisheyeRadTanThinPrism"), "Name: the lens 'FisheyeRadTanThinPrism'"),
        ("rig.xml", calibu("_w", (0.9,)), "the lens 'calibu_fu_fv_u0_v0_w' with 5 numbers is not supported"),
        ("sensor.yaml", euroc(model="omni"), "distortion_model: unknown distortion model 'omni'"),
        ("k.yaml", euroc().replace("pinhole", "omni"), ":10: camera_model: unknown distortion model 'omni'"),
        ("s.calibration", skeletool().replace("radial      0", "radial  0.1"), "radial: unknown distortion"),
        ("okvis.yaml", okvis().replace("radialtangential8", "eucm"), "unknown distortion model 'eucm'"),
        ("a.calib", captury(), "the file has no image size: give the size"),
        ("a.csv", table(",")() + "cam9,640,480\n", ":5: has 3 columns, but the header has 18"),
        ("p.txt", argus("clicker")() + "4 900 640\n", ":4: needs 12, 10, 17 numbers, not 3"),
        ("a.calibration", skeletool().replace("intrinsic   ", "intrinsic   x"), "K or focal length"),
    ],
)
def test_what_is_not_read_is_named(tmp_path: Path, name: str, content: Any, said: str) -> None:
    with pytest.raises(CameraError, match=re.escape(said)):
        read(tmp_path, name, content)


WORLD_TO_CAMERA = (
    *("cam_from_world", "camera_from_world", "T_cam_world", "T_c_w", "T_cw", "world_to_cam", "world2camera"),
    *("cam_T_world", "H_world_to_cam", "world_to_camera_matrix", "extrinsics_w2c", "T_world2cam"),
    *("worldToCamera", "T_camera_from_world"),
)
CAMERA_TO_WORLD = (
    *("world_from_cam", "world_from_camera", "T_world_cam", "T_w_c", "T_wc", "cam_to_world", "camera2world"),
    *("world_T_cam", "H_cam_to_world", "camera_to_world_matrix", "extrinsics_c2w", "T_cam2world"),
    *("cameraToWorld", "camera_pose_c2w", "T_world_from_camera"),
)


def described(c: Wanted, **pose: Any) -> dict[str, Any]:
    return {"K": c.K.tolist(), "dist": list(D), "width": W, "height": H, **pose}


@pytest.mark.parametrize("key", [*WORLD_TO_CAMERA, *CAMERA_TO_WORLD])
def test_frames_in_a_key_tell_the_direction_of_a_matrix(
    tmp_path: Path, key: str, recwarn: pytest.WarningsRecorder
) -> None:
    pose = w2c if key in WORLD_TO_CAMERA else c2w
    content = {name: described(c, **{key: pose(c).tolist()}) for name, c in CAMERAS.items()}
    assert_same(read(tmp_path, "c.json", content, unit=1.0))
    assert not recwarn


@pytest.mark.parametrize(
    "direction",
    ["world_to_camera", "cw", "w2c", "cam_world", "cam_from_world", "camera_to_world", "wc", "world_cam"],
)
def test_frames_in_keys_tell_the_direction_of_r_and_t(
    tmp_path: Path, direction: str, recwarn: pytest.WarningsRecorder
) -> None:
    turned = direction in ("camera_to_world", "wc", "world_cam")
    content = {
        name: described(
            c,
            **{f"R_{direction}": (c.R.T if turned else c.R).tolist()},
            **{f"t_{direction}": (c.center if turned else c.t).tolist()},
        )
        for name, c in CAMERAS.items()
    }
    assert_same(read(tmp_path, "c.json", content, unit=1.0))
    assert not recwarn


def test_single_numbers_of_json_are_vectors(tmp_path: Path) -> None:
    content = {
        name: {
            **{key: float(value) for key, value in zip(("fx", "fy", "cx", "cy"), focal(c), strict=True)},
            **dict(zip(("qw", "qx", "qy", "qz"), quaternion(c.R), strict=True)),
            **{f"t{axis}": float(value) for axis, value in zip("xyz", c.t, strict=True)},
            "width": W,
            "height": H,
            "dist": list(D),
        }
        for name, c in CAMERAS.items()
    }
    assert_same(read(tmp_path, "c.json", content, unit=1.0))


def test_a_table_of_eleven_cameras_is_not_of_dlt_coefficients(tmp_path: Path) -> None:
    head = "fx,fy,cx,cy,width,height,k1,k2,p1,p2,k3"
    rows = "\n".join(f"7{i}0,690,310,245,640,480,-0.2,0,0,0,0" for i in range(11))
    cameras = read(tmp_path, "c.csv", f"{head}\n{rows}\n")
    assert list(cameras) == [str(i) for i in range(11)]
    assert cameras["3"].K[0, 0] == 730


def test_names_of_a_table_may_be_numbers(tmp_path: Path) -> None:
    cameras = read(tmp_path, "c.csv", "camera_id,fx,fy,cx,cy,width,height\n007,700,690,310,245,640,480\n")
    assert list(cameras) == ["007"]


def test_dotted_keys_of_openvslam_are_those_of_stella(tmp_path: Path) -> None:
    text, r, t = stella()
    lines, section = [], ""
    for line in text.splitlines():
        section = line if not line.startswith(" ") else section
        lines += [f"{section[:-1]}.{line.strip()}"] if line.startswith(" ") else []
    right = read(tmp_path, "vslam.yaml", "\n".join(lines))["right"]
    assert_allclose(right.R, r, atol=1e-6)
    assert_allclose(right.t, t, atol=1e-6)


def test_the_first_line_of_a_recording_of_aria_is_read(tmp_path: Path) -> None:
    text = f"{json.dumps(aria())}\n{json.dumps(aria('Linear'))}\n"
    assert_same(read(tmp_path, "online_calibration.jsonl", text), FISHEYE, True)


def test_equidistant_lenses_of_okvis_are_fisheyes(tmp_path: Path) -> None:
    text = okvis().replace("radialtangential8", "equidistant")
    text = text.replace(numbers((*D, 0, 0, 0), ", "), numbers(FISHEYE, ", "))
    assert_same(dict(zip(CAMERAS, read(tmp_path, "o.yaml", text).values(), strict=True)), FISHEYE, True)


def test_rx_ry_rz_are_a_rotation_vector_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(
        HumansimWarning, match="rx, ry, rz are taken as a rotation vector in radians, as in OpenCV"
    ):
        read(tmp_path, "c.txt", ini()(), unit=1.0)
    degrees = re.sub(r"^rx = .*", "rx = 20", ini()(), flags=re.MULTILINE)
    with pytest.raises(CameraError, match="is no rotation vector in radians: give a matrix, not angles"):
        read(tmp_path, "c.txt", degrees)


HOSTILE = {
    "headings": ("a.txt", "a = 1\n[" + "a" * 1_000_000),
    "a header of many columns": ("a.txt", ("fx fy cx cy w h " * 3000 + "\n") * 40),
    "blank lines before streams": ("a.txt", 'Intrinsic of "a" / 9x9\n' + "\n" * 500_000),
    "commas": ("a.toml", "[a]\nb = 1" + "," * 200_000),
    "digits of a profile": ("a.txt", "1 " + "9" * 60_000),
    "numbers for cameras": ("a.json", json.dumps({"CameraCalibrations": [5, None]})),
    "ragged parameters": (
        "a.json",
        json.dumps({"CameraCalibrations": [{"Projection": {"Params": [[1], [2, [3]]]}}]}),
    ),
    "no mapping": ("a.yaml", "- StereoRectifier: {K_left: 1}\n- Camera: {fx: 0}\n"),
    "an empty rig": ("a.xml", "<rig><camera><camera_model/></camera></rig>"),
    "an empty matrix": ("camera1.Pmat.cal", ""),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_refused_at_once(tmp_path: Path, kind: str) -> None:
    start = time.process_time()
    with pytest.raises(CameraError):
        read(tmp_path, *HOSTILE[kind])
    assert time.process_time() - start < 5
