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
from collections.abc import Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.formats.base import (
    FLIP,
    MAX_CAMERAS,
    CalibrationFile,
    Keys,
    RawCamera,
    SourceLocation,
    check_names,
    fitted_lens,
    row,
)
from humansim_ros.cameras.formats.spellings import SCALARS, role_of
from humansim_ros.cameras.formats.table import Values, calibration_format
from humansim_ros.errors import CameraError, some_of, warn_about
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.types import Array, ImageSize


def _whole(file: CalibrationFile, values: Array, *keys: str | int) -> ImageSize:
    if any(value != int(value) or value <= 0 for value in values):
        raise file.error("needs width and height, whole numbers above zero", *keys)
    return int(values[0]), int(values[1])


# -- Vicon


def _is_vicon(file: CalibrationFile) -> bool:
    return isinstance(file.get("Cameras", "Camera"), list)


def _read_vicon(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    skipped = []
    for index, camera in enumerate(file.need("Cameras", "Camera")):
        at: Keys = ("Cameras", "Camera", index)
        name = str(camera.get("DEVICEID") or camera.get("USERID") or index)
        frame = (*at, "KeyFrames", 0, "KeyFrame", 0)
        if file.get(*frame, "FOCAL_LENGTH") is None:
            skipped.append(name)
            continue
        file.add(cameras, name, _vicon_camera(file, at, frame), *at)
    if not cameras:
        raise CameraError("no camera has a KeyFrame: the system was not calibrated", path=file.path)
    if skipped:
        warn_about(file.path, f"left out, because they are not calibrated: {some_of(skipped, 4)}")
    return cameras


def _vicon_camera(file: CalibrationFile, at: Keys, frame: Keys) -> RawCamera:
    size = _whole(file, file.words(2, *at, "SENSOR_SIZE"), *at, "SENSOR_SIZE")
    focal = float(file.words(1, *frame, "FOCAL_LENGTH")[0])
    ratio = float(file.words(1, *at, "PIXEL_ASPECT_RATIO")[0]) if file.get(*at, "PIXEL_ASPECT_RATIO") else 1.0
    if ratio <= 0 or focal <= 0:
        raise file.error("the focal length and the aspect ratio must be above zero", *at)
    point = file.words(2, *frame, "PRINCIPAL_POINT")
    r = file.unit_rotation(file.words(4, *frame, "ORIENTATION"), *frame, "ORIENTATION")
    k = pinhole(focal, focal / ratio, point[0], point[1])
    model, distortion = _vicon_lens(file, frame, k, size)
    return RawCamera(
        k,
        r,
        center=file.words(3, *frame, "POSITION"),
        size=size,
        distortion=distortion,
        model=model,
        locations=file.locations(frame, K="FOCAL_LENGTH", R="ORIENTATION", t="POSITION"),
    )


def _vicon_lens(
    file: CalibrationFile, frame: Keys, k: Array, size: ImageSize
) -> tuple[str, tuple[float, ...]]:
    """Fit a lens to the radial correction of Vicon over the image."""
    center, radial = k[:2, 2], np.zeros(3)
    if file.get(*frame, "VICON_RADIAL2") is not None:
        kind, *words = str(file.get(*frame, "VICON_RADIAL2")).split() or [""]
        if kind != "Vicon3Parameter" or len(words) != 5:
            raise file.error(
                "needs Vicon3Parameter, a centre (2) and three coefficients", *frame, "VICON_RADIAL2"
            )
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
    ideal = center + (pixels - center) * factor
    focal = k[[0, 1], [0, 1]]
    what = f"{file.get('Cameras', 'Camera', frame[2], 'DEVICEID')}: the lens of Vicon"
    places = (ideal - k[:2, 2]) / focal, (pixels - k[:2, 2]) / focal
    lens = fitted_lens(file, what, *places, float(focal[0]))
    return lens.model, lens.coefficients


VICON = calibration_format("vicon", _is_vicon, _read_vicon)


# -- OptiTrack Motive

_MOTIVE: Keys = ("calibrationProfile", "Calibration", 0, "Cameras", 0, "Camera")
_LENS = ("k1", "k2", "TangentialX", "TangentialY", "k3")
_ORIENT = tuple(f"OrientMatrix{i}" for i in range(9))


def _is_motive(file: CalibrationFile) -> bool:
    return isinstance(file.get(*_MOTIVE), list)


def _read_motive(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    unlike = []
    for index, camera in enumerate(file.need(*_MOTIVE)):
        at: Keys = (*_MOTIVE, index)
        name = str(camera.get("Serial") or index)
        standard = file.get(*at, "IntrinsicStandardCameraModel", 0) is not None
        part = "IntrinsicStandardCameraModel" if standard else "Intrinsic"
        inner: Keys = (*at, part, 0)
        if not standard:
            unlike.append(name)
        fx, fy, cx, cy = (
            file.number(*inner, key)
            for key in ("HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY")
        )
        given = [file.number(*inner, k, otherwise=0.0) for k in _LENS]
        outer = (*at, "Extrinsic", 0)
        rotation, center = None, None
        if file.get(*outer) is not None:
            axes = np.reshape([file.number(*outer, key) for key in _ORIENT], (3, 3))
            rotation = FLIP @ axes.T
            center = np.array([file.number(*outer, key) for key in "XYZ"])
        camera_ = RawCamera(
            pinhole(fx, fy, cx, cy),
            rotation,
            center=center,
            size=file.size(
                (*at, "Attributes", 0, "ImagerPixelWidth"), (*at, "Attributes", 0, "ImagerPixelHeight")
            ),
            distortion=tuple(given) if standard else (),
            model="plumb_bob",
            locations=file.locations(at, K=inner[-2:], R=outer[-2:], t=outer[-2:]),
        )
        file.add(cameras, name, camera_, *at)
    if unlike:
        what = f"no IntrinsicStandardCameraModel of {some_of(unlike, 4)}"
        warn_about(file.path, f"{what}: the lens of Motive is not of OpenCV, and its distortion is left out")
    return cameras


MOTIVE = calibration_format("motive", _is_motive, _read_motive)


# -- Theia3D

_R = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
#: Attributes of K. Qualisys has the same.
_K = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew")
#: Both spellings of each coefficient are in use.
_THEIA_LENS = (
    *(("radialDistortion1",), ("radialDistortion2",)),
    *(("tangentalDistortion1", "tengentialDistortion1", "tangentialDistortion1"),),
    *(("tangentalDistortion2", "tengentialDistortion2", "tangentialDistortion2"),),
    ("radialDistortion3",),
)
#: Largest side of a sensor in pixels. Qualisys counts 64 units per pixel.
_LARGEST_SIDE = 12_000.0


def _theia_cameras(file: CalibrationFile) -> list[Keys]:
    groups = file.get("calibration", "cameras")
    return [
        ("calibration", "cameras", group, "camera", index)
        for group, content in enumerate(groups if isinstance(groups, list) else ())
        for index, _ in enumerate(content.get("camera") or ())
    ]


def _is_theia(file: CalibrationFile) -> bool:
    for at in _theia_cameras(file)[:1]:
        try:
            return 0 < float(file.get(*at, "intrinsic", 0, "sensorMaxU") or 0) < _LARGEST_SIDE
        except (TypeError, ValueError):
            return False
    return False


def _read_k(file: CalibrationFile, inner: Keys) -> Array:
    """K (3, 3) of an element ``intrinsic``, in the unit of the element."""
    k = pinhole(*(file.number(*inner, key) for key in _K[:4]))
    k[0, 1] = file.number(*inner, "skew", otherwise=0.0)
    return k


def _read_theia(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for at in _theia_cameras(file):
        inner, outer = (*at, "intrinsic", 0), (*at, "transform", 0)
        k = _read_k(file, inner)
        keys = (
            next((key for key in names if file.get(*inner, key) is not None), None) for names in _THEIA_LENS
        )
        lens = tuple(0.0 if key is None else file.number(*inner, key) for key in keys)
        rotation, t = None, np.zeros(3)
        if file.get(*outer) is not None:
            rotation = np.reshape([file.number(*outer, key) for key in _R], (3, 3))
            t = np.array([file.number(*outer, key) for key in "xyz"])
        sides = []
        for low, high in (("sensorMinU", "sensorMaxU"), ("sensorMinV", "sensorMaxV")):
            side = file.number(*inner, high) - file.number(*inner, low)
            sides.append(side + 1 if side % 2 else side)  # the side is 1919 or 1920
        where = file.locations(at, K=inner[-2:], R=outer[-2:], t=outer[-2:])
        size = _whole(file, np.array(sides), *inner, "sensorMaxU")
        name = str(file.get(*at, "serial") or len(cameras))
        camera = RawCamera(k, rotation, t, size=size, distortion=lens, model="plumb_bob", locations=where)
        file.add(cameras, name, camera, *at)
    return cameras


THEIA = calibration_format("theia", _is_theia, _read_theia)


# -- Qualisys

#: Focal lengths and principal points are in this fraction of a pixel.
_SUBPIXELS = 64.0
#: Coefficients in the order of ROS, as the files spell them.
_QTM_LENS = (
    *("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2"),
    "radialDistortion3",
)
#: Windows of the video in the sensor, in order of precedence.
_WINDOWS = ("fov_video", "fov_video_max", "fov_marker", "fov_marker_max")


def _is_qualisys(file: CalibrationFile) -> bool:
    return isinstance(file.get("calibration", "cameras"), list)


def _read_qualisys(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for group, _ in enumerate(file.need("calibration", "cameras")):
        for index, _ in enumerate(file.items("calibration", "cameras", group, "camera")):
            at: Keys = ("calibration", "cameras", group, "camera", index)
            name = str(file.get(*at, "serial") or "").strip() or str(len(cameras))
            file.add(cameras, name, _qualisys_camera(file, at), *at)
    return cameras


def _qualisys_camera(file: CalibrationFile, at: Keys) -> RawCamera:
    inner, outer = (*at, "intrinsic", 0), (*at, "transform", 0)
    corner, size = _window(file, at)
    k = _read_k(file, inner)
    k[:2] /= _SUBPIXELS
    k[:2, 2] -= corner
    rotation, center = None, np.zeros(3)
    if file.get(*outer) is not None:
        rotation = FLIP @ np.reshape([file.number(*outer, key) for key in _R], (3, 3))
        center = np.array([file.number(*outer, key) for key in "xyz"])
    return RawCamera(
        k,
        rotation,
        center=center,
        size=size,
        distortion=tuple(file.number(*inner, key, otherwise=0.0) for key in _QTM_LENS),
        model="plumb_bob",
        locations=file.locations(at, K=inner[-2:], distortion=inner[-2:], R=outer[-2:], t=outer[-2:]),
    )


def _window(file: CalibrationFile, at: Keys) -> tuple[Array, ImageSize | None]:
    """First pixel (2,) of the video in the sensor, and its size."""
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


def _dlt_rows(file: CalibrationFile) -> list[list[str]]:
    rows = (text.replace(",", " ").replace(";", " ").split() for _, text in file.lines())
    return list(islice(rows, _DLT + 2))


def _is_dlt(file: CalibrationFile) -> bool:
    rows = _dlt_rows(file)
    while rows and any(word[:1].isalpha() for word in rows[0]):
        if any(role_of(word) in SCALARS for word in rows[0]):
            return False  # it is a table of fx, fy …
        rows = rows[1:]  # without the header
    csv_ = Path(file.path).suffix.lower() == ".csv" or "," in (file.head or [""])[-1]
    alike = len({len(words) for words in rows}) == 1
    return csv_ and alike and len(rows) == _DLT and len(rows[0]) <= MAX_CAMERAS


def _read_dlt(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = [(n, text.replace(",", " ").replace(";", " ").split()) for n, text in file.lines()]
    names: list[str] = []
    while any(word[:1].isalpha() for word in lines[0][1]):
        names, lines = lines[0][1], lines[1:]
    table = np.array([file.row(words, line) for line, words in lines])
    cameras: dict[str, RawCamera] = {}
    upward = []
    for index, values in enumerate(table.T):
        p = np.append(values, 1.0).reshape(3, 4)
        size = file.given_size
        # where the matrix is a reflection, the y axis of the image points up
        if np.linalg.det(p[:, :3]) < 0:
            upward.append(str(index))
            if size is None:
                message = (
                    "missing: image size; its y axis points up, as in DLTdv, and is turned with the height"
                )
                raise CameraError(f"{message}: give the size", path=file.path, key="size")
            p = np.array([[1.0, 0, 0], [0, -1, size[1] - 1], [0, 0, 1]]) @ p
        where = SourceLocation(f"column {index + 1}", lines[0][0])
        try:
            camera = Camera.from_projection_matrix(p, (1, 1))
        except CameraError as error:
            raise CameraError(error.message, path=file.path, line=where.line, key=where.key) from None
        name = names[index] if len(names) == len(table.T) else f"camera_{index + 1}"
        raw = RawCamera(camera.K, camera.R, camera.t, size=size, locations={"": where})
        file.add(cameras, name, raw, line=where.line)
    if upward:
        warn_about(
            file.path, "the image y axis of the coefficients points up; row 0 is taken as the lowest row"
        )
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


def _is_ego(file: CalibrationFile) -> bool:
    head = file.head[0] if file.head else ""
    return "cam_uid" in head and "tx_world_cam" in head


def _read_ego(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = list(islice(file.lines(), MAX_CAMERAS + 1))
    head = [word.strip() for word in next(csv.reader([lines[0][1]]))]
    absent = [key for key in _EGO if key not in head]
    if absent:
        raise CameraError(f"columns are missing: {some_of(absent)}", path=file.path, line=lines[0][0])
    cameras: dict[str, RawCamera] = {}
    for line, text in lines[1:]:
        words = next(csv.reader([text]))
        if len(words) != len(head):
            message = f"needs {len(head)} values as the header, not {len(words)}"
            raise CameraError(message, path=file.path, line=line)
        cells = dict(zip(head, (word.strip() for word in words), strict=True))
        if cells["intrinsics_type"] != "KANNALABRANDTK3":
            message = f"{cells['intrinsics_type'][:40]!r} is not a supported lens; known is KANNALABRANDTK3"
            raise CameraError(message, path=file.path, line=line, key="intrinsics_type")
        value = {
            key: file.row([cells[key]], line, key)[0]
            for key in _EGO
            if key not in ("cam_uid", "intrinsics_type")
        }
        xyzw = np.array([value[f"q{axis}_world_cam"] for axis in "xyzw"])
        fx, fy, cx, cy, *lens = (value[f"intrinsics_{i}"] for i in range(8))
        camera = RawCamera(
            pinhole(fx, fy, cx, cy),
            file.unit_rotation(xyzw, line=line).T,
            center=np.array([value[f"t{axis}_world_cam"] for axis in "xyz"]),
            size=_whole(file, np.array([value["image_width"], value["image_height"]])),
            distortion=tuple(lens),
            model="equidistant",
            locations={"": SourceLocation(None, line)},
        )
        file.add(cameras, cells["cam_uid"], camera, line=line)
    if not cameras:
        raise CameraError("the file has no cameras", path=file.path)
    return cameras


def _write_ego(cameras: Mapping[str, Camera]) -> dict[str, str | bytes]:
    lines = [",".join(_EGO)]
    for name, camera in cameras.items():
        check_names([name])
        if camera.model != "equidistant":
            raise CameraError("this format has only the equidistant lens", key=name)
        if set(name) & set(',"'):
            raise CameraError("this format needs a name without commas and quotation marks", key=name)
        k = camera.K
        pose = (*camera.center, *matrix_to_quaternion(camera.R.T))
        lens = (k[0, 0], k[1, 1], k[0, 2], k[1, 2], *camera.distortion)
        lines.append(
            f"{name},{row(pose, ',')},{camera.size[0]},{camera.size[1]},KANNALABRANDTK3,{row(lens, ',')}"
        )
    return {"": "\n".join(lines) + "\n"}


EGOEXO = calibration_format("egoexo4d", _is_ego, _read_ego, _write_ego)
