"""COLMAP's text models: cameras.txt (lenses) and images.txt (poses, world to camera, in the model's unit).

COLMAP's first pixel has its centre at (0.5, 0.5): half a pixel is taken from its principal points, and added
when writing. https://colmap.github.io/format.html, https://colmap.github.io/cameras.html
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    CalibrationFormat,
    CalibrationSource,
    FilePosition,
    RawCamera,
    picture_names,
    row,
    without_suffix,
)
from humansim_ros.errors import CameraError
from humansim_ros.io.files import read_text
from humansim_ros.rotations import matrix_to_quaternion, quaternion_to_matrix

CAMERAS, IMAGES, POINTS = "cameras.txt", "images.txt", "points3D.txt"
#: Longer ones are of larger scenes than any rig.
MAX_BYTES = 64 << 20
#: What each parameter of a model is; the names of coefficients are those of :data:`_ORDER`.
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
_ORDER = {
    "plumb_bob": "k1 k2 p1 p2 k3",
    "rational_polynomial": "k1 k2 p1 p2 k3 k4 k5 k6",
    "equidistant": "k1 k2 k3 k4",
}
_UNKNOWN = ("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")
_QUATERNION_SLACK = 1e-3


def _is_colmap(source: CalibrationSource) -> bool:
    if Path(source.path).name in (CAMERAS, IMAGES):
        return True
    words = source.head[0].split() if source.head else []
    return len(words) > 4 and words[1] in (*_MODELS, *_UNKNOWN)


def _read(source: CalibrationSource) -> dict[str, RawCamera]:
    """Of either file, with the other one from the same folder."""
    path = Path(source.path)
    if path.name == IMAGES:
        text = read_text(path.parent / CAMERAS, CameraError, "COLMAP cameras", MAX_BYTES)
        inner, images = CalibrationSource(str(path.parent / CAMERAS), text), source
    else:
        inner, images = source, None
        if path.name == CAMERAS and (path.parent / IMAGES).is_file():
            text = read_text(path.parent / IMAGES, CameraError, "COLMAP images", MAX_BYTES)
            images = CalibrationSource(str(path.parent / IMAGES), text)
    lenses = _lenses(inner)
    if images is None:
        return lenses
    cameras: dict[str, RawCamera] = {}
    for line, words in _image_lines(images):
        raw = _placed(images, lenses, line, words)
        images.add(cameras, without_suffix(" ".join(words[9:])), raw, line=line)
    if not cameras:
        raise CameraError("there are no images in it, so no cameras have a place", path=images.path)
    return cameras


def _lenses(source: CalibrationSource) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for line, text in source.lines():
        name, *words = text.split()
        model = words[0] if words else ""
        if model not in _MODELS:
            message = f"no camera model {model[:40]!r} is known here; there are {', '.join(_MODELS)}"
            raise CameraError(message, path=source.path, line=line)
        names = _MODELS[model].split()
        values = source.row(words[1:], line)
        if len(values) != 2 + len(names):
            message = f"{model} needs width, height and {_MODELS[model]}, not {len(values)} numbers"
            raise CameraError(message, path=source.path, line=line)
        if any(v != int(v) or v <= 0 for v in values[:2]):
            message = "width and height must be whole numbers above zero"
            raise CameraError(message, path=source.path, line=line)
        said = dict(zip(names, values[2:], strict=True))
        lens = _lens(model, said, values, FilePosition(None, line, source.path))
        source.add(cameras, name, lens, line=line)
    if not cameras:
        raise CameraError("there are no cameras in it", path=source.path)
    return cameras


def _lens(model: str, said: dict[str, float], values: list[float], place: FilePosition) -> RawCamera:
    fx, fy = said.get("fx", said.get("f", 0.0)), said.get("fy", said.get("f", 0.0))
    ours = "plumb_bob"
    if model.endswith("FISHEYE"):
        ours = "equidistant"
    elif any(said.get(name) for name in ("k4", "k5", "k6")):
        ours = "rational_polynomial"
    return RawCamera(
        np.array([[fx, 0, said["cx"] - 0.5], [0, fy, said["cy"] - 0.5], [0, 0, 1]]),
        size=(int(values[0]), int(values[1])),
        distortion=tuple(said.get(name, 0.0) for name in _ORDER[ours].split()),
        model=ours,
        places={"": place},
    )


def _image_lines(source: CalibrationSource) -> Iterator[tuple[int, list[str]]]:
    """Lines of images; after each comes one of its points, three words each, which may be empty."""
    image = False
    for line, text in source.all_lines():
        if text.startswith("#"):
            continue
        words = text.split()
        if image and len(words) % 3 == 0:
            image = False
        elif words:
            image = True
            yield line, words


def _placed(
    source: CalibrationSource, lenses: Mapping[str, RawCamera], line: int, words: list[str]
) -> RawCamera:
    if len(words) < 10:
        message = "needs an id, a quaternion w x y z, a translation x y z, a camera's id and a name"
        raise CameraError(message, path=source.path, line=line)
    values = np.array(source.row(words[1:8], line))
    length = float(np.linalg.norm(values[:4]))
    if abs(length - 1) > _QUATERNION_SLACK:
        message = f"the quaternion is no rotation: its length is {length:g}, not 1"
        raise CameraError(message, path=source.path, line=line)
    lens = lenses.get(words[8])
    if lens is None:
        raise CameraError(f"there is no camera {words[8][:40]} in {CAMERAS}", path=source.path, line=line)
    xyzw = np.roll(values[:4] / length, -1)
    return RawCamera(
        lens.K,
        quaternion_to_matrix(xyzw),
        values[4:],
        size=lens.size,
        distortion=lens.distortion,
        model=lens.model,
        places={
            **lens.places,
            "R": FilePosition(None, line, source.path),
            "t": FilePosition(None, line, source.path),
        },
    )


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    images = picture_names(cameras)
    inner = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    outer = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for index, (name, camera) in enumerate(cameras.items(), 1):
        model, coefficients = _model_of(camera)
        k = camera.K
        numbers = (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *coefficients)
        inner.append(f"{index} {model} {camera.size[0]} {camera.size[1]} {row(numbers)}")
        x, y, z, w = matrix_to_quaternion(camera.R)
        outer += [f"{index} {row((w, x, y, z, *camera.t))} {index} {images[name]}", ""]
    return {CAMERAS: "\n".join(inner) + "\n", IMAGES: "\n".join(outer) + "\n", POINTS: ""}


def _model_of(camera: Camera) -> tuple[str, tuple[float, ...]]:
    if camera.model == "equidistant":
        return "OPENCV_FISHEYE", camera.distortion
    if not camera.distorted:
        return "PINHOLE", ()
    if not any(camera.distortion[4:]):
        return "OPENCV", camera.distortion[:4]
    return "FULL_OPENCV", (*camera.distortion, 0.0, 0.0, 0.0)[:8]


COLMAP = CalibrationFormat(
    "colmap",
    "COLMAP text model",
    "",
    "text",
    _is_colmap,
    _read,
    _write,
    holds_skew=False,
    lenses={"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4},
)
