"""Kalibr's camchain.yaml and camchain-imucam.yaml: x_cn = T_cn_cnm1 x_cn-1, metres.

The world is the first camera, or the IMU where T_cam_imu tells where it is. Omnidirectional models are
refused. https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import CalibrationFormat, CalibrationSource, Key, RawCamera, row
from humansim_ros.camera.formats.models import check_count
from humansim_ros.rotations import invert_rigid
from humansim_ros.types import Array

_CAMERA = re.compile(r"cam[0-9]+")
_MODELS = {"radtan": "plumb_bob", "equidistant": "equidistant", "equi": "equidistant", "none": None}


def _names(source: CalibrationSource) -> list[str]:
    keys = source.document if isinstance(source.document, dict) else {}
    return [key for key in keys if isinstance(key, str) and _CAMERA.fullmatch(key)]


def _is_camchain(source: CalibrationSource) -> bool:
    return any(isinstance(source.get(name, "camera_model"), str) for name in _names(source))


def _read(source: CalibrationSource) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    names = _names(source)
    pose: Array | None = None
    imu = source.get(names[0], "T_cam_imu") is not None
    for name in names:
        if imu and source.get(name, "T_cam_imu") is not None:
            pose, said = _transform(source, name, "T_cam_imu"), "T_cam_imu"
        elif pose is None:
            pose, said = np.eye(4), "T_cn_cnm1"
        else:
            pose, said = _transform(source, name, "T_cn_cnm1") @ pose, "T_cn_cnm1"
        source.add(cameras, name, _camera(source, name, pose, said), name)
    return cameras


def _transform(source: CalibrationSource, *keys: Key) -> Array:
    matrix = source.numbers((4, 4), *keys)
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise source.error("needs 0 0 0 1 as the last row of its 4 x 4 numbers", *keys)
    return matrix


def _camera(source: CalibrationSource, name: str, pose: Array, said: str) -> RawCamera:
    if source.need(name, "camera_model") != "pinhole":
        message = f"{source.get(name, 'camera_model')!r} cameras are not known here, only pinhole"
        raise source.error(message, name, "camera_model")
    fx, fy, cx, cy = source.numbers((4,), name, "intrinsics")
    named = str(source.get(name, "distortion_model") or "none").lower()
    if named not in _MODELS:
        message = f"distortion model {named!r} is not known here; there are {', '.join(_MODELS)}"
        raise source.error(message, name, "distortion_model")
    model = _MODELS[named]
    distortion: Array = np.zeros(0)
    if model is not None:
        distortion = source.numbers((4,), name, "distortion_coeffs")
        check_count(source, model, distortion, (name, "distortion_coeffs"))
    source.numbers((2,), name, "resolution")
    return RawCamera(
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        pose[:3, :3],
        pose[:3, 3],
        size=source.size((name, "resolution", 0), (name, "resolution", 1)),
        distortion=tuple(distortion),
        model=model,
        places={
            "": source.place(name),
            "K": source.place(name, "intrinsics"),
            "distortion": source.place(name, "distortion_coeffs"),
            "R": source.place(name, said),
            "t": source.place(name, said),
            "size": source.place(name, "resolution"),
        },
    )


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    poses = [camera.optical_from_world for camera in cameras.values()]
    at_first = np.array_equal(poses[0], np.eye(4))
    lines = [] if at_first else ["# T_cam_imu: from the world, metres, to each camera"]
    for index, (name, camera) in enumerate(cameras.items()):
        model = "none" if not camera.distorted else _names_of(camera)
        k = camera.K
        lines += [f"cam{index}:", "  cam_overlaps: []", "  camera_model: pinhole"]
        lines += [f"  intrinsics: [{row((k[0, 0], k[1, 1], k[0, 2], k[1, 2]), ', ')}]"]
        lines += [f"  distortion_model: {model}"]
        lines += [f"  distortion_coeffs: [{row(camera.distortion[:4] if model != 'none' else (), ', ')}]"]
        lines += [f"  resolution: [{camera.size[0]}, {camera.size[1]}]", f"  rostopic: {_topic(name)}"]
        if index:
            lines += _matrix_lines("T_cn_cnm1", poses[index] @ invert_rigid(poses[index - 1]))
        if not at_first:
            lines += _matrix_lines("T_cam_imu", poses[index])
    return {"": "\n".join(lines) + "\n"}


def _names_of(camera: Camera) -> str:
    return "equidistant" if camera.model == "equidistant" else "radtan"


def _topic(name: str) -> str:
    return f"/{re.sub('[^A-Za-z0-9_]', '_', name)}/image_raw"


def _matrix_lines(key: str, matrix: Array) -> list[str]:
    return [f"  {key}:", *(f"  - [{row(values, ', ')}]" for values in matrix)]


KALIBR = CalibrationFormat(
    "kalibr",
    "Kalibr camchain YAML",
    ".yaml",
    "yaml",
    _is_camchain,
    _read,
    _write,
    holds_skew=False,
    lenses={"plumb_bob": 4, "equidistant": 4},
)
