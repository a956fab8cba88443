"""Formats that differ from ``cameras/formats/matrices.py`` only in their keys. A table has a row for each
format.

A row of ``config/calibration_layouts.json`` has ``name`` and ``title`` of the format, ``syntax``, ``known``
(patterns of keys that a file has; for plain text, patterns of path and text), ``renamed`` (by pattern of a
key: its name here, with ' for a matrix in column order, or "" to leave the key out; a pattern with = matches
a key and its value), ``unit`` (metres; absent if the program defines no unit), ``up``, ``direction`` of R and
t if their keys do not state it, and ``arrange``, a function below for files in which a camera is not a
mapping of keys.

Sources: devkits of KITTI, nuScenes, EuRoC, InterHand2.6M, RICH and MPI-INF-3DHP (Skeletool); on github.com
rameau-fr/MC-Calib, ethz-asl/okvis, stella-cv/stella_vslam, facebookresearch/projectaria_tools, arpg/Calibu,
strawlab/flydra, strawlab/pymvg, strawlab/MultiCamSelfCal, UZ-SLAMLab/ORB_SLAM3,
HKUST-Aerial-Robotics/VINS-Fusion, uzh-rpg/rpg_svo_pro_open, VladyslavUsenko/basalt, mapillary/OpenSfM,
PJLab-ADG/SensorsCalibration, backyardbiomech/argus_gui, DLR-RM/BlenderProc (CalLab),
IntelRealSense/librealsense; https://jarvis-mocap.github.io, https://captury.com.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.camera.lens import Lens
from humansim_ros.cameras.formats.base import CalibrationFile, Keys, RawCamera, without_suffix
from humansim_ros.cameras.formats.conventions import fitted_lens
from humansim_ros.cameras.formats.matrices import MATRICES, read_matrices
from humansim_ros.cameras.formats.spellings import keys_of, plain, words
from humansim_ros.cameras.formats.syntax import read_document
from humansim_ros.cameras.formats.table import CalibrationFormat, nested
from humansim_ros.errors import CameraError, located, warn_about
from humansim_ros.files.reading import exists, read_table, read_text
from humansim_ros.types import Array

_MOST_BYTES = 8 << 20
#: Cameras by name, or in a list. Each is a mapping of keys.
_Cameras = dict[str, dict[str, Any]] | list[dict[str, Any]]
#: Names of the parameters of each lens with a name that does not list them.
_LENSES = {"KannalaBrandtK3": "fx_fy_cx_cy_kb4", "Linear": "fx_fy_cx_cy"}
_FROM_DEPTH = re.compile(r'Extrinsic from "Depth"\s+To\s+"(.+?)"')
_LEAST_POINTS = 50
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
_FLYDRA = ("fc1", "fc2", "cc1", "cc2", "k1", "k2", "p1", "p2")
#: Pose of a camera with the world as its frame.
_ORIGIN = {"c2w": np.eye(4)[:3].tolist()}
#: Columns of the text files of Argus, by number of columns.
_ARGUS = {
    12: "name fx width height cx cy aspect k1 k2 p1 p2 k3",
    10: "name fx cx cy aspect k1 k2 p1 p2 k3",
    17: "fx cx cy aspect skew k1 k2 p1 p2 k3 qw qx qy qz tx ty tz",
}


def _with_params(file: CalibrationFile, items: dict[Any, Any], key: str) -> dict[Any, Any]:
    """Give each number of ``params`` a key, which depends on the lens. ``key``: key of the lens, for
    errors."""
    if "params" not in items:
        return items
    model, numbers = str(items.get("model")), replace(file, document=items).some_numbers("params").tolist()
    names = _LENSES.get(model, model.removeprefix("calibu_")).replace("kb4", "k1_k2_k3_k4").split("_")
    if len(names) != len(numbers) or not {*names} <= words("f fu fv u0 v0 fx fy cx cy k1 k2 k3 k4"):
        message = f"the lens {model[:60]!r} with {len(numbers)} numbers is not supported"
        raise CameraError(message, path=file.path, key=key)
    values = {"params": None, "model": "none", "fisheye": "k4" in names}
    return items | values | dict(zip(names, numbers, strict=True))


def _transposed(value: Any) -> Any:
    """Transpose a square matrix in column order. A matrix of OpenCV has its numbers under ``data``."""
    if isinstance(value, Mapping):
        return {**value, "data": _transposed(value.get("data"))}
    numbers = np.array(value, dtype=object).ravel()
    side = int(len(numbers) ** 0.5)
    return numbers.reshape(side, side).T.tolist() if side * side == len(numbers) else value


def _placed(rotation: Array, center: Array) -> dict[str, Any]:
    """Pose of a camera: rotation (3, 3) from the camera to the world, and centre (3,)."""
    return {"c2w": nested(np.column_stack([rotation, center]))}


def _nuscenes(file: CalibrationFile) -> _Cameras:
    """Cameras of nuScenes, named after the channels in the table ``sensor`` of the same folder."""
    path = Path(file.path).with_name("sensor.json")
    table = read_document(path, _MOST_BYTES).items() if exists(path) else []
    names = {str(one.get("token")): one.get("channel") for one in table if isinstance(one, Mapping)}
    cameras = [one for one in file.items() if isinstance(one, Mapping) and one.get("camera_intrinsic")]
    return [{**one, "name": names.get(str(one.get("sensor_token")), "")} for one in cameras]


def _calibu(file: CalibrationFile) -> _Cameras:
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


def _flydra(file: CalibrationFile) -> _Cameras:
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


def _selfcal(file: CalibrationFile) -> _Cameras:
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


def _stephi(file: CalibrationFile) -> _Cameras:
    """Camera of ``*.cal`` of MultiCamSelfCal: a centre, and the inverse of K R."""
    file = plain(file)
    kr = np.linalg.pinv(file.numbers((3, 3), "P"))
    center = kr @ [file.number(f"C{i}") for i in (1, 2, 3)]
    return {Path(file.path).stem: {"P": nested(np.column_stack([kr, -center]))}}


def _captury(file: CalibrationFile) -> _Cameras:
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


def _realsense(file: CalibrationFile) -> _Cameras:
    """Cameras of RealSense for all modes of all streams. The world is the frame of the depth camera."""
    start = file.text.rfind("\n", 0, file.text.index('Intrinsic of "')) + 1
    document, cameras = plain(replace(file, text=file.text[start:])).document or {}, {}
    depth = {"Depth": {"Rotation Matrix": nested(np.eye(3)), "Translation Vector": [0.0] * 3}}
    poses = {match[1]: value for key, value in document.items() if (match := _FROM_DEPTH.match(key))} | depth
    for key, value in document.items():
        mode = re.match(r'Intrinsic of "(.+?)"[\s/]+([0-9]{1,5}x[0-9]{1,5})', key)
        if mode and file.given_size in (None, tuple(map(int, mode[2].split("x")))):
            lens = str(value.get("Distortion")).lower().replace(" ", "_")
            if lens.startswith(("inverse", "modified")) and np.any(value.get("Coeffs", 0)):
                warn_about(file.path, f"{key}: {lens} is taken for plumb_bob, as realsense-ros does")
            lens = re.sub("^(inverse|modified)_", "", lens)
            cameras[f"{mode[1]}_{mode[2]}"] = {**value, **poses.get(mode[1], {}), "Distortion": lens}
    return cameras


def _stereo(file: CalibrationFile) -> _Cameras:
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


def _orbslam3(file: CalibrationFile) -> _Cameras:
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


def _ncamera(file: CalibrationFile) -> _Cameras:
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


def _opensfm(file: CalibrationFile) -> _Cameras:
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


def _pymvg(file: CalibrationFile) -> _Cameras:
    """Cameras of pymvg. (Q, translation) is the pose of the rectified camera. R rectifies."""
    cameras = []
    for at in file.paths("camera_system"):
        camera = file.mapping(*at)
        q = file.numbers((3, 3), *at, "Q" if "Q" in camera else "rotation")
        r, t = file.numbers((3, 3), *at, "R").T, file.numbers((3,), *at, "translation")
        rest = {key: camera[key] for key in ("name", "width", "height", "K", "D") if key in camera}
        cameras.append({**rest, "R": nested(r @ q), "t": nested(r @ t)})
    return cameras


def _matlab(file: CalibrationFile) -> _Cameras:
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


def _argus(file: CalibrationFile) -> _Cameras:
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


_ARRANGED: dict[str, Callable[[CalibrationFile], _Cameras]] = {
    function.__name__.removeprefix("_"): function
    for function in (
        _nuscenes,
        _calibu,
        _flydra,
        _selfcal,
        _stephi,
        _captury,
        _realsense,
        _stereo,
        _orbslam3,
        _ncamera,
        _opensfm,
        _pymvg,
        _matlab,
        _argus,
    )
}


def _format(row: Mapping[str, Any]) -> CalibrationFormat:
    renamed: Mapping[str, str] = row.get("renamed", {})

    def matches(file: CalibrationFile) -> bool:
        if file.syntax == "text":
            text = f"{file.path}\n{file.text[: 1 << 16]}"
            return all(re.search(one, text, re.MULTILINE) for one in row["known"])
        keys = keys_of(file)
        return all(any(re.fullmatch(one, key) for key in keys) for one in row["known"])

    def read(file: CalibrationFile) -> dict[str, RawCamera]:
        back: dict[str, str] = {}

        def rewrite(items: dict[Any, Any]) -> dict[Any, Any]:
            result: dict[Any, Any] = {}
            for key, value in items.items():
                texts = str(key), f"{key}={value}" if isinstance(value, (str, int, float)) else ""
                found = ((re.fullmatch(one, texts["=" in one]), new) for one, new in renamed.items())
                match, new = next(((match, new) for match, new in found if match), (None, ""))
                here = key if match is None else match.expand(new.rstrip("'"))
                back.setdefault(str(here), str(key))
                if here != "":
                    result[here] = _transposed(value) if new.endswith("'") else value
            return _with_params(file, result, back.get("model", "model"))

        arranged = file if "arrange" not in row else replace(file, document=_ARRANGED[row["arrange"]](file))
        document = plain(arranged, rewrite).document
        cameras = document if isinstance(document, dict) else {"cameras": document}
        stated = {"convention": row.get("direction", "w2c"), **cameras}
        read = read_matrices(replace(file, document=stated, renamed=back))
        if stated.get("origin") == "corner":
            read = {name: replace(c, K=c.K - _HALF_PIXEL) for name, c in read.items()}
        path = Path(file.path)
        return {path.parent.name: read[path.stem]} if [*read] == [path.stem] == ["sensor"] else read

    names = {key: row[key] for key in ("name", "title", "syntax", "up", "unit") if key in row}
    format = replace(MATRICES, **names, also=(), matches=matches, read=read)
    return replace(format, find_unit=None) if "unit" in row else format


#: Formats that can only be read.
LAYOUTS = tuple(_format(row) for row in read_table("calibration_layouts"))
