"""Decode and encode image files (PNG, JPEG), with limits for untrusted files."""

from __future__ import annotations

import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError

#: Limit for decoded images: 8192 x 8192; and for image files: that size without compression.
MAX_PIXELS, MAX_IMAGE_BYTES = 1 << 26, 1 << 28


def decode_image(encoded: NDArray[np.uint8] | bytes, noun: str = "texture") -> NDArray[np.uint8]:
    """Decode a PNG or JPEG file to (H, W, 3) uint8 sRGB. ``noun``: its use, for messages.

    Raises MeshError for other files, and for images larger than MAX_PIXELS.
    """
    data = bytes(encoded)
    size = declared_size(data)
    if size is None:
        raise MeshError(f"the {noun} is not a PNG or JPEG image")
    if not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise MeshError(f"a {noun} of {size[0]} x {size[1]} pixels is too large; at most 8192 x 8192")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        raise MeshError(f"the {noun} cannot be decoded: the image is damaged")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def decode_alpha(encoded: NDArray[np.uint8] | bytes) -> NDArray[np.uint8] | None:
    """Alpha channel (H, W) of an image that :func:`decode_image` reads; None if it is opaque."""
    image = cv2.imdecode(np.frombuffer(bytes(encoded), np.uint8), cv2.IMREAD_UNCHANGED)
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
