"""Camera info of ROS, and camera chains of Kalibr.

- YAML files of camera_calibration, printed messages, and the older INI files. Names and order are as in
  ROS's camera_calibration_parsers. Neither format stores extrinsics.
- camchain.yaml and camchain-imucam.yaml of Kalibr: x_cn = T_cn_cnm1 x_cn-1, metres. The world frame is the
  first camera, or the IMU if the file has T_cam_imu, or T_imu_cam (its inverse) as in OpenVINS.
  Omnidirectional models are refused. https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.formats.base import (
    CalibrationFile,
    Key,
    RawCamera,
    SourceLocation,
    check_count,
    find_model,
    row,
)
from humansim_ros.cameras.formats.table import calibration_format
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.geometry import invert_rigid, nearest_rotations, transform
from humansim_ros.types import Array

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_/-]*")
#: Words that YAML does not read as text, such as yes.
_WORDS = {"yes", "no", "on", "off", "true", "false", "null", "y", "n"}
#: Key paths of the camera parameters in a file and in a message.
_IN_FILE: dict[str, tuple[Key, ...]] = {
    "size": ("image_width",),
    "K": ("camera_matrix", "data"),
    "distortion": ("distortion_coefficients", "data"),
    "model": ("distortion_model",),
    "rectification": ("rectification_matrix", "data"),
    "rectified": ("projection_matrix", "data"),
}
_IN_MESSAGE = {
    "K": "k",
    "distortion": "d",
    "model": "distortion_model",
    "rectification": "r",
    "rectified": "p",
}


def _is_camera_info(file: CalibrationFile) -> bool:
    # matrices of OpenCV have the type Matrix, not dict
    of_file = type(file.get("camera_matrix")) is dict and "image_width" in file.document
    return of_file or _is_message(file)


def _is_message(file: CalibrationFile) -> bool:
    keys = file.document if isinstance(file.document, dict) else {}
    return {"height", "width", "distortion_model", "k", "p"} <= {str(key).lower() for key in keys}


def _read_camera_info(file: CalibrationFile) -> dict[str, RawCamera]:
    if _is_message(file):
        return _read_message(file)
    size = file.size(("image_width",), ("image_height",))
    if (
        file.get("distortion_coefficients", "data") is None
    ):  # a truncated file must not become a camera without distortion
        raise file.error("is missing; a camera without distortion has zeros", "distortion_coefficients")
    name = str(file.get("camera_name") or "").strip()
    keys = _IN_FILE
    bent = str(file.get("camera_model")).lower().startswith(("fisheye", "equi", "kannala"))
    if bent and file.get(*keys["model"]) is None:
        keys = {**keys, "model": ("camera_model",)}
    return {name or Path(file.path).stem: _camera(file, size, keys)}


def _read_message(file: CalibrationFile) -> dict[str, RawCamera]:
    """Read a message that ``ros2 topic echo`` has printed. In ROS 1, names of matrices are capital
    letters."""
    spelling = {str(key).lower(): key for key in file.document}
    keys: dict[str, tuple[Key, ...]] = {part: (spelling.get(k, k),) for part, k in _IN_MESSAGE.items()}
    camera = _camera(file, file.size((spelling["width"],), (spelling["height"],)), keys)
    parts = ("x_offset", "y_offset", "height", "width")
    binned = any(file.get(key) not in (None, 0, 1) for key in ("binning_x", "binning_y"))
    if binned or any(file.get("roi", part) for part in parts):
        warn_about(file.path, "binning and region of interest are ignored: the camera has the full image")
    frame = str(file.get("header", "frame_id") or "").strip()
    return {frame.removesuffix("_optical_frame") or Path(file.path).stem: camera}


def _camera(file: CalibrationFile, size: tuple[int, int], keys: Mapping[str, tuple[Key, ...]]) -> RawCamera:
    k = file.numbers((3, 3), *keys["K"])
    if not k.any():
        raise file.error("is all zeros, which means 'not calibrated' in ROS", *keys["K"])
    distortion = file.optional_numbers(*keys["distortion"])
    return RawCamera(
        k,
        size=size,
        distortion=tuple(distortion),
        model=find_model(file, file.get(*keys["model"]), distortion, keys["model"], keys["distortion"]),
        rectification=_matrix(file, (3, 3), keys["rectification"]),
        rectified=_matrix(file, (3, 4), keys["rectified"]),
        locations={part: file.location(*path) for part, path in keys.items()},
    )


def _matrix(file: CalibrationFile, shape: tuple[int, ...], keys: tuple[Key, ...]) -> Array | None:
    """Matrix. It may be missing or all zeros, since drivers that do not rectify write zeros."""
    if file.get(*keys) is None:
        return None
    matrix = file.numbers(shape, *keys)
    return matrix if matrix.any() else None


def _write_camera_info(cameras: Mapping[str, Camera]) -> dict[str, str]:
    ((name, camera),) = cameras.items()
    plain = _PLAIN.fullmatch(name) and name.lower() not in _WORDS
    lines = [
        f"image_width: {camera.size[0]}",
        f"image_height: {camera.size[1]}",
        f"camera_name: {name if plain else json.dumps(name)}",
        *_matrix_lines("camera_matrix", camera.K),
        f"distortion_model: {camera.model}",
        *_matrix_lines("distortion_coefficients", np.array([camera.distortion])),
        *_matrix_lines("rectification_matrix", camera.rectification_matrix),
        *_matrix_lines("projection_matrix", camera.rectified_projection),
    ]
    return {"": "\n".join(lines) + "\n"}


def _matrix_lines(key: str, matrix: Array) -> list[str]:
    rows, columns = matrix.shape
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{row(matrix.ravel(), ', ')}]"]


# -- INI files of the Videre software: a line with a key, then lines with its numbers

_INI_SHAPES = {"camera matrix": (3, 3), "rectification": (3, 3), "projection": (3, 4)}
#: Sections that are not cameras. ROS ignores the second one.
_IMAGE, _EXTERNALS = "image", "externals"
_MAX_NUMBERS = 50
_HEADING = re.compile(r"\[(.*)\]")


def _is_ini(file: CalibrationFile) -> bool:
    first = next(iter(file.head), "")
    assigns = any("=" in line or ":" in line for line in file.head[1:])
    return _HEADING.fullmatch(first) is not None and any(c.isalpha() for c in first) and not assigns


def _read_ini(file: CalibrationFile) -> dict[str, RawCamera]:
    sections = _sections(file)
    size = tuple(_whole(file, sections, key) for key in ("width", "height"))
    cameras: dict[str, RawCamera] = {}
    for name, (line, section) in sections.items():
        if name not in (_IMAGE, _EXTERNALS):
            camera = _ini_camera(file, name, line, section, (size[0], size[1]))
            file.add(cameras, name or Path(file.path).stem, camera, line=line)
    if not cameras:
        raise CameraError("the file has no section of a camera, such as [narrow_stereo]", path=file.path)
    return cameras


_Section = dict[str, tuple[int, list[float]]]


def _sections(file: CalibrationFile) -> dict[str, tuple[int, _Section]]:
    """Sections by name. Each has its line, and its keys with their lines and numbers."""
    sections: dict[str, tuple[int, _Section]] = {}
    section: _Section = {}
    values: list[float] | None = None
    for number, line in file.lines():
        heading = _HEADING.fullmatch(line)
        if heading:
            name, section, values = heading[1].strip(), {}, None
            if name in sections:
                raise CameraError("this section is duplicate", path=file.path, line=number, key=name)
            sections[name] = number, section
        elif any(c.isalpha() for c in line.split()[0]) and line.split()[0].lower() not in ("nan", "inf"):
            values = []
            if line in section:
                raise CameraError("this key is duplicate", path=file.path, line=number, key=line)
            section[line] = number, values
        elif values is None:
            raise CameraError("numbers without a key above them", path=file.path, line=number)
        else:
            values += file.row(line.split(), number)
            if len(values) > _MAX_NUMBERS:
                raise CameraError(f"more than {_MAX_NUMBERS} numbers for a key", path=file.path, line=number)
    return sections


def _whole(file: CalibrationFile, sections: Mapping[str, tuple[int, _Section]], key: str) -> int:
    line, values = _values(file, sections.get(_IMAGE, (None, {}))[1], _IMAGE, key)
    if len(values) != 1 or values[0] != int(values[0]) or values[0] <= 0:
        raise CameraError("needs a whole number above zero", path=file.path, line=line, key=key)
    return int(values[0])


def _values(file: CalibrationFile, section: _Section, name: str, key: str) -> tuple[int, list[float]]:
    if key not in section:
        raise CameraError(f"is missing in section [{name}]", path=file.path, key=key)
    return section[key]


def _ini_camera(
    file: CalibrationFile, name: str, line: int, section: _Section, size: tuple[int, int]
) -> RawCamera:
    matrices, locations = {}, {"": SourceLocation(name, line)}
    for key, shape in _INI_SHAPES.items():
        key_line, values = _values(file, section, name, key)
        if len(values) != shape[0] * shape[1]:
            message = f"needs {shape[0]} x {shape[1]} numbers, not {len(values)}"
            raise CameraError(message, path=file.path, line=key_line, key=key)
        matrices[key], locations[key] = np.reshape(values, shape), SourceLocation(key, key_line)
    key_line, distortion = _values(file, section, name, "distortion")
    if len(distortion) not in (4, 5, 8):
        message = f"needs 5 coefficients (plumb_bob) or 8 (rational_polynomial), not {len(distortion)}"
        raise CameraError(message, path=file.path, line=key_line, key="distortion")
    return RawCamera(
        matrices["camera matrix"],
        size=size,
        distortion=tuple(distortion),
        model="rational_polynomial" if len(distortion) == 8 else "plumb_bob",
        rectification=matrices["rectification"],
        rectified=matrices["projection"],
        locations={
            "": locations[""],
            "K": locations["camera matrix"],
            "distortion": SourceLocation("distortion", key_line),
            "rectification": locations["rectification"],
            "rectified": locations["projection"],
        },
    )


def _write_ini(cameras: Mapping[str, Camera]) -> dict[str, str]:
    ((name, camera),) = cameras.items()
    if name in (_IMAGE, _EXTERNALS) or any(c in "[]\n\r" for c in name) or not name.strip():
        raise CameraError("this format cannot store a camera of this name", key=name)
    parts: dict[str, Any] = {
        "camera matrix": camera.K,
        "distortion": np.array([camera.distortion]),
        "rectification": camera.rectification_matrix,
        "projection": camera.rectified_projection,
    }
    lines = ["# Camera intrinsics", "", "[image]", "", "width", str(camera.size[0]), ""]
    lines += ["height", str(camera.size[1]), "", f"[{name}]"]
    for key, matrix in parts.items():
        lines += ["", key, *(row(values) for values in matrix)]
    return {"": "\n".join(lines) + "\n"}


CAMERA_INFO = calibration_format("camera_info", _is_camera_info, _read_camera_info, _write_camera_info)
INI = calibration_format("ini", _is_ini, _read_ini, _write_ini)


#: Rounding explains errors of orthonormality up to this.
_ROUNDING = 1e-3
_CAMERA = re.compile(r"cam[0-9]+")
#: Extrinsics of the IMU: from the IMU to the camera, and the inverse.
_IMU = ("T_cam_imu", "T_imu_cam")
_MODELS = {"radtan": "plumb_bob", "equidistant": "equidistant", "equi": "equidistant", "none": None}


def _names(file: CalibrationFile) -> list[str]:
    keys = file.document if isinstance(file.document, dict) else {}
    return [key for key in keys if isinstance(key, str) and _CAMERA.fullmatch(key)]


def _is_camchain(file: CalibrationFile) -> bool:
    return any(isinstance(file.get(name, "camera_model"), str) for name in _names(file))


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    names = _names(file)
    pose: Array | None = None
    for name in names:
        # if the first camera has extrinsics of the IMU, the chain starts at the IMU
        imu = next((key for key in _IMU if file.get(name, key) is not None), None)
        if imu is not None and (pose is None or file.get(names[0], imu) is not None):
            pose, key = file.pose_matrix(name, imu, rows=4), imu
            pose = invert_rigid(_rigid(pose)) if imu == "T_imu_cam" else pose
        elif pose is None:
            pose, key = np.eye(4), "T_cn_cnm1"
        else:
            pose, key = file.pose_matrix(name, "T_cn_cnm1", rows=4) @ pose, "T_cn_cnm1"
        file.add(cameras, name, _camera_kalibr(file, name, pose, key), name)
    return cameras


def _rigid(matrix: Array) -> Array:
    """The same transform with an exact rotation, if rounding explains its error."""
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROUNDING:
        return matrix
    return transform(nearest_rotations(rotation), matrix[:3, 3])


def _camera_kalibr(file: CalibrationFile, name: str, pose: Array, pose_key: str) -> RawCamera:
    if file.need(name, "camera_model") != "pinhole":
        message = f"{file.get(name, 'camera_model')!r} is not a supported camera model; only pinhole is"
        raise file.error(message, name, "camera_model")
    fx, fy, cx, cy = file.numbers((4,), name, "intrinsics")
    word = str(file.get(name, "distortion_model") or "none").lower()
    if word not in _MODELS:
        message = f"unknown distortion model {word!r}; known are {', '.join(_MODELS)}"
        raise file.error(message, name, "distortion_model")
    model = _MODELS[word]
    distortion: Array = np.zeros(0)
    if model is not None:
        distortion = file.numbers((4,), name, "distortion_coeffs")
        check_count(file, model, distortion, (name, "distortion_coeffs"))
    file.numbers((2,), name, "resolution")
    return RawCamera(
        pinhole(fx, fy, cx, cy),
        pose[:3, :3],
        pose[:3, 3],
        size=file.size((name, "resolution", 0), (name, "resolution", 1)),
        distortion=tuple(distortion),
        model=model,
        locations=file.locations(
            (name,), K="intrinsics", distortion="distortion_coeffs", R=pose_key, t=pose_key, size="resolution"
        ),
    )


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    poses = [camera.optical_from_world for camera in cameras.values()]
    at_first = np.array_equal(poses[0], np.eye(4))
    lines = [] if at_first else ["# T_cam_imu: from the world, metres, to each camera"]
    for index, (name, camera) in enumerate(cameras.items()):
        model = "none" if not camera.distorted else _model_name(camera)
        k = camera.K
        lines += [f"cam{index}:", "  cam_overlaps: []", "  camera_model: pinhole"]
        lines += [f"  intrinsics: [{row((k[0, 0], k[1, 1], k[0, 2], k[1, 2]), ', ')}]"]
        lines += [f"  distortion_model: {model}"]
        lines += [f"  distortion_coeffs: [{row(camera.distortion[:4] if model != 'none' else (), ', ')}]"]
        lines += [f"  resolution: [{camera.size[0]}, {camera.size[1]}]", f"  rostopic: {_topic(name)}"]
        if index:
            lines += _matrix_lines_kalibr("T_cn_cnm1", poses[index] @ invert_rigid(poses[index - 1]))
        if not at_first:
            lines += _matrix_lines_kalibr("T_cam_imu", poses[index])
    return {"": "\n".join(lines) + "\n"}


def _model_name(camera: Camera) -> str:
    return "equidistant" if camera.model == "equidistant" else "radtan"


def _topic(name: str) -> str:
    return f"/{re.sub('[^A-Za-z0-9_]', '_', name)}/image_raw"


def _matrix_lines_kalibr(key: str, matrix: Array) -> list[str]:
    return [f"  {key}:", *(f"  - [{row(values, ', ')}]" for values in matrix)]


KALIBR = calibration_format("kalibr", _is_camchain, _read, _write)
