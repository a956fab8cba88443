"""Noise of photons and of the electronics, in electrons (EMVA 1288)."""

from __future__ import annotations

import hashlib
from functools import cache

import numpy as np
from numpy.typing import NDArray

from humansim_ros.sensor.optics import Light

#: Mean electrons from which on a normal distribution of the same variance stands for Poisson's.
_NEARLY_NORMAL = 20.0


def generator(seed: int, camera: str, stamp: int) -> np.random.Generator:
    """Random numbers that depend on nothing else than these: a frame is the same whenever it is made."""
    digest = hashlib.sha256(f"{seed} {stamp} {camera}".encode()).digest()
    return np.random.Generator(np.random.SFC64(int.from_bytes(digest, "little")))


def noisy(electrons: Light, read_noise: float, random: np.random.Generator) -> Light:
    """Electrons that are read where so many (H, N) are expected: Poisson distributed, and the normal noise of
    reading them, of standard deviation ``read_noise``. May be negative.
    """
    normal = _normals(electrons.shape, random)
    out = np.sqrt(electrons + np.float32(read_noise**2))
    out *= normal
    out += electrons
    few = electrons < _NEARLY_NORMAL
    if few.any():
        out[few] = random.poisson(electrons[few]) + np.float32(read_noise) * normal[few]
    return np.asarray(out, dtype=np.float32)


def _normals(shape: tuple[int, ...], random: np.random.Generator) -> Light:
    """Normal numbers, variance 1, by their quantiles: a fifth of the time of ``standard_normal``."""
    count = int(np.prod(shape))
    uniform = np.frombuffer(random.bytes(2 * count), "<u2")
    return np.take(_quantiles(), uniform).reshape(shape)


@cache
def _quantiles() -> NDArray[np.float32]:
    """65536 equally likely normal numbers, up to 4.3 standard deviations."""
    from scipy.special import ndtri  # slow to import, and few cameras are noisy

    values = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
    return np.asarray(values / values.std(), dtype=np.float32)
