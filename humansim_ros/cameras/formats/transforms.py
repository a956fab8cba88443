"""transforms.json of NeRF, Instant-NGP and Nerfstudio, and cameras of Blender as JSON.

transform_matrix is the pose of a camera in the world, with the camera axes of OpenGL (x right, y up, z
backward). The centre of the first pixel is (0.5, 0.5), as in COLMAP. The world has z up and any unit.
https://github.com/NVlabs/instant-ngp/blob/master/docs/nerf_dataset_tips.md

JSON of Blender has the names of bpy: matrix_world (or location with rotation_euler or
rotation_quaternion) with the same camera axes, lens and sensor_width in mm (or angle), shift_x and shift_y,
resolution_x and resolution_y. https://docs.blender.org/api/current/bpy.types.Camera.html
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.camera.lens import MODELS
from humansim_ros.cameras.formats.base import (
    FLIP,
    CalibrationFile,
    Key,
    Keys,
    RawCamera,
    SourceLocation,
    find_cameras,
    has_keys,
    reader_of,
    without_suffix,
)
from humansim_ros.cameras.formats.checks import size_of_named_image
from humansim_ros.cameras.formats.table import Values, calibration_format
from humansim_ros.errors import warn_about
from humansim_ros.types import Array, ImageSize

#: Image size of the synthetic scenes of NeRF. Their files have no size.
_NERF_SIZE = (800, 800)
#: Folder of the images in most files. It is not part of a camera's name.
_FOLDER = "images/"
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
#: Names of lens models in ``camera_model``.
_MODELS = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"), "plumb_bob"),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "equidistant"),
}


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
    """Names of the cameras, which are those of their images."""
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
        FLIP @ pose[:3, :3].T,
        center=pose[:3, 3],
        size=size,
        distortion=distortion,
        model=model,
        locations={"": file.location("frames", index), "R": at, "t": at, "K": _where(file, index, "fl_x")},
    )


def _keys(file: CalibrationFile, index: int, key: str) -> tuple[Key, ...]:
    """Key path of a value of a frame. The frame has the key itself, or the file has it for all frames."""
    own: tuple[Key, ...] = ("frames", index, key)
    return own if file.get(*own) is not None else (key,)


def _where(file: CalibrationFile, index: int, key: str) -> SourceLocation:
    return file.location(*_keys(file, index, key))


def _number(file: CalibrationFile, index: int, key: str) -> float | None:
    keys = _keys(file, index, key)
    return None if file.get(*keys) is None else file.number(*keys)


def _size(file: CalibrationFile, index: int) -> ImageSize | None:
    width, height = _keys(file, index, "w"), _keys(file, index, "h")
    if file.get(*width) is not None or file.get(*height) is not None:
        return file.size(width, height)
    image = str(file.get("frames", index, "file_path") or "")
    folder = Path(file.path).parent
    return size_of_named_image(folder, image) or size_of_named_image(folder, f"{image}.png")


def _matrix(file: CalibrationFile, index: int, size: ImageSize | None) -> Array:
    """K of a frame. The size is needed if the file has an angle, or no principal point."""
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


def _values(own: Values, camera: Camera) -> Values:
    return {"lens": "OPENCV_FISHEYE" if camera.model == "equidistant" else "OPENCV"}


TRANSFORMS = calibration_format("transforms", _is_transforms, _read, values=_values)


# -- Blender: cameras as scripts write them, with the names of bpy

_BLENDER_POSE = {"matrix_world", "location"}
_BLENDER_LENS = {"lens", "angle", "angle_x", "focal_length_mm"}


def _blender_cameras(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, has_keys(_BLENDER_POSE, _BLENDER_LENS), has_keys(_BLENDER_POSE))


def _blender_value(file: CalibrationFile, at: Keys, key: str, otherwise: float | None = None) -> float:
    """Number from a camera, or from the section ``render``, or from the file."""
    places: tuple[Keys, ...] = ((*at, key), (*at, "render", key), ("render", key), (key,))
    found = next((place for place in places if file.get(*place) is not None), None)
    if found is None and otherwise is not None:
        return otherwise
    return float(file.numbers((), *(found or (*at, key))))


def _blender_camera(file: CalibrationFile, at: Keys) -> RawCamera:
    sides = [_blender_value(file, at, f"resolution_{axis}") for axis in "xy"]
    percent = _blender_value(file, at, "resolution_percentage", 100.0) / 100
    width, height = (round(side * percent) for side in sides)
    if min(width, height) < 1:
        raise file.error("needs resolution_x and resolution_y above zero", *at)
    aspects = [_blender_value(file, at, f"pixel_aspect_{axis}", 1.0) for axis in "xy"]
    if min(aspects) <= 0:
        raise file.error("needs pixel aspects above zero", *at)
    aspect = aspects[1] / aspects[0]
    fit = str(file.get(*at, "sensor_fit") or "AUTO").upper()
    across = fit == "HORIZONTAL" or (fit == "AUTO" and width >= aspect * height)
    view = width if across else aspect * height
    if any(file.get(*at, key) is not None for key in ("lens", "focal_length_mm")):
        key = "lens" if file.get(*at, "lens") is not None else "focal_length_mm"
        sensor = _blender_value(file, at, "sensor_width", 36.0)
        if fit == "VERTICAL":
            sensor = _blender_value(file, at, "sensor_height", 24.0)
        if sensor <= 0:
            raise file.error("needs a sensor above zero", *at, "sensor_width")
        focal = _blender_value(file, at, key) / sensor * view
    else:
        key = "angle" if file.get(*at, "angle") is not None else "angle_x"
        angle = _blender_value(file, at, key)
        if not 1e-9 < angle < np.pi:
            raise file.error(f"must be an angle between 0 and pi radians, not {angle:g}", *at, key)
        focal = (width if key == "angle_x" else view) / 2 / float(np.tan(angle / 2))
    cx = width / 2 - _blender_value(file, at, "shift_x", 0.0) * view - 0.5
    cy = height / 2 + _blender_value(file, at, "shift_y", 0.0) * view / aspect - 0.5
    rotation, center = _blender_pose(file, at)
    part = "matrix_world" if file.get(*at, "matrix_world") is not None else "location"
    return RawCamera(
        pinhole(focal, focal / aspect, cx, cy),
        FLIP @ rotation.T,
        center=center,
        size=(width, height),
        locations=file.locations(at, K=key, R=part, t=part),
    )


def _blender_pose(file: CalibrationFile, at: Keys) -> tuple[Array, Array]:
    """Rotation from the axes of the camera to the world, and its centre."""
    if file.get(*at, "matrix_world") is not None:
        pose = file.pose_matrix(*at, "matrix_world", rows=4, tolerance=1e-6)
        lengths = np.linalg.norm(pose[:3, :3], axis=0)
        if lengths.min() <= 0:
            raise file.error("has an axis of length 0", *at, "matrix_world")
        return pose[:3, :3] / lengths, pose[:3, 3]
    center = file.numbers((3,), *at, "location")
    if file.get(*at, "rotation_quaternion") is not None:
        w, x, y, z = file.numbers((4,), *at, "rotation_quaternion")
        return file.unit_rotation(np.array([x, y, z, w]), *at, "rotation_quaternion"), center
    angles = file.numbers((3,), *at, "rotation_euler")
    return np.asarray(Rotation.from_euler("xyz", angles).as_matrix()), center


def _blender_values(own: Values, camera: Camera) -> Values:
    width, height = camera.size
    return {
        "lens": own["fx"] / width * 36.0,
        "shift_x": (width / 2 - own["cx"] - 0.5) / width,
        "shift_y": (own["cy"] + 0.5 - height / 2) / width * own["aspect"],
    }


BLENDER = calibration_format("blender", *reader_of(_blender_cameras, _blender_camera), values=_blender_values)
