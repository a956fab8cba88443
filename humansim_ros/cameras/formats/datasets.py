"""Files of public data sets and of motion capture without markers.

- JSON of Human3.6M, Shelf and Campus (in the format of VoxelPose), and CMU Panoptic.
- TOML of Anipose, which FreeMoCap, Caliscope and Pose2Sim write too: x_cam = R x + t. The file does not name
  its unit. It is the unit of the calibration board: millimetres for most boards, metres in Pose2Sim.
  https://anipose.readthedocs.io/en/latest/aniposelib-tutorial.html
- JSON of 4DAssociation and related programs: K, RT (3x4) or R and T, distCoeff, imgSize; x = R X + t; metres,
  z up. The world of the Shelf data in this format is the floor. https://github.com/zhangyux15/4d_association
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.formats.base import (
    LARGEST,
    CalibrationFile,
    Key,
    Keys,
    RawCamera,
    check_count,
    find_cameras,
    find_unit,
    has_keys,
    json_file,
    nested,
    opencv_model,
    reader_of,
    rotation_of,
    row,
    stated_unit,
    vector_of,
)
from humansim_ros.cameras.formats.checks import IMAGE_SIZES
from humansim_ros.cameras.formats.conventions import FilePose, resolved
from humansim_ros.cameras.formats.spellings import role_of
from humansim_ros.cameras.formats.table import Values, calibration_format
from humansim_ros.cameras.formats.thesis_cam import cam_of, camera_of, format_cam, parse_cam
from humansim_ros.errors import CameraError
from humansim_ros.types import Array, ImageSize

_LINE = re.compile(r"(C|f|R|k|size|format)\s*=.*")


def _is_cam(file: CalibrationFile) -> bool:
    return bool(file.head) and _LINE.fullmatch(file.head[0]) is not None


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    cam = parse_cam(file.text, file.path)
    if max(map(abs, (*cam.center, cam.focal, *cam.euler_deg, *cam.aspect))) > LARGEST:
        raise CameraError(f"a number is above {LARGEST:g}: too large for a camera", path=file.path)
    camera = camera_of(cam)
    return {Path(file.path).stem: RawCamera(camera.K, camera.R, camera.t, size=camera.size)}


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    (camera,) = cameras.values()
    return {"": format_cam(cam_of(camera))}


CAM = calibration_format("cam", _is_cam, _read, _write)


# -- Human3.6M: x = R X + t in millimetres, z up; 4 cameras, with a pose for each of 11 subjects

#: Image sizes of the cameras by their serial numbers.
_H36M_SIZES: dict[str, ImageSize] = {serial: (w, h) for serial, (w, h) in IMAGE_SIZES["human36m"].items()}
#: Keys of the lens and focal lengths of Shelf and Campus. One of them is enough to recognise a file.
_SHELF_INTRINSICS = {"k", "p", "f"}
_PANEL_AND_NODE = re.compile(r"([0-9]{2})_([0-9]{2})")
_SUBJECT = re.compile(r"(S[0-9]+)_(.+)", re.DOTALL)


def _is_h36m(file: CalibrationFile) -> bool:
    inner = file.get("intrinsics")
    whole = isinstance(inner, dict) and isinstance(file.get("extrinsics"), dict)
    return whole and any(isinstance(one, dict) and "calibration_matrix" in one for one in inner.values())


def _read_h36m(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    subjects = file.mapping("extrinsics")
    for subject in subjects:
        for name in file.mapping("extrinsics", subject):
            if name not in file.mapping("intrinsics"):
                raise file.error("has no intrinsics", "extrinsics", subject, name)
            camera = _h36m_camera(file, ("intrinsics", name), ("extrinsics", subject, name))
            file.add(cameras, name if len(subjects) == 1 else f"{subject}_{name}", camera)
    return cameras


def _h36m_camera(
    file: CalibrationFile, intrinsics: tuple[Key, ...], extrinsics: tuple[Key, ...]
) -> RawCamera:
    keys = {
        "K": (*intrinsics, "calibration_matrix"),
        "distortion": (*intrinsics, "distortion"),
        "R": (*extrinsics, "R"),
        "t": (*extrinsics, "t"),
    }
    distortion = file.some_numbers(*keys["distortion"])
    check_count(file, "plumb_bob", distortion, keys["distortion"])
    return RawCamera(
        file.numbers((3, 3), *keys["K"]),
        file.numbers((3, 3), *keys["R"]),
        file.numbers((3,), *keys["t"]),
        size=_H36M_SIZES.get(str(intrinsics[-1])),
        distortion=tuple(distortion),
        model="plumb_bob",
        locations={part: file.location(*path) for part, path in keys.items()},
    )


def _write_h36m(cameras: Mapping[str, Camera]) -> dict[str, str]:
    intrinsics: dict[str, Any] = {}
    extrinsics: dict[str, Any] = {}
    for name, camera in cameras.items():
        matched = _SUBJECT.fullmatch(name)
        subject, serial = (matched[1], matched[2]) if matched else ("S1", name)
        parameters = {
            "calibration_matrix": nested(camera.K),
            "distortion": nested(camera.distortion[:5]),
        }
        if intrinsics.setdefault(serial, parameters) != parameters:
            message = "this format needs the same K and lens of a camera for all subjects"
            raise CameraError(message, key=name)
        poses = extrinsics.setdefault(subject, {})
        if serial in poses:
            raise CameraError(f"there are two cameras {serial} of subject {subject}", key=name)
        poses[serial] = {"R": nested(camera.R), "t": nested(camera.t[:, None])}
    return json_file({"intrinsics": intrinsics, "extrinsics": extrinsics})


# -- Shelf and Campus: x = R (X - T), where T is the camera centre; millimetres, z up


def _shelf_cameras(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, has_keys({"R"}, {"T"}, _SHELF_INTRINSICS), has_keys({"R", "T", "fx", "f"}))


def _shelf_camera(file: CalibrationFile, at: Keys) -> RawCamera:
    if file.get(*at, "f") is not None and file.get(*at, "fx") is None:  # arrays as VoxelPose writes them
        fx, fy, cx, cy = (*file.numbers((2,), *at, "f"), *file.numbers((2,), *at, "c"))
    else:
        fx, fy, cx, cy = (file.number(*at, key) for key in ("fx", "fy", "cx", "cy"))
    radial: Array = np.zeros(3)
    tangential: Array = np.zeros(2)
    if file.get(*at, "k") is not None:
        radial = file.numbers((3,), *at, "k")
    if file.get(*at, "p") is not None:
        tangential = file.numbers((2,), *at, "p")
    posed = file.get(*at, "R") is not None or file.get(*at, "T") is not None
    size = file.pair_size(*at, "imgSize")
    if size is None and file.get(*at, "width") is not None and file.get(*at, "height") is not None:
        size = file.positive_integer(*at, "width"), file.positive_integer(*at, "height")
    return RawCamera(
        pinhole(fx, fy, cx, cy),
        file.numbers((3, 3), *at, "R") if posed else None,
        center=file.numbers((3,), *at, "T") if posed else None,
        size=size,
        distortion=(*radial[:2], *tangential, radial[2]),
        model="plumb_bob",
        locations=file.locations(at, K="fx", R="R", t="T", distortion="k"),
    )


_is_shelf, _read_as_shelf = reader_of(_shelf_cameras, _shelf_camera)


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
    own = ({"K", "distCoef"}, {"K", "panel"}, {"K", "type", "resolution"})
    return isinstance(cameras, list) and any(
        isinstance(c, dict) and any(keys <= c.keys() for keys in own) for c in cameras
    )


def _read_panoptic(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for index in range(len(file.need("cameras"))):
        at: tuple[Key, ...] = ("cameras", index)
        distortion = file.optional_numbers(*at, "distCoef")
        check_count(file, "plumb_bob", distortion, (*at, "distCoef"))
        posed = file.get(*at, "R") is not None or file.get(*at, "t") is not None
        camera = RawCamera(
            file.numbers((3, 3), *at, "K"),
            file.numbers((3, 3), *at, "R") if posed else None,
            file.numbers((3,), *at, "t") if posed else np.zeros(3),
            size=file.pair_size(*at, "resolution"),
            distortion=tuple(distortion),
            model="plumb_bob",
            locations=file.locations(at, K="K", R="R", t="t", distortion="distCoef", size="resolution"),
        )
        file.add(cameras, str(file.need(*at, "name")), camera, *at)
    return cameras


def _panoptic_values(own: Values, camera: Camera) -> Values:
    """Type of a camera, and its panel and node in the studio. Its name consists of them."""
    matched = _PANEL_AND_NODE.fullmatch(own["name"])
    panel, node = (int(matched[1]), int(matched[2])) if matched else (0, own["index"])
    return {"type": "hd" if camera.size == (1920, 1080) else "vga", "panel": panel, "node": node}


H36M = calibration_format("human36m", _is_h36m, _read_h36m, _write_h36m)
SHELF = calibration_format(
    "shelf", _is_shelf, _read_shelf, find_unit=lambda file, _: stated_unit(file) or 0.001
)
PANOPTIC = calibration_format("panoptic", _is_panoptic, _read_panoptic, values=_panoptic_values)


_PARTS = {"matrix", "rotation", "translation", "distortions"}


def _cameras_anipose(file: CalibrationFile) -> list[tuple[str, Keys]]:
    found = find_cameras(file, has_keys({"matrix"}), has_keys(_PARTS))
    return [(str(file.get(*at, "name") or "").strip() or table, at) for table, at in found]


def _camera_anipose(file: CalibrationFile, at: Keys) -> RawCamera:
    matrix = file.numbers((3, 3), *at, "matrix")
    distortion = file.optional_numbers(*at, "distortions")
    model = _model(file, at, distortion)
    rotation, t = file.get(*at, "rotation"), file.get(*at, "translation")
    if (rotation is None) != (t is None):
        present, missing = ("rotation", "translation") if t is None else ("translation", "rotation")
        raise file.error(f"needs {missing} as well", *at, present)
    return RawCamera(
        matrix,
        None if rotation is None else rotation_of(file, *at, "rotation"),
        np.zeros(3) if t is None else file.numbers((3,), *at, "translation"),
        size=file.pair_size(*at, "size"),
        distortion=tuple(distortion),
        model=model,
        locations=file.locations(
            at, K="matrix", distortion="distortions", R="rotation", t="translation", size="size"
        ),
    )


def _model(file: CalibrationFile, at: Keys, distortion: Array) -> str:
    fisheye = file.get(*at, "fisheye")
    if fisheye is not None and not isinstance(fisheye, bool):
        raise file.error("needs true or false", *at, "fisheye")
    model = "equidistant" if fisheye else opencv_model(distortion)
    if len(distortion) >= 4 or model == "equidistant":
        check_count(file, model, distortion, (*at, "distortions"))
    return model


def _write_anipose(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lines: list[str] = []
    for index, (name, camera) in enumerate(cameras.items()):
        matrix = ", ".join(f"[{row(values, ', ')}]" for values in camera.K)
        lines += [f"[cam_{index}]", f"name = {_text(name)}"]
        lines += [f"size = [{camera.size[0]}, {camera.size[1]}]", f"matrix = [{matrix}]"]
        lines += [f"distortions = [{row(camera.distortion, ', ')}]"]
        lines += [f"rotation = [{row(vector_of(camera.R), ', ')}]"]
        lines += [f"translation = [{row(camera.t, ', ')}]"]
        lines += [f"fisheye = {str(camera.model == 'equidistant').lower()}", ""]
    return {"": "\n".join([*lines, "[metadata]", 'unit = "m"']) + "\n"}


def _text(name: str) -> str:
    if not name.isprintable():
        raise CameraError("this format needs a name without control characters", key=name)
    escaped: Any = name.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


ANIPOSE = calibration_format(
    "anipose", *reader_of(_cameras_anipose, _camera_anipose), _write_anipose, find_unit=find_unit
)


#: Keys of the lens, in order of precedence.
_LENS = ("distCoeff", "distCoeffs", "distCoef", "distortion_coefficients", "D")


def _cameras_association(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, _is_camera, has_keys({"K", "RT"}))


#: Keys of a camera. If other camera parameters are there, the file has another format.
_OWN = {"K", "RT", "R", "T", "t", "imgSize", "name", "id", *_LENS}


def _is_camera(value: object) -> bool:
    if not isinstance(value, dict) or "K" not in value or value.keys().isdisjoint(("RT", "imgSize")):
        return False
    return not any(role_of(key) for key in value.keys() - _OWN)


def _camera_association(file: CalibrationFile, at: Keys) -> RawCamera:
    k = file.numbers((3, 3), *at, "K")
    r, t, (r_key, t_key) = _pose(file, at)
    lens = next((key for key in _LENS if file.get(*at, key) not in (None, [])), _LENS[0])
    distortion = file.optional_numbers(*at, lens)
    model = opencv_model(distortion)
    check_count(file, model, distortion, (*at, lens))
    return RawCamera(
        k,
        r,
        t,
        size=file.pair_size(*at, "imgSize"),
        distortion=tuple(distortion),
        model=model,
        locations=file.locations(at, K="K", R=r_key, t=t_key, distortion=lens, size="imgSize"),
    )


def _pose(file: CalibrationFile, at: Keys) -> tuple[Array | None, Array, tuple[str, str]]:
    """R and t with their keys: from RT (3x4 or 4x4), or from R and T. R is None if there is none."""
    if file.get(*at, "RT") is not None:
        rows = 4 if len(file.some_numbers(*at, "RT")) == 16 else 3
        matrix = file.pose_matrix(*at, "RT", rows=rows)
        return matrix[:3, :3], matrix[:3, 3], ("RT", "RT")
    t_key = next((key for key in ("T", "t") if file.get(*at, key) is not None), "T")
    if file.get(*at, "R") is None and file.get(*at, t_key) is None:
        return None, np.zeros(3), ("R", t_key)
    return rotation_of(file, *at, "R"), file.numbers((3,), *at, t_key), ("R", t_key)


ASSOCIATION = calibration_format("4dassociation", *reader_of(_cameras_association, _camera_association))
