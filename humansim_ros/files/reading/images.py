"""Decode and encode image files (PNG, JPEG), with limits for untrusted files; encode and decode sRGB."""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.types import Array

#: Most pixels of a decoded image (8192 x 8192), and largest image file: that size without compression.
MAX_PIXELS, MAX_IMAGE_BYTES = 1 << 26, 1 << 28
#: Most pixels of all images of one file together: 128 images of 2048 x 2048.
MAX_PIXELS_OF_FILE = 1 << 29


def decode_image(encoded: NDArray[np.uint8] | bytes, noun: str = "texture") -> NDArray[np.uint8]:
    """Decode a PNG or JPEG file to (H, W, 3) uint8 sRGB. ``noun``: what the image is, for messages. Raises
    MeshError for other files, and for images larger than MAX_PIXELS."""
    data = bytes(encoded)
    _checked_size(data, noun)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        raise MeshError(f"the {noun} cannot be decoded: the image is damaged")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def _checked_size(data: bytes, noun: str) -> int:
    """Number of pixels in the header of an image, before it is decoded. Raises MeshError."""
    size = declared_size(data)
    if size is None:
        raise MeshError(f"the {noun} is not a PNG or JPEG image")
    if not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise MeshError(f"a {noun} of {size[0]} x {size[1]} pixels is too large; at most 8192 x 8192")
    if data[:4] == b"\x89PNG" and not _has_whole_chunks(data):
        raise MeshError(f"the {noun} cannot be decoded: the image is damaged")
    return size[0] * size[1]


def _has_whole_chunks(data: bytes) -> bool:
    """Whether a PNG file has all bytes that its chunks declare, since OpenCV allocates memory for what they
    declare."""
    start = 8
    while start < len(data) and data[start + 4 : start + 8] != b"IEND":
        start += 12 + int.from_bytes(data[start : start + 4], "big")
    return start <= len(data)


class DecodedImages:
    """Cache of the decoded images of one file. Together the images have at most MAX_PIXELS_OF_FILE pixels."""

    def __init__(self) -> None:
        self._images: dict[Hashable, NDArray[np.uint8]] = {}
        self._alphas: dict[Hashable, NDArray[np.uint8] | None] = {}
        self._pixels = 0

    def get(self, key: Hashable, encoded: Callable[[], bytes]) -> NDArray[np.uint8]:
        """Image (H, W, 3) with a key, decoded from ``encoded`` on the first call. Raises MeshError."""
        if key not in self._images:
            self._images[key] = decode_image(self._counted(encoded()))
        return self._images[key]

    def alpha(self, key: Hashable, encoded: Callable[[], bytes]) -> NDArray[np.uint8] | None:
        """Alpha channel (H, W) of the image with a key; None if the image is opaque. Raises MeshError."""
        if key not in self._alphas:
            self._alphas[key] = _decode_alpha(self._counted(encoded()))
        return self._alphas[key]

    def tinted(self, key: Hashable, image: NDArray[np.uint8], color: Array) -> NDArray[np.uint8]:
        """Image (H, W, 3) times a colour (3,), sRGB 0 to 1. The result is cached by key and colour. Raises
        MeshError."""
        key = key, *color.tolist()
        if key not in self._images:
            self._reserve(image.shape[0] * image.shape[1])
            table = np.rint(np.arange(256)[:, None] * color).astype(np.uint8)
            self._images[key] = np.asarray(cv2.LUT(image, table[None]), dtype=np.uint8)
        return self._images[key]

    def _counted(self, data: bytes) -> bytes:
        self._reserve(_checked_size(data, "texture"))
        return data

    def _reserve(self, pixels: int) -> None:
        self._pixels += pixels
        if self._pixels > MAX_PIXELS_OF_FILE:
            raise MeshError(f"its images have more than {MAX_PIXELS_OF_FILE >> 20} million pixels together")


def _decode_alpha(data: bytes) -> NDArray[np.uint8] | None:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None  # the image is damaged, and reading its colours raises the error
    if image is None or image.ndim != 3 or image.shape[2] != 4:
        return None
    alpha = image[..., 3] if image.dtype == np.uint8 else image[..., 3] // 257
    return None if (alpha == 255).all() else np.ascontiguousarray(alpha, dtype=np.uint8)


def encode_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Encode an image (H, W, 3) sRGB as PNG, (N,) bytes."""
    done, encoded = cv2.imencode(".png", image[..., ::-1])
    if not done:
        raise MeshError("the texture cannot be encoded")
    return np.asarray(encoded, dtype=np.uint8).ravel()


def declared_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header of a PNG or JPEG file; None for other files."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return int(width), int(height)
    if data[:2] != b"\xff\xd8":
        return None
    offset = 2
    while offset + 9 <= len(data):
        if data[offset] != 0xFF:
            return None
        marker = data[offset + 1]
        if marker == 0xFF:  # padding
            offset += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, offset + 5)
            return int(width), int(height)
        offset += 2 + struct.unpack_from(">H", data, offset + 2)[0]
    return None


# --- sRGB from linear light and back (IEC 61966-2-1), for values from 0 to 1


def encode_srgb(linear: Array) -> Array:
    """Convert linear light to sRGB values. White is 1 in both."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: Array) -> Array:
    """Convert sRGB values to linear light. White is 1 in both."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
