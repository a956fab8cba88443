"""sRGB encoding of linear light and its inverse (IEC 61966-2-1), for values from 0 to 1."""

from __future__ import annotations

import numpy as np

from humansim_ros.types import Array


def encode_srgb(linear: Array) -> Array:
    """sRGB values of linear light."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: Array) -> Array:
    """Linear light of sRGB values."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
