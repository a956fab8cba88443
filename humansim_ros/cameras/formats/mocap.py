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
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.formats.base import (
    FLIP,
    MAX_CAMERAS,
    CalibrationFile,
    Keys,
    RawCamera,
    SourceLocation,
    camera_at,
)
from humansim_ros.cameras.formats.conventions import fitted_lens
from humansim_ros.cameras.formats.spellings import SCALARS, role_of
from humansim_ros.cameras.formats.table import Values, calibration_format, row
from humansim_ros.errors import CameraError, some_of, warn_about
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.types import Array, ImageSize

# -- Vicon


def _read_vicon(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    skipped = []
    for index, camera in enumerate(file.need("Cameras", "Camera")):
        at: Keys = ("Cameras", "Camera", index)
        name = str(camera.get("DEVICEID") or camera.get("USERID") or index)
        frame = (*at, "KeyFrames", 0, "KeyFrame", 0)
        if file.has(*frame, "FOCAL_LENGTH"):
            file.add(cameras, name, _vicon_camera(file, at, frame), *at)
        else:
            skipped.append(name)
    if not cameras:
        raise file.error("no camera has a KeyFrame: the system was not calibrated")
    if skipped:
        warn_about(file.path, f"left out, because they are not calibrated: {some_of(skipped, 4)}")
    return cameras


def _vicon_camera(file: CalibrationFile, at: Keys, frame: Keys) -> RawCamera:
    size = file.size_of(file.words(2, *at, "SENSOR_SIZE"), *at, "SENSOR_SIZE")
    focal = file.words(1, *frame, "FOCAL_LENGTH")[0]
    ratio = file.words(1, *at, "PIXEL_ASPECT_RATIO")[0] if file.get(*at, "PIXEL_ASPECT_RATIO") else 1.0
    if ratio <= 0 or focal <= 0:
        raise file.error("the focal length and the aspect ratio must be above zero", *at)
    k = pinhole(focal, focal / ratio, *file.words(2, *frame, "PRINCIPAL_POINT"))
    r = file.unit_rotation(file.words(4, *frame, "ORIENTATION"), *frame, "ORIENTATION")
    center = file.words(3, *frame, "POSITION")
    places = {"K": "FOCAL_LENGTH", "R": "ORIENTATION", "center": "POSITION"}
    model, lens = _vicon_lens(file, frame, k, size)
    return camera_at(file, frame, places, K=k, R=r, center=center, size=size, model=model, distortion=lens)


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


VICON = calibration_format("vicon", lambda file: isinstance(file.get("Cameras", "Camera"), list), _read_vicon)


# -- OptiTrack Motive

_MOTIVE: Keys = ("calibrationProfile", "Calibration", 0, "Cameras", 0, "Camera")
_LENS = "k1 k2 TangentialX TangentialY k3"
_ORIENT = " ".join(f"OrientMatrix{i}" for i in range(9))


def _read_motive(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    unlike = []
    for index, item in enumerate(file.need(*_MOTIVE)):
        at: Keys = (*_MOTIVE, index)
        name = str(item.get("Serial") or index)
        standard = file.has(*at, "IntrinsicStandardCameraModel", 0)
        inner: Keys = ("IntrinsicStandardCameraModel" if standard else "Intrinsic", 0)
        places = {
            "K": (*inner, "HorizontalFocalLength VerticalFocalLength LensCenterX LensCenterY"),
            "R": ("Extrinsic", 0, _ORIENT),
            "center": ("Extrinsic", 0, "X Y Z"),
            "size": ("Attributes", 0, "ImagerPixelWidth ImagerPixelHeight"),
        }
        if standard:
            places["distortion"] = (*inner, _LENS)
        else:
            unlike.append(name)
        camera = camera_at(file, at, places, model="plumb_bob")
        file.add(cameras, name, camera if camera.R is None else replace(camera, R=FLIP @ camera.R.T), *at)
    if unlike:
        what = f"no IntrinsicStandardCameraModel of {some_of(unlike, 4)}"
        warn_about(file.path, f"{what}: the lens of Motive is not of OpenCV, and its distortion is left out")
    return cameras


MOTIVE = calibration_format("motive", lambda file: isinstance(file.get(*_MOTIVE), list), _read_motive)


# -- Theia3D

#: Attributes of a camera of Theia3D and of Qualisys.
_K = ("intrinsic", 0, "focalLengthU focalLengthV centerPointU centerPointV")
_R = ("transform", 0, " ".join(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)))
_POSITION = ("transform", 0, "x y z")
#: Keys of the coefficients in the order of ROS. Tangential coefficients have several spellings.
_LENS_KEYS = (
    *(("radialDistortion1",), ("radialDistortion2",)),
    *(tuple(f"{word}Distortion{i}" for word in ("tangental", "tengential", "tangential")) for i in (1, 2)),
    ("radialDistortion3",),
)
#: Largest side of a sensor in pixels. Qualisys counts 64 units per pixel.
_LARGEST_SIDE = 12_000.0


def _xml_cameras(file: CalibrationFile) -> list[Keys]:
    """Key paths of the cameras in all groups of a file of Theia3D or Qualisys."""
    return file.elements(("calibration",), "cameras", "camera") if _is_qualisys(file) else []


def _xml_camera(file: CalibrationFile, at: Keys, shift: str, **own: Any) -> RawCamera:
    """Camera with K in the unit of its element ``intrinsic``. ``shift``: ``t`` or ``center``, which x, y, z
    are."""
    keys = (file.first((*at, "intrinsic", 0), *names) for names in _LENS_KEYS)
    lens = [0.0 if key is None else file.number(*at, "intrinsic", 0, key) for key in keys]
    camera = camera_at(
        file, at, {"K": _K, "R": _R, shift: _POSITION}, **own, distortion=lens, model="plumb_bob"
    )
    camera.K[0, 1] = file.number(*at, "intrinsic", 0, "skew", otherwise=0.0)
    return camera


def _is_theia(file: CalibrationFile) -> bool:
    for at in _xml_cameras(file)[:1]:
        try:
            return 0 < float(file.get(*at, "intrinsic", 0, "sensorMaxU") or 0) < _LARGEST_SIDE
        except (TypeError, ValueError):
            return False
    return False


def _read_theia(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for at in _xml_cameras(file):
        inner = (*at, "intrinsic", 0)
        sides = [
            file.number(*inner, f"sensorMax{axis}") - file.number(*inner, f"sensorMin{axis}") for axis in "UV"
        ]
        # the side is 1919 or 1920
        even = np.array([side + bool(side % 2) for side in sides])
        camera = _xml_camera(file, at, "t", size=file.size_of(even, *inner, "sensorMaxU"))
        file.add(cameras, str(file.get(*at, "serial") or len(cameras)), camera, *at)
    return cameras


THEIA = calibration_format("theia", _is_theia, _read_theia)


# -- Qualisys

#: Units of focal lengths and principal points per pixel.
_SUBPIXELS = 64.0
#: Elements with the window of the video on the sensor. The first one that a file has counts.
_WINDOWS = ("fov_video", "fov_video_max", "fov_marker", "fov_marker_max")


def _is_qualisys(file: CalibrationFile) -> bool:
    return isinstance(file.get("calibration", "cameras"), list)


def _read_qualisys(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for at in _xml_cameras(file):
        corner, size = _window(file, at)
        camera = _xml_camera(file, at, "center", size=size)
        camera.K[:2] /= _SUBPIXELS
        camera.K[:2, 2] -= corner
        if camera.R is not None:
            camera = replace(camera, R=FLIP @ camera.R)
        name = str(file.get(*at, "serial") or "").strip() or str(len(cameras))
        file.add(cameras, name, camera, *at)
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


QUALISYS = calibration_format("qualisys", _is_qualisys, _read_qualisys, values=_qualisys_values)


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

_EGO = (
    *("cam_uid", "tx_world_cam", "ty_world_cam", "tz_world_cam"),
    *("qx_world_cam", "qy_world_cam", "qz_world_cam", "qw_world_cam"),
    *("image_width", "image_height", "intrinsics_type"),
    *(f"intrinsics_{i}" for i in range(8)),
)
_EGO_LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")


def _is_ego(file: CalibrationFile) -> bool:
    head = file.head[0] if file.head else ""
    return "cam_uid" in head and "tx_world_cam" in head


def _read_ego(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = list(islice(file.lines(), MAX_CAMERAS + 1))
    head = [word.strip() for word in next(csv.reader([lines[0][1]]))]
    absent = [key for key in _EGO if key not in head]
    if absent:
        raise file.error(f"columns are missing: {some_of(absent)}", line=lines[0][0])
    cameras: dict[str, RawCamera] = {}
    for line, text in lines[1:]:
        words = next(csv.reader([text]))
        if len(words) != len(head):
            raise file.error(f"needs {len(head)} values as the header, not {len(words)}", line=line)
        cells = dict(zip(head, (word.strip() for word in words), strict=True))
        name, lens_type = cells["cam_uid"], cells["intrinsics_type"]
        if lens_type != "KANNALABRANDTK3":
            message = f"{lens_type[:40]!r} is not a supported lens; known is KANNALABRANDTK3"
            raise file.error(message, "intrinsics_type", line=line)
        numbers = {
            key: file.row([cells[key]], line, key)[0]
            for key in _EGO
            if key not in ("cam_uid", "intrinsics_type")
        }
        x, y, z, *xyzw, width, height, fx, fy, cx, cy, k1, k2, k3, k4 = numbers.values()
        camera = RawCamera(
            pinhole(fx, fy, cx, cy),
            file.unit_rotation(np.array(xyzw), line=line).T,
            center=np.array([x, y, z]),
            size=file.size_of(np.array([width, height])),
            distortion=(k1, k2, k3, k4),
            model="equidistant",
            locations={"": SourceLocation(None, line)},
        )
        file.add(cameras, name, camera, line=line)
    if not cameras:
        raise file.error("the file has no cameras")
    return cameras


def _ego_values(own: Values, camera: Camera) -> Values:
    name = own["name"]
    if camera.model != "equidistant":
        raise CameraError("this format has only the equidistant lens", key=name)
    if set(name) & set(',"'):
        raise CameraError("this format needs a name without commas and quotation marks", key=name)
    numbers = (*camera.center, *matrix_to_quaternion(camera.R.T)), (*(own[key] for key in _EGO_LENS),)
    return {"pose": row(numbers[0], ","), "lens": row(numbers[1], ",")}


EGOEXO = calibration_format("egoexo4d", _is_ego, _read_ego, values=_ego_values)

FORMATS = (DLT, EGOEXO, MOTIVE, QUALISYS, THEIA, VICON)
