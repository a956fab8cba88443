"""Vignetting and lateral chromatic aberration of the lens."""

from __future__ import annotations

import cv2
import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.sensor.config import ChromaticAberration, Vignetting
from humansim_ros.types import Float32Array

#: Distance of the pixels whose rays are computed; the inverse of a distortion is slow.
_STEP = 4


def corner_distance(camera: Camera) -> float:
    """Distance in pixels from the principal point to the centre of the farthest corner pixel."""
    farthest = np.maximum(camera.K[:2, 2], np.array(camera.size) - 1 - camera.K[:2, 2])
    return float(np.hypot(*farthest))


def transmission(camera: Camera, vignetting: Vignetting) -> Float32Array:
    """Fraction (H, W) of the light that reaches each pixel."""
    width, height = camera.size
    x, y = np.arange(width) - camera.K[0, 2], np.arange(height)[:, None] - camera.K[1, 2]
    squared = ((x**2 + y**2) / corner_distance(camera) ** 2).astype(np.float32)
    a, b, c = vignetting.polynomial
    fraction = 1 + squared * (a + squared * (b + squared * c))
    fraction *= 1 - vignetting.corner * squared
    if vignetting.cos4:
        fraction *= _cos4_falloff(camera)
    return np.asarray(np.maximum(fraction, 0), dtype=np.float32)


def _cos4_falloff(camera: Camera) -> Float32Array:
    """cos^4 (H, W) of the angle between each pixel's ray and the optical axis, 0 for pixels without a ray.

    Interpolated linearly between every fourth pixel, with an error below 16 / f^2.
    """
    width, height = camera.size
    columns, rows = (np.arange(0, n - 1 + _STEP, _STEP) for n in (width, height))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = camera.to_optical(camera.unproject(pixels, np.ones(len(pixels))))
    fraction = np.nan_to_num(np.linalg.norm(rays, axis=-1) ** -4.0, nan=0.0).reshape(len(rows), len(columns))
    across, down = (
        np.maximum(0, 1 - np.abs(np.arange(n)[:, None] - nodes) / _STEP)
        for n, nodes in ((width, columns), (height, rows))
    )
    return np.asarray(down @ fraction @ across.T, dtype=np.float32)


def aberrate(light: Float32Array, camera: Camera, aberration: ChromaticAberration) -> Float32Array:
    """Magnify red and blue of light (H, W, 3) about the principal point."""
    out = light.copy()
    for channel, pixels in ((0, aberration.red), (2, aberration.blue)):
        if pixels:
            # WARP_INVERSE_MAP: the matrix maps output pixels to input pixels
            scale = 1 / (1 + pixels / corner_distance(camera))
            input_from_output = np.column_stack([scale * np.eye(2), (1 - scale) * camera.K[:2, 2]])
            out[..., channel] = cv2.warpAffine(
                cv2.extractChannel(light, channel),
                input_from_output,
                camera.size,
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )
    return out
