"""Formats with cameras that are not mappings of keys, and with keys in any usual spelling.

A function of this module makes mappings of the cameras of a file; their keys are those of the format's row in
``config/calibration_formats.json``.

Sources: devkits of KITTI, nuScenes, EuRoC, InterHand2.6M, RICH and MPI-INF-3DHP (Skeletool); on github.com
rameau-fr/MC-Calib, ethz-asl/okvis, stella-cv/stella_vslam, facebookresearch/projectaria_tools, arpg/Calibu,
strawlab/flydra, strawlab/pymvg, strawlab/MultiCamSelfCal, UZ-SLAMLab/ORB_SLAM3,
HKUST-Aerial-Robotics/VINS-Fusion, uzh-rpg/rpg_svo_pro_open, VladyslavUsenko/basalt, mapillary/OpenSfM,
PJLab-ADG/SensorsCalibration, backyardbiomech/argus_gui, DLR-RM/BlenderProc (CalLab),
IntelRealSense/librealsense; https://jarvis-mocap.github.io, https://captury.com.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.camera.lens import Lens
from humansim_ros.cameras.formats.base import CalibrationFile, Keys, without_suffix
from humansim_ros.cameras.formats.conventions import fitted_lens
from humansim_ros.cameras.formats.devices import realsense_lens
from humansim_ros.cameras.formats.matrices import is_matrices, read_matrices
from humansim_ros.cameras.formats.spellings import plain
from humansim_ros.cameras.formats.syntax import read_document
from humansim_ros.cameras.formats.table import Cameras, calibration_format, nested, unit_of_file
from humansim_ros.errors import CameraError, located, warn_about
from humansim_ros.files.reading import exists, npz_bytes, read_text
from humansim_ros.types import Array

_MOST_BYTES = 8 << 20
_FROM_DEPTH = re.compile(r'Extrinsic from "Depth"\s+To\s+"(.+?)"')
_LEAST_POINTS = 50
_FLYDRA = ("fc1", "fc2", "cc1", "cc2", "k1", "k2", "p1", "p2")
#: Pose of a camera with the world as its frame.
_ORIGIN = {"c2w": np.eye(4)[:3].tolist()}
#: Columns of the text files of Argus, by number of columns.
_ARGUS = {
    12: "name fx width height cx cy aspect k1 k2 p1 p2 k3",
    10: "name fx cx cy aspect k1 k2 p1 p2 k3",
    17: "fx cx cy aspect skew k1 k2 p1 p2 k3 qw qx qy qz tx ty tz",
}


def _placed(rotation: Array, center: Array) -> dict[str, Any]:
    """Pose of a camera: rotation (3, 3) from the camera to the world, and centre (3,)."""
    return {"c2w": nested(np.column_stack([rotation, center]))}


def _nuscenes(file: CalibrationFile) -> Cameras:
    """Cameras of nuScenes, named after the channels in the table ``sensor`` of the same folder."""
    path = Path(file.path).with_name("sensor.json")
    table = read_document(path, _MOST_BYTES).items() if exists(path) else []
    names = {str(one.get("token")): one.get("channel") for one in table if isinstance(one, Mapping)}
    cameras = [one for one in file.items() if isinstance(one, Mapping) and one.get("camera_intrinsic")]
    return [{**one, "name": names.get(str(one.get("sensor_token")), "")} for one in cameras]


def _calibu(file: CalibrationFile) -> Cameras:
    """Cameras of Calibu. Their axes ``right``, ``down`` and ``forward`` are turned to the axes of OpenCV."""
    file, cameras = plain(file), []
    for at in file.elements(("rig",), "camera"):
        lens, pose = (*at, "camera_model", 0), (*at, "pose", 0, "T_wc")
        axes = np.array([file.numbers((3,), *lens, axis) for axis in ("right", "down", "forward")])
        rows = 4 if len(file.optional_numbers(*pose)) == 16 else 3
        matrix = file.numbers((rows, 4), *pose) if file.has(*pose) else np.eye(4)
        cameras.append({**file.mapping(*lens), **_placed(matrix[:3, :3] @ axes.T, matrix[:3, 3])})
    return cameras


def _through(
    file: CalibrationFile, name: str, p: Array, k: Array, lens: Sequence[float], size: Sequence[float] | Array
) -> dict[str, Any]:
    """Camera with a matrix P (3, 4) to undistorted pixels. The ``k`` (3, 3) of the lens may be another
    one."""
    camera = {"P": nested(p), "distortion": list(lens), **({"size": list(size)} if len(size) else {})}
    with located(CameraError, path=file.path, key=name):
        own, bending = Camera.from_projection_matrix(p, (1, 1)).K, Lens.of(lens)
    if not any(lens) or np.allclose(own, k, rtol=1e-4, atol=0.05):
        return camera
    width, height = size if len(size) else 2 * k[:2, 2]
    bent = np.stack(np.meshgrid(np.linspace(0, width, 24), np.linspace(0, height, 24)), -1).reshape(-1, 2)
    straight = bending.undistort((bent - k[:2, 2]) / k[[0, 1], [0, 1]]) * k[[0, 1], [0, 1]] + k[:2, 2]
    straight, bent = ((each - own[:2, 2]) @ np.linalg.inv(own[:2, :2]).T for each in (straight, bent))
    seen = np.isfinite(straight).all(axis=1)
    if seen.sum() < _LEAST_POINTS:
        raise file.error(f"{name}: the lens does not fit the image")
    fitted = fitted_lens(file, f"{name}: a lens with another K than P", straight[seen], bent[seen], own[0, 0])
    return {**camera, "distortion": list(fitted.coefficients), "model": fitted.model}


def _flydra(file: CalibrationFile) -> Cameras:
    file, cameras = plain(file), {}
    for at in file.elements(("multi_camera_reconstructor",), "single_camera_calibration"):
        fx, fy, cx, cy, *d = (file.number(*at, "non_linear_parameters", 0, key) for key in _FLYDRA)
        p = file.numbers((3, 4), *at, "calibration_matrix")
        p[:, 3] *= file.number(*at, "scale_factor", otherwise=1.0)
        name, size = str(file.need(*at, "cam_id")), file.optional_numbers(*at, "resolution")
        cameras[name] = _through(file, name, p, pinhole(fx, fy, cx, cy), d, size)
    if file.has("multi_camera_reconstructor", "water"):
        warn_about(file.path, "water is ignored: the cameras see through air")
    return cameras


def _selfcal(file: CalibrationFile) -> Cameras:
    """Camera of ``cameraN.Pmat.cal``, with the lens of ``*N.rad``, the size in line N of Res.dat, and the
    name in line N of camera_order.txt."""
    path = Path(file.path)
    number = int((re.search(r"([0-9]{1,4})\.Pmat", path.name, re.IGNORECASE) or "00")[1])
    name, size = (_line(path.with_name(other), number) for other in ("camera_order.txt", "Res.dat"))
    name = name or path.name[: -len(".Pmat.cal")]
    p = np.array([value for line, text in file.lines() for value in file.row(text.split(), line)])
    if p.shape != (12,):
        raise file.error(f"needs 3 x 4 numbers, not {p.size}")
    k, lens = np.eye(3), np.zeros(0)
    for rad in sorted(path.parent.glob(f"*[!0-9]{number}.rad"))[:1]:
        inner = plain(read_document(rad, _MOST_BYTES))
        k, lens = inner.numbers((3, 3), "K"), inner.some_numbers("kc")
    return {name: _through(file, name, p.reshape(3, 4), k, lens.tolist(), file.row(size.split()[:2], number))}


def _line(path: Path, number: int) -> str:
    """Line ``number`` of a text file, counted from 1. Empty if the line is missing."""
    lines = read_text(path, CameraError, "calibration", _MOST_BYTES).splitlines() if exists(path) else []
    return lines[number - 1].strip() if 0 < number <= len(lines) else ""


def _stephi(file: CalibrationFile) -> Cameras:
    """Camera of ``*.cal`` of MultiCamSelfCal: a centre, and the inverse of K R."""
    file = plain(file)
    kr = np.linalg.pinv(file.numbers((3, 3), "P"))
    center = kr @ [file.number(f"C{i}") for i in (1, 2, 3)]
    return {Path(file.path).stem: {"P": nested(np.column_stack([kr, -center]))}}


def _captury(file: CalibrationFile) -> Cameras:
    """Cameras of Captury. Lengths on the sensor are in mm. The width gives the pixels per mm."""
    if file.given_size is None:
        raise file.error("the file has no image size: give the size", "size")
    width, cameras = file.given_size[0], {}
    file = plain(file)
    several = file.get("cameras")
    for at in [("cameras", key) for key in several] if isinstance(several, Mapping) else [()]:
        sensor = file.numbers((2,), *at, "sensorSize")
        scale = width / max(sensor[0], 1e-9)
        f = file.number(*at, "focalLength") * scale
        center = (sensor / 2 + file.numbers((2,), *at, "centerOffset")) * scale
        up, right = (file.numbers((3,), *at, key) for key in ("up", "right"))
        cameras[(str(file.need(*at, "camera")).split() or ["camera"])[0]] = {
            "K": [f, f * file.number(*at, "pixelAspect", otherwise=1.0), *center],
            "distortion": file.optional_numbers(*at, "distortion").tolist(),
            "model": file.get(*at, "distortionModel"),
            **_placed(np.column_stack([right, -up, np.cross(right, -up)]), file.numbers((3,), *at, "origin")),
        }
    return cameras


def _realsense(file: CalibrationFile) -> Cameras:
    """Cameras of RealSense for all modes of all streams. The world is the frame of the depth camera."""
    start = file.text.rfind("\n", 0, file.text.index('Intrinsic of "')) + 1
    document, cameras = plain(replace(file, text=file.text[start:])).document or {}, {}
    depth = {"Depth": {"Rotation Matrix": nested(np.eye(3)), "Translation Vector": [0.0] * 3}}
    poses = {match[1]: value for key, value in document.items() if (match := _FROM_DEPTH.match(key))} | depth
    for key, value in document.items():
        mode = re.match(r'Intrinsic of "(.+?)"[\s/]+([0-9]{1,5}x[0-9]{1,5})', key)
        if mode and file.given_size in (None, tuple(map(int, mode[2].split("x")))):
            lens = realsense_lens(replace(file, document=document), (key,), "Distortion", "Coeffs")
            model = {"Distortion": lens.get("model", "none")}
            cameras[f"{mode[1]}_{mode[2]}"] = {**value, **poses.get(mode[1], {}), **model}
    return cameras


def _stereo(file: CalibrationFile) -> Cameras:
    """Left and right camera in files of stella_vslam, OpenVSLAM and ORB-SLAM2. In these files, the matrix R
    of a camera rotates from its own axes to those of the rectified images."""
    items: dict[str, Any] = {}
    for key, value in file.mapping().items():  # LEFT.K, or K under LEFT
        first, _, rest = str(key).partition(".")
        before = items.get(first)
        items[first] = {**(before if isinstance(before, dict) else {}), rest: value} if rest else value
    file, stella = replace(file, document=items), "StereoRectifier" in items
    fx = file.number("Camera", "fx")
    if fx <= 0:
        raise file.error("must be above zero", "Camera", "fx")
    shift = np.array([file.number("Camera", "focal_x_baseline" if stella else "bf") / fx, 0, 0])
    at, width, height = ("Camera", "cols", "rows") if stella else ("LEFT", "width", "height")
    keys = {"width": (at, width), "height": (at, height), "model": ("StereoRectifier", "model")}
    shared = {key: file.get(*path) for key, path in keys.items()}
    cameras: dict[str, dict[str, Any]] = {}
    left = np.eye(3)
    for side in ("left", "right"):
        k, d, r = (("StereoRectifier", f"{p}_{side}") if stella else (side.upper(), p, "data") for p in "KDR")
        turn = file.numbers((3, 3), *r)
        left = left if cameras else turn
        pose = {"R": nested(turn.T @ left), "t": nested(-turn.T @ shift * len(cameras))}
        lens = {"K": nested(file.some_numbers(*k)), "distortion": nested(file.some_numbers(*d))}
        cameras[side] = {**lens, **pose, **shared}
    return cameras


def _orbslam3(file: CalibrationFile) -> Cameras:
    """Cameras of ORB-SLAM3. The second camera of a rectified pair is the first one, moved by the baseline."""
    cameras: dict[str, dict[str, Any]] = {}
    for key, value in file.mapping().items():
        name, _, part = str(key).partition(".")
        if name in ("Camera", "Camera1", "Camera2"):
            cameras.setdefault(name, {})[part] = value
    shared = {key: file.get(f"Camera.{key}") for key in ("type", "width", "height")}
    left = "Camera1" if "Camera1" in cameras else "Camera"
    if shared["type"] == "Rectified":
        shared["type"] = "PinHole"
        moved = _placed(np.eye(3), np.array([file.number("Stereo.b"), 0.0, 0.0]))
        cameras["Camera2"] = {**cameras.get(left, {}), **moved}
    pose = file.first((), "Stereo.T_c1_c2", "Tlr")
    if "Camera2" in cameras and pose is not None:
        cameras["Camera2"]["c2w"] = file.get(pose)
    if left in cameras and "c2w" in cameras.get("Camera2", ()):
        cameras[left] |= _ORIGIN
    return [{"name": name, **shared, **camera} for name, camera in cameras.items() if "fx" in camera]


def _ncamera(file: CalibrationFile) -> Cameras:
    """Cameras of a rig. The lens that this format calls fisheye has the FOV model."""
    cameras = []
    for at in file.paths("cameras"):
        camera, lens = dict(file.mapping(*at, "camera")), dict(file.mapping(*at, "camera", "distortion"))
        kind = str(lens.pop("type", "none")).replace("fisheye", "fov")
        own = str(camera.pop("type", "pinhole"))
        pose = {"T_B_C": file.get(*at, "T_B_C")} if file.has(*at, "T_B_C") else {}
        cameras.append({**camera, **lens, **pose, "model": kind if own.lower() == "pinhole" else own})
    return cameras


#: Lenses of OpenSfM, and their models.
_OPENSFM = {
    **dict.fromkeys(("perspective", "brown", "radial", "simple_radial"), "plumb_bob"),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), "equidistant"),
}


def _opensfm(file: CalibrationFile) -> Cameras:
    """Shots of OpenSfM, or its cameras. Lengths are fractions of the longer side, measured from the image
    centre."""
    at: Keys = (0,) if isinstance(file.document, list) else ()
    if at and len(file.document) > 1:
        warn_about(file.path, f"the first of {len(file.document)} reconstructions is read")
    group = (*at, "cameras") if file.get(*at, "cameras") is not None else at
    own = file.get(*at, "shots") is not None
    cameras = {}
    for name in file.mapping(*at, "shots") if own else file.mapping(*group):
        shot = (*at, "shots", name)
        lens: Keys = (*group, str(file.need(*shot, "camera")) if own else name)
        kind = str(file.mapping(*lens).get("projection_type", "perspective"))
        if kind not in _OPENSFM:
            message = f"the lens {kind[:40]!r} is not supported; known are {', '.join(_OPENSFM)}"
            raise file.error(message, *lens, "projection_type")
        width, height = file.size((*lens, "width"), (*lens, "height"))
        side = max(width, height)
        fx, fy = (key if file.has(*lens, key) else "focal" for key in ("focal_x", "focal_y"))
        k = pinhole(file.number(*lens, fx), file.number(*lens, fy), 0, 0) * side
        k[:, 2] = [(width - 1) / 2, (height - 1) / 2, 1]
        k[:2, 2] += [side * file.number(*lens, key, otherwise=0.0) for key in ("c_x", "c_y")]
        numbers = {key: file.get(*lens, key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
        pose = {"rvec": file.need(*shot, "rotation"), "t": file.need(*shot, "translation")} if own else {}
        camera = {"K": nested(k), "model": _OPENSFM[kind], "width": width, "height": height}
        cameras[without_suffix(name)] = {**camera, **numbers, **pose}
    return cameras


def _pymvg(file: CalibrationFile) -> Cameras:
    """Cameras of pymvg. (Q, translation) is the pose of the rectified camera. R rectifies."""
    cameras = []
    for at in file.paths("camera_system"):
        camera = file.mapping(*at)
        q = file.numbers((3, 3), *at, "Q" if "Q" in camera else "rotation")
        r, t = file.numbers((3, 3), *at, "R").T, file.numbers((3,), *at, "translation")
        rest = {key: camera[key] for key in ("name", "width", "height", "K", "D") if key in camera}
        cameras.append({**rest, "R": nested(r @ q), "t": nested(r @ t)})
    return cameras


def _matlab(file: CalibrationFile) -> Cameras:
    """Cameras of MATLAB. Pixels count from 1. Matrices are for row vectors, but not K and PoseCamera2."""
    pair = [key for key in ("CameraParameters1", "CameraParameters2") if file.get(key) is not None]
    cameras: dict[str, dict[str, Any]] = {}
    for name in pair or [Path(file.path).stem]:
        at: Keys = (name,) if pair else ()
        key = file.first(at, "IntrinsicMatrix", "K")
        if key is None:
            k = pinhole(*file.numbers((2,), *at, "FocalLength"), *file.numbers((2,), *at, "PrincipalPoint"))
            k[0, 1] = file.number(*at, "Skew", otherwise=0.0)
        else:
            k = file.numbers((3, 3), *at, key)
        k = k.T if k[2, :2].any() else k
        k[:2, 2] -= 1
        lens = [file.optional_numbers(*at, f"{part}Distortion").tolist() for part in ("Radial", "Tangential")]
        given = {"K": nested(k), "shape": file.need(*at, "ImageSize")}
        cameras[name] = {**given, "radial": lens[0], "tangential": lens[1] or [0.0, 0.0]}
    if len(pair) == 2:
        cameras[pair[0]] |= _ORIGIN
        if file.has("PoseCamera2"):
            cameras[pair[1]] |= {"w2c": file.get("PoseCamera2", "A") or file.need("PoseCamera2")}
        else:
            rotation = file.numbers((3, 3), "RotationOfCamera2").T
            cameras[pair[1]] |= {"R": nested(rotation), "t": file.need("TranslationOfCamera2")}
    return cameras


def _argus(file: CalibrationFile) -> Cameras:
    cameras: dict[str, dict[str, Any]] = {}
    for line, text in file.lines():
        values = file.row(text.replace(",", " ").split(), line)
        if len(values) not in _ARGUS:
            message = f"needs {', '.join(map(str, _ARGUS))} numbers, not {len(values)}"
            raise file.error(message, line=line)
        camera = dict(zip(_ARGUS[len(values)].split(), values, strict=True))
        name = str(int(camera.pop("name", len(cameras) + 1)))
        cameras[name] = {"fy": camera["fx"] * camera.pop("aspect"), **camera}
    return cameras


def _write_npz(cameras: Mapping[str, Camera]) -> dict[str, str | bytes]:
    models = {str(camera.model) for camera in cameras.values()}
    if len(models) > 1:
        given = " and ".join(sorted(models))
        raise CameraError(f"this format needs one lens model for all cameras, not {given}")
    values = list(cameras.values())
    arrays = {
        "names": np.array(list(cameras)),
        "size": np.array([camera.size for camera in values]),
        "K": np.array([camera.K for camera in values]),
        "dist": np.array([camera.distortion for camera in values]),
        "R": np.array([camera.R for camera in values]),
        "t": np.array([camera.t for camera in values]),
        "distortion_model": np.array(models.pop()),
        "convention": np.array("world_to_camera"),
        "unit": np.array("m"),
    }
    return {"": npz_bytes(arrays)}


MATRICES = calibration_format("matrices", is_matrices, read_matrices, find_unit=unit_of_file)
MATRICES_NPZ = calibration_format("npz", is_matrices, read_matrices, _write_npz, find_unit=unit_of_file)

FORMATS = (
    *(MATRICES, MATRICES_NPZ),
    calibration_format("nuscenes", arrange=_nuscenes),
    calibration_format("stella", arrange=_stereo),
    calibration_format("orbslam2", arrange=_stereo),
    calibration_format("orbslam3", arrange=_orbslam3),
    calibration_format("ncamera", arrange=_ncamera),
    calibration_format("opensfm", arrange=_opensfm),
    calibration_format("pymvg", arrange=_pymvg),
    calibration_format("matlab", arrange=_matlab),
    calibration_format("calibu", arrange=_calibu),
    calibration_format("flydra", arrange=_flydra),
    calibration_format("captury", arrange=_captury),
    calibration_format("realsense_text", arrange=_realsense),
    calibration_format("multicamselfcal", arrange=_selfcal),
    calibration_format("multicamselfcal_cal", arrange=_stephi),
    calibration_format("argus", arrange=_argus),
)
