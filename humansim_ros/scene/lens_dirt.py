"""Dirt on the lens of a camera: spots that are far out of focus."""

from __future__ import annotations

import numpy as np

from humansim_ros.scene.fault_config import DirtFault
from humansim_ros.types import Float32Array

#: Share of the radius of a spot over which it fades.
_EDGE = 0.6


def transmission(dirt: DirtFault, size: tuple[int, int], random: np.random.Generator) -> Float32Array:
    """Share (H, W) of the light that passes the spots.

    Args:
        dirt: Settings.
        size: Width and height of the image, pixels. The spots are the same in images of any size.
        random: Draws places and sizes.
    """
    width, height = size
    share = np.ones((height, width), np.float32)
    low, high = dirt.size
    for across, down, part in random.random((dirt.spots, 3)).tolist():
        radius = (low + (high - low) * part) * width / 2
        # the centre of the top-left pixel is (0, 0)
        x, y = across * width - 0.5, down * height - 0.5
        left, right = (int(np.clip(np.ceil(x + side * radius), 0, width)) for side in (-1, 1))
        top, bottom = (int(np.clip(np.ceil(y + side * radius), 0, height)) for side in (-1, 1))
        distance = np.hypot(np.arange(left, right) - x, np.arange(top, bottom)[:, None] - y)
        inside = np.clip((1 - distance / radius) / _EDGE, 0, 1)
        cover = dirt.opacity * inside**2 * (3 - 2 * inside)
        share[top:bottom, left:right] *= (1 - cover).astype(np.float32)
    return share
