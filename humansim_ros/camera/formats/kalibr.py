"""camchain.yaml and camchain-imucam.yaml of Kalibr: x_cn = T_cn_cnm1 x_cn-1, metres.

The world frame is the first camera, or the IMU if the file has T_cam_imu, or T_imu_cam (its inverse) as in
OpenVINS. Omnidirectional models are refused.
https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import CalibrationFile, CalibrationFormat, Key, RawCamera, row
from humansim_ros.camera.formats.lens_models import check_count
from humansim_ros.rotations import invert_rigid, transform
from humansim_ros.types import Array

#: Largest error of orthonormality that rounding explains.
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
        # with extrinsics of the IMU for the first camera, the chain starts there
        imu = next((key for key in _IMU if file.get(name, key) is not None), None)
        if imu is not None and (pose is None or file.get(names[0], imu) is not None):
            pose, key = _transform(file, name, imu), imu
            pose = invert_rigid(_rigid(pose)) if imu == "T_imu_cam" else pose
        elif pose is None:
            pose, key = np.eye(4), "T_cn_cnm1"
        else:
            pose, key = _transform(file, name, "T_cn_cnm1") @ pose, "T_cn_cnm1"
        file.add(cameras, name, _camera(file, name, pose, key), name)
    return cameras


def _transform(file: CalibrationFile, *keys: Key) -> Array:
    matrix = file.numbers((4, 4), *keys)
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise file.error("needs 0 0 0 1 as the last row of its 4 x 4 numbers", *keys)
    return matrix


def _rigid(matrix: Array) -> Array:
    """The same transform with an exact rotation, where its error is that of rounding."""
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROUNDING:
        return matrix
    u, _, vt = np.linalg.svd(rotation)
    return transform(u @ vt, matrix[:3, 3])


def _camera(file: CalibrationFile, name: str, pose: Array, pose_key: str) -> RawCamera:
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
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        pose[:3, :3],
        pose[:3, 3],
        size=file.size((name, "resolution", 0), (name, "resolution", 1)),
        distortion=tuple(distortion),
        model=model,
        locations={
            "": file.location(name),
            "K": file.location(name, "intrinsics"),
            "distortion": file.location(name, "distortion_coeffs"),
            "R": file.location(name, pose_key),
            "t": file.location(name, pose_key),
            "size": file.location(name, "resolution"),
        },
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
            lines += _matrix_lines("T_cn_cnm1", poses[index] @ invert_rigid(poses[index - 1]))
        if not at_first:
            lines += _matrix_lines("T_cam_imu", poses[index])
    return {"": "\n".join(lines) + "\n"}


def _model_name(camera: Camera) -> str:
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
