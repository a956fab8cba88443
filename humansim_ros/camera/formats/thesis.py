"""The .cam files of the thesis (8.3); thesis_cam.py has the maths."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import LARGEST, CalibrationFormat, CalibrationSource, RawCamera
from humansim_ros.camera.thesis_cam import cam_of, camera_of, format_cam, parse_cam
from humansim_ros.errors import CameraError

_LINE = re.compile(r"(C|f|R|k|size|format)\s*=.*")


def _is_cam(source: CalibrationSource) -> bool:
    return bool(source.head) and _LINE.fullmatch(source.head[0]) is not None


def _read(source: CalibrationSource) -> dict[str, RawCamera]:
    cam = parse_cam(source.text, source.path)
    if max(map(abs, (*cam.center, cam.focal, *cam.euler_deg, *cam.aspect))) > LARGEST:
        raise CameraError(f"a number is above {LARGEST:g}: of no camera", path=source.path)
    camera = camera_of(cam)
    return {Path(source.path).stem: RawCamera(camera.K, camera.R, camera.t, size=camera.size)}


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    (camera,) = cameras.values()
    return {"": format_cam(cam_of(camera))}


CAM = CalibrationFormat(
    "cam", ".cam of the thesis", ".cam", "text", _is_cam, _read, _write, several=False, holds_skew=False
)
