"""Files of public data sets, of motion capture without markers, and of Blender.

- JSON of Human3.6M, Shelf and Campus (in the format of VoxelPose), and CMU Panoptic.
- TOML of Anipose, which FreeMoCap, Caliscope and Pose2Sim write too: x_cam = R x + t. The file does not name
  its unit. It is the unit of the calibration board: millimetres for most boards, metres in Pose2Sim.
  https://anipose.readthedocs.io/en/latest/aniposelib-tutorial.html
- JSON of 4DAssociation and related programs: K, RT (3x4) or R and T, distCoeff, imgSize; x = R X + t; metres,
  z up. The world of the Shelf data in this format is the floor. https://github.com/zhangyux15/4d_association
- transforms.json of NeRF, Instant-NGP and Nerfstudio. transform_matrix is the pose of a camera in the world,
  with the camera axes of OpenGL (x right, y up, z backward). The centre of the first pixel is (0.5, 0.5), as
  in COLMAP. The world has z up and any unit.
  https://github.com/NVlabs/instant-ngp/blob/master/docs/nerf_dataset_tips.md
- JSON of Blender with the names of bpy: matrix_world (or location with rotation_euler or rotation_quaternion)
  with the same camera axes, lens and sensor_width in mm (or angle), shift_x and shift_y, resolution_x and
  resolution_y. https://docs.blender.org/api/current/bpy.types.Camera.html
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.camera.lens import MODELS
from humansim_ros.cameras.formats.base import (
    FLIP,
    CalibrationFile,
    Keys,
    Place,
    RawCamera,
    camera_at,
    has_keys,
    opencv_model,
    reader_of,
    without_suffix,
)
from humansim_ros.cameras.formats.checks import IMAGE_SIZES, size_of_named_image
from humansim_ros.cameras.formats.conventions import FilePose, find_unit, resolved, stated_unit
from humansim_ros.cameras.formats.spellings import role_of
from humansim_ros.cameras.formats.table import Values, calibration_format, json_file, nested
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.types import Array, ImageSize

# -- Human3.6M: x = R X + t in millimetres, z up; 4 cameras, with a pose for each of 11 subjects

#: Image sizes of the cameras by their serial numbers.
_H36M_SIZES: dict[str, ImageSize] = {serial: (w, h) for serial, (w, h) in IMAGE_SIZES["human36m"].items()}
#: Keys of lens and focal lengths in files of Shelf and Campus. One of these keys identifies a file.
_SHELF_INTRINSICS = {"k", "p", "f"}
_PANEL_AND_NODE = re.compile(r"([0-9]{2})_([0-9]{2})")
_SUBJECT = re.compile(r"(S[0-9]+)_(.+)", re.DOTALL)


def _is_h36m(file: CalibrationFile) -> bool:
    inner, outer = file.get("intrinsics"), file.get("extrinsics")
    whole = isinstance(inner, dict) and isinstance(outer, dict)
    return whole and any(map(has_keys({"calibration_matrix"}), inner.values()))


def _read_h36m(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    subjects = file.mapping("extrinsics")
    for subject in subjects:
        for name in file.mapping("extrinsics", subject):
            if name not in file.mapping("intrinsics"):
                raise file.error("has no intrinsics", "extrinsics", subject, name)
            inner, outer = ("intrinsics", name), ("extrinsics", subject, name)
            for keys in ((*inner, "distortion"), (*outer, "R")):
                file.need(*keys)
            places: dict[str, Place] = {
                "K": (*inner, "calibration_matrix"),
                "distortion": (*inner, "distortion"),
            }
            places |= {"R": (*outer, "R"), "t": (*outer, "t")}
            camera = camera_at(file, (), places, size=_H36M_SIZES.get(str(name)), model="plumb_bob")
            file.add(cameras, name if len(subjects) == 1 else f"{subject}_{name}", camera)
    return cameras


def _write_h36m(cameras: Mapping[str, Camera]) -> dict[str, str]:
    intrinsics: dict[str, Any] = {}
    extrinsics: dict[str, Any] = {}
    for name, camera in cameras.items():
        matched = _SUBJECT.fullmatch(name)
        subject, serial = (matched[1], matched[2]) if matched else ("S1", name)
        parameters = {"calibration_matrix": nested(camera.K), "distortion": nested(camera.distortion[:5])}
        if intrinsics.setdefault(serial, parameters) != parameters:
            message = "this format needs the same K and lens of a camera for all subjects"
            raise CameraError(message, key=name)
        poses = extrinsics.setdefault(subject, {})
        if serial in poses:
            raise CameraError(f"there are two cameras {serial} of subject {subject}", key=name)
        poses[serial] = {"R": nested(camera.R), "t": nested(camera.t[:, None])}
    return json_file({"intrinsics": intrinsics, "extrinsics": extrinsics})


# -- Shelf and Campus: x = R (X - T), where T is the camera centre; millimetres, z up


def _shelf_camera(file: CalibrationFile, at: Keys) -> RawCamera:
    own: dict[str, Any] = {}
    if file.has(*at, "f") and not file.has(*at, "fx"):  # arrays as VoxelPose writes them
        own["K"] = pinhole(*file.numbers((2,), *at, "f"), *file.numbers((2,), *at, "c"))
    size = file.pair_size(*at, "imgSize")
    if size is None and file.has(*at, "width") and file.has(*at, "height"):
        size = file.size((*at, "width"), (*at, "height"))
    radial, tangential = (
        file.numbers((count,), *at, key) if file.has(*at, key) else np.zeros(count)
        for key, count in (("k", 3), ("p", 2))
    )
    places = {"K": "fx fy cx cy", "R": "R", "center": "T", "distortion": "k"}
    lens = (*radial[:2], *tangential, radial[2])
    return camera_at(file, at, places, **own, size=size, distortion=lens, model="plumb_bob")


_is_shelf, _read_as_shelf = reader_of(
    has_keys({"R"}, {"T"}, _SHELF_INTRINSICS), has_keys({"R", "T", "fx", "f"}), _shelf_camera
)


def _read_shelf(file: CalibrationFile) -> dict[str, RawCamera]:
    """Cameras with R and T as VoxelPose defines them, unless the file or the views contradict."""
    cameras = _read_as_shelf(file)
    poses = {
        name: FilePose(
            camera.R, camera.position, "shelf", False, {part: camera.locations[part] for part in ("R", "t")}
        )
        for name, camera in cameras.items()
        if camera.R is not None
    }
    return {**cameras, **resolved(file, cameras, poses)}


# -- CMU Panoptic: x = R X + t in centimetres, y down


def _is_panoptic(file: CalibrationFile) -> bool:
    cameras = file.get("cameras")
    own = has_keys({"K"}, {"distCoef", "panel"}), has_keys({"K"}, {"type"}, {"resolution"})
    return isinstance(cameras, list) and any(is_own(camera) for camera in cameras for is_own in own)


def _read_panoptic(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    places = {"K": "K", "R": "R", "t": "t", "distortion": "distCoef", "size": "resolution"}
    for at in file.paths("cameras"):
        camera = camera_at(file, at, places, model="plumb_bob")
        file.add(cameras, str(file.need(*at, "name")), camera, *at)
    return cameras


def _panoptic_values(own: Values, camera: Camera) -> Values:
    """Values for the template, from the name of a camera: its type, and its panel and node in the studio."""
    matched = _PANEL_AND_NODE.fullmatch(own["name"])
    panel, node = (int(matched[1]), int(matched[2])) if matched else (0, own["index"])
    return {"type": "hd" if camera.size == (1920, 1080) else "vga", "panel": panel, "node": node}


H36M = calibration_format("human36m", _is_h36m, _read_h36m, _write_h36m)
SHELF = calibration_format(
    "shelf", _is_shelf, _read_shelf, find_unit=lambda file, _: stated_unit(file) or 0.001
)
PANOPTIC = calibration_format("panoptic", _is_panoptic, _read_panoptic, values=_panoptic_values)


_PARTS = {"matrix", "rotation", "translation", "distortions"}


def _camera_anipose(file: CalibrationFile, at: Keys) -> RawCamera:
    places = {
        "K": "matrix",
        "rvec": "rotation",
        "t": "translation",
        "size": "size",
        "distortion": "distortions",
    }
    lens = file.optional_numbers(*at, "distortions")
    for present, missing in (("rotation", "translation"), ("translation", "rotation")):
        if file.has(*at, present) and not file.has(*at, missing):
            raise file.error(f"needs {missing} as well", *at, present)
    return camera_at(file, at, places, distortion=lens, model=_anipose_model(file, at, lens))


def _anipose_model(file: CalibrationFile, at: Keys, distortion: Array) -> str:
    fisheye = file.get(*at, "fisheye")
    if fisheye is not None and not isinstance(fisheye, bool):
        raise file.error("needs true or false", *at, "fisheye")
    model = "equidistant" if fisheye else opencv_model(distortion)
    if len(distortion) >= 4 or model == "equidistant":
        file.check_count(model, distortion, (*at, "distortions"))
    return model


def _anipose_values(own: Values, camera: Camera) -> Values:
    name = own["name"]
    if not name.isprintable():
        raise CameraError("this format needs a name without control characters", key=name)
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return {"quoted": f'"{escaped}"', "fisheye": str(camera.model == "equidistant").lower()}


ANIPOSE = calibration_format(
    "anipose",
    *reader_of(has_keys({"matrix"}), has_keys(_PARTS), _camera_anipose, named=True),
    values=_anipose_values,
    find_unit=find_unit,
)


#: Keys of the lens, in order of precedence.
_LENS = ("distCoeff", "distCoeffs", "distCoef", "distortion_coefficients", "D")


#: Keys of a camera. If a camera has other parameters, the file has another format.
_OWN = {"K", "RT", "R", "T", "t", "imgSize", "name", "id", *_LENS}


def _is_camera(value: object) -> bool:
    if not isinstance(value, dict) or "K" not in value or value.keys().isdisjoint(("RT", "imgSize")):
        return False
    return not any(role_of(key) for key in value.keys() - _OWN)


def _camera_association(file: CalibrationFile, at: Keys) -> RawCamera:
    whole = file.has(*at, "RT")
    shift = "RT" if whole else file.first(at, "T", "t") or "T"
    lens = next((key for key in _LENS if file.get(*at, key) not in (None, [])), _LENS[0])
    places = {"K": "K", "rvec": "RT" if whole else "R", "t": shift, "distortion": lens, "size": "imgSize"}
    if not whole:
        return camera_at(file, at, places)
    rows = 4 if len(file.some_numbers(*at, "RT")) == 16 else 3
    matrix = file.pose_matrix(*at, "RT", rows=rows)
    return camera_at(file, at, places, R=matrix[:3, :3], t=matrix[:3, 3])


ASSOCIATION = calibration_format(
    "4dassociation", *reader_of(_is_camera, has_keys({"K", "RT"}), _camera_association)
)


# -- transforms.json

#: Image size of the synthetic scenes of NeRF. Their files have no size.
_NERF_SIZE = (800, 800)
#: Folder of the images in most files. It is not part of a camera's name.
_FOLDER = "images/"
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
#: Names of lens models in ``camera_model``.
_COLMAP_LENSES = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"), "plumb_bob"),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "equidistant"),
}


def _is_transforms(file: CalibrationFile) -> bool:
    frames = file.get("frames")
    return isinstance(frames, list) and any(map(has_keys({"transform_matrix"}), frames))


def _read_transforms(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    assumed = False
    for index, name in enumerate(_names(file)):
        size = _size(file, index)
        if size is None and file.given_size is None and _number(file, index, "cx") is None:
            size, assumed = _NERF_SIZE, True
        file.add(cameras, name, _frame_camera(file, index, size), "frames", index)
    if assumed:
        width, height = _NERF_SIZE
        message = f"w and h are missing; {width}x{height} is assumed, as in the synthetic scenes of NeRF"
        warn_about(file.path, message)
    return cameras


def _names(file: CalibrationFile) -> list[str]:
    """Names of the cameras, made from the names of their images."""
    names = []
    for index, _ in enumerate(file.need("frames")):
        image = str(file.get("frames", index, "file_path") or "").strip().removeprefix("./")
        names.append(without_suffix(image) or str(index))
    if all(name.startswith(_FOLDER) and name != _FOLDER for name in names):
        names = [name.removeprefix(_FOLDER) for name in names]
    return names


def _frame_camera(file: CalibrationFile, index: int, size: ImageSize | None) -> RawCamera:
    keys = ("frames", index, "transform_matrix")
    rows = 3 if len(file.some_numbers(*keys)) == 12 else 4
    pose = file.pose_matrix(*keys, rows=rows, tolerance=1e-6)
    k = _matrix(file, index, file.given_size or size)
    model, lens = _frame_lens(file, index)
    locations = file.locations(keys[:2], R=keys[2], t=keys[2]) | {
        "K": file.location(*_keys(file, index, "fl_x"))
    }
    return RawCamera(
        k, FLIP @ pose[:3, :3].T, np.zeros(3), pose[:3, 3], size, lens, model, locations=locations
    )


def _keys(file: CalibrationFile, index: int, key: str) -> Keys:
    """Key path of a value of a frame: in the frame or, if it is for all frames, at the top of the file."""
    own = ("frames", index, key)
    return own if file.has(*own) else (key,)


def _number(file: CalibrationFile, index: int, key: str) -> float | None:
    keys = _keys(file, index, key)
    return file.number(*keys) if file.has(*keys) else None


def _size(file: CalibrationFile, index: int) -> ImageSize | None:
    width, height = _keys(file, index, "w"), _keys(file, index, "h")
    if file.has(*width) or file.has(*height):
        return file.size(width, height)
    image, folder = str(file.get("frames", index, "file_path") or ""), Path(file.path).parent
    return size_of_named_image(folder, image) or size_of_named_image(folder, f"{image}.png")


def _matrix(file: CalibrationFile, index: int, size: ImageSize | None) -> Array:
    """K of a frame. ``size`` is needed if the file has an angle of view in place of a focal length, or no
    principal point."""
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


def _frame_lens(file: CalibrationFile, index: int) -> tuple[str, tuple[float, ...]]:
    keys = _keys(file, index, "camera_model")
    word = file.get(*keys)
    fisheye = file.get(*_keys(file, index, "is_fisheye")) is True
    model = "equidistant" if fisheye else "plumb_bob"
    if word is not None:
        if str(word).upper() not in _COLMAP_LENSES:
            message = f"unknown camera model {str(word)[:40]!r}; known are {', '.join(_COLMAP_LENSES)}"
            raise file.error(message, *keys)
        model = _COLMAP_LENSES[str(word).upper()]
    values = {key: _number(file, index, key) or 0.0 for key in _COEFFICIENTS}
    for key in set(_COEFFICIENTS) - set(MODELS[model]):
        if values[key]:
            raise file.error(f"is not supported by a {model} lens", *_keys(file, index, key))
    return model, tuple(values[key] for key in MODELS[model])


TRANSFORMS = calibration_format(
    "transforms",
    _is_transforms,
    _read_transforms,
    values=lambda own, camera: {"lens": "OPENCV_FISHEYE" if camera.model == "equidistant" else "OPENCV"},
)


# -- Blender: cameras as scripts write them, with the names of bpy

_BLENDER_POSE = {"matrix_world", "location"}
_BLENDER_LENS = {"lens", "angle", "angle_x", "focal_length_mm"}


def _blender_value(file: CalibrationFile, at: Keys, key: str, otherwise: float | None = None) -> float:
    """Number with a key of a camera, or else of the section ``render``, or else of the file."""
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
    key = file.first(at, "lens", "focal_length_mm", "angle") or "angle_x"
    value = _blender_value(file, at, key)
    if key in ("lens", "focal_length_mm"):
        side, usual = ("sensor_height", 24.0) if fit == "VERTICAL" else ("sensor_width", 36.0)
        sensor = _blender_value(file, at, side, usual)
        if sensor <= 0:
            raise file.error("needs a sensor above zero", *at, "sensor_width")
        focal = value / sensor * view
    elif 1e-9 < value < np.pi:
        focal = (width if key == "angle_x" else view) / 2 / float(np.tan(value / 2))
    else:
        raise file.error(f"must be an angle between 0 and pi radians, not {value:g}", *at, key)
    cx = width / 2 - _blender_value(file, at, "shift_x", 0.0) * view - 0.5
    cy = height / 2 + _blender_value(file, at, "shift_y", 0.0) * view / aspect - 0.5
    k, (rotation, center) = pinhole(focal, focal / aspect, cx, cy), _blender_pose(file, at)
    part = "matrix_world" if file.has(*at, "matrix_world") else "location"
    places = {"K": key, "R": part, "center": part}
    return camera_at(file, at, places, K=k, R=FLIP @ rotation.T, center=center, size=(width, height))


def _blender_pose(file: CalibrationFile, at: Keys) -> tuple[Array, Array]:
    """Rotation from the axes of a camera to the world, and the centre of the camera."""
    if file.has(*at, "matrix_world"):
        pose = file.pose_matrix(*at, "matrix_world", rows=4, tolerance=1e-6)
        lengths = np.linalg.norm(pose[:3, :3], axis=0)
        if lengths.min() <= 0:
            raise file.error("has an axis of length 0", *at, "matrix_world")
        return pose[:3, :3] / lengths, pose[:3, 3]
    center = file.numbers((3,), *at, "location")
    if file.has(*at, "rotation_quaternion"):
        xyzw = np.roll(file.numbers((4,), *at, "rotation_quaternion"), -1)
        return file.unit_rotation(xyzw, *at, "rotation_quaternion"), center
    angles = file.numbers((3,), *at, "rotation_euler")
    return np.asarray(Rotation.from_euler("xyz", angles).as_matrix()), center


def _blender_values(own: Values, camera: Camera) -> Values:
    width, height = camera.size
    return {
        "lens": own["fx"] / width * 36.0,
        "shift_x": (width / 2 - own["cx"] - 0.5) / width,
        "shift_y": (own["cy"] + 0.5 - height / 2) / width * own["aspect"],
    }


BLENDER = calibration_format(
    "blender",
    *reader_of(has_keys(_BLENDER_POSE, _BLENDER_LENS), has_keys(_BLENDER_POSE), _blender_camera),
    values=_blender_values,
)

FORMATS = (H36M, ASSOCIATION, PANOPTIC, SHELF, TRANSFORMS, ANIPOSE, BLENDER)
