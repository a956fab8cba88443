"""Calibrations of Qualisys Track Manager (.qca.txt, XML): millimetres, z up.

The rows of r11 … r33 are the axes of the camera in the world: x right, y up, z backward; x, y, z is its
centre. Focal lengths and principal points are in 1/64 pixel of the sensor; a pixel of the video is a pixel of
the sensor minus the corner of fov_video. Poses and K are as in Pose2Sim's conversion. The distortion
coefficients are as in OpenCV, without a unit; Pose2Sim divides them by 64 as well, which leaves almost no
distortion. https://github.com/perfanalytics/pose2sim
"""

from __future__ import annotations

from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import CalibrationFile, CalibrationFormat, Key, RawCamera, number
from humansim_ros.errors import CameraError
from humansim_ros.types import Array, ImageSize

#: Parts of a pixel in which focal lengths and principal points are given.
_SUBPIXELS = 64.0
_ROTATION = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
#: Coefficients in the order of ROS, with the spelling of the files.
_LENS = (
    *("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2"),
    "radialDistortion3",
)
_FLIP = np.diag([1.0, -1.0, -1.0])
#: Windows of the video in the sensor, in order of precedence.
_WINDOWS = ("fov_video", "fov_video_max", "fov_marker", "fov_marker_max")


def _is_qualisys(file: CalibrationFile) -> bool:
    return isinstance(file.get("calibration", "cameras"), list)


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for group, _ in enumerate(file.need("calibration", "cameras")):
        for index, _ in enumerate(file.items("calibration", "cameras", group, "camera")):
            at: tuple[Key, ...] = ("calibration", "cameras", group, "camera", index)
            name = str(file.get(*at, "serial") or "").strip() or str(len(cameras))
            file.add(cameras, name, _camera(file, at), *at)
    return cameras


def _camera(file: CalibrationFile, at: tuple[Key, ...]) -> RawCamera:
    inner, outer = (*at, "intrinsic", 0), (*at, "transform", 0)
    corner, size = _window(file, at)
    fu, fv, cu, cv = (
        file.number(*inner, key) / _SUBPIXELS
        for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    skew = file.number(*inner, "skew", otherwise=0.0) / _SUBPIXELS
    rotation, center = None, np.zeros(3)
    if file.get(*outer) is not None:
        rotation = _FLIP @ np.reshape([file.number(*outer, key) for key in _ROTATION], (3, 3))
        center = np.array([file.number(*outer, key) for key in "xyz"])
    return RawCamera(
        np.array([[fu, skew, cu - corner[0]], [0, fv, cv - corner[1]], [0, 0, 1]]),
        rotation,
        center=center,
        size=size,
        distortion=tuple(file.number(*inner, key, otherwise=0.0) for key in _LENS),
        model="plumb_bob",
        locations=file.locations(at, K=inner[-2:], distortion=inner[-2:], R=outer[-2:], t=outer[-2:]),
    )


def _window(file: CalibrationFile, at: tuple[Key, ...]) -> tuple[Array, ImageSize | None]:
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


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<calibration type="regular">', "  <cameras>"]
    for name, camera in cameras.items():
        if not name.isprintable() or name != name.strip() or not name:
            raise CameraError("this format needs a name without control characters", key=name)
        width, height = camera.size
        k = camera.K * _SUBPIXELS
        window = {"left": 0, "top": 0, "right": width - 1, "bottom": height - 1}
        pose = dict(zip(_ROTATION, (_FLIP @ camera.R).ravel(), strict=True))
        intrinsic = {
            "focalLengthU": k[0, 0],
            "focalLengthV": k[1, 1],
            "centerPointU": k[0, 2],
            "centerPointV": k[1, 2],
            "skew": k[0, 1],
            **dict(zip(_LENS, camera.distortion, strict=False)),
        }
        lines.append(f'    <camera active="1" serial={quoteattr(name)} model="none" viewrotation="0">')
        lines.append(_element("fov_video", window))
        lines.append(_element("transform", {**dict(zip("xyz", camera.center, strict=True)), **pose}))
        lines += [_element("intrinsic", intrinsic), "    </camera>"]
    return {"": "\n".join([*lines, "  </cameras>", "</calibration>"]) + "\n"}


def _element(tag: str, values: Mapping[str, float]) -> str:
    words = (f'{key}="{value if isinstance(value, int) else number(value)}"' for key, value in values.items())
    return f"      <{tag} {' '.join(words)}/>"


QUALISYS = CalibrationFormat(
    "qualisys",
    "Qualisys .qca.txt",
    ".qca.txt",
    "xml",
    _is_qualisys,
    _read,
    _write,
    unit=0.001,
    lenses={"plumb_bob": 5},
)
