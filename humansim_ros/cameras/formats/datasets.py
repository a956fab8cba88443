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
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.formats.base import (
    FLIP,
    CalibrationFile,
    Keys,
    find_cameras,
    has_keys,
    without_suffix,
)
from humansim_ros.cameras.formats.checks import IMAGE_SIZES, size_of_named_image
from humansim_ros.cameras.formats.conventions import stated_unit
from humansim_ros.cameras.formats.table import Cameras, Values, calibration_format, json_file, nested
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.types import Array, ImageSize

# -- Human3.6M: x = R X + t in millimetres, z up; 4 cameras, with a pose for each of 11 subjects

#: Image sizes of the cameras by their serial numbers.
_H36M_SIZES: dict[str, ImageSize] = {serial: (w, h) for serial, (w, h) in IMAGE_SIZES["human36m"].items()}
_PANEL_AND_NODE = re.compile(r"([0-9]{2})_([0-9]{2})")
_SUBJECT = re.compile(r"(S[0-9]+)_(.+)", re.DOTALL)


def _h36m(file: CalibrationFile) -> Cameras:
    cameras = []
    lenses, subjects = file.mapping("intrinsics"), file.mapping("extrinsics")
    for subject in subjects:
        for name in file.mapping("extrinsics", subject):
            if name not in lenses:
                raise file.error("has no intrinsics", "extrinsics", subject, name)
            one = {**file.mapping("intrinsics", name), **file.mapping("extrinsics", subject, name)}
            label = name if len(subjects) == 1 else f"{subject}_{name}"
            cameras.append({"name": label, **one, "size": _H36M_SIZES.get(str(name))})
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


H36M = calibration_format("human36m", write=_write_h36m, arrange=_h36m)
#: Shelf and Campus: x = R (X - T), where T is the camera centre, unless the file or the views contradict.
SHELF = calibration_format("shelf", find_unit=lambda file, _: stated_unit(file) or 0.001)


# -- CMU Panoptic: x = R X + t in centimetres, y down


def _panoptic_values(own: Values, camera: Camera) -> Values:
    """Values for the template, from the name of a camera: its type, and its panel and node in the studio."""
    matched = _PANEL_AND_NODE.fullmatch(own["name"])
    panel, node = (int(matched[1]), int(matched[2])) if matched else (0, own["index"])
    return {"type": "hd" if camera.size == (1920, 1080) else "vga", "panel": panel, "node": node}


PANOPTIC = calibration_format("panoptic", values=_panoptic_values)


def _anipose_values(own: Values, camera: Camera) -> Values:
    name = own["name"]
    if not name.isprintable():
        raise CameraError("this format needs a name without control characters", key=name)
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return {"quoted": f'"{escaped}"', "fisheye": str(camera.model == "equidistant").lower()}


ANIPOSE = calibration_format("anipose", values=_anipose_values)


# -- transforms.json

#: Image size of the synthetic scenes of NeRF. Their files have no size.
_NERF_SIZE = (800, 800)
#: Folder of the images in most files. It is not part of a camera's name.
_FOLDER = "images/"
_KEPT = ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "transform_matrix")
#: Names of lens models in ``camera_model``.
_COLMAP_LENSES = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"), "plumb_bob"),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "equidistant"),
}


def _transforms(file: CalibrationFile) -> Cameras:
    """Frames with the values that the file gives for all frames, which have their own values first."""
    shared = {key: value for key, value in file.mapping().items() if key != "frames"}
    cameras: dict[str, dict[str, Any]] = {}
    assumed = False
    for at, name in zip(file.paths("frames"), _names(file), strict=True):
        frame = replace(file, document={**shared, **file.mapping(*at)})
        size = _size(frame)
        if size is None and file.given_size is None and not frame.has("cx"):
            size, assumed = _NERF_SIZE, True
        file.add(cameras, name, _frame(frame, size), *at)
    if assumed:
        width, height = _NERF_SIZE
        message = f"w and h are missing; {width}x{height} is assumed, as in the synthetic scenes of NeRF"
        warn_about(file.path, message)
    return {"origin": "corner", "frames": [{"name": name, **one} for name, one in cameras.items()]}


def _names(file: CalibrationFile) -> list[str]:
    """Names of the cameras, made from the names of their images."""
    names = []
    for index, _ in enumerate(file.need("frames")):
        image = str(file.get("frames", index, "file_path") or "").strip().removeprefix("./")
        names.append(without_suffix(image) or str(index))
    if all(name.startswith(_FOLDER) and name != _FOLDER for name in names):
        names = [name.removeprefix(_FOLDER) for name in names]
    return names


def _size(frame: CalibrationFile) -> ImageSize | None:
    if frame.has("w") or frame.has("h"):
        return frame.size(("w",), ("h",))
    image, folder = str(frame.get("file_path") or ""), Path(frame.path).parent
    return size_of_named_image(folder, image) or size_of_named_image(folder, f"{image}.png")


def _frame(frame: CalibrationFile, size: ImageSize | None) -> dict[str, Any]:
    """Camera of a frame. ``size`` is needed if the file has an angle of view in place of a focal length, or
    no principal point."""
    width, height = frame.given_size or size or (None, None)
    given = _focal_length(frame, "x", width), _focal_length(frame, "y", height)
    lengths = [length for length in given if length is not None]
    if not lengths:
        raise frame.error("is missing: give fl_x, or camera_angle_x", "fl_x")
    middle = {} if width is None or height is None else {"cx": width / 2, "cy": height / 2}
    word = frame.get("camera_model")
    model = "equidistant" if frame.get("is_fisheye") is True else "plumb_bob"
    if word is not None:
        if str(word).upper() not in _COLMAP_LENSES:
            message = f"unknown camera model {str(word)[:40]!r}; known are {', '.join(_COLMAP_LENSES)}"
            raise frame.error(message, "camera_model")
        model = _COLMAP_LENSES[str(word).upper()]
    own = {key: frame.get(key) for key in _KEPT if frame.has(key)}
    return {"fl_x": lengths[0], "fl_y": lengths[-1], **middle, **own, "size": size, "model": model}


def _focal_length(frame: CalibrationFile, axis: str, side: int | None) -> float | None:
    length, angle = f"fl_{axis}", f"camera_angle_{axis}"
    if frame.has(length) or not frame.has(angle):
        return frame.number(length) if frame.has(length) else None
    value = frame.number(angle)
    if not 0 < value < np.pi:
        raise frame.error(f"must be an angle between 0 and pi radians, not {value:g}", angle)
    if side is None:
        raise frame.error("needs w and h as well", angle)
    return float(side / 2 / np.tan(value / 2))


TRANSFORMS = calibration_format(
    "transforms",
    arrange=_transforms,
    values=lambda own, camera: {"lens": "OPENCV_FISHEYE" if camera.model == "equidistant" else "OPENCV"},
)


# -- Blender: cameras as scripts write them, with the names of bpy

_BLENDER = (
    has_keys({"matrix_world", "location"}, {"lens", "angle", "angle_x", "focal_length_mm"}),
    has_keys({"matrix_world", "location"}),
)


def _blender_value(file: CalibrationFile, at: Keys, key: str, otherwise: float | None = None) -> float:
    """Number with a key of a camera, or else of the section ``render``, or else of the file."""
    places: tuple[Keys, ...] = ((*at, key), (*at, "render", key), ("render", key), (key,))
    found = next((place for place in places if file.get(*place) is not None), None)
    if found is None and otherwise is not None:
        return otherwise
    return float(file.numbers((), *(found or (*at, key))))


def _blender(file: CalibrationFile) -> Cameras:
    return [{"name": name, **_blender_camera(file, at)} for name, at in find_cameras(file, *_BLENDER)]


def _blender_camera(file: CalibrationFile, at: Keys) -> dict[str, Any]:
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
    pose = {"R_w2c": nested(FLIP @ rotation.T), "center": nested(center)}
    return {"K": nested(k), **pose, "size": [width, height]}


def _blender_pose(file: CalibrationFile, at: Keys) -> tuple[Array, Array]:
    """Rotation from the axes of a camera to the world, and the centre of the camera."""
    if file.has(*at, "matrix_world"):
        pose = file.pose_matrix(*at, "matrix_world", tolerance=1e-6)
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
    matches=lambda file: bool(find_cameras(file, *_BLENDER)),
    arrange=_blender,
    values=_blender_values,
)

FORMATS = (H36M, PANOPTIC, SHELF, TRANSFORMS, ANIPOSE, BLENDER)
