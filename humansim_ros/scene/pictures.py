"""Photographs and panoramas that a scene file names, read with errors that say where."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimError, MeshError, SceneError
from humansim_ros.files import beside, read_bytes
from humansim_ros.images import MOST_PIXELS, decode_image, stated_size
from humansim_ros.render.light import Photograph
from humansim_ros.scene.config import line_of_key

_RADIANCE = re.compile(rb"^#\?(RADIANCE|RGBE)\b.*?\n\s*?\n-Y (\d{1,6}) \+X (\d{1,6})\n", re.DOTALL)
_EXR = b"\x76\x2f\x31\x01"
#: Columns of the largest panorama that is kept: a camera of 60 degrees sees 700 of them.
_WIDEST = 4096


def scene_file(name: str, scene: Path, key: str) -> Path:
    """A file that a scene names, from the scene's folder. SceneError with the key if there is none."""
    path, there = beside(scene, name)
    if not there:
        raise SceneError(f"no such file {str(path)!r}", path=scene, line=line_of_key(scene, key), key=key)
    return path


def photograph_of(name: str, scene: Path, key: str) -> Photograph:
    """A photograph (PNG or JPEG). SceneError with the scene's key and the file if it cannot be read."""
    path = scene_file(name, scene, key)
    try:
        return Photograph(decode_image(read_bytes(path, SceneError, "photograph")))
    except HumansimError as error:
        raise _unreadable(path, error, scene, key) from None


def radiance_of(name: str, scene: Path, key: str) -> NDArray[np.float32]:
    """(H, W, 3) linear light of a panorama: Radiance .hdr; OpenEXR where OpenCV reads it; PNG or JPEG, with 1
    as its white. SceneError with the scene's key and the file if it cannot be read.
    """
    path = scene_file(name, scene, key)
    try:
        radiance = _decoded(read_bytes(path, SceneError, "panorama"))
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
    if stated_size(data) is not None:
        return np.asarray((decode_image(data) / np.float32(255)) ** 2, dtype=np.float32)
    header = _RADIANCE.match(data[:65536])
    exr = data[:4] == _EXR
    if header is None and not exr:
        raise SceneError("this is no panorama: neither Radiance (.hdr), nor PNG or JPEG")
    if header is not None and not 0 < int(header[2]) * int(header[3]) <= MOST_PIXELS:
        raise SceneError(f"a panorama of {int(header[3])} x {int(header[2])} pixels is too large")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        image = None
    if image is None and exr:
        raise SceneError("this OpenCV reads no OpenEXR: save it as Radiance (.hdr)")
    if image is None or image.dtype != np.float32:
        raise SceneError("the panorama cannot be decoded: it is damaged")
    light = np.nan_to_num(image[..., ::-1], nan=0.0, posinf=65504.0)
    return np.ascontiguousarray(np.clip(light, 0.0, 65504.0), dtype=np.float32)


def _unreadable(path: Path, error: HumansimError, scene: Path, key: str) -> SceneError:
    message = error.message.replace("the texture", "the picture") if isinstance(error, MeshError) else None
    return SceneError(
        f"{path}: {message or error.message}", path=scene, line=line_of_key(scene, key), key=key
    )
