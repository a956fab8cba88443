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
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.formats.base import (
    CalibrationFile,
    Key,
    Keys,
    Place,
    RawCamera,
    camera_at,
    opencv_model,
    vector_of,
)
from humansim_ros.cameras.formats.conventions import find_model, model_of_four
from humansim_ros.cameras.formats.spellings import CAMERA_KEYS, Entry, size_of
from humansim_ros.cameras.formats.syntax import Matrix, name_of_half, other_half, read_document
from humansim_ros.cameras.formats.table import Values, calibration_format, json_file, nested, row
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.geometry import invert_rigid, nearest_rotations, transform
from humansim_ros.types import Array

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_/-]*")
#: Words that YAML does not read as text, such as yes.
_WORDS = {"yes", "no", "on", "off", "true", "false", "null", "y", "n"}
#: Places of the values of a camera in a file, and their keys in a message.
_IN_FILE: dict[str, Place] = {
    "size": "image_width image_height",
    "K": ("camera_matrix", "data"),
    "distortion": ("distortion_coefficients", "data"),
    "model": "distortion_model",
    "rectification": ("rectification_matrix", "data"),
    "rectified": ("projection_matrix", "data"),
}
_IN_MESSAGE = {
    "size": "width height",
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
    places = dict(_IN_FILE)
    if not file.has("distortion_coefficients", "data"):
        # a truncated file must not become a camera without distortion
        raise file.error("is missing; a camera without distortion has zeros", "distortion_coefficients")
    bent = str(file.get("camera_model")).lower().startswith(("fisheye", "equi", "kannala"))
    if bent and not file.has("distortion_model"):
        places["model"] = "camera_model"
    name = str(file.get("camera_name") or "").strip()
    return {name or Path(file.path).stem: _camera(file, places)}


def _read_message(file: CalibrationFile) -> dict[str, RawCamera]:
    """Read a message that ``ros2 topic echo`` has printed. In ROS 1, names of matrices are capital
    letters."""
    spelling = {str(key).lower(): key for key in file.document}
    camera = _camera(
        file, {part: " ".join(spelling.get(k, k) for k in keys.split()) for part, keys in _IN_MESSAGE.items()}
    )
    parts = ("x_offset", "y_offset", "height", "width")
    binned = any(file.get(key) not in (None, 0, 1) for key in ("binning_x", "binning_y"))
    if binned or any(file.get("roi", part) for part in parts):
        warn_about(file.path, "binning and region of interest are ignored: the camera has the full image")
    frame = str(file.get("header", "frame_id") or "").strip()
    return {frame.removesuffix("_optical_frame") or Path(file.path).stem: camera}


def _camera(file: CalibrationFile, places: Mapping[str, Place]) -> RawCamera:
    paths = {part: (place,) if isinstance(place, str) else place for part, place in places.items()}
    lens = file.optional_numbers(*paths["distortion"])
    model = find_model(file, file.get(*paths["model"]), lens, paths["model"], paths["distortion"])
    camera = camera_at(file, (), places, distortion=lens, model=model)
    if not camera.K.any():
        raise file.error("is all zeros, which means 'not calibrated' in ROS", *paths["K"])
    # drivers that do not rectify write zeros
    absent: dict[str, Any] = {
        part: None
        for part in ("rectification", "rectified")
        if (matrix := getattr(camera, part)) is not None and not matrix.any()
    }
    return replace(camera, **absent)


def _info_values(own: Values, camera: Camera) -> Values:
    name = own["name"]
    plain = _PLAIN.fullmatch(name) and name.lower() not in _WORDS
    return {"quoted": name if plain else json.dumps(name)}


# -- INI files of the Videre software: a line with a key, then lines with its numbers

#: Places of the values of a camera in its section.
_IN_SECTION = {
    "K": "camera_matrix",
    "distortion": "distortion",
    "rectification": "rectification",
    "rectified": "projection",
}
#: Sections that are not cameras. ROS ignores the second one.
_IMAGE, _EXTERNALS = "image", "externals"
_MAX_NUMBERS = 50
_HEADING = re.compile(r"\[(.*)\]")


def _is_ini(file: CalibrationFile) -> bool:
    first = next(iter(file.head), "")
    assigns = any("=" in line or ":" in line for line in file.head[1:])
    return _HEADING.fullmatch(first) is not None and any(c.isalpha() for c in first) and not assigns


def _read_ini(file: CalibrationFile) -> dict[str, RawCamera]:
    file = _sections(file)
    size = file.size((_IMAGE, "width"), (_IMAGE, "height"))
    cameras: dict[str, RawCamera] = {}
    for name in [name for name in file.document if name not in (_IMAGE, _EXTERNALS)]:
        at: Keys = (name,)
        for key in _IN_SECTION.values():
            file.need(name, key)
        lens = file.some_numbers(name, "distortion")
        if len(lens) not in (4, 5, 8):
            message = f"needs 5 coefficients (plumb_bob) or 8 (rational_polynomial), not {len(lens)}"
            raise file.error(message, name, "distortion")
        model = "rational_polynomial" if len(lens) == 8 else "plumb_bob"
        camera = camera_at(file, at, _IN_SECTION, size=size, distortion=lens, model=model)
        file.add(cameras, name or Path(file.path).stem, camera, *at)
    if not cameras:
        raise file.error("the file has no section of a camera, such as [narrow_stereo]")
    return cameras


def _sections(file: CalibrationFile) -> CalibrationFile:
    """The file with its sections parsed as ``document``: lists of numbers by section and key."""
    document: dict[str, dict[str, list[float]]] = {}
    lines: dict[tuple[str, ...], int] = {}
    section: dict[str, list[float]] = {}
    name, values = "", None
    for number, line in file.lines():
        heading = _HEADING.fullmatch(line)
        if heading:
            name, section, values = heading[1].strip(), {}, None
            if name in document:
                raise file.error("this section is duplicate", name, line=number)
            document[name], lines[name,] = section, number
        elif any(c.isalpha() for c in line.split()[0]) and line.split()[0].lower() not in ("nan", "inf"):
            key = line.replace(" ", "_")
            if key in section:
                raise file.error("this key is duplicate", line, line=number)
            values = section[key] = []
            lines[name, line] = number
        elif values is None:
            raise file.error("numbers without a key above them", line=number)
        else:
            values += file.row(line.split(), number)
            if len(values) > _MAX_NUMBERS:
                raise file.error(f"more than {_MAX_NUMBERS} numbers for a key", line=number)
    return replace(file, document=document, key_lines=lines, renamed={"camera_matrix": "camera matrix"})


def _ini_values(own: Values, camera: Camera) -> Values:
    name = own["name"]
    if name in (_IMAGE, _EXTERNALS) or any(c in "[]\n\r" for c in name) or not name.strip():
        raise CameraError("this format cannot store a camera of this name", key=name)
    return {}


CAMERA_INFO = calibration_format("camera_info", _is_camera_info, _read_camera_info, values=_info_values)
INI = calibration_format("ini", _is_ini, _read_ini, values=_ini_values)


#: Rounding explains errors of orthonormality up to this.
_ROUNDING = 1e-3
_CAMERA = re.compile(r"cam[0-9]+")
#: Keys of the transforms from the IMU to the camera, and from the camera to the IMU.
_IMU = ("T_cam_imu", "T_imu_cam")
_MODELS = {"radtan": "plumb_bob", "equidistant": "equidistant", "equi": "equidistant", "none": None}


def _kalibr_names(file: CalibrationFile) -> list[str]:
    keys = file.document if isinstance(file.document, dict) else {}
    return [key for key in keys if isinstance(key, str) and _CAMERA.fullmatch(key)]


def _read_kalibr(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    names = _kalibr_names(file)
    pose: Array | None = None
    for name in names:
        # if the first camera has extrinsics of the IMU, the chain starts at the IMU
        key = file.first((name,), *_IMU) or "T_cn_cnm1"
        if key in _IMU and (pose is None or file.has(names[0], key)):
            pose = file.pose_matrix(name, key, rows=4)
            pose = invert_rigid(_rigid(pose)) if key == "T_imu_cam" else pose
        else:
            key = "T_cn_cnm1"
            pose = np.eye(4) if pose is None else file.pose_matrix(name, key, rows=4) @ pose
        file.add(cameras, name, _camera_kalibr(file, name, pose, key), name)
    return cameras


def _rigid(matrix: Array) -> Array:
    """The same transform (4, 4), with an exact rotation if the error can come from rounding."""
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROUNDING:
        return matrix
    return transform(nearest_rotations(rotation), matrix[:3, 3])


def _camera_kalibr(file: CalibrationFile, name: str, pose: Array, pose_key: str) -> RawCamera:
    if file.need(name, "camera_model") != "pinhole":
        message = f"{file.get(name, 'camera_model')!r} is not a supported camera model; only pinhole is"
        raise file.error(message, name, "camera_model")
    k = pinhole(*file.numbers((4,), name, "intrinsics"))
    word = str(file.get(name, "distortion_model") or "none").lower()
    if word not in _MODELS:
        message = f"unknown distortion model {word!r}; known are {', '.join(_MODELS)}"
        raise file.error(message, name, "distortion_model")
    model = _MODELS[word]
    lens = np.zeros(0) if model is None else file.numbers((4,), name, "distortion_coeffs")
    file.numbers((2,), name, "resolution")
    places = {"K": "intrinsics", "distortion": "distortion_coeffs", "size": "resolution"}
    places |= {"R": pose_key, "t": pose_key}
    size = file.size((name, "resolution", 0), (name, "resolution", 1))
    r, t = pose[:3, :3], pose[:3, 3]
    return camera_at(file, (name,), places, K=k, R=r, t=t, size=size, distortion=lens, model=model)


def _write_kalibr(cameras: Mapping[str, Camera]) -> dict[str, str]:
    poses = [camera.optical_from_world for camera in cameras.values()]
    at_first = np.array_equal(poses[0], np.eye(4))
    lines = [] if at_first else ["# T_cam_imu: from the world, metres, to each camera"]
    for index, (name, camera) in enumerate(cameras.items()):
        fisheye = camera.model == "equidistant"
        model = "equidistant" if fisheye else "radtan" if camera.distorted else "none"
        k = camera.K
        lines += [f"cam{index}:", "  cam_overlaps: []", "  camera_model: pinhole"]
        lines += [f"  intrinsics: [{row((k[0, 0], k[1, 1], k[0, 2], k[1, 2]), ', ')}]"]
        lines += [f"  distortion_model: {model}"]
        lines += [f"  distortion_coeffs: [{row(camera.distortion[:4] if model != 'none' else (), ', ')}]"]
        lines += [
            f"  resolution: [{camera.size[0]}, {camera.size[1]}]",
            f"  rostopic: /{re.sub('[^A-Za-z0-9_]', '_', name)}/image_raw",
        ]
        if index:
            lines += _matrix_lines_kalibr("T_cn_cnm1", poses[index] @ invert_rigid(poses[index - 1]))
        if not at_first:
            lines += _matrix_lines_kalibr("T_cam_imu", poses[index])
    return {"": "\n".join(lines) + "\n"}


def _matrix_lines_kalibr(key: str, matrix: Array) -> list[str]:
    return [f"  {key}:", *(f"  - [{row(values, ', ')}]" for values in matrix)]


KALIBR = calibration_format(
    "kalibr",
    lambda file: any(isinstance(file.get(name, "camera_model"), str) for name in _kalibr_names(file)),
    _read_kalibr,
    _write_kalibr,
)


# -- OpenCV

#: Names of the camera parameters, in order of precedence. Case and underscores are ignored.
_OPENCV_NAMES: dict[str, list[str]] = {part: names.split() for part, names in CAMERA_KEYS["opencv"].items()}
_PARTS = ("K", "distortion", "R", "t", "rectification", "rectified")
#: Parameters that all cameras may share.
_SHARED = ("width", "height", "size", "model", "fisheye")
_SUFFIX = r"(?:_?([0-9]+)|_([A-Za-z0-9_-]+))?"
_STORED_NAME = re.compile(r"[A-Za-z0-9_-]+")


def _pattern(names: Sequence[str]) -> re.Pattern[str]:
    longest = sorted(names, key=len, reverse=True)
    return re.compile(f"({'|'.join(n.replace('_', '_?') for n in longest)}){_SUFFIX}", re.IGNORECASE)


_PATTERNS = {part: _pattern(names) for part, names in _OPENCV_NAMES.items()}


_Table = dict[str, dict[str, Entry]]


def _is_storage(file: CalibrationFile) -> bool:
    table = _table([file])
    if file.syntax == "json" and not _is_opencv_json(file, table):
        return False  # plain lists are read by the format of matrices, which knows all their spellings
    return bool(table["K"]) or (bool(table["R"]) and bool(table["t"]))


def _is_opencv_json(file: CalibrationFile, table: _Table) -> bool:
    stereo = {"1", "2"} <= table["K"].keys() and "" in table["R"]
    values = file.document.values() if isinstance(file.document, dict) else ()
    return stereo or any(isinstance(value, Matrix) for value in values)


def _table(files: Sequence[CalibrationFile]) -> _Table:
    """Entries of files by parameter, then by the end of the key, which names the camera."""
    ranked: dict[str, dict[str, tuple[int, Entry]]] = {part: {} for part in _OPENCV_NAMES}
    for file in files:
        for key in file.document if isinstance(file.document, dict) else ():
            for part, pattern in _PATTERNS.items():
                matched = pattern.fullmatch(str(key))
                value = file.document[key]
                if matched is None or (part in _PARTS and not isinstance(value, (dict, list))):
                    continue
                keys: tuple[Key, ...] = (key, "data") if isinstance(value, dict) else (key,)
                if isinstance(value, dict) and "data" not in value:
                    continue
                name = matched[1].replace("_", "").lower()
                rank = [n.replace("_", "").lower() for n in _OPENCV_NAMES[part]].index(name)
                suffix = matched[2] or matched[3] or ""
                known = ranked[part].get(suffix)
                if known is None or rank < known[0]:
                    ranked[part][suffix] = rank, Entry(file, keys)
    return {part: {s: entry for s, (_, entry) in entries.items()} for part, entries in ranked.items()}


def _read_opencv(file: CalibrationFile) -> dict[str, RawCamera]:
    table, stem = _table([file]), Path(file.path).stem
    if not table["K"] or not (table["R"] or table["t"] or table["rectified"]):
        half = other_half(Path(file.path))
        if half is not None:
            stem = name_of_half(stem)
            table = _table([file, read_document(half, 8 << 20)])
    if not table["K"]:
        message = f"the file has no camera matrix; its known names are {', '.join(_OPENCV_NAMES['K'])}"
        raise CameraError(message, path=file.path)
    cameras: dict[str, RawCamera] = {}
    stereo = list(table["K"]) == ["1", "2"] and "" in table["R"] and "" in table["t"]
    for suffix in table["K"]:
        name = suffix or str(file.get("camera_name") or "").strip() or stem
        entries = {part: by_suffix[suffix] for part, by_suffix in table.items() if suffix in by_suffix}
        shared = {part: table[part][""] for part in _SHARED if "" in table[part]}
        file.add(cameras, name, _opencv_camera(shared | entries, suffix, stereo, table))
    return cameras


def _opencv_camera(entries: Mapping[str, Entry], suffix: str, stereo: bool, table: _Table) -> RawCamera:
    k, rotation, t = entries["K"].numbers(3, 3), entries.get("R"), entries.get("t")
    rectification, rectified = entries.get("rectification"), entries.get("rectified")
    if stereo:
        rectification = rotation or rectification
        rotation, t = (None, None) if suffix == "1" else (table["R"][""], table["t"][""])
    elif rotation is not None and t is None and rectified is not None:
        rotation, rectification = None, rotation  # R is the rectification, as in CameraInfo
    if rotation is None and t is not None:
        raise t.error("needs R as well")
    if rotation is not None and t is None:
        raise rotation.error("needs T as well")
    distortion = entries["distortion"].numbers() if "distortion" in entries else np.zeros(0)
    r = np.eye(3) if stereo else None  # the first camera of a stereo pair is the world
    return RawCamera(
        k,
        r if rotation is None else rotation.file.rotation(*rotation.keys),
        np.zeros(3) if t is None else t.numbers(3),
        size=size_of(entries),
        distortion=tuple(distortion),
        model=_opencv_model(entries, distortion, k),
        rectification=None if rectification is None else rectification.numbers(3, 3),
        rectified=None if rectified is None else rectified.numbers(3, 4),
        locations={part: entries[part].location for part in _PARTS if part in entries},
    )


def _opencv_model(entries: Mapping[str, Entry], distortion: Array, k: Array) -> str | None:
    """Distortion model. OpenCV decides by the number of coefficients, except for fisheyes."""
    lens, name, fisheye = (entries.get(part) for part in ("distortion", "model", "fisheye"))
    word = "" if name is None else name.word
    if word in ("", "pinhole", "perspective", "opencv"):
        bent = None if fisheye is None else fisheye.word not in ("0", "false", "no")
        word = "equidistant" if bent else opencv_model(distortion)
        if lens is not None and len(distortion) == 4:
            word = model_of_four(lens.file, lens.keys, distortion, k, bent)
    if lens is None:
        return None if word != "equidistant" else word
    return find_model(lens.file, word, distortion, (name or fisheye or lens).keys, lens.keys)


# -- writing

_Value = int | str | list[str] | Array


def _entries(cameras: Mapping[str, Camera]) -> dict[str, _Value]:
    """Names and values of all entries of a file to write. Matrices are arrays (rows, cols)."""
    if len(cameras) == 1:
        ((name, camera),) = cameras.items()
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
            f"R_{name}": vector_of(camera.R)[:, None],
            f"Rot_{name}": camera.R,
            f"T_{name}": camera.t[:, None],
            **_stereo_entries(camera, f"_{name}"),
        }
        if any(_is_single_camera_key(key) for key in own):
            raise CameraError("this format cannot store a camera of this name", key=name)
        entries |= own
    return entries


def _is_single_camera_key(key: str) -> bool:
    """Whether readers would take a key, such as dist_coeffs, for a parameter of an only camera."""
    matches = (pattern.fullmatch(key) for pattern in _PATTERNS.values())
    return any(matched and not (matched[2] or matched[3]) for matched in matches)


def _stereo_entries(camera: Camera, suffix: str) -> dict[str, _Value]:
    entries: dict[str, _Value] = {}
    if camera.rectification is not None:
        entries[f"rectification_matrix{suffix}"] = camera.rectification
    if camera.rectified is not None:
        entries[f"projection_matrix{suffix}"] = camera.rectified
    return entries


def _write_yaml(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lines = ["%YAML:1.0", "---"]
    for key, value in _entries(cameras).items():
        if isinstance(value, np.ndarray):
            rows, columns = value.shape
            lines += [f"{key}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
            lines += [f"   data: [ {row(value.ravel(), ', ')} ]"]
        elif isinstance(value, list):
            lines += [f"{key}:", *(f'   - "{item}"' for item in value)]
        else:
            lines.append(f"{key}: {value if isinstance(value, int) else json.dumps(value)}")
    return {"": "\n".join(lines) + "\n"}


def _write_xml(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lines = ['<?xml version="1.0"?>', "<opencv_storage>"]
    for key, value in _entries(cameras).items():
        if isinstance(value, np.ndarray):
            rows, columns = value.shape
            lines += [
                f'<{key} type_id="opencv-matrix">',
                f"  <rows>{rows}</rows>",
                f"  <cols>{columns}</cols>",
            ]
            lines += ["  <dt>d</dt>", "  <data>", f"    {row(value.ravel())}</data></{key}>"]
        elif isinstance(value, list):
            lines += [f"<{key}>", "  " + " ".join(f'"{item}"' for item in value) + f"</{key}>"]
        else:
            lines.append(f"<{key}>{value if isinstance(value, int) else _quoted(value)}</{key}>")
    return {"": "\n".join([*lines, "</opencv_storage>"]) + "\n"}


def _quoted(text: str) -> str:
    if any(c in '<>&"' or not c.isprintable() for c in text):
        raise CameraError("this format cannot store a camera of this name", key=text)
    return f'"{text}"'


def _write_json(cameras: Mapping[str, Camera]) -> dict[str, str]:
    def item(value: _Value) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        rows, columns = value.shape
        data = nested(value.ravel())
        return {"type_id": "opencv-matrix", "rows": rows, "cols": columns, "dt": "d", "data": data}

    return json_file({key: item(value) for key, value in _entries(cameras).items()})


OPENCV = calibration_format("opencv", _is_storage, _read_opencv, _write_yaml)
OPENCV_XML = calibration_format("opencv_xml", _is_storage, _read_opencv, _write_xml)
OPENCV_JSON = calibration_format("opencv_json", _is_storage, _read_opencv, _write_json)

FORMATS = (CAMERA_INFO, INI, KALIBR, OPENCV, OPENCV_JSON, OPENCV_XML)
