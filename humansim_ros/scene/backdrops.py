"""Read the photographs and panoramas of backdrops."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.io.files import read_bytes
from humansim_ros.io.images import MAX_PIXELS, declared_size, decode_image
from humansim_ros.render.backdrops import ImageBackdrop

_RADIANCE = re.compile(rb"^#\?(RADIANCE|RGBE)\b.*?\n\s*?\n-Y (\d{1,6}) \+X (\d{1,6})\n", re.DOTALL)
_EXR = b"\x76\x2f\x31\x01"
#: Columns of the largest panorama in memory: a camera of 60 degrees sees 700 of them.
_MAX_WIDTH = 4096


def load_backdrop(path: Path) -> ImageBackdrop:
    """Read a photograph (PNG or JPEG). Raises SceneError with the path."""
    with _naming(path):
        return ImageBackdrop(decode_image(read_bytes(path, SceneError, "photograph"), "photograph"))


def load_panorama(path: Path) -> NDArray[np.float32]:
    """Read a panorama: Radiance (.hdr), OpenEXR if its package is installed, PNG or JPEG with 1 as white.

    Returns:
        Linear light (H, W, 3), at most 4096 columns.

    Raises:
        SceneError: With the path, if the file is no panorama.
    """
    with _naming(path):
        data = read_bytes(path, SceneError, "panorama")
        radiance = _finite(_read_exr(path) if data[:4] == _EXR else _decode(data))
        height, width = radiance.shape[:2]
        if not 1.9 < width / height < 2.1:
            raise SceneError(f"a panorama is twice as wide as high, this one is {width} x {height}")
    if width > _MAX_WIDTH:
        size = (_MAX_WIDTH, round(height * _MAX_WIDTH / width))
        radiance = np.asarray(cv2.resize(radiance, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    return radiance


def _decode(data: bytes) -> NDArray[np.float32]:
    if declared_size(data) is not None:
        return np.asarray((decode_image(data, "panorama") / np.float32(255)) ** 2, dtype=np.float32)
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
    """(H, W, 3) of the first part of an OpenEXR file."""
    try:
        import OpenEXR
    except ImportError:
        message = "to read OpenEXR files, pip install OpenEXR; or save the panorama as Radiance (.hdr)"
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


def _finite(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Light without NaN, infinity and negative values."""
    light = np.nan_to_num(image, nan=0.0, posinf=65504.0)
    return np.ascontiguousarray(np.clip(light, 0.0, 65504.0), dtype=np.float32)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Make errors SceneErrors with the path."""
    try:
        yield
    except HumansimError as error:
        raise SceneError(error.message, path=path) from None
