"""Stand-ins for calibration files of other people, written from known cameras; and checks of wrong files.

stand_in = CALIBRATIONS["own_shelf.json"]
calibration_path("own_shelf.json")      # the file, written once per test run; or a shared file
stand_in.cameras["0"].center            # what must be read from it
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SHARED_DATA
from numpy.typing import NDArray

from humansim_ros.cameras import read_calibration
from humansim_ros.errors import CameraError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class KnownCamera:
    """A camera, x_cam = R x + t in metres.

    ``rectification`` (3, 3) and ``projection`` (3, 4) are those of a ROS camera_info.
    """

    size: tuple[int, int]
    K: Array
    R: Array
    t: Array
    distortion: tuple[float, ...] = ()
    rectification: Array | None = None
    projection: Array | None = None

    @property
    def center(self) -> Array:
        return np.asarray(-self.R.T @ self.t)


@dataclass(frozen=True)
class CalibrationStandIn:
    """A calibration file: name of its format, text, and its cameras."""

    form: str
    text: str
    cameras: Mapping[str, KnownCamera]


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def aimed(
    size: tuple[int, int],
    k: Array,
    center: Sequence[float],
    target: Sequence[float],
    distortion: tuple[float, ...] = (),
) -> KnownCamera:
    """A camera at a place that looks at another one; z is up, image rows are horizontal.

    Args:
        size: Width and height.
        k: (3, 3).
        center: Place in metres.
        target: What it looks at.
        distortion: k1 k2 p1 p2 k3.
    """
    forward = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return KnownCamera(size, k, rotation, -rotation @ np.array(center, dtype=float), distortion)


def _numbers(values: Array | Sequence[float]) -> str:
    return " ".join(map(repr, np.ravel(values).astype(float).tolist()))


# Shelf and Campus as VoxelPose has them: T is the place of the camera in millimetres


def _shelf(size: tuple[int, int], count: int, focal: float, centers_off: int) -> CalibrationStandIn:
    rng = np.random.default_rng(centers_off)
    cameras = {}
    for number in range(count):
        angle = 2 * np.pi * number / count
        center = (3.1 * np.cos(angle), 2.7 * np.sin(angle), 1.5 + 0.1 * number)
        principal = np.array(size) / 2 + rng.uniform(-0.03, 0.03, 2) * size
        k = intrinsics(focal * rng.uniform(0.98, 1.02), focal, *principal)
        cameras[str(number)] = aimed(size, k, center, (0.1, 0, 1))
    data = {
        name: {
            "k": [[0.0]] * 3,
            "p": [[0.0]] * 2,
            "R": camera.R.tolist(),
            "T": (1000 * camera.center[:, None]).tolist(),
            **{key: float(camera.K[at]) for key, at in
               (("fx", (0, 0)), ("fy", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2)))},
        }
        for name, camera in cameras.items()
    }  # fmt: skip
    return CalibrationStandIn("shelf", json.dumps(data, indent=2), cameras)


# Human3.6M: x = R X + t in millimetres, a pose for each subject and camera

_SERIALS = {
    "54138969": (1000, 1002),
    "55011271": (1000, 1000),
    "58860488": (1000, 1000),
    "60457274": (1000, 1002),
}
#: k1 k2 p1 p2 k3
_LENS = (-0.2071, 0.2478, -0.0014, -0.00098, -0.0031)


def _human36m() -> CalibrationStandIn:
    cameras = {}
    intrinsic: dict[str, object] = {}
    extrinsic: dict[str, dict[str, object]] = {f"S{subject}": {} for subject in range(1, 12)}
    for number, (serial, size) in enumerate(_SERIALS.items()):
        k = intrinsics(1145.0 + number, 1143.8, 512.5, 515.5 - number)
        intrinsic[serial] = {"calibration_matrix": k.tolist(), "distortion": list(_LENS)}
        for subject in range(1, 12):
            corner = ((-1) ** number * 2.0, (1 if number < 2 else -1) * (4.5 + 0.1 * subject), 1.5)
            camera = aimed(size, k, corner, (0.1 * subject, 0, 0.9), _LENS)
            cameras[f"S{subject}_{serial}"] = camera
            t = (1000 * camera.t[:, None]).tolist()
            extrinsic[f"S{subject}"][serial] = {"R": camera.R.tolist(), "t": t}
    data = {"intrinsics": intrinsic, "extrinsics": extrinsic}
    order = [f"S{subject}_{serial}" for subject in range(1, 12) for serial in _SERIALS]
    return CalibrationStandIn("human36m", json.dumps(data), {name: cameras[name] for name in order})


# Middlebury: name K R t on one line


def _middlebury() -> CalibrationStandIn:
    """Sixteen cameras around a model at 57 cm, as a robot's arm moves them."""
    k, middle = intrinsics(1520.4, 1525.9, 302.32, 246.87), np.array([-0.03, 0.05, -0.02])
    cameras = {}
    for number in range(16):
        azimuth, height = 2 * np.pi * number / 16, 0.4 * np.sin(number)
        way = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
        cameras[f"temple{number + 1:04d}"] = aimed((640, 480), k, middle + 0.57 * way, middle)
    lines = [f"{name}.png {_numbers(c.K)} {_numbers(c.R)} {_numbers(c.t)}" for name, c in cameras.items()]
    return CalibrationStandIn("middlebury", "\n".join(["16", *lines]) + "\n", cameras)


# ROS


def _small_turn(x: float, y: float, z: float) -> Array:
    """Rotation by small angles, exact."""
    vector = np.array([x, y, z])
    angle = np.linalg.norm(vector)
    a = vector / angle if angle else vector
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _monocular(
    size: tuple[int, int], k: Array, distortion: tuple[float, ...], turn: Array, projection: Array
) -> KnownCamera:
    return KnownCamera(size, k, np.eye(3), np.zeros(3), distortion, turn, projection)


def _ros(name: str, camera: KnownCamera) -> CalibrationStandIn:
    assert camera.rectification is not None and camera.projection is not None
    matrices = {
        "camera_matrix": camera.K,
        "distortion_coefficients": np.array([camera.distortion]),
        "rectification_matrix": camera.rectification,
        "projection_matrix": camera.projection,
    }
    lines = [f"image_width: {camera.size[0]}", f"image_height: {camera.size[1]}", f"camera_name: {name}"]
    for key, matrix in matrices.items():
        data = ", ".join(map(repr, matrix.ravel().astype(float).tolist()))
        lines += [f"{key}:", f"  rows: {len(matrix)}", f"  cols: {matrix.shape[1]}", f"  data: [{data}]"]
        if key == "camera_matrix":
            lines.append("distortion_model: plumb_bob")
    return CalibrationStandIn("camera_info", "\n".join(lines) + "\n", {name: camera})


def _ini(camera: KnownCamera) -> CalibrationStandIn:
    assert camera.rectification is not None and camera.projection is not None

    def rows(matrix: Array) -> str:
        return "\n".join(" ".join(f"{value:.6f}" for value in row) for row in np.atleast_2d(matrix))

    parts = (
        ("camera matrix", camera.K),
        ("distortion", np.array(camera.distortion)),
        ("rectification", camera.rectification),
        ("projection", camera.projection),
    )
    text = (
        f"# oST version 5.0 parameters\n\n[image]\n\nwidth\n{camera.size[0]}\n\nheight\n{camera.size[1]}\n\n"
    )
    text += "[mono_left]\n\n" + "".join(f"{name}\n{rows(matrix)}\n\n" for name, matrix in parts)
    return CalibrationStandIn("ini", text, {"mono_left": camera})


def _with_p(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.hstack([intrinsics(fx, fy, cx, cy), np.zeros((3, 1))])


_FIVE = (-0.363528, 0.115856, 0.003531, 0.000197, 0.0)
_EIGHT = (0.189544, -0.018229, -0.00063, 0.000054, -0.000212, 0.543582, -0.027892, 0.0)
_HD = intrinsics(999.46, 996.96, 642.26, 474.15)
_NARROW = intrinsics(369.344588, 367.15433, 320.739078, 203.59245)
CALIBRATIONS: dict[str, CalibrationStandIn] = {
    "own_shelf.json": _shelf((1032, 776), 5, 1070.0, 1),
    "own_campus.json": _shelf((360, 288), 3, 440.0, 2),
    "own_human36m.json": _human36m(),
    "own_middlebury_par.txt": _middlebury(),
    "own_5.ini": _ini(
        _monocular((640, 480), _NARROW, _FIVE, np.eye(3), _with_p(262.927429, 302.056213, 320.98, 188.59))
    ),
    "own_8.ini": _ini(
        _monocular((640, 480), _NARROW, _EIGHT, np.eye(3), _with_p(262.927429, 302.056213, 320.98, 188.59))
    ),
    # a camera of a stereo pair: R is not I, and P is not K
    "own_stereo.yaml": _ros(
        "left_camera",
        _monocular(
            (640, 480),
            intrinsics(438.783367, 437.302876, 305.593336, 243.738352),
            (-0.361976, 0.11051, 0.001014, 0.000505, 0.0),
            _small_turn(0.0044, -0.006, -0.0028),
            _with_p(393.6538, 393.6538, 322.797939, 241.090902),
        ),
    ),
    "own_1280x720.yaml": _ros(
        "hd",
        _monocular(
            (1280, 720), intrinsics(1010, 1008, 632, 361), _FIVE, np.eye(3), _with_p(1000, 1002, 630, 360)
        ),
    ),
    "own_410x308.yaml": _ros(
        "small",
        _monocular(
            (410, 308), intrinsics(320, 319, 205, 152), _FIVE, np.eye(3), _with_p(318, 317, 204, 151)
        ),
    ),
    # its K is that of 1280x960
    "own_mislabelled_1640x1232.yaml": _ros(
        "mislabelled", _monocular((1640, 1232), _HD, _FIVE, np.eye(3), _with_p(1022.1, 1021.6, 642.2, 471.9))
    ),
}  # fmt: skip


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="humansim_calibrations_")


@cache
def calibration_path(name: str) -> Path:
    """A stand-in, or a shared file."""
    if name not in CALIBRATIONS:
        return SHARED_DATA / "calib" / name
    path = Path(_folder().name) / name
    path.write_text(CALIBRATIONS[name].text)
    return path


# Wrong files


def changed(document: Mapping[str, Any], path: str, value: Any) -> str:
    """JSON with a changed value at a path such as cameras.0.K; None removes it."""
    copy = json.loads(json.dumps(document))
    place, (*keys, last) = copy, path.split(".")
    for key in keys:
        place = place[int(key) if isinstance(place, list) else key]
    if value is None:
        del place[last]
    else:
        place[int(last) if isinstance(place, list) else last] = value
    return json.dumps(copy)


def assert_refused(folder: Path, text: str, said: str) -> None:
    """A calibration file with this text is refused with its path and a message."""
    path = folder / "calibration"
    path.write_text(text)
    with pytest.raises(CameraError) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(str(path)) and said in str(caught.value)


def assert_refused_within(folder: Path, text: str, seconds: float) -> None:
    """A calibration file with this text is refused within seconds of processor time."""
    path = folder / "calibration"
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(CameraError):
        read_calibration(path)
    assert time.process_time() - start < seconds
