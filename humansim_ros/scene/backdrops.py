"""Photographs and panoramas that a scene file names, read with errors that say where."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimError, MeshError, SceneError
from humansim_ros.io.files import read_bytes, resolve_relative
from humansim_ros.io.images import MAX_PIXELS, declared_size, decode_image
from humansim_ros.render.backdrops import ImageBackdrop
from humansim_ros.scene.config import line_of_key

_RADIANCE = re.compile(rb"^#\?(RADIANCE|RGBE)\b.*?\n\s*?\n-Y (\d{1,6}) \+X (\d{1,6})\n", re.DOTALL)
_EXR = b"\x76\x2f\x31\x01"
#: Columns of the largest panorama that is kept: a camera of 60 degrees sees 700 of them.
_WIDEST = 4096


def scene_file(name: str, scene: Path, key: str) -> Path:
    """A file that a scene names, from the scene's folder. SceneError with the key if there is none."""
    path, there = resolve_relative(scene, name)
    if not there:
        raise SceneError(f"no such file {str(path)!r}", path=scene, line=line_of_key(scene, key), key=key)
    return path


def load_backdrop(name: str, scene: Path, key: str) -> ImageBackdrop:
    """A photograph (PNG or JPEG). SceneError with the scene's key and the file if it cannot be read."""
    path = scene_file(name, scene, key)
    try:
        return ImageBackdrop(decode_image(read_bytes(path, SceneError, "photograph")))
    except HumansimError as error:
        raise _unreadable(path, error, scene, key) from None


def load_panorama(name: str, scene: Path, key: str) -> NDArray[np.float32]:
    """(H, W, 3) linear light of a panorama: Radiance .hdr; OpenEXR where its package is installed; PNG or
    JPEG, with 1 as its white. SceneError with the scene's key and the file if it cannot be read.
    """
    path = scene_file(name, scene, key)
    try:
        data = read_bytes(path, SceneError, "panorama")
        radiance = _light(_read_exr(path) if data[:4] == _EXR else _decoded(data))
    except HumansimError as error:
        raise _unreadable(path, error, scene, key) from None
    height, width = radiance.shape[:2]
    if not 1.9 < width / height < 2.1:
        message = f"a panorama is twice as wide as high, this one is {width} x {height}"
        raise _unreadable(path, SceneError(message), scene, key)
    if width > _WIDEST:
        size = (_WIDEST, round(height * _WIDEST / width))
        radiance = np.asarray(cv2.resize(radiance, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    return radiance


def _decoded(data: bytes) -> NDArray[np.float32]:
    if declared_size(data) is not None:
        return np.asarray((decode_image(data) / np.float32(255)) ** 2, dtype=np.float32)
    header = _RADIANCE.match(data[:65536])
    if header is None:
        raise SceneError("this is no panorama: neither Radiance (.hdr) nor OpenEXR, PNG or JPEG")
    _check_size(int(header[3]), int(header[2]))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        image = None
    if image is None or image.dtype != np.float32:
        raise SceneError("the panorama cannot be decoded: it is damaged")
    return np.asarray(image[..., ::-1])


def _read_exr(path: Path) -> NDArray[np.float32]:
    """(H, W, 3) the first part of an OpenEXR file."""
    try:
        import OpenEXR
    except ImportError:
        message = (
            "OpenEXR is read by a package of its own: pip install OpenEXR; or save it as Radiance (.hdr)"
        )
        raise SceneError(message) from None
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = (np.asarray(corner, dtype=int) for corner in file.header()["dataWindow"])
        width, height = (high - low + 1).tolist()
        _check_size(width, height)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            pixels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, KeyError):
        raise SceneError("the panorama cannot be decoded: it is damaged") from None
    missing = [name for name in "RGB" if name not in pixels]
    if missing:
        raise SceneError(f"the panorama has no channel {missing[0]}; there are {', '.join(pixels) or 'none'}")
    if any(pixels[name].shape != (height, width) for name in "RGB"):
        raise SceneError("the panorama's channels are not of one size")
    return np.stack([pixels[name] for name in "RGB"], axis=-1).astype(np.float32)


def _check_size(width: int, height: int) -> None:
    if not 0 < width * height <= MAX_PIXELS:
        raise SceneError(f"a panorama of {width} x {height} pixels is too large")


def _light(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """What can be light of an image."""
    light = np.nan_to_num(image, nan=0.0, posinf=65504.0)
    return np.ascontiguousarray(np.clip(light, 0.0, 65504.0), dtype=np.float32)


def _unreadable(path: Path, error: HumansimError, scene: Path, key: str) -> SceneError:
    message = error.message.replace("the texture", "the picture") if isinstance(error, MeshError) else None
    return SceneError(
        f"{path}: {message or error.message}", path=scene, line=line_of_key(scene, key), key=key
    )
