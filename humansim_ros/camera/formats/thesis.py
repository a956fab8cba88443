""".cam files of the thesis [thesis §8.3]; the equations are in ``camera/thesis_cam.py``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import LARGEST, CalibrationFile, CalibrationFormat, RawCamera
from humansim_ros.camera.thesis_cam import cam_of, camera_of, format_cam, parse_cam
from humansim_ros.errors import CameraError

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


CAM = CalibrationFormat(
    "cam", ".cam of the thesis", ".cam", "text", _is_cam, _read, _write, multiple=False, holds_skew=False
)
