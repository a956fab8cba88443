"""Depth and stereo cameras: ZED .conf, JSON of Azure Kinect and RealSense, camera files of Open3D.

- ZED (SN….conf): sections of the left and right camera for each resolution; the right camera is
  x_right = R x_left + t with R of the rotation vector (RX, CV, RZ) and t = (-Baseline, TY, TZ), millimetres.
  https://github.com/stereolabs/zed-opencv-native
- Azure Kinect (k4a_device_get_raw_calibration): focal lengths and principal points are fractions of the
  sensor, Rt is in metres from the depth camera; the lens is rational_polynomial with p2 before p1. A colour
  mode of 16:9 is the middle of the sensor. https://github.com/microsoft/Azure-Kinect-Sensor-SDK
  (src/transformation/mode_specific_calibration.c)
- RealSense (dumps of rs2_intrinsics by librealsense and pyrealsense2): the fields of rs2_intrinsics, for one
  camera or for streams by name; also rs2_extrinsics from depth to colour (metres, rotation in column order).
  https://github.com/realsenseai/librealsense/wiki/Projection-in-RealSense-SDK-2.0
- Open3D: matrices in column order, and maybe extrinsics (x = R X + t, metres). Open3D measures pixels from
  the centre of the first pixel, as RealSense does.
  https://www.open3d.org/docs/release/python_api/open3d.camera.html
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.formats.base import (
    CalibrationFile,
    Keys,
    RawCamera,
    find_cameras,
    has_keys,
)
from humansim_ros.cameras.formats.checks import IMAGE_SIZES
from humansim_ros.cameras.formats.spellings import POSE, keys_of, leaves_of, role_of
from humansim_ros.cameras.formats.syntax import TOML_HEAD, ZED_SECTION, text_document
from humansim_ros.cameras.formats.table import Cameras, Values, calibration_format, nested, number
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.types import Array, ImageSize

# -- ZED

#: Image size of each resolution of ZED cameras.
_ZED_SIZES: dict[str, ImageSize] = {mode: (w, h) for mode, (w, h) in IMAGE_SIZES["zed"].items()}
_ZED_CAMERA = re.compile(r"(LEFT|RIGHT)_CAM_([A-Z0-9]+)", re.IGNORECASE)
_ZED_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def _zed_document(file: CalibrationFile) -> CalibrationFile:
    """The file with its sections parsed as ``document``. Sections are in upper case, keys in lower case."""
    parsed = text_document(file, role_of)
    document: dict[str, dict[str, Any]] = {}
    for section, items in (parsed.document or {}).items():
        own = items if isinstance(items, dict) else {}
        document[section.upper()] = {str(key).lower(): value for key, value in own.items()}
    lines = {(keys[0].upper(), *map(str.lower, keys[1:])): line for keys, line in parsed.key_lines.items()}
    first: dict[tuple[str, ...], int] = {}
    for keys, line in lines.items():
        first.setdefault(keys[:1], line - 1)  # the line of the section
    return replace(file, document=document, key_lines=lines | first)


def _zed_number(file: CalibrationFile, section: str, *keys: str, needed: bool = True) -> float:
    """Number with the first of ``keys`` that a section has. Without one: 0, or CameraError if ``needed``."""
    key = file.first((section,), *map(str.lower, keys))
    if key is None and needed:
        raise file.error("is missing", section, keys[0])
    return 0.0 if key is None else file.number(section, key)


def _read_zed(file: CalibrationFile) -> dict[str, RawCamera]:
    file = _zed_document(file)
    found = (_ZED_CAMERA.fullmatch(name) for name in file.document)
    modes = list(dict.fromkeys(match[2] for match in found if match))
    unknown = [mode for mode in modes if mode not in _ZED_SIZES]
    known = [mode for mode in modes if mode in _ZED_SIZES]
    fitting = [mode for mode in known if file.given_size in (None, _ZED_SIZES[mode])]
    if unknown:
        warn_about(file.path, f"left out, because their image size is not known: {', '.join(unknown)}")
    if not fitting:
        sizes = ", ".join("{}x{}".format(*_ZED_SIZES[mode]) for mode in known)
        raise file.error(f"has no resolution of that size; there are {sizes}", "size")
    cameras: dict[str, RawCamera] = {}
    for mode in fitting:
        for side in ("LEFT", "RIGHT"):
            name = f"{side}_CAM_{mode}"
            if name in file.document:
                file.add(cameras, name, _zed_camera(file, name, mode, side), name)
    return cameras


def _zed_camera(file: CalibrationFile, name: str, mode: str, side: str) -> RawCamera:
    k = pinhole(*(_zed_number(file, name, key) for key in ("fx", "fy", "cx", "cy")))
    disto = f"{side}_DISTO"  # the distortion of all modes; the SDK uses this lens
    thin = [key for key in ("s1", "s2", "s3", "s4") if _zed_number(file, disto, key, needed=False)]
    if thin and not file.has(name, "k1"):
        raise file.error("thin prism models are not supported", disto, thin[0])
    if thin:
        warn_about(file.path, f"{disto}: a thin prism is not supported; the lens of {name} is taken")
    lens_at = disto if disto in file.document and not thin else name
    lens = np.array([_zed_number(file, lens_at, key, needed=key == "k1") for key in _ZED_LENS])
    fisheye = lens_at == disto and lens[5] and not lens[[2, 3, 6, 7]].any()
    lens, model = (lens, "rational_polynomial") if lens[5:].any() else (lens[:5], "plumb_bob")
    lens, model = (lens[[0, 1, 4, 5]], "equidistant") if fisheye else (lens, model)
    rotation, t = np.eye(3), np.zeros(3)
    if side == "RIGHT":
        shift = (_zed_number(file, "STEREO", f"{k}_{mode}", k, needed=False) for k in ("TY", "TZ"))
        t = np.array([-_zed_number(file, "STEREO", "Baseline"), *shift])
        vector = [_zed_number(file, "STEREO", f"{k}_{mode}", k) for k in ("RX", "CV", "RZ")]
        rotation = np.asarray(Rotation.from_rotvec(vector).as_matrix())
    where = dict.fromkeys(("", "K"), file.location(name))
    return RawCamera(k, rotation, t, None, _ZED_SIZES[mode], tuple(lens), model, locations=where)


def _write_zed(cameras: Mapping[str, Camera]) -> dict[str, str | bytes]:
    lines: list[str] = []
    modes = {size: mode for mode, size in reversed(_ZED_SIZES.items())}
    if len(cameras) != 2 or len({camera.size for camera in cameras.values()}) > 1:
        raise CameraError("this format needs the left and the right camera of one size")
    (name, left), (_, right) = cameras.items()
    mode = modes.get(left.size)
    if mode is None:
        known = ", ".join(f"{w}x{h}" for w, h in modes)
        raise CameraError(f"this format needs an image size of ZED cameras: {known}", key=name)
    if not (np.allclose(left.R, np.eye(3)) and np.allclose(left.t, 0)):
        raise CameraError("this format needs the left camera as the world", key=name)
    for side, camera in (("LEFT", left), ("RIGHT", right)):
        k = camera.K
        values = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
        values |= dict(zip(_ZED_LENS, camera.distortion, strict=False))
        lines += [f"[{side}_CAM_{mode}]", *(f"{key}={number(value)}" for key, value in values.items()), ""]
    rx, cv, rz = Rotation.from_matrix(right.R).as_rotvec()
    stereo = {"Baseline": -right.t[0], "TY": right.t[1], "TZ": right.t[2]}
    stereo |= {f"RX_{mode}": rx, f"CV_{mode}": cv, f"RZ_{mode}": rz}
    lines += ["[STEREO]", *(f"{key}={number(value)}" for key, value in stereo.items())]
    return {"": "\n".join(lines) + "\n"}


ZED = calibration_format(
    "zed", lambda file: ZED_SECTION.search(file.text, 0, TOML_HEAD) is not None, _read_zed, _write_zed
)


# -- Azure Kinect

_K4A: Keys = ("CalibrationInformation", "Cameras")
_BROWN = "CALIBRATION_LensDistortionModelBrownConrady"
_COLOR = "CALIBRATION_CameraPurposePhotoVideo"
#: Modes of the depth camera by image size: side of the sensor after binning, and first pixel on it.
_DEPTH_MODES = {
    (640, 576): (1024, (192, 180)),
    (320, 288): (512, (96, 90)),
    (1024, 1024): (1024, (0, 0)),
    (512, 512): (512, (0, 0)),
}


def _k4a(file: CalibrationFile) -> Cameras:
    cameras: dict[str, dict[str, Any]] = {}
    skipped = []
    for at in file.paths(*_K4A):
        color = file.need(*at, "Purpose") == _COLOR
        name = "color" if color else "depth"
        name = name if name not in cameras else str(file.get(*at, "Location") or at[-1])
        sensor = file.size((*at, "SensorWidth"), (*at, "SensorHeight"))
        mode = _mode(file.given_size or sensor, sensor, color)
        if mode is None:
            skipped.append(name)
        else:
            file.add(cameras, name, _k4a_camera(file, at, file.given_size or sensor, *mode), *at)
    if not cameras:
        raise file.error("no camera has a mode of this size", "size")
    if skipped:
        width, height = file.given_size or (0, 0)
        what = f"left out, because they have no mode of {width}x{height}: {', '.join(skipped)}"
        warn_about(file.path, what)
    return [{"name": name, **camera} for name, camera in cameras.items()]


def _mode(size: ImageSize, sensor: ImageSize, color: bool) -> tuple[Array, Array] | None:
    """Size (2,) of the sensor in pixels of a mode, and first pixel (2,) of the mode; None for an unknown
    mode."""
    if size == sensor:
        return np.array(sensor, dtype=float), np.zeros(2)
    if not color:
        if size not in _DEPTH_MODES:
            return None
        side, corner = _DEPTH_MODES[size]
        return np.array([side, side], dtype=float), np.array(corner, dtype=float)
    scaled = np.array(sensor) * (size[0] / sensor[0])
    cut = (scaled[1] - size[1]) / 2
    return (scaled, np.array([0, cut])) if 0 <= cut < size[1] / 4 else None


def _k4a_camera(
    file: CalibrationFile, at: Keys, size: ImageSize, scale: Array, corner: Array
) -> dict[str, Any]:
    inner: Keys = (*at, "Intrinsics")
    values = file.some_numbers(*inner, "ModelParameters")
    if len(values) < 14:
        raise file.error(f"needs 14 numbers, not {len(values)}", *inner, "ModelParameters")
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1 = values[:14]
    model = str(file.need(*inner, "ModelType"))
    if model != _BROWN:
        raise file.error(f"{model[:60]!r} is not a supported lens; known is {_BROWN}", *inner, "ModelType")
    if codx or cody:
        message = "a centre of distortion beside the axis (numbers 11 and 12) is not supported"
        raise file.error(message, *inner, "ModelParameters")
    k = pinhole(fx, fy, cx, cy)
    k[:2] *= scale[:, None]
    k[:2, 2] -= corner
    k[:2, 2] -= 0.5
    lens = {"distortion": [k1, k2, p1, p2, k3, k4, k5, k6], "model": "rational_polynomial"}
    camera = {"K": nested(k), **lens, "size": size}
    if not file.has(*at, "Rt"):
        return camera
    rotation = file.numbers((3, 3), *at, "Rt", "Rotation")
    return {**camera, "R": nested(rotation), "t": nested(file.numbers((3,), *at, "Rt", "Translation"))}


def _k4a_values(own: Values, camera: Camera) -> Values:
    if own["name"] not in ("depth", "color"):
        raise CameraError("this format has cameras of the names depth and color only", key=own["name"])
    width, height = camera.size
    point = own["cx_corner"] / width, own["cy_corner"] / height
    lens = (own.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "k5", "k6"))
    values = (*point, own["fx"] / width, own["fy"] / height, *lens, 0.0, 0.0, own["p2"], own["p1"])
    purpose = _COLOR if own["name"] == "color" else "CALIBRATION_CameraPurposeDepth"
    return {"parameters": nested(values), "purpose": purpose}


K4A = calibration_format("k4a", arrange=_k4a, values=_k4a_values)


# -- RealSense and Open3D

#: Lens models by the names (in lower case) and the numbers of rs2_distortion.
_MODELS = {
    **dict.fromkeys(("none", "0"), None),
    **dict.fromkeys(("modified brown conrady", "1", "inverse brown conrady", "2"), "plumb_bob"),
    **dict.fromkeys(("brown conrady", "4"), "plumb_bob"),
    **dict.fromkeys(("kannala brandt4", "5"), "equidistant"),
}
#: Models that almost equal the models of OpenCV.
_NEARLY = ("modified brown conrady", "1", "inverse brown conrady", "2")
_MOST_VALUES = 2000
_WRITTEN = {"plumb_bob": "brown_conrady", "equidistant": "kannala_brandt4"}
_FIELDS = ({"fx"}, {"fy"}, {"ppx", "cx"}, {"ppy", "cy"}, {"width"}, {"height"})
_STREAMS = has_keys(*_FIELDS), has_keys({"fx", "ppx"})
#: Keys of rs2_extrinsics between the streams of one device.
_EXTRINSICS = ("extrinsics", "depth_to_color", "depth_to_color_extrinsics", "extrinsics_depth_to_color")


def _is_realsense(file: CalibrationFile) -> bool:
    keys = keys_of(file)
    roles = {role_of(key) for key in keys - {"coeffs", "distortion"}}
    if roles & {"k1", "radial", "distortion"} or ("ppx" not in keys and roles & POSE):
        return False  # cx, cy and extrinsics come from another program
    return all(keys & field for field in _FIELDS) and bool(find_cameras(file, *_STREAMS))


def _realsense(file: CalibrationFile) -> Cameras:
    """Streams. With rs2_extrinsics from the depth to the colour stream, the depth camera is the world."""
    cameras = [{"name": name, **_stream(file, at)} for name, at in find_cameras(file, *_STREAMS)]
    at = next((key for key in _EXTRINSICS if isinstance(file.get(key), dict)), None)
    depth = [one for one in cameras if "depth" in one["name"].lower()]
    color = [one for one in cameras if "color" in one["name"].lower() or "rgb" in one["name"].lower()]
    if at is not None and len(depth) == len(color) == 1:
        # librealsense stores rotations in column order
        rotation, t = file.numbers((3, 3), at, "rotation").T, file.numbers((3,), at, "translation")
        color[0] |= {"R": nested(rotation), "t": nested(t)}
        depth[0] |= {"R": nested(np.eye(3)), "t": [0.0] * 3}
        if at == "extrinsics":
            warn_about(file.path, f"{at}: taken from depth to color, with the rotation in column order")
    return cameras


def _stream(file: CalibrationFile, at: Keys) -> dict[str, Any]:
    kept = ("fx", "fy", "ppx", "ppy", "cx", "cy", "width", "height")
    key = "coeffs" if file.has(*at, "coeffs") else "distortion"
    lens = realsense_lens(file, at, file.first(at, "model") or "distortion_model", key)
    return {**{key: file.get(*at, key) for key in kept if file.has(*at, key)}, "model": "none", **lens}


def realsense_lens(file: CalibrationFile, at: Keys, model_key: str, coefficients: str) -> dict[str, Any]:
    """Model and coefficients of a lens of librealsense; empty for a lens without distortion.

    Args:
        file: File that is being read.
        at: Key path of the stream.
        model_key: Key of the model in the stream.
        coefficients: Key of the coefficients in the stream.
    """
    keys, distortion = (*at, model_key), file.optional_numbers(*at, coefficients)
    value = file.get(*keys)
    # distortion.inverse_brown_conrady, RS2_DISTORTION_NONE, Brown Conrady, 4
    word = re.sub(r"^.*distortion[._]|[^a-z0-9]+", " ", str(value).lower()).strip()
    if value is None or not distortion.any():
        word = "none" if not distortion.any() and word != "kannala brandt4" else word
        word = "brown conrady" if value is None and distortion.any() else word
    if word not in _MODELS:
        known = "none, brown_conrady, modified_brown_conrady, inverse_brown_conrady, kannala_brandt4"
        raise file.error(f"{str(value)[:40]!r} is not a supported lens model; known are {known}", *keys)
    model = _MODELS[word]
    if model is None and distortion.any():
        raise file.error(f"is {str(value)[:40]!r}, but there are distortion coefficients", *keys)
    if word in _NEARLY:
        what = f"{'.'.join(map(str, keys))}: {word} is taken for plumb_bob, as realsense-ros does"
        warn_about(file.path, what)
    return {} if model is None else {"model": model, "coeffs": file.get(*at, coefficients)}


# -- Open3D


def _is_open3d(file: CalibrationFile) -> bool:
    """Whether a K is below ``intrinsic``, or has nine numbers in column order. Other programs write rows."""
    for keys, shape in islice(leaves_of(file), _MOST_VALUES):
        if keys[-1:] == ("intrinsic_matrix",):
            k = file.get(*keys)
            return keys[-2:-1] == ("intrinsic",) or (shape == (9,) and (not k[2] or bool(k[6])))
    return False


def _realsense_values(own: Values, camera: Camera) -> Values:
    if not camera.distorted:
        return {"lens": "none", "coeffs": [0.0] * 5}
    return {"lens": _WRITTEN[str(camera.model)], "coeffs": [*nested(camera.distortion), 0.0][:5]}


REALSENSE = calibration_format(
    "realsense", matches=_is_realsense, arrange=_realsense, values=_realsense_values
)
OPEN3D = calibration_format("open3d", matches=_is_open3d)

FORMATS = (ZED, K4A, REALSENSE, OPEN3D)
