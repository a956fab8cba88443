"""Response curves and colour filters."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.io.images import encode_srgb
from humansim_ros.types import Float32Array, Image

#: Largest value of the analog-to-digital converter.
LEVELS = 65535
#: Weights of red, green and blue of linear sRGB in the luminance (IEC 61966-2-1, ITU-R BT.709).
_LUMINANCE = np.array([[0.2126, 0.7152, 0.0722]], np.float32)


def response_table(response: str | float) -> Image:
    """8-bit value (65536,) of each level of the converter."""
    light = np.arange(LEVELS + 1) / LEVELS
    if response == "srgb":
        values = encode_srgb(light)
    else:
        values = light if response == "linear" else light ** (1 / float(response))
    return np.rint(255 * values).astype(np.uint8)


def luminance(light: Float32Array) -> Float32Array:
    """Luminance (H, W) of light (H, W, 3)."""
    return np.asarray(cv2.transform(light, _LUMINANCE), dtype=np.float32).reshape(light.shape[:2])


def bayer_mosaic(image: NDArray[Any]) -> NDArray[Any]:
    """Samples (H, W) of an image (H, W, 3) behind a Bayer filter: red, green / green, blue."""
    out = np.array(image[..., 1], order="C")
    out[0::2, 0::2] = image[0::2, 0::2, 0]
    out[1::2, 1::2] = image[1::2, 1::2, 2]
    return out
