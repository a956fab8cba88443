"""Cameras of Blender in ``.cam`` files [thesis §8.3, §9.2, §9.3, §9.8], and cameras of scene files.

Such a camera of Blender has a centre, Euler angles, a focal length and the aspect ratio of its pixels. It has
no skew, no distortion, and a centred principal point. Numbers in parentheses are equations of the thesis.
Where equations contradict each other, they are corrected so that the round trip camera -> P -> camera is
exact. The thesis indexes pixels by (u, v) = (row, column) from the image corner, as OpenGL does. In this
package and in ROS, pixels are (x, y) = (column, row) from the centre of the first pixel.

Cameras of scene files have all their parameters, in metres.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.camera import Camera, look_at_pose, pinhole_of_fov
from humansim_ros.cameras.formats.base import LARGEST, CalibrationFile, Keys, RawCamera
from humansim_ros.cameras.formats.conventions import find_model
from humansim_ros.cameras.formats.table import Values, calibration_format, nested
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.types import Array, ImageSize

#: From the axes of a Blender camera (right, up, backward) to the thesis (up, right, forward) (9.18).
BLENDER_TO_CAMERA = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
#: From the camera axes of the thesis to the axes of a ROS optical frame (right, down, forward).
_OPTICAL = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
#: Converts (row, column) from the image corner to (column, row) from the centre of the first pixel.
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
    return np.asarray(Rotation.from_euler("xyz", angles).as_matrix(), dtype=float)


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
    """Shift (2,), pixels (x, y), that moves the principal point of K (3, 3) in ROS order to the image centre
    (9.74)."""
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


#: Separator, count and example of the numbers of each key.
_CAM_NUMBERS = {
    "size": ("x", 2, "640x480"),
    "C": (",", 3, "3.0,0.0,0.0"),
    "f": (",", 1, "1"),
    "R": (",", 3, "80.0,0.0,80.0"),
    "k": (":", 2, "1:1"),
}


def parse_cam(text: str, path: str | os.PathLike[str] | None = None) -> CamFile:
    """Parse the text of a ``.cam`` file [thesis §8.3]: lines ``key=value``, empty lines, ``#`` comments.

    ``C``, ``f``, ``R`` and ``size`` are required.

    Raises:
        CameraError: A line is wrong or a key is missing. The error names the path, line and key.
    """
    values: dict[str, tuple[str, int]] = {}
    for line, content in enumerate((line.split("#")[0].strip() for line in text.splitlines()), 1):
        key, equals, value = (part.strip() for part in content.partition("="))
        wrong = {
            "a line of a .cam file is key=value": not equals,
            f"unknown key; known are {', '.join(_KEYS)}": key not in _KEYS,
            "this key is duplicate": key in values,
        }
        for message in (message for message, found in wrong.items() if content and found):
            raise CameraError(message, path=path, line=line, key=key if equals else None)
        if content:
            values[key] = value, line
    missing = next((key for key in ("C", "f", "R", "size") if key not in values), None)
    if missing:
        raise CameraError("missing in the .cam file", path=path, key=missing)
    numbers: dict[str, Any] = {"k": (1.0, 1.0)}
    for key, (separator, count, example) in _CAM_NUMBERS.items():
        if key not in values:
            continue
        value, line = values[key]
        try:
            parts = tuple(float(part) for part in value.split(separator))
        except ValueError:
            parts = ()
        if len(parts) != count or not np.isfinite(parts).all():
            raise CameraError(f"must have the form {key}={example}", path=path, line=line, key=key)
        if key in ("f", "k", "size") and min(parts) <= 0:
            raise CameraError("must be above zero", path=path, line=line, key=key)
        numbers[key] = parts
    kind = values.get("format", ("", 0))[0] or "png"
    cam = CamFile(numbers["C"], numbers["f"][0], numbers["R"], numbers["size"], numbers["k"], kind)
    try:
        return replace(cam, size=camera_of(cam).size)
    except CameraError as error:
        wrong_key = {"K": "f", "t": "C"}.get(error.key or "", error.key or "")
        line_number = values[wrong_key][1] if wrong_key in values else None
        raise CameraError(error.message, path=path, line=line_number, key=wrong_key) from None


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


_LINE = re.compile(r"(C|f|R|k|size|format)\s*=.*")


def _read_cam(file: CalibrationFile) -> dict[str, RawCamera]:
    cam = parse_cam(file.text, file.path)
    if max(map(abs, (*cam.center, cam.focal, *cam.euler_deg, *cam.aspect))) > LARGEST:
        raise file.error(f"a number is above {LARGEST:g}: too large for a camera")
    camera = camera_of(cam)
    return {Path(file.path).stem: RawCamera(camera.K, camera.R, camera.t, size=camera.size)}


def _write_cam(cameras: Mapping[str, Camera]) -> dict[str, str]:
    (camera,) = cameras.values()
    return {"": format_cam(cam_of(camera))}


CAM = calibration_format(
    "cam", lambda file: bool(file.head) and _LINE.fullmatch(file.head[0]) is not None, _read_cam, _write_cam
)


# -- scene files

_SIZE, _FOV = (640, 480), 60.0
#: Keys of a scene file that have the same names as the parameters of Camera.
_PARTS = ("K", "R", "t", "size", "distortion", "rectification", "rectified")
#: Keys that take a camera from another file; and keys that are not part of a calibration.
_OTHER_FILES, _IGNORED = ("calibration", "trajectory"), ("binning", "roi", "sensor")


def _read_scene(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for name in file.mapping("cameras"):
        file.add(cameras, str(name), _camera(file, name), "cameras", name)
    if not cameras:
        raise file.error("the file has no cameras", "cameras")
    return cameras


def _camera(file: CalibrationFile, name: str) -> RawCamera:
    at: Keys = ("cameras", name)
    file.mapping(*at)
    for key in _OTHER_FILES:
        if file.has(*at, key):
            message = f"a camera with a {key} file cannot be read from a scene: use that file"
            raise file.error(message, *at, key)
    ignored = [key for key in _IGNORED if file.has(*at, key)]
    if ignored:
        what = f"{' and '.join(ignored)} ignored: this camera is the whole sensor"
        warn_about(file.path, f"cameras.{name}: {what}")
    size = file.pair_size(*at, "size") or _SIZE
    distortion = file.optional_numbers(*at, "distortion")
    word, model_keys = file.get(*at, "distortion_model"), (*at, "distortion_model")
    # if None, Camera decides by the number of coefficients, as in scenes
    model = None
    if word is not None:
        model = find_model(file, word, distortion, model_keys, (*at, "distortion"))
    k, r, t = _matrices(file, at, size)
    rectified: dict[str, Any] = {
        key: file.numbers(shape, *at, key)
        for key, shape in (("rectification", (3, 3)), ("rectified", (3, 4)))
        if file.has(*at, key)
    }
    locations = {part: file.location(*at, part) for part in _PARTS}
    locations |= {"": file.location(*at), "model": file.location(*at, "distortion_model")}
    return RawCamera(k, r, t, None, size, tuple(distortion), model, **rectified, locations=locations)


def _matrices(file: CalibrationFile, at: Keys, size: ImageSize) -> tuple[Array, Array, Array]:
    """K, R and t of a camera of a scene file, from any keys that define them."""
    try:
        if file.has(*at, "P"):
            camera = Camera.from_projection_matrix(file.numbers((3, 4), *at, "P"), size)
            return camera.K, camera.R, camera.t
        k = pinhole_of_fov(size, np.radians(file.number(*at, "fov_deg", otherwise=_FOV)))
        if file.has(*at, "position"):
            up = file.numbers((3,), *at, "up") if file.has(*at, "up") else (0, 0, 1)
            position, target = (file.numbers((3,), *at, key) for key in ("position", "look_at"))
            r, t = look_at_pose(position, target, up)
        else:
            r, t = file.numbers((3, 3), *at, "R"), file.numbers((3,), *at, "t")
    except CameraError as error:
        if error.path is not None:
            raise
        raise file.error(error.message, *at, *((error.key,) if error.key else ())) from None
    return file.numbers((3, 3), *at, "K") if file.has(*at, "K") else k, r, t


def _scene_values(own: Values, camera: Camera) -> Values:
    lens = {} if camera.distorted else {"distortion": None, "model": None}
    rectification, rectified = camera.rectification, camera.rectified
    return {
        **lens,
        "rectification": None if rectification is None else nested(rectification),
        "rectified": None if rectified is None else nested(rectified),
    }


SCENE = calibration_format(
    "scene", lambda file: isinstance(file.get("cameras"), Mapping), _read_scene, values=_scene_values
)

FORMATS = (CAM, SCENE)
