"""transforms.json of NeRF, Instant-NGP and Nerfstudio: intrinsics, and the pose of each image.

transform_matrix is the pose of a camera in the world, with the camera axes of OpenGL (x right, y up, z
backward). The centre of the first pixel is (0.5, 0.5), as in COLMAP. The world has z up and any unit.
https://github.com/NVlabs/instant-ngp/blob/master/docs/nerf_dataset_tips.md
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from humansim_ros.camera.camera import Camera, pinhole
from humansim_ros.camera.checks import size_of_named_image
from humansim_ros.camera.formats.base import (
    CalibrationFile,
    CalibrationFormat,
    Key,
    RawCamera,
    SourceLocation,
    image_names,
    json_file,
    nested,
    without_suffix,
)
from humansim_ros.camera.lens import MODELS
from humansim_ros.errors import warn_about
from humansim_ros.types import Array, ImageSize

#: Size of the images of the synthetic scenes of NeRF, whose files have no size.
_NERF_SIZE = (800, 800)
#: Folder of images in most files, which is not part of a camera's name.
_FOLDER = "images/"
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
#: Names of lens models in ``camera_model``.
_MODELS = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"), "plumb_bob"),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "equidistant"),
}
_FLIP = np.diag([1.0, -1.0, -1.0])


def _is_transforms(file: CalibrationFile) -> bool:
    frames = file.get("frames")
    return isinstance(frames, list) and any(isinstance(f, dict) and "transform_matrix" in f for f in frames)


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    assumed = False
    for index, name in enumerate(_names(file)):
        size = _size(file, index)
        if size is None and file.given_size is None and _number(file, index, "cx") is None:
            size, assumed = _NERF_SIZE, True
        file.add(cameras, name, _camera(file, index, size), "frames", index)
    if assumed:
        width, height = _NERF_SIZE
        message = f"w and h are missing; {width}x{height} is assumed, as in the synthetic scenes of NeRF"
        warn_about(file.path, message)
    return cameras


def _names(file: CalibrationFile) -> list[str]:
    """Names of the cameras: the names of their images."""
    names = []
    for index, _ in enumerate(file.need("frames")):
        image = file.get("frames", index, "file_path")
        name = without_suffix(str(image).strip().removeprefix("./")) if image is not None else ""
        names.append(name or str(index))
    if all(name.startswith(_FOLDER) and name != _FOLDER for name in names):
        names = [name.removeprefix(_FOLDER) for name in names]
    return names


def _camera(file: CalibrationFile, index: int, size: ImageSize | None) -> RawCamera:
    keys = ("frames", index, "transform_matrix")
    rows = 3 if len(file.some_numbers(*keys)) == 12 else 4
    pose = file.pose_matrix(*keys, rows=rows, tolerance=1e-6)
    k = _matrix(file, index, file.given_size or size)
    model, distortion = _lens(file, index)
    at = file.location(*keys)
    return RawCamera(
        k,
        _FLIP @ pose[:3, :3].T,
        center=pose[:3, 3],
        size=size,
        distortion=distortion,
        model=model,
        locations={"": file.location("frames", index), "R": at, "t": at, "K": _where(file, index, "fl_x")},
    )


def _keys(file: CalibrationFile, index: int, key: str) -> tuple[Key, ...]:
    """Key path of a value of a frame: its own key, or the key of all frames."""
    own: tuple[Key, ...] = ("frames", index, key)
    return own if file.get(*own) is not None else (key,)


def _where(file: CalibrationFile, index: int, key: str) -> SourceLocation:
    return file.location(*_keys(file, index, key))


def _number(file: CalibrationFile, index: int, key: str) -> float | None:
    keys = _keys(file, index, key)
    return None if file.get(*keys) is None else float(file.numbers((), *keys))


def _size(file: CalibrationFile, index: int) -> ImageSize | None:
    width, height = _keys(file, index, "w"), _keys(file, index, "h")
    if file.get(*width) is not None or file.get(*height) is not None:
        return file.size(width, height)
    image = str(file.get("frames", index, "file_path") or "")
    folder = Path(file.path).parent
    return size_of_named_image(folder, image) or size_of_named_image(folder, f"{image}.png")


def _matrix(file: CalibrationFile, index: int, size: ImageSize | None) -> Array:
    """K of a frame. The size is needed where the file has an angle, or no principal point."""
    width, height = size or (None, None)
    given = _focal_length(file, index, "x", width), _focal_length(file, index, "y", height)
    lengths = [length for length in given if length is not None]
    if not lengths:
        raise file.error("is missing: give fl_x, or camera_angle_x", *_keys(file, index, "fl_x"))
    cx, cy = _number(file, index, "cx"), _number(file, index, "cy")
    if (cx is None or cy is None) and size is None:
        raise file.error("is missing", *_keys(file, index, "cx" if cx is None else "cy"))
    cx = (width or 0) / 2 if cx is None else cx
    cy = (height or 0) / 2 if cy is None else cy
    return pinhole(lengths[0], lengths[-1], cx - 0.5, cy - 0.5)


def _focal_length(file: CalibrationFile, index: int, axis: str, side: int | None) -> float | None:
    length, angle = _number(file, index, f"fl_{axis}"), _number(file, index, f"camera_angle_{axis}")
    if length is not None or angle is None:
        return length
    keys = _keys(file, index, f"camera_angle_{axis}")
    if not 0 < angle < np.pi:
        raise file.error(f"must be an angle between 0 and pi radians, not {angle:g}", *keys)
    if side is None:
        raise file.error("needs w and h as well", *keys)
    return float(side / 2 / np.tan(angle / 2))


def _lens(file: CalibrationFile, index: int) -> tuple[str, tuple[float, ...]]:
    keys = _keys(file, index, "camera_model")
    word = file.get(*keys)
    fisheye = file.get(*_keys(file, index, "is_fisheye")) is True
    model = "equidistant" if fisheye else "plumb_bob"
    if word is not None:
        if str(word).upper() not in _MODELS:
            message = f"unknown camera model {str(word)[:40]!r}; known are {', '.join(_MODELS)}"
            raise file.error(message, *keys)
        model = _MODELS[str(word).upper()]
    values = {key: _number(file, index, key) or 0.0 for key in _COEFFICIENTS}
    for key in set(_COEFFICIENTS) - set(MODELS[model]):
        if values[key]:
            raise file.error(f"is not supported by a {model} lens", *_keys(file, index, key))
    return model, tuple(values[key] for key in MODELS[model])


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    images = image_names(cameras)
    frames = []
    for name, camera in cameras.items():
        pose = camera.world_from_optical.copy()
        pose[:3, :3] = pose[:3, :3] @ _FLIP
        model = str(camera.model)
        k = camera.K
        frames.append(
            {
                "file_path": f"{_FOLDER}{images[name]}",
                "w": camera.size[0],
                "h": camera.size[1],
                "fl_x": k[0, 0],
                "fl_y": k[1, 1],
                "cx": k[0, 2] + 0.5,
                "cy": k[1, 2] + 0.5,
                "camera_model": "OPENCV_FISHEYE" if model == "equidistant" else "OPENCV",
                **{key: camera.distortion[i] for i, key in enumerate(MODELS[model])},
                "transform_matrix": nested(pose),
            }
        )
    fisheye = (
        {"is_fisheye": True} if all(camera.model == "equidistant" for camera in cameras.values()) else {}
    )
    return json_file({**fisheye, "frames": frames})


TRANSFORMS = CalibrationFormat(
    "transforms",
    "transforms.json of NeRF, Instant-NGP",
    ".json",
    "json",
    _is_transforms,
    _read,
    _write,
    holds_skew=False,
    lenses={"plumb_bob": 5, "equidistant": 4},
)
