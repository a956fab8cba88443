"""Random variations: light, colours, textures and camera poses.

The same seed gives the same variations. Each kind has its own random numbers: one does not change another.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from humansim_ros.files.mesh import Mesh
from humansim_ros.scene.config.config import LightConfig, RandomiseConfig
from humansim_ros.scene.core.textures import pattern
from humansim_ros.types import Image

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
    for name, low, high in (
        ("sun_color", 0.3, 1.0),
        ("sky_color", 0.45, 0.95),
        ("ground_color", 0.25, 0.6),
    ):
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
