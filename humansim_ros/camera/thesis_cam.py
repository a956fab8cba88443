"""Cameras as the thesis describes them (8.3, 9.2, 9.3, 9.8): Blender's, in ``.cam`` files.

Such a camera has a centre, Euler angles, a focal length and the aspect ratio of its pixels; no skew, no
distortion, and its principal point in the middle of the image. The equations are the thesis' own, corrected
where they do not hold together; the round trip camera -> P -> camera is what decides.

The thesis indexes pixels by (u, v) = (row, column) from the corner of the image, as OpenGL does; here and in
ROS they are (x, y) = (column, row) from the centre of the first pixel. :func:`ros_from_thesis` goes over.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.camera.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: (9.18) from the axes of Blender's camera (right, up, backward) to the thesis' (up, right, forward).
BLENDER_TO_CAMERA = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
#: From the thesis' camera axes to those of a ROS optical frame (right, down, forward).
_OPTICAL = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
#: From (row, column) of the corner to (column, row) of the first pixel's centre.
_PIXELS = np.array([[0.0, 1, -0.5], [1, 0, -0.5], [0, 0, 1]])
#: Pixels by which the principal point may be off, and the skew may be there, in what counts as none.
_ROUNDING = 1e-6
_KEYS = ("C", "f", "R", "k", "size", "format")


@dataclass(frozen=True)
class CamFile:
    """What a ``.cam`` file says (8.3).

    ``center``: C, metres. ``euler_deg``: R, the camera's Blender Euler angles about x, y, z. ``focal``: f, in
    units of half the longer side of the image (9.17). ``aspect``: k, (k_u, k_v): height and width of a pixel.
    ``size``: (width, height). ``format``: of the images that Blender writes.
    """

    center: tuple[float, float, float]
    focal: float
    euler_deg: tuple[float, float, float]
    size: tuple[int, int]
    aspect: tuple[float, float] = (1.0, 1.0)
    format: str = "png"


def compose_euler(angles: ArrayLike) -> Array:
    """(3, 3) rotation of Euler angles (3,) about x, y, z, radians: Rz Ry Rx (9.4)-(9.8)."""
    a, b, c = np.asarray(angles, dtype=float)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(rz @ ry @ rx, dtype=float)


def decompose_euler(rotation: ArrayLike) -> Array:
    """Euler angles (3,) about x, y, z, radians, of a rotation (3, 3) (9.9)-(9.16).

    cos(beta) is taken positive in (9.10), so that angles come back as they are written. Where it vanishes,
    alpha is 0 (9.15). beta and gamma are found with alpha turned back, which is (9.16) at the poles and
    (9.10), (9.13) elsewhere, and exact in between.
    """
    (_, b, c), (_, e, f), (g, h, i) = np.asarray(rotation, dtype=float)
    alpha = np.arctan2(h, i) if np.hypot(h, i) > 1e-15 else 0.0
    sine, cosine = np.sin(alpha), np.cos(alpha)
    beta = np.arctan2(-g, h * sine + i * cosine)
    return np.array([alpha, beta, np.arctan2(c * sine - b * cosine, e * cosine - f * sine)])


def focal_of_lens(lens: float) -> float:
    """f of Blender's lens, millimetres on a sensor of 32 (9.17): 16 sees 90 degrees of the longer side."""
    return lens / 16.0


def lens_of_focal(focal: float) -> float:
    """Blender's lens of f (9.17)."""
    return 16.0 * focal


def camera_rotation(euler: ArrayLike) -> Array:
    """(3, 3) world to camera, of the camera's Euler angles (3,), radians (9.19)."""
    return np.asarray(BLENDER_TO_CAMERA @ compose_euler(euler).T, dtype=float)


def calibration_matrix(focal: float, size: tuple[int, int], aspect: tuple[float, float]) -> Array:
    """(3, 3) K of f, (width, height) and k_u : k_v, in the thesis' (row, column) order (9.24)-(9.26)."""
    (width, height), (ku, kv) = size, aspect
    m = max(width * kv, height * ku)
    mu, mv = m / (2 * ku), m / (2 * kv)
    return np.array([[-mu * focal, 0, height / 2], [0, mv * focal, width / 2], [0, 0, 1]])


def projection_matrix(cam: CamFile) -> Array:
    """(3, 4) P = K [R | -R C] in the thesis' (row, column) order (9.23), with (9.20) corrected."""
    k, r = calibration_matrix(cam.focal, cam.size, cam.aspect), camera_rotation(np.radians(cam.euler_deg))
    return np.asarray(k @ np.column_stack([r, -r @ np.array(cam.center)]), dtype=float)


def ros_from_thesis(P: ArrayLike) -> Array:
    """A projection matrix (3, 4) of the thesis as one to ROS pixels: the first two rows swapped, and half a
    pixel from the corner of the image to the centre of its first pixel.
    """
    return np.asarray(_PIXELS @ np.asarray(P, dtype=float), dtype=float)


def thesis_from_ros(P: ArrayLike) -> Array:
    """The inverse of :func:`ros_from_thesis`."""
    return np.linalg.solve(_PIXELS, np.asarray(P, dtype=float))


def aspect_of(K: ArrayLike) -> float:
    """k_u / k_v, height over width of a pixel, of a K (3, 3) in ROS order: fx / fy (9.72, corrected)."""
    k = np.asarray(K, dtype=float)
    return float(k[0, 0] / k[1, 1])


def focal_of(K: ArrayLike, size: tuple[int, int]) -> float:
    """f of a K (3, 3) in ROS order for an image of (width, height) (9.73, corrected): 2 K11 / max(width,
    height) for square pixels.
    """
    width, height = size
    return float(2 * np.asarray(K, dtype=float)[0, 0] / max(width, height * aspect_of(K)))


def image_shift(K: ArrayLike, size: tuple[int, int]) -> Array:
    """(2,) pixels (x, y) by which an image is shifted so that the principal point of K (3, 3), in ROS order,
    comes to its middle (9.74).
    """
    return np.asarray((np.array(size) - 1) / 2 - np.asarray(K, dtype=float)[:2, 2], dtype=float)


def camera_of(cam: CamFile) -> Camera:
    """The camera of a ``.cam`` file. Raises CameraError where its numbers are none of a camera."""
    k = _PIXELS @ calibration_matrix(cam.focal, cam.size, cam.aspect) @ _OPTICAL.T
    r = _OPTICAL @ camera_rotation(np.radians(cam.euler_deg))
    return Camera(cam.size, k, r, -r @ np.array(cam.center))


def cam_of(camera: Camera, image_format: str = "png") -> CamFile:
    """The values of a ``.cam`` file of a camera (9.68)-(9.73).

    Raises CameraError for a camera with a lens, skew, or a principal point that is not in the image's middle:
    a ``.cam`` file cannot say so.
    """
    shift = image_shift(camera.K, camera.size)
    wrong = {
        "lens distortion": camera.distorted,
        "skew": abs(camera.K[0, 1]) > _ROUNDING,
        f"a principal point {abs(shift).max():g} pixels off the middle": abs(shift).max() > _ROUNDING,
    }
    if any(wrong.values()):
        what = " and ".join(name for name, there in wrong.items() if there)
        raise CameraError(f"a .cam file cannot hold {what}: idealize the camera first", key="K")
    ratio = aspect_of(camera.K)
    angles = np.degrees(decompose_euler(camera.R.T @ _OPTICAL @ BLENDER_TO_CAMERA))
    return CamFile(
        center=_three(camera.center),
        focal=focal_of(camera.K, camera.size),
        euler_deg=_three(angles),
        size=camera.size,
        aspect=(1.0, 1.0) if abs(ratio - 1) < 1e-12 else (ratio, 1.0),
        format=image_format,
    )


def parse_cam(text: str, path: str | os.PathLike[str] | None = None) -> CamFile:
    """The content of a ``.cam`` file (8.3): one ``key=value`` a line; empty lines and ``#`` comments may be.

    ``C``, ``f``, ``R`` and ``size`` must be there. Raises CameraError with path, line and key.
    """
    found: dict[str, tuple[str, int]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split("#")[0].strip()
        if not content:
            continue
        key, equals, value = (part.strip() for part in content.partition("="))
        if not equals:
            raise CameraError("a line of a .cam file is key=value", path=path, line=number)
        if key not in _KEYS:
            raise CameraError(f"unknown key; known are {', '.join(_KEYS)}", path=path, line=number, key=key)
        if key in found:
            raise CameraError("this key is here a second time", path=path, line=number, key=key)
        found[key] = (value, number)
    missing = [key for key in ("C", "f", "R", "size") if key not in found]
    if missing:
        raise CameraError("missing in the .cam file", path=path, key=missing[0])

    def numbers(key: str, separator: str, count: int, example: str) -> tuple[Any, ...]:
        value, line = found[key]
        try:
            parts = tuple(float(part) for part in value.split(separator))
        except ValueError:
            parts = ()
        if len(parts) != count or not np.isfinite(parts).all():
            raise CameraError(f"must be as in {key}={example}", path=path, line=line, key=key)
        if key in ("f", "k", "size") and min(parts) <= 0:
            raise CameraError("must be above zero", path=path, line=line, key=key)
        return parts

    size = numbers("size", "x", 2, "640x480")
    cam = CamFile(
        center=numbers("C", ",", 3, "3.0,0.0,0.0"),
        focal=numbers("f", ",", 1, "1")[0],
        euler_deg=numbers("R", ",", 3, "80.0,0.0,80.0"),
        size=size,
        aspect=numbers("k", ":", 2, "1:1") if "k" in found else (1.0, 1.0),
        format=found.get("format", ("", 0))[0] or "png",
    )
    try:
        camera = camera_of(cam)
    except CameraError as error:
        said = {"K": "f", "t": "C"}.get(error.key or "", error.key or "")
        where = found[said][1] if said in found else None
        raise CameraError(error.message, path=path, line=where, key=said) from None
    return CamFile(cam.center, cam.focal, cam.euler_deg, camera.size, cam.aspect, cam.format)


def format_cam(cam: CamFile) -> str:
    """The text of a ``.cam`` file, in which every number comes back as it is."""
    width, height = cam.size
    return (
        f"C={_text(cam.center, ',')}\nf={_text((cam.focal,))}\nR={_text(cam.euler_deg, ',')}\n"
        f"k={_text(cam.aspect, ':')}\nsize={width}x{height}\nformat={cam.format}\n"
    )


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 12) + 0.0 for value in values)  # 3, not 2.9999999999999996; 0, not -0
    return x, y, z


def _text(values: tuple[float, ...], separator: str = "") -> str:
    return separator.join(f"{value:g}" if float(f"{value:g}") == value else repr(value) for value in values)
