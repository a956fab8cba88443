"""Lines of sight through 2D points of several views: points in space where pairs of them meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera.camera import Camera
from humansim_ros.types import Array, Indices

#: Most pairs of views that are tried for one keypoint; of more views, this number is drawn.
_MAX_PAIRS = 100
#: Least square of the sine of the angle between two lines that meet: 0.6 degrees.
_PARALLEL = 1e-4


@dataclass(frozen=True, eq=False)
class Sightlines:
    """Lines from V cameras through the 2D points of K keypoints.

    Attributes:
        cameras: V cameras.
        pixels: (V, K, 2); NaN where a point is absent, or no ray of the lens reaches it.
        weights: (V, K) confidence of the points; 0 where one is absent.
        directions: (V, K, 3) unit vectors in ``map``.
        radii: (V,) median distance of the points of a view from their middle, in pixels: the size of the
            person in the image. NaN without points.
    """

    cameras: tuple[Camera, ...]
    pixels: Array
    weights: Array
    directions: Array
    radii: Array

    @classmethod
    def of(cls, cameras: Sequence[Camera], points: Array) -> Sightlines:
        """Lines through points (V, K, 3): x, y and confidence, which is 0 where a point is absent."""
        present = (points[..., 2] > 0) & np.isfinite(points[..., :2]).all(axis=-1)
        pixels = np.where(present[..., None], points[..., :2], np.nan)
        rays = np.array([camera.rays(own) @ camera.R for camera, own in zip(cameras, pixels, strict=True)])
        directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        reached = np.isfinite(directions).all(axis=-1)
        radii = np.full(len(cameras), np.nan)
        for view in np.flatnonzero(reached.any(axis=1)):
            own = pixels[view, reached[view]]
            radii[view] = np.median(np.linalg.norm(own - np.median(own, axis=0), axis=1))
        return cls(
            tuple(cameras),
            np.where(reached[..., None], pixels, np.nan),
            np.where(reached, points[..., 2], 0.0),
            directions,
            radii,
        )

    def exchanged(self, views: NDArray[np.bool_], partners: Sequence[int]) -> Sightlines:
        """The lines with left and right exchanged in some views.

        ``views``: (V,). ``partners``: (K,), as :attr:`KeypointSet.mirrored`.
        """
        order = np.where(views[:, None], np.asarray(partners), np.arange(len(partners)))
        pixels, weights, directions = (
            np.take_along_axis(each, order.reshape(*order.shape, *(1,) * (each.ndim - 2)), axis=1)
            for each in (self.pixels, self.weights, self.directions)
        )
        return Sightlines(self.cameras, pixels, weights, directions, self.radii)

    def pairs(self, seed: int = 0) -> tuple[Indices, Indices]:
        """Numbers of the views of pairs that see a keypoint, (P, K) and (P, K); both 0 to fill up.

        ``seed``: of the random choice among many pairs.
        """
        rng = np.random.default_rng(seed)
        found = []
        for seen in (self.weights > 0).T:
            own = np.array(list(combinations(np.flatnonzero(seen), 2)), np.intp).reshape(-1, 2)
            if len(own) > _MAX_PAIRS:
                own = own[np.sort(rng.choice(len(own), _MAX_PAIRS, replace=False))]
            found.append(own)
        pairs = np.zeros((max(map(len, found), default=0), len(found), 2), np.intp)
        for keypoint, own in enumerate(found):
            pairs[: len(own), keypoint] = own
        return pairs[..., 0], pairs[..., 1]

    def meet(self, first: Indices, second: Indices) -> Array:
        """Points (P, K, 3) halfway between the lines of pairs of views (P, K) where these are nearest.

        NaN where the lines are parallel, or nearest behind a camera.
        """
        centers = np.array([camera.center for camera in self.cameras])
        keypoint = np.arange(self.weights.shape[1])
        a, b = self.directions[first, keypoint], self.directions[second, keypoint]
        offset = centers[second] - centers[first]
        along_a, along_b, cosine = (
            np.einsum("pki,pki->pk", left, right) for left, right in ((offset, a), (offset, b), (a, b))
        )
        with np.errstate(all="ignore"):
            square = 1 - cosine**2
            far_a, far_b = (along_a - cosine * along_b) / square, (cosine * along_a - along_b) / square
            meet = (square > _PARALLEL) & (far_a > 0) & (far_b > 0)
        points = centers[first] + far_a[..., None] * a + centers[second] + far_b[..., None] * b
        return np.where(meet[..., None], points / 2, np.nan)

    def errors(self, positions: Array) -> Array:
        """Distances (..., V, K) in pixels of positions (..., K, 3) in the images from the points.

        Infinite where a point is present and the position has no pixel; NaN where the point is absent.
        """
        flat = positions.reshape(-1, 3)
        shape = positions.shape[:-1]
        seen = np.stack([camera.project(flat)[0].reshape(*shape, 2) for camera in self.cameras], axis=-3)
        distances = np.linalg.norm(seen - self.pixels, axis=-1)
        return np.where(self.weights > 0, np.where(np.isfinite(distances), distances, np.inf), np.nan)

    def candidates(self, seed: int = 0) -> Candidates:
        """Points of all pairs of views. ``seed``: of the random choice among many pairs."""
        positions = self.meet(*self.pairs(seed))
        return Candidates(positions, self.errors(positions), self.weights)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points of P pairs of views for each of K keypoints.

    ``positions``: (P, K, 3), NaN where lines do not meet. ``errors``: (P, V, K) pixels. ``weights``: (V, K).
    """

    positions: Array
    errors: Array
    weights: Array

    def costs(self, limits: Array) -> Array:
        """Costs (P, K): each point of a view adds its confidence times the square of its error by the limit
        (V,) of the view in pixels, at most 1.
        """
        shares = np.minimum(np.nan_to_num(self.errors, nan=0.0, posinf=1e9) / limits[:, None], 1.0) ** 2
        return np.asarray(np.einsum("pvk,vk->pk", shares, self.weights))

    def best(self, costs: Array) -> Array:
        """Positions (K, 3) of least cost (P, K); NaN where no two lines meet, or all costs are infinite."""
        if not len(costs):
            return np.full((self.weights.shape[1], 3), np.nan)
        chosen, keypoint = np.argmin(costs, axis=0), np.arange(costs.shape[1])
        possible = np.isfinite(costs[chosen, keypoint])
        return np.where(possible[:, None], self.positions[chosen, keypoint], np.nan)

    def supported(self, costs: Array, limits: Array) -> Array:
        """The positions of :meth:`best` with which three points agree, or two where three views or fewer are.

        NaN for the other keypoints.
        """
        if not len(costs):
            return self.best(costs)
        chosen, keypoint = np.argmin(costs, axis=0), np.arange(costs.shape[1])
        errors = self.errors[chosen, :, keypoint]
        agree = (np.nan_to_num(errors, nan=np.inf) <= limits).sum(axis=1)
        enough = agree >= min(3, max(2, len(limits) - 1))
        return np.where(enough[:, None], self.best(costs), np.nan)
