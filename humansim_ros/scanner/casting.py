"""Intersection of rays with moving triangles: the nearest surface of each ray when it is fired."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.rotations import quaternion_to_matrix
from humansim_ros.scanner.ray_index import Angles, Bounds, RayIndex
from humansim_ros.types import Array, Float32Array, FloatArray, Indices

#: Barycentric coordinates below zero that count as inside: no ray passes between two triangles.
_SEAM = 1e-9
#: Corners of a box: all choices of low and high.
_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], dtype=float)


@dataclass(frozen=True, eq=False)
class MovingTriangles:
    """Triangles that move in straight lines from one moment to another.

    Attributes:
        number: Number of the surface, for :class:`Hits`.
        triangles: (T, 3) indices of vertices.
        start: Vertices (V, 3) in ``map`` at the first moment, metres.
        end: Vertices at the second moment; the same array if it stands still.
    """

    number: int
    triangles: NDArray[np.integer]
    start: FloatArray
    end: FloatArray


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a scanner in ``map`` at the firing of N rays: one for all if it stands still.

    Attributes:
        positions: (N, 3) or (1, 3) metres.
        rotations: (N, 4) or (1, 4) unit quaternions xyzw.
    """

    positions: Array
    rotations: Array

    @property
    def still(self) -> bool:
        """Whether there is one pose for all."""
        return len(self.positions) == 1

    def take(self, chosen: Indices | slice) -> Poses:
        """Poses of some rays."""
        return self if self.still else Poses(self.positions[chosen], self.rotations[chosen])

    def to_map(self, vectors: Array) -> Array:
        """Turn vectors (N, 3) from the scanner's frame to ``map``."""
        matrices = quaternion_to_matrix(self.rotations)
        return vectors @ matrices[0].T if self.still else np.einsum("nij,nj->ni", matrices, vectors)

    def to_scanner(self, vectors: Array) -> Array:
        """Turn vectors (N, 3) from ``map`` to the scanner's frame."""
        matrices = quaternion_to_matrix(self.rotations)
        return vectors @ matrices[0] if self.still else np.einsum("nji,nj->ni", matrices, vectors)


@dataclass(frozen=True, eq=False)
class Hits:
    """Nearest surfaces of N rays.

    Attributes:
        ranges: (N,) metres; infinite where there is no surface.
        surfaces: (N,) numbers of the surfaces; -1 where there is none.
        triangles: (N,) triangles.
        weights: (N, 2) barycentric weights of the second and the third corner.
        cosines: (N,) cosine of the angle between the ray and the normal of the triangle.
    """

    ranges: Array
    surfaces: NDArray[np.int32]
    triangles: NDArray[np.int32]
    weights: Array
    cosines: Array

    @classmethod
    def none(cls, count: int) -> Hits:
        """No surface for any ray."""
        return cls(
            np.full(count, np.inf),
            np.full(count, -1, np.int32),
            np.zeros(count, np.int32),
            np.zeros((count, 2)),
            np.zeros(count),
        )

    def copy(self) -> Hits:
        """Hits whose arrays may be changed."""
        return Hits(*(part.copy() for part in self._arrays()))

    def take(self, chosen: Any) -> Hits:
        """Hits of some rays."""
        return Hits(*(part[chosen] for part in self._arrays()))

    def put(self, chosen: Indices, values: Hits) -> None:
        """Replace the hits of some rays."""
        for part, new in zip(self._arrays(), values._arrays(), strict=True):
            part[chosen] = new

    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return self.ranges, self.surfaces, self.triangles, self.weights, self.cosines


@dataclass(frozen=True, eq=False)
class Shot:
    """Rays that are fired between two moments.

    Attributes:
        directions: (N, 3) unit vectors in the scanner's frame.
        shares: (N,) time of each ray from the first moment, as a share of the time to the second.
        poses: Pose of the scanner at each ray.
        ends: Poses at the two moments (2, …), if it moves; the pose of all rays otherwise.
        index: The rays by direction.
    """

    directions: Array
    shares: Array
    poses: Poses
    ends: Poses
    index: RayIndex

    def cast(self, surfaces: Iterable[MovingTriangles], hits: Hits) -> None:
        """Find surfaces that are nearer than ``hits`` (N), which are replaced in place."""
        vectors = self.poses.to_map(self.directions)
        for surface in surfaces:
            self._cast(surface, vectors, hits)

    def _cast(self, surface: MovingTriangles, vectors: Array, hits: Hits) -> None:
        margin = self._margin(surface)
        boxes = replace(surface, start=_box(surface.start), end=_box(surface.end))
        whole = Bounds.of(np.arange(8)[None], self._seen(boxes), margin)
        if not self.index.meets(whole):
            return
        bounds = Bounds.of(surface.triangles, self._seen(surface), margin)
        for rays, triangles in self.index.pairs(bounds):
            found = self._test(surface, vectors, rays, triangles)
            if found is not None:
                _keep_nearest(hits, *found)

    def _seen(self, surface: MovingTriangles) -> tuple[Angles, ...]:
        """Directions of the vertices at both moments, once if neither they nor the scanner move."""
        moments = (
            [surface.start]
            if surface.end is surface.start and self.poses.still
            else [surface.start, surface.end]
        )
        last = len(self.ends.positions) - 1
        return tuple(
            Angles.of(
                np.asarray(vertices - self.ends.positions[min(i, last)], np.float32)
                @ quaternion_to_matrix(self.ends.rotations[min(i, last)]).astype(np.float32)
            )
            for i, vertices in enumerate(moments)
        )

    def _margin(self, surface: MovingTriangles) -> float:
        """Radians by which directions differ from straight paths in the scanner's frame, because it moves."""
        if self.poses.still:
            return 0.0
        share = self.shares[:, None]
        start, end = self.ends.positions
        off = np.linalg.norm(self.poses.positions - ((1 - share) * start + share * end), axis=1).max()
        near = max(0.05, min(_distance(start, surface.start), _distance(end, surface.end)))
        matrices = quaternion_to_matrix(self.poses.rotations)
        first, last = quaternion_to_matrix(self.ends.rotations)
        # the chord between the turned axes, and how far the axes are from it
        chord = (1 - share[:, :, None]) * first + share[:, :, None] * last
        turn = np.sqrt(((matrices - chord) ** 2).sum(axis=(1, 2)).max())
        # a point that moves while the scanner turns
        paths = max(np.abs(surface.end - surface.start).max(), np.abs(end - start).max())
        coupled = np.abs(last - first).max() * paths / near
        return float(2 * (off / near + turn + coupled))

    def _test(
        self, surface: MovingTriangles, vectors: Array, rays: Indices, triangles: Indices
    ) -> tuple[Indices, Hits] | None:
        """Rays of some pairs that meet the triangle, and where [Moller 1997]."""
        corners = surface.triangles[triangles]
        start = [surface.start[corners[:, i]].astype(float) for i in range(3)]
        if surface.end is not surface.start:
            share = self.shares[rays][:, None]
            start = [a + share * (surface.end[corners[:, i]] - a) for i, a in enumerate(start)]
        a, b, c = start
        origin = self.poses.take(rays).positions
        ray, ab, ac = vectors[rays], b - a, c - a
        p = _cross(ray, ac)
        determinant = _dot(ab, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / determinant
            from_a = origin - a
            u = _dot(from_a, p) * inverse
            q = _cross(from_a, ab)
            v = _dot(ray, q) * inverse
            distance = _dot(ac, q) * inverse
            inside = (u >= -_SEAM) & (v >= -_SEAM) & (u + v <= 1 + _SEAM) & (distance > 0)
        hit = np.flatnonzero(inside & np.isfinite(distance))
        if not len(hit):
            return None
        normal = _cross(ab[hit], ac[hit])
        cosine = np.abs(determinant[hit]) / np.sqrt(_dot(normal, normal))
        return rays[hit], Hits(
            distance[hit],
            np.full(len(hit), surface.number, np.int32),
            triangles[hit].astype(np.int32),
            np.stack([u[hit], v[hit]], axis=-1),
            np.minimum(cosine, 1.0),
        )


def _keep_nearest(hits: Hits, rays: Indices, found: Hits) -> None:
    """Put hits that are nearer in the place of earlier ones; of equal ones the first remains."""
    order = np.lexsort((found.ranges, rays))
    first = np.ones(len(order), dtype=bool)
    first[1:] = rays[order][1:] != rays[order][:-1]
    chosen = order[first]
    chosen = chosen[found.ranges[chosen] < hits.ranges[rays[chosen]]]
    hits.put(rays[chosen], found.take(chosen))


def _box(vertices: FloatArray) -> Float32Array:
    """Corners (8, 3) of the box of some vertices, along the axes."""
    low, high = _limits(vertices)
    return np.asarray(low + _CORNERS * (high - low), np.float32)


def _limits(vertices: FloatArray) -> tuple[Array, Array]:
    """Lowest and highest coordinates (3,) of vertices (V, 3)."""
    # axis by axis: three times as fast as along the first axis
    low = np.array([axis.min() for axis in vertices.T], dtype=float)
    return low, np.array([axis.max() for axis in vertices.T], dtype=float)


def _distance(point: Array, vertices: FloatArray) -> float:
    """Distance of a point from the box of some vertices."""
    low, high = _limits(vertices)
    return float(np.linalg.norm(np.maximum(0, np.maximum(low - point, point - high))))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def _cross(a: Array, b: Array) -> Array:
    ax, ay, az = a[:, 0], a[:, 1], a[:, 2]
    bx, by, bz = b[:, 0], b[:, 1], b[:, 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
