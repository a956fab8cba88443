"""Rays of cameras: from pixels of a distorted image to directions in ``map``.

The rest of the tracker sees no pixels, lenses or matrices: only centres of cameras and unit rays. Therefore
fisheyes and pinhole cameras are treated alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LENS_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")

_NEWTON_STEPS = 30
#: Error on the normalised image plane at which a lens counts as inverted.
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Camera:
    """A calibrated camera at one instant.

    Attributes:
        matrix: Intrinsics K of the image, (3, 3).
        rotation: From ``map`` to the optical frame (z forward, x right, y down), (3, 3).
        center: Centre of the camera in ``map``, (3,) metres.
        model: ``distortion_model`` of CameraInfo, one of :data:`LENS_MODELS`.
        distortion: Its coefficients, as in CameraInfo.
    """

    matrix: Array
    rotation: Array
    center: Array
    model: str = "plumb_bob"
    distortion: tuple[float, ...] = ()

    @property
    def focal_length(self) -> float:
        """Mean focal length, pixels: the pixels of a radian near the optical axis."""
        return float(self.matrix[0, 0] + self.matrix[1, 1]) / 2

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit directions (..., 3) in ``map`` of pixels (..., 2); NaN where no ray reaches a pixel."""
        uv = np.asarray(pixels, dtype=float)
        homogeneous = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1)
        plane = (homogeneous @ np.linalg.inv(self.matrix).T)[..., :2]
        if self.model == "equidistant":
            optical = _fisheye_rays(plane, self.distortion)
        else:
            ideal = _undistort(plane, self.distortion) if any(self.distortion) else plane
            optical = np.concatenate([ideal, np.ones((*uv.shape[:-1], 1))], axis=-1)
            optical /= np.linalg.norm(optical, axis=-1, keepdims=True)
        return np.asarray(optical @ self.rotation)


def _distort(points: Array, coefficients: tuple[float, ...]) -> Array:
    """The models ``plumb_bob`` (5 coefficients) and ``rational_polynomial`` (8) of OpenCV."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *[0.0] * 8)[:8]
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    factor = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * factor + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        ],
        axis=-1,
    )


def _undistort(distorted: Array, coefficients: tuple[float, ...]) -> Array:
    """Invert :func:`_distort` by Newton's method; NaN where it does not converge, or where the lens folds."""
    points, step = distorted.copy(), 1e-6
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            value = _distort(points, coefficients)
            error = value - distorted
            slope_x = (_distort(points + step * np.array([1, 0]), coefficients) - value) / step
            slope_y = (_distort(points + step * np.array([0, 1]), coefficients) - value) / step
            determinant = _cross(slope_x, slope_y)
            if not (np.abs(error) > _TOLERANCE).any():
                break
            move = np.stack([_cross(error, slope_y), _cross(slope_x, error)], axis=-1)
            points = points - move / determinant[..., None]
        outward = (points * distorted).sum(axis=-1) >= 0
        valid = (np.abs(error).max(axis=-1) <= _TOLERANCE) & (determinant > 0) & outward
    return np.where(valid[..., None], points, np.nan)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _fisheye_rays(plane: Array, coefficients: tuple[float, ...]) -> Array:
    """Unit rays (..., 3) of points (..., 2) of the model ``equidistant``; NaN where there is none."""
    k = (*coefficients, *[0.0] * 4)[:4]
    distorted = np.linalg.norm(plane, axis=-1)
    angle = distorted.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            a2 = angle * angle
            error = angle * (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3])))) - distorted
            slope = 1 + a2 * (3 * k[0] + a2 * (5 * k[1] + a2 * (7 * k[2] + a2 * 9 * k[3])))
            angle = angle - error / slope
        # sin(angle) / distorted is 1 on the axis
        scale = np.where(distorted > 1e-9, np.sin(angle) / distorted, 1.0)
    valid = (np.abs(error) < _TOLERANCE) & (angle >= 0) & (angle < np.pi)
    rays = np.concatenate([plane * scale[..., None], np.cos(angle)[..., None]], axis=-1)
    return np.where(valid[..., None], rays, np.nan)
