"""Intrinsics as JSON: dumps of rs2_intrinsics (librealsense, pyrealsense2), and camera files of Open3D.

The first have the fields of rs2_intrinsics, for one camera or for streams by name. Files of Open3D have
matrices in column order, and may have extrinsics (x = R X + t, metres). Both measure pixels from the centre
of the first one. https://github.com/realsenseai/librealsense/wiki/Projection-in-RealSense-SDK-2.0,
https://www.open3d.org/docs/release/python_api/open3d.camera.html
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    CalibrationFile,
    CalibrationFormat,
    Keys,
    RawCamera,
    check_count,
    find_cameras,
    has_keys,
    nested,
)
from humansim_ros.errors import warn_about
from humansim_ros.types import Array, ImageSize

#: Names of rs2_distortion without case, and its numbers.
_MODELS = {
    **dict.fromkeys(("none", "0"), None),
    **dict.fromkeys(("modified brown conrady", "1", "inverse brown conrady", "2"), "plumb_bob"),
    **dict.fromkeys(("brown conrady", "4"), "plumb_bob"),
    **dict.fromkeys(("kannala brandt4", "5"), "equidistant"),
}
#: Models that are only nearly the models of OpenCV.
_NEARLY = ("modified brown conrady", "1", "inverse brown conrady", "2")
_WRITTEN = {"plumb_bob": "brown_conrady", "equidistant": "kannala_brandt4"}
_FIELDS = ({"fx"}, {"fy"}, {"ppx", "cx"}, {"ppy", "cy"}, {"width"}, {"height"})


def _realsense_cameras(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, has_keys(*_FIELDS), has_keys({"fx", "ppx"}))


def _is_realsense(file: CalibrationFile) -> bool:
    return bool(_realsense_cameras(file))


def _read_realsense(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for name, at in _realsense_cameras(file):
        file.add(cameras, name, _realsense_camera(file, at), *at)
    return cameras


def _realsense_camera(file: CalibrationFile, at: Keys) -> RawCamera:
    fx, fy = (float(file.numbers((), *at, key)) for key in ("fx", "fy"))
    cx, cy = (
        float(file.numbers((), *at, next((k for k in keys if file.get(*at, k) is not None), keys[0])))
        for keys in (("ppx", "cx"), ("ppy", "cy"))
    )
    key = "coeffs" if file.get(*at, "coeffs") is not None else "distortion"
    distortion: Array = np.zeros(0)
    if file.get(*at, key) not in (None, []):
        distortion = file.some_numbers(*at, key)
    model = _model(file, at, key, distortion)
    size = file.size((*at, "width"), (*at, "height"))
    return RawCamera(
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        size=size,
        distortion=tuple(distortion) if model else (),
        model=model,
        locations={
            "": file.location(*at),
            "K": file.location(*at, "fx"),
            "distortion": file.location(*at, key),
            "size": file.location(*at, "width"),
        },
    )


def _model(file: CalibrationFile, at: Keys, coefficients: str, distortion: Array) -> str | None:
    keys = (*at, "model" if file.get(*at, "model") is not None else "distortion_model")
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
    if model is not None:
        check_count(file, model, distortion, (*at, coefficients))
    if word in _NEARLY:
        warn_about(
            file.path, f"{'.'.join(map(str, keys))}: {word} is taken for plumb_bob, as realsense-ros does"
        )
    return model


def _write_realsense(cameras: Mapping[str, Camera]) -> dict[str, str]:
    data = {}
    for name, camera in cameras.items():
        k = camera.K
        bent = camera.distorted
        data[name] = {
            "width": camera.size[0],
            "height": camera.size[1],
            "fx": k[0, 0],
            "fy": k[1, 1],
            "ppx": k[0, 2],
            "ppy": k[1, 2],
            "model": _WRITTEN[str(camera.model)] if bent else "none",
            "coeffs": [*nested(np.array(camera.distortion)), 0.0][:5] if bent else [0.0] * 5,
        }
    return {"": json.dumps(data, indent=1) + "\n"}


# -- Open3D


def _open3d_cameras(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, _is_open3d_camera, has_keys({"intrinsic", "intrinsic_matrix", "extrinsic"}))


def _is_open3d_camera(value: Any) -> bool:
    if not isinstance(value, dict):
        return False
    inner = value.get("intrinsic")
    return "intrinsic_matrix" in (inner if isinstance(inner, dict) else value)


def _is_open3d(file: CalibrationFile) -> bool:
    return bool(_open3d_cameras(file))


def _read_open3d(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for name, at in _open3d_cameras(file):
        inner = (*at, "intrinsic") if isinstance(file.get(*at, "intrinsic"), dict) else at
        k = file.numbers((3, 3), *inner, "intrinsic_matrix").T
        rotation, t = None, np.zeros(3)
        if file.get(*at, "extrinsic") is not None:
            pose = file.numbers((4, 4), *at, "extrinsic").T
            if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
                raise file.error(
                    "needs 4 x 4 numbers in column order, the last row 0 0 0 1", *at, "extrinsic"
                )
            rotation, t = pose[:3, :3], pose[:3, 3]
        size: ImageSize | None = None
        if file.get(*inner, "width") is not None:
            size = file.size((*inner, "width"), (*inner, "height"))
        locations = {
            "": file.location(*at),
            "K": file.location(*inner, "intrinsic_matrix"),
            **dict.fromkeys(("R", "t"), file.location(*at, "extrinsic")),
        }
        file.add(cameras, name, RawCamera(k, rotation, t, size=size, locations=locations), *at)
    return cameras


def _write_open3d(cameras: Mapping[str, Camera]) -> dict[str, str]:
    version = {"version_major": 1, "version_minor": 0}
    parameters = [
        {
            "class_name": "PinholeCameraParameters",
            "name": name,
            "intrinsic": {
                "width": camera.size[0],
                "height": camera.size[1],
                "intrinsic_matrix": nested(camera.K.T.ravel()),
            },
            "extrinsic": nested(camera.optical_from_world.T.ravel()),
            **version,
        }
        for name, camera in cameras.items()
    ]
    data = {"class_name": "PinholeCameraTrajectory", "parameters": parameters, **version}
    return {"": json.dumps(data, indent=1) + "\n"}


REALSENSE = CalibrationFormat(
    "realsense",
    "RealSense intrinsics JSON",
    ".json",
    "json",
    _is_realsense,
    _read_realsense,
    _write_realsense,
    holds_pose=False,
    holds_skew=False,
    lenses={"plumb_bob": 5, "equidistant": 4},
)
OPEN3D = CalibrationFormat(
    "open3d", "Open3D camera JSON", ".json", "json", _is_open3d, _read_open3d, _write_open3d
)
