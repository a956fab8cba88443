"""What the lens does to the light besides bending it: vignetting and lateral chromatic aberration."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.sensor.config import ChromaticAberration, Vignetting

Light = NDArray[np.float32]

#: From pixel to pixel whose rays are looked for: a lens' distortion is slow to undo.
_STEP = 4


def corner_distance(camera: Camera) -> float:
    """Pixels from the principal point to the pixel in the farthest corner."""
    across = np.maximum(camera.K[:2, 2], np.array(camera.size) - 1 - camera.K[:2, 2])
    return float(np.hypot(*across))


def transmission(camera: Camera, vignetting: Vignetting) -> Light:
    """Share (H, W) of the light that reaches each pixel."""
    width, height = camera.size
    x, y = np.arange(width) - camera.K[0, 2], np.arange(height)[:, None] - camera.K[1, 2]
    squared = ((x**2 + y**2) / corner_distance(camera) ** 2).astype(np.float32)
    a, b, c = vignetting.polynomial
    share = 1 + squared * (a + squared * (b + squared * c))
    share *= 1 - vignetting.corner * squared
    if vignetting.cos4:
        share *= _natural(camera)
    return np.asarray(np.maximum(share, 0), dtype=np.float32)


def _natural(camera: Camera) -> Light:
    """Fourth power (H, W) of the cosine of the angle of each pixel's ray, 0 where the lens sees nothing.

    Linear between every fourth pixel: that is off by less than 16 / f^2.
    """
    width, height = camera.size
    columns, rows = (np.arange(0, n - 1 + _STEP, _STEP) for n in (width, height))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = camera.to_optical(camera.unproject(pixels, np.ones(len(pixels))))
    share = np.nan_to_num(np.linalg.norm(rays, axis=-1) ** -4.0, nan=0.0).reshape(len(rows), len(columns))
    across, down = (
        np.maximum(0, 1 - np.abs(np.arange(n)[:, None] - nodes) / _STEP)
        for n, nodes in ((width, columns), (height, rows))
    )
    return np.asarray(down @ share @ across.T, dtype=np.float32)


def aberrate(light: Light, camera: Camera, aberration: ChromaticAberration) -> Light:
    """Light (H, W, 3) with red and blue magnified about the principal point."""
    out = light.copy()
    for channel, pixels in ((0, aberration.red), (2, aberration.blue)):
        if pixels:
            # warpAffine asks where each pixel's light comes from
            shrink = 1 / (1 + pixels / corner_distance(camera))
            come_from = np.column_stack([shrink * np.eye(2), (1 - shrink) * camera.K[:2, 2]])
            out[..., channel] = cv2.warpAffine(
                cv2.extractChannel(light, channel),
                come_from,
                camera.size,
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )
    return out
