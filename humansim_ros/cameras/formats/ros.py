"""Camera info of ROS, camera chains of Kalibr, and FileStorage files of OpenCV.

- YAML files of camera_calibration, printed messages, and the older INI files. Names and order are as in
  ROS's camera_calibration_parsers. Neither format stores extrinsics.
- camchain.yaml and camchain-imucam.yaml of Kalibr: x_cn = T_cn_cnm1 x_cn-1, metres. The world frame is the
  first camera, or the IMU if the file has T_cam_imu, or T_imu_cam (its inverse) as in OpenVINS.
  Omnidirectional models are refused. https://github.com/ethz-asl/kalibr/wiki/yaml-formats
- FileStorage of OpenCV (YAML, XML, JSON), with the keys of its samples and of other programs: one camera
  (camera_matrix, distortion_coefficients, R, T), a stereo pair (M1, D1, M2, D2, R, T, R1, P1 …), or many
  cameras (K_left, dist_left, Rot_left, T_left, as in EasyMocap). Intrinsics and extrinsics are in one file,
  or in two with intri and extri in their names. x_cam = R x + T in the unit of the calibration board.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.formats.base import CalibrationFile, RawCamera
from humansim_ros.cameras.formats.conventions import find_model
from humansim_ros.cameras.formats.spellings import POSE, Found, find_parameters, plain
from humansim_ros.cameras.formats.syntax import Matrix, name_of_half, other_half, read_document
from humansim_ros.cameras.formats.table import (
    ROWS,
    Cameras,
    Values,
    calibration_format,
    nested,
    reader,
    yaml_file,
)
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.geometry import invert_rigid, nearest_rotations, transform
from humansim_ros.types import Array

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_/-]*")
#: Words that YAML does not read as text, such as yes.
_WORDS = {"yes", "no", "on", "off", "true", "false", "null", "y", "n"}
#: Keys of K, distortion and the matrices of the rectified image in a file.
_MATRICES = ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix")


def _is_camera_info(file: CalibrationFile) -> bool:
    # matrices of OpenCV have the type Matrix, not dict
    of_file = type(file.get("camera_matrix")) is dict and "image_width" in file.document
    return of_file or _is_message(file)


def _is_message(file: CalibrationFile) -> bool:
    keys = file.document if isinstance(file.document, dict) else {}
    return {"height", "width", "distortion_model", "k", "p"} <= {str(key).lower() for key in keys}


def _camera_info(file: CalibrationFile) -> Cameras:
    """Keys of a file, or of a message that ``ros2 topic echo`` has printed. In ROS 1, names of matrices in
    messages are capital letters."""
    message = _is_message(file)
    spelling = {str(key).lower(): key for key in file.document}
    parts = ("k", "d", "r", "p") if message else _MATRICES
    k, d, *rectified = ((spelling.get(part, part), *(() if message else ("data",))) for part in parts)
    if not message and not file.has(*d):
        # a truncated file must not become a camera without distortion
        raise file.error("is missing; a camera without distortion has zeros", *d[:1])
    if not file.numbers((3, 3), *k).any():
        raise file.error("is all zeros, which means 'not calibrated' in ROS", *k)
    width, height = ("width", "height") if message else ("image_width", "image_height")
    file.size((width,), (height,))
    bent = str(file.get("camera_model")).lower().startswith(("fisheye", "equi", "kannala"))
    model = "camera_model" if bent and not file.has("distortion_model") else "distortion_model"
    lens = find_model(file, file.get(model), file.optional_numbers(*d), (model,), d)
    # drivers that do not rectify write zeros
    used = [matrix[0] for matrix in rectified if file.has(*matrix) and file.some_numbers(*matrix).any()]
    kept = {key: file.get(key) for key in (width, height, k[0], d[0], *used)}
    name = file.get("header", "frame_id") if message else file.get("camera_name")
    name = str(name or "").strip()
    if message:
        name = name.removesuffix("_optical_frame")
        region = any(file.get("roi", part) for part in ("x_offset", "y_offset", "height", "width"))
        if region or any(file.get(key) not in (None, 0, 1) for key in ("binning_x", "binning_y")):
            warn_about(file.path, "binning and region of interest are ignored: the camera has the full image")
    return {**kept, model: lens or "none", "camera_name": name}


def _info_values(own: Values, camera: Camera) -> Values:
    name = own["name"]
    plain = _PLAIN.fullmatch(name) and name.lower() not in _WORDS
    return {"quoted": name if plain else json.dumps(name)}


# -- INI files of the Videre software: a line with a key, then lines with its numbers

#: Shapes of the matrices of each camera.
_IN_SECTION = {"camera_matrix": (3, 3), "rectification": (3, 3), "projection": (3, 4)}
#: Sections that are not cameras. ROS ignores the second one.
_IMAGE, _EXTERNALS = "image", "externals"
_HEADING = re.compile(r"\[([^\[\],;=\n\r]*[A-Za-z][^\[\],;=\n\r]*)\]")


def _is_ini(file: CalibrationFile) -> bool:
    first = next(iter(file.head), "")
    assigns = any("=" in line or ":" in line for line in file.head[1:])
    return _HEADING.fullmatch(first) is not None and not assigns


def _read_ini(file: CalibrationFile) -> dict[str, RawCamera]:
    file = plain(replace(file, text=file.text.replace("camera matrix", "camera_matrix")))
    file.size((_IMAGE, "width"), (_IMAGE, "height"))
    document = {name: section for name, section in file.document.items() if name != _EXTERNALS}
    for name in [name for name in document if name != _IMAGE]:
        for key, shape in _IN_SECTION.items():
            file.numbers(shape, name, key)
        count = len(file.some_numbers(name, "distortion"))
        model = "rational_polynomial" if count == 8 else "plumb_bob"
        document[name] = {**document[name], "name": name, "distortion_model": model}
    return reader(ROWS["ini"])(replace(file, document=document))


def _ini_values(own: Values, camera: Camera) -> Values:
    name = own["name"]
    if name in (_IMAGE, _EXTERNALS) or _HEADING.fullmatch(f"[{name}]") is None:
        raise CameraError("this format cannot store a camera of this name", key=name)
    return {}


CAMERA_INFO = calibration_format("camera_info", _is_camera_info, arrange=_camera_info, values=_info_values)
INI = calibration_format("ini", _is_ini, _read_ini, values=_ini_values)


#: Rounding explains errors of orthonormality up to this.
_ROUNDING = 1e-3
_CAMERA = re.compile(r"cam[0-9]+")
#: Keys of the transforms from the IMU to the camera, and from the camera to the IMU.
_IMU = ("T_cam_imu", "T_imu_cam")
_MODELS = ("radtan", "equidistant", "equi", "none")


def _kalibr_names(file: CalibrationFile) -> list[str]:
    keys = file.document if isinstance(file.document, dict) else {}
    return [key for key in keys if isinstance(key, str) and _CAMERA.fullmatch(key)]


def _kalibr(file: CalibrationFile) -> Cameras:
    cameras: dict[str, Any] = {}
    names = _kalibr_names(file)
    pose: Array | None = None
    for name in names:
        # if the first camera has extrinsics of the IMU, the chain starts at the IMU
        key = file.first((name,), *_IMU) or "T_cn_cnm1"
        if key in _IMU and (pose is None or file.has(names[0], key)):
            pose = file.pose_matrix(name, key)
            pose = invert_rigid(_rigid(pose)) if key == "T_imu_cam" else pose
        else:
            key = "T_cn_cnm1"
            pose = np.eye(4) if pose is None else file.pose_matrix(name, key) @ pose
        if file.need(name, "camera_model") != "pinhole":
            message = f"{file.get(name, 'camera_model')!r} is not a supported camera model; only pinhole is"
            raise file.error(message, name, "camera_model")
        word = str(file.get(name, "distortion_model") or "none").lower()
        if word not in _MODELS:
            message = f"unknown distortion model {word!r}; known are {', '.join(_MODELS)}"
            raise file.error(message, name, "distortion_model")
        counts = {"intrinsics": 4, "resolution": 2, **({} if word == "none" else {"distortion_coeffs": 4})}
        numbers = {part: nested(file.numbers((count,), name, part)) for part, count in counts.items()}
        cameras[name] = {**numbers, "distortion_model": word, key: nested(pose)}
    return cameras


def _rigid(matrix: Array) -> Array:
    """The same transform (4, 4), with an exact rotation if the error can come from rounding."""
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROUNDING:
        return matrix
    return transform(nearest_rotations(rotation), matrix[:3, 3])


def _write_kalibr(cameras: Mapping[str, Camera]) -> dict[str, str]:
    poses = [camera.optical_from_world for camera in cameras.values()]
    at_first = np.array_equal(poses[0], np.eye(4))
    content = {}
    for index, (name, camera) in enumerate(cameras.items()):
        model = "equidistant" if camera.model == "equidistant" else "radtan" if camera.distorted else "none"
        content[f"cam{index}"] = {
            "cam_overlaps": [],
            "camera_model": "pinhole",
            "intrinsics": nested(camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]),
            "distortion_model": model,
            "distortion_coeffs": nested(camera.distortion[:4] if model != "none" else ()),
            "resolution": list(camera.size),
            "rostopic": f"/{re.sub('[^A-Za-z0-9_]', '_', name)}/image_raw",
            **({"T_cn_cnm1": nested(poses[index] @ invert_rigid(poses[index - 1]))} if index else {}),
            **({} if at_first else {"T_cam_imu": nested(poses[index])}),
        }
    comment = "" if at_first else "# T_cam_imu: from the world, metres, to each camera\n"
    return {"": comment + yaml_file(content)[""]}


KALIBR = calibration_format(
    "kalibr",
    lambda file: any(isinstance(file.get(name, "camera_model"), str) for name in _kalibr_names(file)),
    write=_write_kalibr,
    arrange=_kalibr,
)


# -- OpenCV

_STORED_NAME = re.compile(r"[A-Za-z0-9_-]+")
#: Keys of K, R and T, which may end with the name of a camera.
_K, _R, _T = (
    re.compile(rf"(?:{names})(?:_?[0-9]+|_[\w-]+)?", re.IGNORECASE)
    for names in (
        "camera_?matrix|intrinsic_?matrix|intrinsics?|mtx|K|M",
        "rotation_?matrix|rotation|rot|rvec|R",
        "translation_?vector|translation|tvec|T",
    )
)


def _is_storage(file: CalibrationFile) -> bool:
    items = file.document.items() if isinstance(file.document, dict) else ()
    values = {str(key): value for key, value in items if isinstance(value, list) or _is_matrix(value)}
    # plain lists in JSON are read by the format of matrices, which knows all their spellings
    stored = file.syntax != "json" or any(isinstance(value, Matrix) for value in values.values())
    if not stored and not _is_pair(find_parameters(plain(file))):
        return False
    k, r, t = (any(map(pattern.fullmatch, values)) for pattern in (_K, _R, _T))
    return k or (r and t)


def _is_matrix(value: Any) -> bool:
    return isinstance(value, dict) and "data" in value


def _is_pair(found: Found) -> bool:
    """Whether a file has K of two cameras, and the pose from the first one to the second one."""
    own = [identity for identity, entries in found.cameras.items() if "K" in entries]
    shared = found.cameras.get((), {}).keys()
    return own == [("1",), ("2",)] and "t" in shared and bool({"R", "rvec"} & shared)


def _read_opencv(file: CalibrationFile) -> dict[str, RawCamera]:
    for key, value in file.document.items():
        if isinstance(value, Matrix) and _K.fullmatch(key):
            file.numbers((3, 3), key, "data")
    found = find_parameters(plain(file))
    whole = "K" in found.roles
    half = None if whole and POSE & found.roles else other_half(Path(file.path))
    files = [file]
    if half is not None:
        own = {**file.document, "camera_name": name_of_half(Path(file.path).stem)}
        files = [replace(file, document=own), read_document(half, 8 << 20)]
        files = files if whole else files[::-1]
        found = find_parameters(*map(plain, files))
    renamed = dict(ROWS["opencv"]["renamed"])
    if any(str(key).startswith("Rot_") for one in files for key in one.document):
        renamed["R_.*"] = ""  # the same rotation as a vector
    elif _is_pair(found):
        renamed["R([12])"] = r"rectification_\1"
    elif "P" in found.roles and "t" not in found.roles:
        renamed["R(_.*)?"] = r"rectification\1"  # as in CameraInfo
    return reader({"renamed": renamed}, others=True)(*files)


# -- writing

_Value = int | str | list[str] | Array


def _entries(cameras: Mapping[str, Camera]) -> dict[str, _Value]:
    """Names and values of all entries of a file to write. Matrices are arrays (rows, cols)."""
    if len(cameras) == 1:
        ((name, camera),) = cameras.items()
        if not name.isprintable() or '"' in name or name.lower() in _WORDS:
            raise CameraError("this format cannot store a camera of this name", key=name)
        return {
            "camera_name": name,
            "image_width": camera.size[0],
            "image_height": camera.size[1],
            "camera_matrix": camera.K,
            "distortion_model": str(camera.model),
            "distortion_coefficients": np.array([camera.distortion]),
            "R": camera.R,
            "T": camera.t[:, None],
            **_stereo_entries(camera, ""),
        }
    entries: dict[str, _Value] = {"names": list(cameras)}
    for name, camera in cameras.items():
        if _STORED_NAME.fullmatch(name) is None:
            raise CameraError("this format needs a name of letters, digits, _ and -", key=name)
        own: dict[str, _Value] = {
            f"W_{name}": camera.size[0],
            f"H_{name}": camera.size[1],
            f"K_{name}": camera.K,
            f"distortion_model_{name}": str(camera.model),
            f"dist_{name}": np.array([camera.distortion]),
            f"R_{name}": np.asarray(cv2.Rodrigues(camera.R)[0], dtype=float),
            f"Rot_{name}": camera.R,
            f"T_{name}": camera.t[:, None],
        }
        read = {**own, f"rectified_{name}": camera.rectified}
        plain_values = {key: nested(v) if isinstance(v, np.ndarray) else v for key, v in read.items()}
        # a reader would take dist_coeffs for a parameter of an only camera
        if [*find_parameters(CalibrationFile("", "", plain_values)).cameras] != [(name,)]:
            raise CameraError("this format cannot store a camera of this name", key=name)
        entries |= own | _stereo_entries(camera, f"_{name}")
    return entries


def _stereo_entries(camera: Camera, suffix: str) -> dict[str, _Value]:
    entries: dict[str, _Value] = {}
    if camera.rectification is not None:
        entries[f"rectification_matrix{suffix}"] = camera.rectification
    if camera.rectified is not None:
        entries[f"projection_matrix{suffix}"] = camera.rectified
    return entries


def _write_storage(suffix: str, cameras: Mapping[str, Camera]) -> dict[str, str]:
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for key, value in _entries(cameras).items():
        if isinstance(value, list):
            storage.startWriteStruct(key, cv2.FileNode_SEQ)
            for item in value:
                storage.write("", item)
            storage.endWriteStruct()
        else:
            storage.write(key, value)
    return {"": storage.releaseAndGetString()}


OPENCV, OPENCV_XML, OPENCV_JSON = (
    calibration_format(name, _is_storage, _read_opencv, partial(_write_storage, ROWS[name]["suffix"]))
    for name in ("opencv", "opencv_xml", "opencv_json")
)

FORMATS = (CAMERA_INFO, INI, KALIBR, OPENCV, OPENCV_JSON, OPENCV_XML)
