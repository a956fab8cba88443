"""What the lens does to the light besides bending it: vignetting and lateral chromatic aberration."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.sensor.config import ChromaticAberration, Vignetting

Light = NDArray[np.float32]

#: Rows whose angles are worked out at a time.
_ROWS = 64


def corner_distance(camera: Camera) -> float:
    """Pixels from the principal point to the pixel in the farthest corner."""
    across = np.maximum(camera.K[:2, 2], np.array(camera.size) - 1 - camera.K[:2, 2])
    return float(np.hypot(*across))


def transmission(camera: Camera, vignetting: Vignetting) -> Light:
    """Share (H, W) of the light that reaches each pixel; 0 where the lens sees nothing."""
    width, height = camera.size
    x = np.arange(width) - camera.K[0, 2]
    a, b, c = vignetting.polynomial
    out = np.empty((height, width), np.float32)
    for top in range(0, height, _ROWS):
        rows = np.arange(top, min(top + _ROWS, height))
        squared = (x**2 + (rows[:, None] - camera.K[1, 2]) ** 2) / corner_distance(camera) ** 2
        share = 1 + squared * (a + squared * (b + squared * c))
        share *= 1 - vignetting.corner * squared
        if vignetting.cos4:
            share *= _cosines(camera, rows) ** 4
        out[rows] = np.maximum(share, 0)
    return out


def _cosines(camera: Camera, rows: NDArray[np.intp]) -> NDArray[np.float64]:
    """Cosines (N, W) of the angles at which light falls into the pixels of some rows (N,)."""
    row, column = np.meshgrid(rows, np.arange(camera.size[0]), indexing="ij")
    pixels = np.stack([column.ravel(), row.ravel()], axis=-1)
    rays = camera.to_optical(camera.unproject(pixels, np.ones(len(pixels))))
    cosines = 1 / np.linalg.norm(rays, axis=-1)
    return np.asarray(np.nan_to_num(cosines, nan=0.0), dtype=float).reshape(row.shape)


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
