"""Cameras of Blender in ``.cam`` files [thesis §8.3, §9.2, §9.3, §9.8].

Such a camera has a centre, Euler angles, a focal length and the aspect ratio of its pixels. It has no skew,
no distortion, and a centred principal point. Numbers in parentheses are equations of the thesis. Where
equations contradict each other, they are corrected so that the round trip camera -> P -> camera is exact.

The thesis indexes pixels by (u, v) = (row, column) from the image corner, as OpenGL does. In this package
and in ROS, pixels are (x, y) = (column, row) from the centre of the first pixel.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: From the axes of a Blender camera (right, up, backward) to the thesis (up, right, forward) (9.18).
BLENDER_TO_CAMERA = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
#: From the camera axes of the thesis to the axes of a ROS optical frame (right, down, forward).
_OPTICAL = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
#: From (row, column) from the corner to (column, row) from the centre of the first pixel.
_PIXELS = np.array([[0.0, 1, -0.5], [1, 0, -0.5], [0, 0, 1]])
#: Largest skew and offset of the principal point that count as zero, pixels.
_ROUNDING = 1e-6
_KEYS = ("C", "f", "R", "k", "size", "format")


@dataclass(frozen=True)
class CamFile:
    """Values of a ``.cam`` file [thesis §8.3].

    ``center``: C, metres. ``euler_deg``: R, Euler angles of Blender about x, y, z, degrees. ``focal``: f, in
    units of half the longer image side (9.17). ``aspect``: k, (k_u, k_v): height and width of a pixel.
    ``size``: (width, height). ``format``: format of the images that Blender writes.
    """

    center: tuple[float, float, float]
    focal: float
    euler_deg: tuple[float, float, float]
    size: tuple[int, int]
    aspect: tuple[float, float] = (1.0, 1.0)
    format: str = "png"


def compose_euler(angles: ArrayLike) -> Array:
    """Rotation (3, 3) of Euler angles (3,) about x, y, z, radians: Rz Ry Rx (9.4)-(9.8)."""
    a, b, c = np.asarray(angles, dtype=float)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(rz @ ry @ rx, dtype=float)


def decompose_euler(rotation: ArrayLike) -> Array:
    """Euler angles (3,) about x, y, z, radians, of a rotation (3, 3) (9.9)-(9.16).

    cos(beta) is positive in (9.10), so that the angles are those that were composed. Where cos(beta) is zero,
    alpha is 0 (9.15). beta and gamma are computed after alpha is undone. This equals (9.16) at the poles,
    (9.10) and (9.13) elsewhere, and is exact in between.
    """
    (_, b, c), (_, e, f), (g, h, i) = np.asarray(rotation, dtype=float)
    alpha = np.arctan2(h, i) if np.hypot(h, i) > 1e-15 else 0.0
    sine, cosine = np.sin(alpha), np.cos(alpha)
    beta = np.arctan2(-g, h * sine + i * cosine)
    return np.array([alpha, beta, np.arctan2(c * sine - b * cosine, e * cosine - f * sine)])


def camera_rotation(euler: ArrayLike) -> Array:
    """Rotation (3, 3) from the world to the camera, from Euler angles (3,), radians (9.19)."""
    return np.asarray(BLENDER_TO_CAMERA @ compose_euler(euler).T, dtype=float)


def calibration_matrix(focal: float, size: tuple[int, int], aspect: tuple[float, float]) -> Array:
    """K (3, 3) in (row, column) order from f, (width, height) and (k_u, k_v) (9.24)-(9.26)."""
    (width, height), (ku, kv) = size, aspect
    m = max(width * kv, height * ku)
    mu, mv = m / (2 * ku), m / (2 * kv)
    return np.array([[-mu * focal, 0, height / 2], [0, mv * focal, width / 2], [0, 0, 1]])


def aspect_of(K: ArrayLike) -> float:
    """Aspect k_u / k_v of K (3, 3) in ROS order: height of a pixel over its width, fx / fy (9.72,
    corrected)."""
    k = np.asarray(K, dtype=float)
    return float(k[0, 0] / k[1, 1])


def focal_of(K: ArrayLike, size: tuple[int, int]) -> float:
    """f of a K (3, 3) in ROS order for an image of (width, height) (9.73, corrected).

    For square pixels it is 2 K11 / max(width, height).
    """
    width, height = size
    return float(2 * np.asarray(K, dtype=float)[0, 0] / max(width, height * aspect_of(K)))


def image_shift(K: ArrayLike, size: tuple[int, int]) -> Array:
    """Shift (2,), pixels (x, y), that moves the principal point to the image centre (9.74). ``K``: (3, 3) in
    ROS order."""
    return np.asarray((np.array(size) - 1) / 2 - np.asarray(K, dtype=float)[:2, 2], dtype=float)


def camera_of(cam: CamFile) -> Camera:
    """Camera of a ``.cam`` file. Raises CameraError if no camera can have these values."""
    k = _PIXELS @ calibration_matrix(cam.focal, cam.size, cam.aspect) @ _OPTICAL.T
    r = _OPTICAL @ camera_rotation(np.radians(cam.euler_deg))
    return Camera(cam.size, k, r, -r @ np.array(cam.center))


def cam_of(camera: Camera) -> CamFile:
    """Values of the ``.cam`` file of a camera (9.68)-(9.73).

    Raises:
        CameraError: The camera has distortion, skew, or a principal point that is not centred.
    """
    shift = image_shift(camera.K, camera.size)
    unsupported = {
        "lens distortion": camera.distorted,
        "skew": abs(camera.K[0, 1]) > _ROUNDING,
        f"a principal point {abs(shift).max():g} pixels off the image centre": abs(shift).max() > _ROUNDING,
    }
    if any(unsupported.values()):
        names = " and ".join(name for name, present in unsupported.items() if present)
        raise CameraError(f"a .cam file cannot store {names}: idealize the camera first", key="K")
    ratio = aspect_of(camera.K)
    angles = np.degrees(decompose_euler(camera.R.T @ _OPTICAL @ BLENDER_TO_CAMERA))
    return CamFile(
        center=_three(camera.center),
        focal=focal_of(camera.K, camera.size),
        euler_deg=_three(angles),
        size=camera.size,
        aspect=(1.0, 1.0) if abs(ratio - 1) < 1e-12 else (ratio, 1.0),
    )


def parse_cam(text: str, path: str | os.PathLike[str] | None = None) -> CamFile:
    """Parse the text of a ``.cam`` file [thesis §8.3]: lines ``key=value``, empty lines, ``#`` comments.

    ``C``, ``f``, ``R`` and ``size`` are required.

    Raises:
        CameraError: A line is wrong or a key is missing. The error names the path, line and key.
    """
    values: dict[str, tuple[str, int]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split("#")[0].strip()
        if not content:
            continue
        key, equals, value = (part.strip() for part in content.partition("="))
        if not equals:
            raise CameraError("a line of a .cam file is key=value", path=path, line=number)
        if key not in _KEYS:
            raise CameraError(f"unknown key; known are {', '.join(_KEYS)}", path=path, line=number, key=key)
        if key in values:
            raise CameraError("this key is duplicate", path=path, line=number, key=key)
        values[key] = (value, number)
    missing = [key for key in ("C", "f", "R", "size") if key not in values]
    if missing:
        raise CameraError("missing in the .cam file", path=path, key=missing[0])

    def numbers(key: str, separator: str, count: int, example: str) -> tuple[Any, ...]:
        value, line = values[key]
        try:
            parts = tuple(float(part) for part in value.split(separator))
        except ValueError:
            parts = ()
        if len(parts) != count or not np.isfinite(parts).all():
            raise CameraError(f"must have the form {key}={example}", path=path, line=line, key=key)
        if key in ("f", "k", "size") and min(parts) <= 0:
            raise CameraError("must be above zero", path=path, line=line, key=key)
        return parts

    size = numbers("size", "x", 2, "640x480")
    cam = CamFile(
        center=numbers("C", ",", 3, "3.0,0.0,0.0"),
        focal=numbers("f", ",", 1, "1")[0],
        euler_deg=numbers("R", ",", 3, "80.0,0.0,80.0"),
        size=size,
        aspect=numbers("k", ":", 2, "1:1") if "k" in values else (1.0, 1.0),
        format=values.get("format", ("", 0))[0] or "png",
    )
    try:
        camera = camera_of(cam)
    except CameraError as error:
        wrong_key = {"K": "f", "t": "C"}.get(error.key or "", error.key or "")
        line_number = values[wrong_key][1] if wrong_key in values else None
        raise CameraError(error.message, path=path, line=line_number, key=wrong_key) from None
    return CamFile(cam.center, cam.focal, cam.euler_deg, camera.size, cam.aspect, cam.format)


def format_cam(cam: CamFile) -> str:
    """Text of a ``.cam`` file with all digits of its numbers."""
    width, height = cam.size
    return (
        f"C={_text(cam.center, ',')}\nf={_text((cam.focal,))}\nR={_text(cam.euler_deg, ',')}\n"
        f"k={_text(cam.aspect, ':')}\nsize={width}x{height}\nformat={cam.format}\n"
    )


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 12) + 0.0 for value in values)  # 3, not 2.9999999999999996; and 0, not -0
    return x, y, z


def _text(values: tuple[float, ...], separator: str = "") -> str:
    return separator.join(f"{value:g}" if float(f"{value:g}") == value else repr(value) for value in values)
