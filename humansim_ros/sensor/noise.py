"""Shot noise and read noise in electrons [EMVA 1288]."""

from __future__ import annotations

import hashlib
from functools import cache

import numpy as np

from humansim_ros.types import Float32Array

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
