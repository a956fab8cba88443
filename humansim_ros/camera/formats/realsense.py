"""Intrinsics as JSON: dumps of rs2_intrinsics (librealsense, pyrealsense2), and camera files of Open3D.

The first have the fields of rs2_intrinsics, for one camera or for streams by name, and may have
rs2_extrinsics from depth to colour (metres, rotation in column order). Files of Open3D have
matrices in column order, and may have extrinsics (x = R X + t, metres). Both measure pixels from the centre
of the first one. https://github.com/realsenseai/librealsense/wiki/Projection-in-RealSense-SDK-2.0,
https://www.open3d.org/docs/release/python_api/open3d.camera.html
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from humansim_ros.camera.camera import Camera, pinhole
from humansim_ros.camera.formats.base import (
    CalibrationFile,
    CalibrationFormat,
    Keys,
    RawCamera,
    check_count,
    find_cameras,
    has_keys,
    json_file,
    nested,
    reader_of,
)
from humansim_ros.camera.formats.spellings import POSE, find_parameters
from humansim_ros.errors import warn_about
from humansim_ros.types import Array

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
    if '"ppx"' not in file.text and find_parameters(file).having(POSE):
        return []  # cx, cy and extrinsics are of another program
    return find_cameras(file, has_keys(*_FIELDS), has_keys({"fx", "ppx"}))


def _realsense_camera(file: CalibrationFile, at: Keys) -> RawCamera:
    fx, fy = (file.number(*at, key) for key in ("fx", "fy"))
    cx, cy = (
        float(file.numbers((), *at, next((k for k in keys if file.get(*at, k) is not None), keys[0])))
        for keys in (("ppx", "cx"), ("ppy", "cy"))
    )
    key = "coeffs" if file.get(*at, "coeffs") is not None else "distortion"
    distortion = file.optional_numbers(*at, key)
    model = _model(file, at, key, distortion)
    return RawCamera(
        pinhole(fx, fy, cx, cy),
        size=file.size((*at, "width"), (*at, "height")),
        distortion=tuple(distortion) if model else (),
        model=model,
        locations=file.locations(at, K="fx", distortion=key, size="width"),
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
    content = {}
    for name, camera in cameras.items():
        k = camera.K
        bent = camera.distorted
        content[name] = {
            "width": camera.size[0],
            "height": camera.size[1],
            "fx": k[0, 0],
            "fy": k[1, 1],
            "ppx": k[0, 2],
            "ppy": k[1, 2],
            "model": _WRITTEN[str(camera.model)] if bent else "none",
            "coeffs": [*nested(camera.distortion), 0.0][:5] if bent else [0.0] * 5,
        }
    return json_file(content)


# -- Open3D


def _open3d_cameras(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, _is_open3d_camera, has_keys({"intrinsic", "intrinsic_matrix", "extrinsic"}))


def _is_open3d_camera(value: Any) -> bool:
    if not isinstance(value, dict):
        return False
    inner = value.get("intrinsic")
    if isinstance(inner, dict):
        return "intrinsic_matrix" in inner
    k = value.get("intrinsic_matrix")
    # nine numbers in column order; other programs write rows
    return isinstance(k, list) and len(k) == 9 and (not k[2] or bool(k[6]))


def _open3d_camera(file: CalibrationFile, at: Keys) -> RawCamera:
    inner = (*at, "intrinsic") if isinstance(file.get(*at, "intrinsic"), dict) else at
    rotation, t = None, np.zeros(3)
    if file.get(*at, "extrinsic") is not None:
        pose = file.numbers((4, 4), *at, "extrinsic").T
        if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
            raise file.error("needs 4 x 4 numbers in column order, the last row 0 0 0 1", *at, "extrinsic")
        rotation, t = pose[:3, :3], pose[:3, 3]
    sized = file.get(*inner, "width") is not None
    return RawCamera(
        file.numbers((3, 3), *inner, "intrinsic_matrix").T,
        rotation,
        t,
        size=file.size((*inner, "width"), (*inner, "height")) if sized else None,
        locations={
            **file.locations(at, R="extrinsic", t="extrinsic"),
            "K": file.location(*inner, "intrinsic_matrix"),
        },
    )


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
    return json_file({"class_name": "PinholeCameraTrajectory", "parameters": parameters, **version})


#: Keys of rs2_extrinsics between the streams of one device.
_EXTRINSICS = ("extrinsics", "depth_to_color", "depth_to_color_extrinsics", "extrinsics_depth_to_color")
_matches_realsense, _read_streams = reader_of(_realsense_cameras, _realsense_camera)


def _read_realsense(file: CalibrationFile) -> dict[str, RawCamera]:
    """Streams; with rs2_extrinsics from the depth to the colour stream, the depth camera is the world."""
    cameras = _read_streams(file)
    at = next((key for key in _EXTRINSICS if isinstance(file.get(key), dict)), None)
    depth = [name for name in cameras if "depth" in name.lower()]
    color = [name for name in cameras if "color" in name.lower() or "rgb" in name.lower()]
    if at is None or len(depth) != 1 or len(color) != 1:
        return cameras
    # librealsense stores rotations in column order
    rotation = file.numbers((3, 3), at, "rotation").T
    t = file.numbers((3,), at, "translation")
    where = {"R": file.location(at, "rotation"), "t": file.location(at, "translation")}
    if at == "extrinsics":
        warn_about(file.path, f"{at}: taken from depth to color, with the rotation in column order")
    posed = replace(cameras[color[0]], R=rotation, t=t, locations={**cameras[color[0]].locations, **where})
    return cameras | {depth[0]: replace(cameras[depth[0]], R=np.eye(3)), color[0]: posed}


REALSENSE = CalibrationFormat(
    "realsense",
    "RealSense intrinsics JSON",
    ".json",
    "json",
    _matches_realsense,
    _read_realsense,
    _write_realsense,
    holds_pose=False,
    holds_skew=False,
    lenses={"plumb_bob": 5, "equidistant": 4},
)
OPEN3D = CalibrationFormat(
    "open3d",
    "Open3D camera JSON",
    ".json",
    "json",
    *reader_of(_open3d_cameras, _open3d_camera),
    _write_open3d,
)
