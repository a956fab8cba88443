"""Lens and shutter: vignetting, lateral chromatic aberration, and the exposure of rows over time."""

from __future__ import annotations

import cv2
import numpy as np

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.sensor.config import ChromaticAberration, Vignetting
from humansim_ros.types import Array, Float32Array

#: The rays are computed for every fourth pixel, since the inverse of a distortion is slow.
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
    """cos^4 (H, W) of the angle between each pixel's ray and the optical axis. 0 for pixels without a ray. It
    is interpolated linearly between every fourth pixel, with an error below 16 / f^2."""
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


#: Shortest exposure, seconds, since stamps are whole nanoseconds.
_SHORTEST = 1e-9


def sample_times(height: int, exposure: float, row_time: float, samples: int) -> Array:
    """Times at which the scene is rendered.

    With a global shutter, they are the midpoints of equal parts of the exposure. With a rolling shutter, they
    are spread evenly from the start of the first row to the end of the last row.

    Args:
        height: Number of image rows.
        exposure: Exposure time of a row, seconds.
        row_time: Time from the exposure of one row to that of the next, seconds. 0 for a global shutter.
        samples: Number of times.

    Returns:
        Times (T,) in seconds from the midpoint of the exposure of the middle row. A single 0.0 if there is
        neither motion blur nor a rolling shutter.
    """
    span = exposure + (height - 1) * row_time
    if span < _SHORTEST or samples == 1:
        return np.zeros(1)
    if row_time == 0:
        return exposure * ((np.arange(samples) + 0.5) / samples - 0.5)
    return np.linspace(-span / 2, span / 2, samples, dtype=float)


def row_weights(height: int, exposure: float, row_time: float, samples: int) -> Array:
    """Weights of the images at :func:`sample_times` in the light of each row.

    With a rolling shutter, the midpoint of the exposure of row y is (y - (H - 1) / 2) row_time. Light is
    interpolated linearly between samples, so that the mean time of each row is exact for any number of
    samples.

    Args:
        height: Number of image rows.
        exposure: Exposure time of a row, seconds.
        row_time: Time from the exposure of one row to that of the next, seconds.
        samples: Number of times.

    Returns:
        Weights (H, T). The sum of each row is 1.
    """
    times = sample_times(height, exposure, row_time, samples)
    if len(times) == 1 or row_time == 0:
        return np.full((height, len(times)), 1 / len(times))
    step = times[1] - times[0]
    middle = (np.arange(height) - (height - 1) / 2)[:, None] * row_time
    if exposure < _SHORTEST:
        weights = np.maximum(0.0, 1 - np.abs(middle - times) / step)
    else:
        weights = _triangle_integral((middle + exposure / 2 - times) / step)
        weights = weights - _triangle_integral((middle - exposure / 2 - times) / step)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=float)


def _triangle_integral(u: Array) -> Array:
    """Integral from -1 to ``u`` of the triangle function 1 - |u|."""
    u = np.clip(u, -1.0, 1.0)
    return np.where(u < 0, (1 + u) ** 2 / 2, 1 - (1 - u) ** 2 / 2)
