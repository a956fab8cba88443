"""JSON files of public data sets: Human3.6M, Shelf and Campus (in the format of VoxelPose), CMU Panoptic."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import CalibrationFile, CalibrationFormat, Key, RawCamera, nested
from humansim_ros.camera.formats.containers import Keys, find_cameras, has_keys
from humansim_ros.camera.formats.lens_models import check_count
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

# -- Human3.6M: x = R X + t in millimetres, z up; each of 4 cameras has a pose per subject, 11 in all

#: Image sizes of the cameras by their serial numbers.
_H36M_SIZES = {
    "54138969": (1000, 1002),
    "55011271": (1000, 1000),
    "58860488": (1000, 1000),
    "60457274": (1000, 1002),
}
#: Keys of the intrinsics in Shelf and Campus, of which one is enough to recognise them.
_SHELF_INTRINSICS = {"fx", "k", "f"}
_PANEL_AND_NODE = re.compile(r"([0-9]{2})_([0-9]{2})")
_SUBJECT = re.compile(r"(S[0-9]+)_(.+)", re.DOTALL)


def _is_h36m(file: CalibrationFile) -> bool:
    return all(isinstance(file.get(key), dict) for key in ("intrinsics", "extrinsics"))


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
            "distortion": nested(np.array(camera.distortion[:5])),
        }
        if intrinsics.setdefault(serial, parameters) != parameters:
            message = "this format needs the same K and lens of a camera for all subjects"
            raise CameraError(message, key=name)
        poses = extrinsics.setdefault(subject, {})
        if serial in poses:
            raise CameraError(f"there are two cameras {serial} of subject {subject}", key=name)
        poses[serial] = {"R": nested(camera.R), "t": nested(camera.t[:, None])}
    return _json({"intrinsics": intrinsics, "extrinsics": extrinsics})


# -- Shelf and Campus: x = R (X - T), where T is the camera centre; millimetres, z up


def _shelf_cameras(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, has_keys({"R"}, {"T"}, _SHELF_INTRINSICS), has_keys({"R", "T", "fx", "f"}))


def _is_shelf(file: CalibrationFile) -> bool:
    return bool(_shelf_cameras(file))


def _read_shelf(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for name, at in _shelf_cameras(file):
        file.add(cameras, name, _shelf_camera(file, at), *at)
    return cameras


def _shelf_camera(file: CalibrationFile, at: Keys) -> RawCamera:
    if file.get(*at, "f") is not None and file.get(*at, "fx") is None:  # VoxelPose's own arrays
        fx, fy, cx, cy = (*file.numbers((2,), *at, "f"), *file.numbers((2,), *at, "c"))
    else:
        fx, fy, cx, cy = (float(file.numbers((), *at, key)) for key in ("fx", "fy", "cx", "cy"))
    radial: Array = np.zeros(3)
    tangential: Array = np.zeros(2)
    if file.get(*at, "k") is not None:
        radial = file.numbers((3,), *at, "k")
    if file.get(*at, "p") is not None:
        tangential = file.numbers((2,), *at, "p")
    posed = file.get(*at, "R") is not None or file.get(*at, "T") is not None
    return RawCamera(
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        file.numbers((3, 3), *at, "R") if posed else None,
        center=file.numbers((3,), *at, "T") if posed else None,
        size=file.pair_size(*at, "imgSize"),
        distortion=(*radial[:2], *tangential, radial[2]),
        model="plumb_bob",
        locations={
            "": file.location(*at),
            "K": file.location(*at, "fx"),
            "R": file.location(*at, "R"),
            "t": file.location(*at, "T"),
            "distortion": file.location(*at, "k"),
        },
    )


def _write_shelf(cameras: Mapping[str, Camera]) -> dict[str, str]:
    data = {}
    for name, camera in cameras.items():
        k1, k2, p1, p2, k3 = camera.distortion[:5]
        data[name] = {
            "R": nested(camera.R),
            "T": nested(camera.center[:, None]),
            "fx": camera.K[0, 0],
            "fy": camera.K[1, 1],
            "cx": camera.K[0, 2],
            "cy": camera.K[1, 2],
            "k": nested(np.array([[k1], [k2], [k3]])),
            "p": nested(np.array([[p1], [p2]])),
        }
    return _json(data)


# -- CMU Panoptic: x = R X + t in centimetres, y down


def _is_panoptic(file: CalibrationFile) -> bool:
    cameras = file.get("cameras")
    return isinstance(cameras, list) and any(isinstance(c, dict) and "K" in c for c in cameras)


def _read_panoptic(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for index in range(len(file.need("cameras"))):
        at: tuple[Key, ...] = ("cameras", index)
        distortion: Array = np.zeros(0)
        if file.get(*at, "distCoef") is not None:
            distortion = file.some_numbers(*at, "distCoef")
        check_count(file, "plumb_bob", distortion, (*at, "distCoef"))
        posed = file.get(*at, "R") is not None or file.get(*at, "t") is not None
        camera = RawCamera(
            file.numbers((3, 3), *at, "K"),
            file.numbers((3, 3), *at, "R") if posed else None,
            file.numbers((3,), *at, "t") if posed else np.zeros(3),
            size=file.pair_size(*at, "resolution"),
            distortion=tuple(distortion),
            model="plumb_bob",
            locations={
                "": file.location(*at),
                **{part: file.location(*at, part) for part in ("K", "R", "t")},
                "distortion": file.location(*at, "distCoef"),
                "size": file.location(*at, "resolution"),
            },
        )
        file.add(cameras, str(file.need(*at, "name")), camera, *at)
    return cameras


def _write_panoptic(cameras: Mapping[str, Camera]) -> dict[str, str]:
    written = [
        {
            "name": name,
            "type": "hd" if camera.size == (1920, 1080) else "vga",
            "resolution": list(camera.size),
            **_panel_and_node(name, index),
            "K": nested(camera.K),
            "distCoef": nested(np.array(camera.distortion[:5])),
            "R": nested(camera.R),
            "t": nested(camera.t[:, None]),
        }
        for index, (name, camera) in enumerate(cameras.items())
    ]
    return _json({"cameras": written})


def _panel_and_node(name: str, index: int) -> dict[str, int]:
    """Panel and node of the studio, of which the names are made."""
    matched = _PANEL_AND_NODE.fullmatch(name)
    panel, node = (int(matched[1]), int(matched[2])) if matched else (0, index)
    return {"panel": panel, "node": node}


def _json(data: Any) -> dict[str, str]:
    return {"": json.dumps(data, indent=1) + "\n"}


H36M = CalibrationFormat(
    "human36m",
    "Human3.6M JSON",
    ".json",
    "json",
    _is_h36m,
    _read_h36m,
    _write_h36m,
    unit=0.001,
    holds_size=False,
    lenses={"plumb_bob": 5},
    sizes=((1000, 1000),),
)
SHELF = CalibrationFormat(
    "shelf",
    "Shelf/Campus JSON",
    ".json",
    "json",
    _is_shelf,
    _read_shelf,
    _write_shelf,
    unit=0.001,
    holds_size=False,
    holds_skew=False,
    lenses={"plumb_bob": 5},
    sizes=((1032, 776), (360, 288)),
)
PANOPTIC = CalibrationFormat(
    "panoptic",
    "CMU Panoptic JSON",
    ".json",
    "json",
    _is_panoptic,
    _read_panoptic,
    _write_panoptic,
    unit=0.01,
    up="-y",
    lenses={"plumb_bob": 5},
)
