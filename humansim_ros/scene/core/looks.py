"""Random light, colours and textures, and procedural patterns: planks, plaster, weave, posters.

The same seed gives the same variations. Each kind has its own random numbers: one does not change another.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import scipy.fft

from humansim_ros.files.mesh import Mesh
from humansim_ros.scene.config.config import LightConfig, RandomiseConfig
from humansim_ros.types import Array, Image

Rng = np.random.Generator


class BlankNumbers(np.random.Generator):
    """Random numbers for meshes with textures that are not shown. Noise is left out, since it takes time."""


def pattern(seed: int, color: Sequence[int], side: int) -> Image:
    """Random pattern (side, side, 3): planks, weave, plaster, picture, checks, stripes or dots."""
    rng = np.random.default_rng(seed)
    kind = int(rng.integers(7))
    if kind < 3:
        if kind == 0:
            return planks(rng, color, side=side)
        return (weave if kind == 1 else plaster)(rng, color, side)
    if kind == 3:
        return poster(rng, (side, side))
    count = int(rng.integers(2, 9))
    y, x = np.mgrid[:side, :side] * (count / side)
    where = (
        (np.floor(x) + np.floor(y)) % 2 > 0,
        np.mod(x if rng.random() < 0.5 else y, 1) < rng.uniform(0.2, 0.8),
        np.hypot(np.mod(x, 1) - 0.5, np.mod(y, 1) - 0.5) < rng.uniform(0.15, 0.45),
    )[kind - 4]
    other = rng.integers(30, 240, 3)
    image = np.where(where[..., None], np.array(color), other)
    return np.clip(image * (1 + 0.04 * noise(rng, (side, side), 2)[..., None]), 0, 255).astype(np.uint8)


def noise(rng: Rng, shape: tuple[int, int], scale: float) -> Array:
    """Smooth noise with unit deviation that repeats at its edges."""
    white = rng.standard_normal(shape)
    if isinstance(rng, BlankNumbers):
        return np.zeros(shape, np.float32)
    spectrum = scipy.fft.rfft2(white.astype(np.float32), overwrite_x=True)
    spectrum *= _smoothing(shape, scale)
    out = scipy.fft.irfft2(spectrum, shape, overwrite_x=True)
    out /= max(float(cv2.meanStdDev(out)[1][0, 0]), 1e-9)
    return np.asarray(out)


@lru_cache(maxsize=8)
def _smoothing(shape: tuple[int, int], scale: float) -> Array:
    """Share of each frequency that remains in smooth noise."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    return np.exp(-((fx**2 + fy**2) * (scale * np.pi) ** 2)).astype(np.float32)


def shaded(color: Sequence[int], amount: Array) -> Image:
    """Image of a colour that an amount (H, W) makes brighter."""
    light = 1 + amount.astype(np.float32)
    channels = [np.clip(value * light, 0, 255).astype(np.uint8) for value in np.array(color, np.float32)]
    return np.asarray(cv2.merge(channels), np.uint8)


def plaster(rng: Rng, color: Sequence[int], side: int = 256) -> Image:
    """Plaster with few spots."""
    return shaded(color, 0.008 * noise(rng, (side, side), 3) + 0.008 * noise(rng, (side, side), 24))


def planks(rng: Rng, color: Sequence[int], rows: int = 8, side: int = 1024) -> Image:
    """Boards along x with different shades, grain and dark joints.

    Args:
        rng: Random numbers.
        color: Mean colour, sRGB.
        rows: Number of boards.
        side: Pixels of each side.
    """
    grain = cv2.resize(noise(rng, (side, side // 16), 2), (side, side), interpolation=cv2.INTER_LINEAR)
    amount = 0.05 * grain + 0.03 * noise(rng, (side, side), 30)
    board = side // rows
    for row in range(rows):
        band = slice(row * board, (row + 1) * board)
        cut = int(rng.integers(0, side))
        for part in (slice(0, cut), slice(cut, side)):
            amount[band, part] += float(rng.normal(0, 0.07))
        amount[row * board : row * board + 3] -= 0.3
        amount[band, cut : cut + 3] -= 0.3
    return shaded(color, amount)


def weave(rng: Rng, color: Sequence[int], side: int = 512) -> Image:
    """Cloth with threads along x and y."""
    y, x = np.mgrid[:side, :side] * (2 * np.pi * 64 / side)
    return shaded(
        color,
        0.08 * np.sin(x) * np.sin(y)
        + 0.05 * noise(rng, (side, side), 2)
        + 0.04 * noise(rng, (side, side), 20),
    )


def poster(rng: Rng, shape: tuple[int, int]) -> Image:
    """Framed abstract picture with many image features."""
    h, w = shape
    palette = np.array(
        [(212, 96, 66), (236, 190, 92), (66, 104, 132), (92, 138, 112), (40, 48, 60), (222, 216, 200)]
    )
    image = np.full((h, w, 3), palette[rng.integers(len(palette))], np.uint8)
    for _ in range(26):
        color = tuple(int(c) for c in palette[rng.integers(len(palette))])
        x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
        if rng.random() < 0.5:
            cv2.circle(image, (x, y), int(rng.integers(8, max(9, min(h, w) // 5))), color, -1, cv2.LINE_AA)
        else:
            a, b = int(rng.integers(10, w // 3)), int(rng.integers(10, h // 3))
            cv2.rectangle(image, (x, y), (x + a, y + b), color, -1)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (236, 232, 224), max(6, w // 22))
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (58, 48, 42), max(3, w // 60))
    return np.ascontiguousarray(image[::-1])


#: Returns the next random number, from 0 to 1.
RandomNumbers = Callable[[], float]


def random_numbers(seed: int, purpose: str) -> RandomNumbers:
    """Random numbers from a seed, different for each purpose."""
    # random.random() is the same for a seed in every Python. Its other functions need not be
    return random.Random(f"{seed}/{purpose}").random


def random_light(light: LightConfig, randomise: RandomiseConfig) -> LightConfig:
    """Light with a random sun and random colours of sun, sky and ground."""
    uniform = random_numbers(randomise.seed, "light")
    height, azimuth = math.radians(25 + 50 * uniform()), 2 * math.pi * uniform()
    sun = (math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height))
    colors = {}
    for name, low, high in (("sun_color", 0.3, 1.0), ("sky_color", 0.45, 0.95), ("ground_color", 0.25, 0.6)):
        amount, warmth, green = low + (high - low) * uniform(), 0.5 * uniform() - 0.25, 0.1 * uniform() - 0.05
        colors[name] = (amount * (1 + warmth), amount * (1 + green), amount * (1 - warmth))
    return light.model_copy(update={"sun": sun, **colors})


def random_looks(meshes: Sequence[Mesh], randomise: RandomiseConfig) -> list[Mesh]:
    """Meshes with random colours and textures; meshes that shared a texture share the new one."""
    textures: dict[int, Image] = {}
    out = []
    for number, mesh in enumerate(meshes):
        if mesh.texture is None:
            colors = mesh.colors
            if randomise.colours and colors is not None:
                uniform = random_numbers(randomise.seed, f"colour {number}")
                colors = _recolour(colors[:, None], uniform)[:, 0]
            out.append(replace(mesh, colors=colors))
            continue
        key = id(mesh.texture)
        if key not in textures:
            textures[key] = _random_texture(mesh.texture, len(textures), randomise)
        out.append(replace(mesh, texture=textures[key]))
    return out


def _random_texture(texture: Image, number: int, randomise: RandomiseConfig) -> Image:
    if randomise.textures:
        uniform = random_numbers(randomise.seed, f"texture {number}")
        color = tuple(int(40 + 200 * uniform()) for _ in range(3))
        if not randomise.colours:
            color = tuple(int(c) for c in texture.reshape(-1, 3).mean(axis=0))
        side = 512 if max(texture.shape) >= 256 else 64
        return pattern(int(uniform() * 1e9), color, side)
    if not randomise.colours:
        return texture
    return _recolour(texture, random_numbers(randomise.seed, f"colour {number}"))


def _recolour(image: Image, uniform: RandomNumbers) -> Image:
    """Image (H, W, 3) with random hue, saturation and brightness."""
    hsv = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2HSV).astype(np.float32)
    hsv[..., 0] = np.mod(hsv[..., 0] + 180 * uniform(), 180)
    hsv[..., 1] *= 0.5 + uniform()
    hsv[..., 2] *= 0.6 + 0.6 * uniform()
    return np.asarray(cv2.cvtColor(np.clip(hsv, 0, 255).astype(np.uint8), cv2.COLOR_HSV2RGB), np.uint8)
