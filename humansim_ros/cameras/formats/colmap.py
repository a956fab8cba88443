"""Text models of COLMAP: cameras.txt (intrinsics) and images.txt (poses, world to camera).

The centre of COLMAP's first pixel is (0.5, 0.5), so principal points are shifted by half a pixel when they
are read or written. https://colmap.github.io/format.html, https://colmap.github.io/cameras.html
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.camera.lens import MODELS
from humansim_ros.cameras.formats.base import (
    CalibrationFile,
    RawCamera,
    SourceLocation,
    image_names,
    row,
    without_suffix,
)
from humansim_ros.cameras.formats.table import calibration_format
from humansim_ros.errors import CameraError
from humansim_ros.files.reading import read_text
from humansim_ros.geometry import matrix_to_quaternion, quaternion_to_matrix

CAMERAS, IMAGES, POINTS = "cameras.txt", "images.txt", "points3D.txt"
#: Largest file of a rig, bytes. Larger files are models of large scenes.
MAX_BYTES = 64 << 20
#: Parameters of COLMAP's camera models. The coefficients have the names of ``lens.MODELS``.
_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}
#: Names of all camera models, also of those that cannot be read.
COLMAP_MODELS = (*_MODELS, "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")
_QUATERNION_SLACK = 1e-3


def _is_colmap(file: CalibrationFile) -> bool:
    if Path(file.path).name in (CAMERAS, IMAGES):
        return True
    words = file.head[0].split() if file.head else []
    return len(words) > 4 and words[1] in COLMAP_MODELS


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    """Read cameras.txt or images.txt, together with the other file in the same folder."""
    path = Path(file.path)
    if path.name == IMAGES:
        text = read_text(path.parent / CAMERAS, CameraError, "COLMAP cameras", MAX_BYTES)
        intrinsics, images = CalibrationFile(str(path.parent / CAMERAS), text), file
    else:
        intrinsics, images = file, None
        if path.name == CAMERAS and (path.parent / IMAGES).is_file():
            text = read_text(path.parent / IMAGES, CameraError, "COLMAP images", MAX_BYTES)
            images = CalibrationFile(str(path.parent / IMAGES), text)
    models = _read_models(intrinsics)
    if images is None:
        return models
    cameras: dict[str, RawCamera] = {}
    for line, words in _image_lines(images):
        raw = _posed_camera(images, models, line, words)
        images.add(cameras, without_suffix(" ".join(words[9:])), raw, line=line)
    if not cameras:
        raise CameraError("the file has no images, so the cameras have no poses", path=images.path)
    return cameras


def _read_models(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for line, text in file.lines():
        name, *words = text.split()
        model = words[0] if words else ""
        location = SourceLocation(None, line, file.path)
        values = file.row(words[1:], line) if model in _MODELS else []
        camera = camera_of_model(model, values[2:], location)
        if any(v != int(v) or v <= 0 for v in values[:2]):
            message = "width and height must be whole numbers above zero"
            raise CameraError(message, path=file.path, line=line)
        camera = replace(camera, size=(int(values[0]), int(values[1])))
        file.add(cameras, name, camera, line=line)
    if not cameras:
        raise CameraError("the file has no cameras", path=file.path)
    return cameras


def camera_of_model(model: str, values: Sequence[float], location: SourceLocation) -> RawCamera:
    """Camera without size and pose from the parameters of a camera model.

    Args:
        model: Name of the camera model, in upper case.
        values: Numbers after width and height in cameras.txt; ``params`` in other files.
        location: Location of the numbers, for errors.

    Raises:
        CameraError: The model is not known, or has another number of parameters.
    """
    names = _MODELS.get(model, "").split()
    if not names:
        message = f"unknown camera model {model[:40]!r}; known are {', '.join(_MODELS)}"
        raise CameraError(message, path=location.path, line=location.line, key=location.key)
    if len(values) != len(names):
        message = f"{model} needs {_MODELS[model]} after width and height, not {len(values)} numbers"
        raise CameraError(message, path=location.path, line=location.line, key=location.key)
    parameters = dict(zip(names, values, strict=True))
    fx, fy = parameters.get("fx", parameters.get("f", 0.0)), parameters.get("fy", parameters.get("f", 0.0))
    ros_model = "plumb_bob"
    if model.endswith("FISHEYE"):
        ros_model = "equidistant"
    elif any(parameters.get(name) for name in ("k4", "k5", "k6")):
        ros_model = "rational_polynomial"
    return RawCamera(
        pinhole(fx, fy, parameters["cx"] - 0.5, parameters["cy"] - 0.5),
        distortion=tuple(parameters.get(name, 0.0) for name in MODELS[ros_model]),
        model=ros_model,
        locations={"": location},
    )


def _image_lines(file: CalibrationFile) -> Iterator[tuple[int, list[str]]]:
    """Lines of images. After each one, the file has a line with points (three words each), which may be
    empty."""
    image = False
    for line, text in file.all_lines():
        if text.startswith("#"):
            continue
        words = text.split()
        if image and len(words) % 3 == 0:
            image = False
        elif words:
            image = True
            yield line, words


def _posed_camera(
    file: CalibrationFile, models: Mapping[str, RawCamera], line: int, words: list[str]
) -> RawCamera:
    if len(words) < 10:
        message = "needs an image id, a quaternion w x y z, a translation x y z, a camera id and a name"
        raise CameraError(message, path=file.path, line=line)
    values = np.array(file.row(words[1:8], line))
    length = float(np.linalg.norm(values[:4]))
    if abs(length - 1) > _QUATERNION_SLACK:
        message = f"the quaternion is not a rotation: its length is {length:g}, not 1"
        raise CameraError(message, path=file.path, line=line)
    model = models.get(words[8])
    if model is None:
        raise CameraError(f"there is no camera {words[8][:40]} in {CAMERAS}", path=file.path, line=line)
    xyzw = np.roll(values[:4] / length, -1)
    posed = dict.fromkeys(("R", "t"), SourceLocation(None, line, file.path))
    locations = {**model.locations, **posed}
    return replace(model, R=quaternion_to_matrix(xyzw), t=values[4:], locations=locations)


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    images = image_names(cameras)
    intrinsics = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    outer = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for index, (name, camera) in enumerate(cameras.items(), 1):
        model, coefficients = _model_of(camera)
        k = camera.K
        numbers = (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *coefficients)
        intrinsics.append(f"{index} {model} {camera.size[0]} {camera.size[1]} {row(numbers)}")
        x, y, z, w = matrix_to_quaternion(camera.R)
        outer += [f"{index} {row((w, x, y, z, *camera.t))} {index} {images[name]}", ""]
    return {CAMERAS: "\n".join(intrinsics) + "\n", IMAGES: "\n".join(outer) + "\n", POINTS: ""}


def _model_of(camera: Camera) -> tuple[str, tuple[float, ...]]:
    if camera.model == "equidistant":
        return "OPENCV_FISHEYE", camera.distortion
    if not camera.distorted:
        return "PINHOLE", ()
    if not any(camera.distortion[4:]):
        return "OPENCV", camera.distortion[:4]
    return "FULL_OPENCV", (*camera.distortion, 0.0, 0.0, 0.0)[:8]


COLMAP = calibration_format("colmap", _is_colmap, _read, _write)
