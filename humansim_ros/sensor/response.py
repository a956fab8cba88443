"""Light to numbers and back: response curves, colour filters."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.sensor.optics import Light
from humansim_ros.types import Array

#: The largest number of the converter behind the pixels.
LEVELS = 65535
#: Share of red, green and blue of linear sRGB in its luminance (IEC 61966-2-1, ITU-R BT.709).
_LUMINANCE = np.array([[0.2126, 0.7152, 0.0722]], np.float32)


def srgb_to_light(values: Array) -> Array:
    """Linear light (0..1) of sRGB values (0..1) (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def light_to_srgb(light: Array) -> Array:
    """sRGB values (0..1) of linear light (0..1) (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def response_table(response: str | float) -> NDArray[np.uint8]:
    """What number (65536,) each level of the converter becomes."""
    light = np.arange(LEVELS + 1) / LEVELS
    if response == "srgb":
        values = light_to_srgb(light)
    else:
        values = light if response == "linear" else light ** (1 / float(response))
    return np.rint(255 * values).astype(np.uint8)


def luminance(light: Light) -> Light:
    """Luminance (H, W) of light (H, W, 3)."""
    return np.asarray(cv2.transform(light, _LUMINANCE), dtype=np.float32).reshape(light.shape[:2])


def mosaic(picture: NDArray[Any]) -> NDArray[Any]:
    """What (H, W) of a picture (H, W, 3) passes colour filters that begin red, green / green, blue."""
    out = np.array(picture[..., 1], order="C")
    out[0::2, 0::2] = picture[0::2, 0::2, 0]
    out[1::2, 1::2] = picture[1::2, 1::2, 2]
    return out
