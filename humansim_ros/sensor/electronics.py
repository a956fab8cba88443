"""Electronics of a sensor: noise in electrons [EMVA 1288], response curves and colour filters."""

from __future__ import annotations

import hashlib
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.io.images import encode_srgb
from humansim_ros.types import Float32Array, Image

#: Mean number of electrons from which a normal distribution replaces the Poisson distribution.
_NORMAL_FROM = 20.0


def generator(seed: int, camera: str, stamp: int) -> np.random.Generator:
    """Random generator of a frame. It depends on these values only, so that frames are reproducible."""
    digest = hashlib.sha256(f"{seed} {stamp} {camera}".encode()).digest()
    return np.random.Generator(np.random.SFC64(int.from_bytes(digest, "little")))


def add_noise(electrons: Float32Array, read_noise: float, random: np.random.Generator) -> Float32Array:
    """Draw the electrons that are read where ``electrons`` (H, N) are expected.

    Shot noise is Poisson distributed; read noise is normal with standard deviation ``read_noise``. Results
    may be negative.
    """
    normal = _normals(electrons.shape, random)
    out = np.sqrt(electrons + np.float32(read_noise**2))
    out *= normal
    out += electrons
    few = electrons < _NORMAL_FROM
    if few.any():
        out[few] = random.poisson(electrons[few]) + np.float32(read_noise) * normal[few]
    return np.asarray(out, dtype=np.float32)


def _normals(shape: tuple[int, ...], random: np.random.Generator) -> Float32Array:
    """Standard normal numbers from a table of quantiles, in a fifth of the time of ``standard_normal``."""
    count = int(np.prod(shape))
    uniform = np.frombuffer(random.bytes(2 * count), "<u2")
    return np.take(_quantiles(), uniform).reshape(shape)


@cache
def _quantiles() -> Float32Array:
    """65536 equally likely standard normal numbers, up to 4.3 standard deviations."""
    from scipy.special import ndtri  # slow to import, and few cameras have noise

    values = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
    return np.asarray(values / values.std(), dtype=np.float32)


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
