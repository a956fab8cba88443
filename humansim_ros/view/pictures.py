"""Pictures of a page."""

from __future__ import annotations

import cv2
import numpy as np

from humansim_ros.types import Image
from humansim_ros.view.source import JOINTS

#: Width of images on the page, pixels.
IMAGE_WIDTH = 640
#: Channels whose pixels may be mixed; others are labels or have edges.
_SMOOTH = ("rgb", JOINTS, "shadow", "alpha")


def texture_jpeg(texture: Image, side: int) -> bytes:
    """JPEG file of a texture (H, W, 3) whose longest side has at most ``side`` pixels."""
    scale = side / max(texture.shape[:2])
    if scale < 1:
        smaller = cv2.resize(texture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        texture = np.asarray(smaller, dtype=np.uint8)
    return bytes(cv2.imencode(".jpg", texture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1])


def fitted(image: Image, width: int, channel: str) -> Image:
    """Image of at most ``width`` pixels; labels are not mixed."""
    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    method = cv2.INTER_AREA if channel in _SMOOTH else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), dtype=np.uint8)
