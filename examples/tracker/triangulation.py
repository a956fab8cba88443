"""Points from rays: least squares, and RANSAC against false detections.

V views (cameras), J joints. A ray that is missing is NaN.

The ray of a camera with centre c and unit direction d says that a point x lies on it, up to a small angle.
The distance of x from the ray is |(I - d dᵀ)(x - c)|, and the angle is about this distance divided by the
range |x - c|. Least squares of the angles is a linear system A x = b as soon as the ranges are known:

    A = Σ w (I - d dᵀ),   b = Σ w (I - d dᵀ) c,   w = (focal length / range)²

Few repetitions with the new ranges are enough. A is in pixels² per metre²: for noise of σ pixels, σ² A⁻¹ is
the covariance of x. A of one view is singular, because a ray says nothing about the range. The Kalman filter
takes A and b as they are: a joint that only one camera sees is still tracked across its ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_REPETITIONS = 3
#: Points nearer than this are in no image, metres.
_NEAREST = 0.05
#: det(A) / (trace(A) / 3)³ of two rays at an angle of one degree. Rays closer to parallel give no point.
_PARALLEL = 3e-4


@dataclass(frozen=True)
class Rays:
    """Rays of the joints of one person.

    Attributes:
        centers: Centres of the cameras, (V, 3) metres in ``map``.
        directions: Unit vectors (V, J, 3) in ``map``; NaN where a camera has no detection.
        focal_lengths: (V,) pixels.
    """

    centers: Array
    directions: Array
    focal_lengths: Array

    @property
    def present(self) -> Mask:
        """Rays that are there, (V, J)."""
        return np.isfinite(self.directions[..., 0])

    def residuals(self, points: Array) -> Array:
        """Angles (..., V, J) between rays and points (..., J, 3), pixels; inf where one is missing."""
        offsets = points[..., None, :, :] - self.centers[:, None]
        across = np.linalg.norm(np.cross(offsets, self.directions), axis=-1)
        along = (offsets * self.directions).sum(axis=-1)
        pixels = np.arctan2(across, along) * self.focal_lengths[:, None]
        return np.where(np.isfinite(pixels), pixels, np.inf)

    def distances(self, points: Array) -> Array:
        """Distances (V, J) of points (J, 3) from the rays, metres; NaN where a ray or point is missing."""
        return np.linalg.norm(np.cross(points - self.centers[:, None], self.directions), axis=-1)

    def equations(self, points: Array, used: Mask) -> tuple[Array, Array]:
        """A (J, 3, 3) and b (J, 3) of the rays ``used`` (V, J), with the ranges of ``points`` (J, 3)."""
        ranges = np.linalg.norm(points - self.centers[:, None], axis=-1)
        return self._equations((self.focal_lengths[:, None] / np.maximum(ranges, _NEAREST)) ** 2, used)

    def _equations(self, weights: Array, used: Mask) -> tuple[Array, Array]:
        weights = np.where(used & self.present & np.isfinite(weights), weights, 0.0)
        across = weights[..., None, None] * _across(np.nan_to_num(self.directions))
        return across.sum(axis=0), np.einsum("vjab,vb->ja", across, self.centers)

    def triangulate(self, used: Mask | None = None) -> Array:
        """Triangulate points (J, 3) from the rays ``used`` (V, J), all if None.

        A point is NaN where fewer than two views are, where rays are almost parallel, and behind a camera.
        """
        used = self.present if used is None else used & self.present
        points = _solve(*self._equations(np.ones(used.shape), used))
        for _ in range(_REPETITIONS):
            points = _solve(*self.equations(points, used))
        along = ((points - self.centers[:, None]) * self.directions).sum(axis=-1)
        behind = (used & ~(along > _NEAREST)).any(axis=0)
        return np.where((behind | (used.sum(axis=0) < 2))[:, None], np.nan, points)


def ransac(rays: Rays, threshold: float, predicted: Array | None = None) -> tuple[Array, Mask]:
    """Triangulate the joints of one person in spite of false detections.

    Hypotheses are the points of all pairs of views (there are few, so none is drawn at random) and the
    predicted points. The cost of a hypothesis is Σ min(residual, threshold)² over the views, as in MSAC
    [Torr 2000].

    Args:
        rays: Rays of the person.
        threshold: Residual from which a detection is false, pixels.
        predicted: Points (J, 3) of the motion model, NaN where there is none. They decide if only one view
            sees a joint, or if two views contradict each other.

    Returns:
        Points (J, 3), NaN where fewer than two views agree, and the rays (V, J) that are not false.
    """
    hypotheses = _points_of_pairs(rays)
    if predicted is not None:
        hypotheses = np.concatenate([hypotheses, predicted[None]])
    if not len(hypotheses):  # one view, and nothing is known about the person
        return np.full(rays.directions.shape[1:], np.nan), np.zeros(rays.present.shape, dtype=bool)
    residuals = rays.residuals(hypotheses)  # (H, V, J)
    best = (np.minimum(residuals, threshold) ** 2).sum(axis=1).argmin(axis=0)
    joints = np.arange(residuals.shape[2])
    residual_of_best = residuals[best, :, joints].T
    inliers = residual_of_best < threshold
    points = rays.triangulate(inliers)
    # the point of all inliers is better than that of a pair: decide again
    refined = np.isfinite(points[:, 0])
    inliers = np.where(refined, rays.residuals(points) < threshold, inliers)
    return rays.triangulate(inliers), inliers


def _points_of_pairs(rays: Rays) -> Array:
    """Points (H, J, 3) between the rays of each pair of views; NaN where one is missing."""
    if len(rays.centers) < 2:
        return np.empty((0, *rays.directions.shape[1:]))
    across = _across(rays.directions)
    towards = np.einsum("vjab,vb->vja", across, rays.centers)
    first, second = np.array(list(combinations(range(len(across)), 2))).T
    return _solve(across[first] + across[second], towards[first] + towards[second])


def _across(directions: Array) -> Array:
    """Projections I - d dᵀ (..., 3, 3) across unit vectors (..., 3)."""
    return np.eye(3) - directions[..., :, None] * directions[..., None, :]


def _solve(a: Array, b: Array) -> Array:
    """Solve A x = b for (..., 3, 3) and (..., 3); NaN where A is almost singular."""
    size = np.trace(a, axis1=-2, axis2=-1) / 3
    with np.errstate(invalid="ignore"):
        regular = np.linalg.det(a) > _PARALLEL * size**3
    x = np.linalg.solve(np.where(regular[..., None, None], a, np.eye(3)), b[..., None])[..., 0]
    return np.where(regular[..., None], x, np.nan)
