"""Motion capture: Vicon .xcp, OptiTrack Motive .mcal, Theia3D, Qualisys, DLT coefficients, Ego-Exo4D csv.

- Vicon: millimetres, z up; ORIENTATION (x y z w) rotates the world to the camera (z forward, y down) and
  POSITION is its centre; VICON_RADIAL2 maps pixels r from a centre to ideal ones,
  r (1 + k1 r^2 + k2 r^4 + k3 r^6). Poses and K are as in Pose2Sim. https://github.com/perfanalytics/pose2sim
- Motive: metres, y up; the columns of OrientMatrix are the axes of the camera (x right, y up, z backward);
  IntrinsicStandardCameraModel is the lens of OpenCV. https://docs.optitrack.com/motive/calibration
- Theia3D: millimetres, z up; x = R X + t in pixels.
  https://docs.theiamarkerless.com/theia3d-documentation/data-formats/calibration-files
- Qualisys (.qca.txt): millimetres, z up. The rows of r11 … r33 are the axes of the camera in the world: x
  right, y up, z backward; x, y, z is its centre. Focal lengths and principal points are in 1/64 pixel of the
  sensor; a pixel of the video is a pixel of the sensor minus the corner of fov_video. Poses and K are as in
  Pose2Sim's conversion. The distortion coefficients are those of OpenCV, without a unit. Pose2Sim divides
  them by 64 as well, which leaves almost no distortion. https://github.com/perfanalytics/pose2sim
- DLT: u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1), v with L5 ... L8; a column for each camera.
  http://www.kwon3d.com/theory/dlt/dlt.html
- Ego-Exo4D: metres, z up; the pose of the camera in the world, KANNALABRANDTK3 is cv2.fisheye.
  https://docs.ego-exo4d-data.org/
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.formats.base import (
    MAX_CAMERAS,
    CalibrationFile,
    Keys,
    RawCamera,
    SourceLocation,
    is_number,
)
from humansim_ros.cameras.formats.conventions import fitted_lens
from humansim_ros.cameras.formats.spellings import SCALARS, role_of
from humansim_ros.cameras.formats.table import Cameras, Values, calibration_format, nested, row
from humansim_ros.errors import CameraError, some_of, warn_about
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.types import Array, ImageSize

# -- Vicon


def _vicon(file: CalibrationFile) -> Cameras:
    cameras: list[dict[str, Any]] = []
    skipped = []
    for at in file.paths("Cameras", "Camera"):
        name = str(file.get(*at, "DEVICEID") or file.get(*at, "USERID") or at[-1])
        frame = (*at, "KeyFrames", 0, "KeyFrame", 0)
        if file.has(*frame, "FOCAL_LENGTH"):
            cameras.append({"name": name, **_vicon_camera(file, at, frame)})
        else:
            skipped.append(name)
    if not cameras:
        raise file.error("no camera has a KeyFrame: the system was not calibrated")
    if skipped:
        warn_about(file.path, f"left out, because they are not calibrated: {some_of(skipped, 4)}")
    return cameras


def _vicon_camera(file: CalibrationFile, at: Keys, frame: Keys) -> dict[str, Any]:
    size = file.size_of(file.words(2, *at, "SENSOR_SIZE"), *at, "SENSOR_SIZE")
    focal = file.words(1, *frame, "FOCAL_LENGTH")[0]
    ratio = file.words(1, *at, "PIXEL_ASPECT_RATIO")[0] if file.get(*at, "PIXEL_ASPECT_RATIO") else 1.0
    if ratio <= 0 or focal <= 0:
        raise file.error("the focal length and the aspect ratio must be above zero", *at)
    k = pinhole(focal, focal / ratio, *file.words(2, *frame, "PRINCIPAL_POINT"))
    r = file.unit_rotation(file.words(4, *frame, "ORIENTATION"), *frame, "ORIENTATION")
    center = file.words(3, *frame, "POSITION")
    model, lens = _vicon_lens(file, frame, k, size)
    pose = {"R_w2c": nested(r), "center": nested(center)}
    return {"K": nested(k), **pose, "size": size, "model": model, "distortion": list(lens)}


def _vicon_lens(
    file: CalibrationFile, frame: Keys, k: Array, size: ImageSize
) -> tuple[str, tuple[float, ...]]:
    """Fit a lens to the radial correction of Vicon over the image."""
    center, radial = k[:2, 2], np.zeros(3)
    if file.get(*frame, "VICON_RADIAL2") is not None:
        kind, *words = str(file.get(*frame, "VICON_RADIAL2")).split() or [""]
        if kind != "Vicon3Parameter" or len(words) != 5:
            message = "needs Vicon3Parameter, a centre (2) and three coefficients"
            raise file.error(message, *frame, "VICON_RADIAL2")
        values = np.array(file.row(words, 0, file.location(*frame, "VICON_RADIAL2").key))
        center, radial = values[:2], values[2:]
    elif file.get(*frame, "VICON_RADIAL") is not None:
        radial[:2] = file.words(2, *frame, "VICON_RADIAL")
    if not radial.any():
        return "plumb_bob", ()
    columns, rows = np.meshgrid(np.linspace(0, size[0] - 1, 25), np.linspace(0, size[1] - 1, 19))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    r2 = ((pixels - center) ** 2).sum(axis=1, keepdims=True)
    factor = 1 + r2 * (radial[0] + r2 * (radial[1] + r2 * radial[2]))
    places = (center + (pixels - center) * factor, pixels)
    focal = k[[0, 1], [0, 1]]
    ideal, bent = ((each - k[:2, 2]) / focal for each in places)
    what = f"{file.get('Cameras', 'Camera', frame[2], 'DEVICEID')}: the lens of Vicon"
    lens = fitted_lens(file, what, ideal, bent, float(focal[0]))
    return lens.model, lens.coefficients


VICON = calibration_format("vicon", arrange=_vicon)


# -- OptiTrack Motive


def _motive(file: CalibrationFile) -> Cameras:
    cameras, unlike = [], []
    for at in file.paths("calibrationProfile", "Calibration", 0, "Cameras", 0, "Camera"):
        camera = {"Serial": file.get(*at, "Serial"), **file.mapping(*at, "Attributes", 0)}
        if file.has(*at, "IntrinsicStandardCameraModel", 0):
            camera |= file.mapping(*at, "IntrinsicStandardCameraModel", 0)
        else:
            unlike.append(str(camera["Serial"] or at[-1]))
            lens = file.mapping(*at, "Intrinsic", 0)
            camera |= {key: value for key, value in lens.items() if "Length" in key or "Center" in key}
        cameras.append({**camera, **(file.get(*at, "Extrinsic", 0) or {})})
    if unlike:
        what = f"no IntrinsicStandardCameraModel of {some_of(unlike, 4)}"
        warn_about(file.path, f"{what}: the lens of Motive is not of OpenCV, and its distortion is left out")
    return cameras


MOTIVE = calibration_format("motive", arrange=_motive)


# -- Theia3D and Qualisys

#: Largest side of a sensor in pixels. Qualisys counts 64 units per pixel.
_LARGEST_SIDE = 12_000.0
_SUBPIXELS = 64.0
#: Elements with the window of the video on the sensor. The first one that a file has counts.
_WINDOWS = ("fov_video", "fov_video_max", "fov_marker", "fov_marker_max")


def _is_theia(file: CalibrationFile) -> bool:
    if not isinstance(file.get("calibration", "cameras"), list):
        return False
    at = next(iter(file.elements(("calibration",), "cameras", "camera")), ())
    side = str(file.get(*at, "intrinsic", 0, "sensorMaxU"))
    return is_number(side) and 0 < float(side) < _LARGEST_SIDE


def _theia(file: CalibrationFile) -> Cameras:
    cameras = []
    for at in file.elements(("calibration",), "cameras", "camera"):
        inner = (*at, "intrinsic", 0)
        sides = [
            file.number(*inner, f"sensorMax{axis}") - file.number(*inner, f"sensorMin{axis}") for axis in "UV"
        ]
        # the side is 1919 or 1920
        size = [side + bool(side % 2) for side in sides]
        pose = file.get(*at, "transform", 0) or {}
        cameras.append({"serial": file.get(*at, "serial"), **file.mapping(*inner), **pose, "size": size})
    return cameras


def _qualisys(file: CalibrationFile) -> Cameras:
    cameras = []
    for at in file.elements(("calibration",), "cameras", "camera"):
        inner = (*at, "intrinsic", 0)
        (left, top), size = _window(file, at)
        keys = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        fx, fy, cx, cy = (file.number(*inner, key) / _SUBPIXELS for key in keys)
        skew = file.number(*inner, "skew", otherwise=0.0) / _SUBPIXELS
        k = [[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1]]
        lens = {key: value for key, value in file.mapping(*inner).items() if "Distortion" in key}
        pose = file.get(*at, "transform", 0) or {}
        cameras.append({"serial": file.get(*at, "serial"), "K": k, "size": size, **lens, **pose})
    return cameras


def _window(file: CalibrationFile, at: Keys) -> tuple[Array, ImageSize | None]:
    """First pixel (2,) of the video on the sensor, and size of the video (None if unknown)."""
    for name in _WINDOWS:
        window = (*at, name, 0)
        if file.get(*window) is None:
            continue
        left, top, right, bottom = (file.number(*window, k) for k in ("left", "top", "right", "bottom"))
        width, height = right - left + 1, bottom - top + 1
        if min(width, height) < 1 or width != int(width) or height != int(height):
            raise file.error("needs whole numbers, with right and bottom beyond left and top", *window)
        return np.array([left, top]), (int(width), int(height))
    return np.zeros(2), None


def _qualisys_values(own: Values, camera: Camera) -> Values:
    places = {"fu": "fx", "fv": "fy", "cu": "cx", "cv": "cy", "shear": "skew"}
    lens = {key: own[value] * _SUBPIXELS for key, value in places.items()}
    return {**lens, "right": own["width"] - 1, "bottom": own["height"] - 1}


THEIA = calibration_format("theia", matches=_is_theia, arrange=_theia)
QUALISYS = calibration_format("qualisys", arrange=_qualisys, values=_qualisys_values)


# -- DLT

_DLT = 11


def _dlt_rows(file: CalibrationFile) -> Iterator[tuple[int, list[str]]]:
    return ((n, text.replace(",", " ").replace(";", " ").split()) for n, text in file.lines())


def _is_dlt(file: CalibrationFile) -> bool:
    rows = [words for _, words in islice(_dlt_rows(file), _DLT + 2)]
    while rows and any(word[:1].isalpha() for word in rows[0]):
        if any(role_of(word) in SCALARS for word in rows[0]):
            return False  # it is a table of fx, fy …
        rows = rows[1:]  # without the header
    csv_ = Path(file.path).suffix.lower() == ".csv" or "," in (file.head or [""])[-1]
    alike = len({len(words) for words in rows}) == 1
    return csv_ and alike and len(rows) == _DLT and len(rows[0]) <= MAX_CAMERAS


def _read_dlt(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = list(_dlt_rows(file))
    names: list[str] = []
    while any(word[:1].isalpha() for word in lines[0][1]):
        names, lines = lines[0][1], lines[1:]
    table = np.array([file.row(words, line) for line, words in lines])
    cameras: dict[str, RawCamera] = {}
    size, upward = file.given_size, False
    for index, values in enumerate(table.T):
        p = np.append(values, 1.0).reshape(3, 4)
        # where the matrix is a reflection, the y axis of the image points up
        if np.linalg.det(p[:, :3]) < 0:
            upward = True
            if size is None:
                why = "its y axis points up, as in DLTdv, and is turned with the height"
                raise file.error(f"missing: image size; {why}: give the size", "size")
            p = np.array([[1.0, 0, 0], [0, -1, size[1] - 1], [0, 0, 1]]) @ p
        name = names[index] if len(names) == len(table.T) else f"camera_{index + 1}"
        where = SourceLocation(f"column {index + 1}", lines[0][0])
        file.add(cameras, name, file.projection(p, where, size), line=where.line)
    if upward:
        what = "the image y axis of the coefficients points up; row 0 is taken as the lowest row"
        warn_about(file.path, what)
    return cameras


def _write_dlt(cameras: Mapping[str, Camera]) -> dict[str, str | bytes]:
    columns = []
    for name, camera in cameras.items():
        p = camera.P
        if p[2, 3] < 1e-9 * np.abs(p[2]).max():
            raise CameraError("this format needs the origin of the world in front of the camera", key=name)
        columns.append((p / p[2, 3]).ravel()[:_DLT])
    return {"": "\n".join(row(values, ",") for values in np.array(columns).T) + "\n"}


DLT = calibration_format("dlt", _is_dlt, _read_dlt, _write_dlt)


# -- Ego-Exo4D

_EGO_NUMBERS = (
    *("tx_world_cam", "ty_world_cam", "tz_world_cam"),
    *("qx_world_cam", "qy_world_cam", "qz_world_cam", "qw_world_cam"),
    *("image_width", "image_height"),
    *(f"intrinsics_{i}" for i in range(8)),
)


def _ego(file: CalibrationFile) -> Cameras:
    lines = list(islice(file.lines(), MAX_CAMERAS + 1))
    head = [word.strip() for word in next(csv.reader([lines[0][1]]))]
    absent = [key for key in ("cam_uid", *_EGO_NUMBERS, "intrinsics_type") if key not in head]
    if absent:
        raise file.error(f"columns are missing: {some_of(absent)}", line=lines[0][0])
    cameras = []
    for line, text in lines[1:]:
        words = next(csv.reader([text]))
        if len(words) != len(head):
            raise file.error(f"needs {len(head)} values as the header, not {len(words)}", line=line)
        cells = dict(zip(head, (word.strip() for word in words), strict=True))
        lens_type = cells["intrinsics_type"]
        if lens_type != "KANNALABRANDTK3":
            message = f"{lens_type[:40]!r} is not a supported lens; known is KANNALABRANDTK3"
            raise file.error(message, "intrinsics_type", line=line)
        numbers = [file.row([cells[key]], line, key)[0] for key in _EGO_NUMBERS]
        pose = {"position": numbers[:3], "quaternion_xyzw": numbers[3:7]}
        lens = {"K": numbers[9:13], "distortion": numbers[13:], "model": "equidistant"}
        cameras.append({"name": cells["cam_uid"], **pose, "size": numbers[7:9], **lens})
    if not cameras:
        raise file.error("the file has no cameras")
    return cameras


def _ego_values(own: Values, camera: Camera) -> Values:
    name = own["name"]
    if camera.model != "equidistant":
        raise CameraError("this format has only the equidistant lens", key=name)
    if set(name) & set(',"'):
        raise CameraError("this format needs a name without commas and quotation marks", key=name)
    numbers = (
        (*camera.center, *matrix_to_quaternion(camera.R.T)),
        [own[key] for key in ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")],
    )
    return {"pose": row(numbers[0], ","), "lens": row(numbers[1], ",")}


EGOEXO = calibration_format("egoexo4d", arrange=_ego, values=_ego_values)

FORMATS = (DLT, EGOEXO, MOTIVE, QUALISYS, THEIA, VICON)
