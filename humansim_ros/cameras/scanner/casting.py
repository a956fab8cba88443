"""Find the surface that each ray of a scanner meets first, among triangles that move.

Rays with similar elevations form a row, in which they are sorted by azimuth. A triangle, with the space
through which it moves, has bounds in both angles. The rays within the bounds are a few runs of consecutive
rays, so that no tree is needed.

Along an arc between two directions the tangent of the elevation is A cos(azimuth - a), so on the arc it is at
most 1 / cos(half of the difference of azimuths) times its larger end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import SceneError
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.types import Array, Float32Array, FloatArray, Indices

#: Negative barycentric coordinates down to -_SEAM count as inside, so that no ray passes between triangles.
_SEAM = 1e-9
#: A surface is around the scanner if it is nearer than this, metres.
_AROUND = 0.3
#: Corners of a box, as all choices of low and high along the axes.
_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], dtype=float)


@dataclass(frozen=True, eq=False)
class MovingTriangles:
    """Triangles that move in straight lines from one moment to another.

    ``number``: number of the surface, for :class:`Hits`. ``triangles``: (T, 3) indices of vertices.
    ``start``, ``end``: vertices (V, 3) in ``map`` at both moments, metres; the same array if the surface does
    not move.
    """

    number: int
    triangles: NDArray[np.integer]
    start: FloatArray
    end: FloatArray

    def at(self, share: float) -> FloatArray:
        """Vertices (V, 3) after a share of the time between the two moments."""
        if self.end is self.start:
            return self.start
        return self.start + np.float32(share) * (self.end - self.start)


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a scanner in ``map`` when N rays are fired; one pose for all if the scanner stands still.

    ``positions``: (N, 3) or (1, 3) metres. ``rotations``: (N, 4) or (1, 4) unit quaternions xyzw.
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
    """The first surface that each of N rays meets.

    ``ranges``: (N,) metres; infinite if the ray meets no surface. ``surfaces``: (N,) number of the surface,
    -1 for none. ``triangles``: (N,) index of the triangle in the surface. ``weights``: (N, 2) barycentric
    weights of the second and third corner of the triangle. ``cosines``: (N,) cosine of the angle between the
    ray and the normal of the triangle.
    """

    ranges: Array
    surfaces: NDArray[np.int32]
    triangles: NDArray[np.int32]
    weights: Array
    cosines: Array

    @classmethod
    def none(cls, count: int) -> Hits:
        """Hits of rays that meet no surface."""
        return cls(
            np.full(count, np.inf),
            np.full(count, -1, np.int32),
            np.zeros(count, np.int32),
            np.zeros((count, 2)),
            np.zeros(count),
        )

    def copy(self) -> Hits:
        """A copy with arrays that may be changed."""
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
    """Rays that are fired between two moments, with the pose of the scanner for each ray.

    ``directions``: (N, 3) unit vectors in the scanner's frame. ``shares``: (N,) time of each ray, as a share
    of the time from the first moment to the second; ascending. ``index``: finds rays by direction.
    """

    directions: Array
    shares: Array
    poses: Poses
    index: RayIndex

    def cast(self, surfaces: Sequence[MovingTriangles], hits: Hits) -> None:
        """Find surfaces that are nearer than ``hits`` (N). The hits are replaced in place.

        Raises:
            SceneError: There are too many triangles near the scanner.
        """
        if not surfaces or not len(self.shares):
            return
        vectors = self.poses.to_map(self.directions)
        for surface, first, last in self._near(surfaces):
            span = surface, first, last
            bounds = Bounds.of(surface.triangles, self._seen(*span), self._margin(*span))
            order, near = self._by_distance(surface, first, last)
            for rays, triangles in self.index.pairs(bounds if order is None else bounds.take(order)):
                if order is not None:
                    open_rays = hits.ranges[rays] > near[triangles]
                    rays, triangles = rays[open_rays], order[triangles[open_rays]]
                found = self._test(surface, vectors, rays, triangles)
                if found is not None:
                    _keep_nearest(hits, *found)

    def _near(self, surfaces: Sequence[MovingTriangles]) -> Iterator[tuple[MovingTriangles, int, int]]:
        """Surfaces with bounding boxes that rays meet, with the first and the last of these rays."""
        starts, ends = (
            np.concatenate([_box(getattr(surface, moment)) for surface in surfaces])
            for moment in ("start", "end")
        )
        corners = np.arange(8 * len(surfaces)).reshape(-1, 8)
        whole = 0, len(self.shares) - 1
        margins = np.array([self._margin(surface, *whole) for surface in surfaces])
        boxes = Bounds.of(corners, self._seen(MovingTriangles(-1, corners, starts, ends), *whole), margins)
        first, last = np.full(len(surfaces), len(self.shares)), np.full(len(surfaces), -1)
        for rays, numbers in self.index.pairs(boxes):
            np.minimum.at(first, numbers, rays)
            np.maximum.at(last, numbers, rays)
        for number in np.flatnonzero(last >= 0).tolist():
            yield surfaces[number], int(first[number]), int(last[number])

    def _by_distance(self, surface: MovingTriangles, first: int, last: int) -> tuple[Indices | None, Array]:
        """Order of the triangles by distance, and a lower bound of each distance. Both hold for all rays from
        the first to the last. The order is None if the surface is not around the scanner. A surface around
        the scanner needs the order: each triangle meets many rays, which mostly hit a nearer triangle
        first."""
        positions = self.poses.take(slice(first, last + 1)).positions
        if _distance(positions[0], surface.start) > _AROUND:
            return None, np.zeros(0)
        corners = surface.at(self.shares[first])[surface.triangles]
        middles = corners.mean(axis=1)
        radii = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
        moved = np.linalg.norm(positions - positions[0], axis=1).max()
        if surface.end is not surface.start:
            moved += np.linalg.norm(surface.end - surface.start, axis=1).max()
        near = np.linalg.norm(middles - positions[0], axis=1) - radii - moved
        order = np.argsort(near)
        return order, near[order]

    def _seen(self, surface: MovingTriangles, first: int, last: int) -> tuple[Angles, ...]:
        """Directions of the vertices at the times of the first and the last ray. One entry if nothing
        moves."""
        still = surface.end is surface.start and self.poses.still
        seen = []
        for ray in (first,) if still else (first, last):
            here = self.poses.take(slice(ray, ray + 1))
            turn = quaternion_to_matrix(here.rotations[0]).astype(np.float32)
            seen.append(Angles.of((surface.at(self.shares[ray]) - here.positions).astype(np.float32) @ turn))
        return tuple(seen)

    def _margin(self, surface: MovingTriangles, first: int, last: int) -> float:
        """Largest angle (radians) by which directions of vertices deviate from straight paths, in the
        scanner's frame, while the scanner moves."""
        if self.poses.still or first == last:
            return 0.0
        here = self.poses.take(slice(first, last + 1))
        shares = self.shares[first : last + 1]
        share = ((shares - shares[0]) / max(shares[-1] - shares[0], 1e-12))[:, None]
        start, end = here.positions[0], here.positions[-1]
        off = np.linalg.norm(here.positions - ((1 - share) * start + share * end), axis=1).max()
        axes = quaternion_to_matrix(here.rotations)
        chord = (1 - share[:, :, None]) * axes[0] + share[:, :, None] * axes[-1]
        turn = np.sqrt(((axes - chord) ** 2).sum(axis=(1, 2)).max())
        # points that move while the axes turn
        turned, paths = np.sqrt(((axes[-1] - axes[0]) ** 2).sum()), np.linalg.norm(end - start)
        if surface.end is not surface.start:
            paths += np.linalg.norm(surface.end - surface.start, axis=1).max()
        distance = min(_distance(start, surface.start), _distance(end, surface.end)) - paths
        near = max(0.05, float(distance))
        return float(2 * (off / near + turn + turned * paths / near))

    def _test(
        self, surface: MovingTriangles, vectors: Array, rays: Indices, triangles: Indices
    ) -> tuple[Indices, Hits] | None:
        """Test pairs of ray and triangle [Moller 1997]. Returns the rays that meet their triangle, and their
        hits."""
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
    """Replace hits by ``found`` hits of ``rays`` that are nearer. Of equal hits, the earlier one remains."""
    order = np.lexsort((found.ranges, rays))
    first = np.ones(len(order), dtype=bool)
    first[1:] = rays[order][1:] != rays[order][:-1]
    chosen = order[first]
    chosen = chosen[found.ranges[chosen] < hits.ranges[rays[chosen]]]
    hits.put(rays[chosen], found.take(chosen))


def _box(vertices: FloatArray) -> Float32Array:
    """Corners (8, 3) of the bounding box of vertices."""
    low, high = _limits(vertices)
    return np.asarray(low + _CORNERS * (high - low), np.float32)


def _limits(vertices: FloatArray) -> tuple[Array, Array]:
    """Lowest and highest coordinates (3,) of vertices (V, 3)."""
    # axis by axis, which is three times as fast as along the first axis
    low = np.array([axis.min() for axis in vertices.T], dtype=float)
    return low, np.array([axis.max() for axis in vertices.T], dtype=float)


def _distance(point: Array, vertices: FloatArray) -> float:
    """Distance of a point from the bounding box of vertices."""
    low, high = _limits(vertices)
    return float(np.linalg.norm(np.maximum(0, np.maximum(low - point, point - high))))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def _cross(a: Array, b: Array) -> Array:
    ax, ay, az = a[:, 0], a[:, 1], a[:, 2]
    bx, by, bz = b[:, 0], b[:, 1], b[:, 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


#: Number of rows into which elevations are divided (one row per elevation, if there are at most
#: ``_MOST_ROWS`` elevations); and number of columns into which a turn is divided.
_ROWS, _MOST_ROWS, _COLUMNS = 128, 256, 2048
#: Radians by which bounds are enlarged, since single precision rounds.
_MARGIN = 1e-5
#: If the azimuths of a triangle span more than this, all azimuths are tried.
_WIDE = 2.4
#: Number of pairs of ray and triangle that are tested at once.
_BATCH = 1 << 17
#: Most pairs of the rays between two frames with the triangles of one surface.
_MAX_PAIRS = 30_000_000
_TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Angles:
    """Azimuth (radians) and tangent of the elevation of points (V,), seen from the origin of a scanner. A
    point on the axis of the scanner has no azimuth. Its tangent is infinite."""

    azimuth: FloatArray
    tangent: FloatArray

    @classmethod
    def of(cls, points: FloatArray) -> Angles:
        """Angles of points (V, 3) in the scanner's frame."""
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        flat = np.sqrt(x * x + y * y)
        with np.errstate(divide="ignore", invalid="ignore"):
            return cls(np.arctan2(y, x), z / flat)


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of triangles (T,): first azimuth, width in azimuth, and lowest and highest tangent of elevation
    (see :func:`_bounded`)."""

    azimuth: FloatArray
    width: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(
        cls, corners: NDArray[np.integer], moments: tuple[Angles, ...], margin: float | Array = 0.0
    ) -> Bounds:
        """Bounds of triangles that move from moment to moment.

        Args:
            corners: (T, K) indices of the points of each triangle or other convex body.
            moments: The points at the moments between which they move in straight lines.
            margin: Radians by which directions may deviate from straight lines: (T,), or one number for all.
        """
        first = moments[0].azimuth[corners[:, 0]]
        low = high = None
        left, right = np.zeros_like(first), np.zeros_like(first)
        for angles in moments:
            for corner in corners.T:
                tangent = angles.tangent[corner]
                low = tangent if low is None else np.minimum(low, tangent)
                high = tangent if high is None else np.maximum(high, tangent)
                offset = angles.azimuth[corner] - first
                offset -= np.float32(_TURN) * np.rint(offset * np.float32(1 / _TURN))
                np.minimum(left, offset, out=left)
                np.maximum(right, offset, out=right)
        assert low is not None and high is not None
        width = right - left
        bulge = 1 / np.cos(np.minimum(width, _WIDE) / 2)
        with np.errstate(invalid="ignore", over="ignore"):
            steep = np.maximum(np.abs(low), np.abs(high))
            tolerance = np.asarray(_MARGIN + margin, steep.dtype) * (1 + steep * steep)
            low = np.where(low < 0, low * bulge, low) - tolerance
            high = np.where(high > 0, high * bulge, high) + tolerance
            sideways = np.asarray(_MARGIN + margin, steep.dtype) * np.sqrt(1 + steep * steep)
        # a triangle around the axis or at the origin may meet any ray
        wide = ~(width + 2 * sideways < _WIDE)
        return cls(
            np.where(wide, -np.pi, first + left - sideways),
            np.where(wide, _TURN, width + 2 * sideways),
            np.where(wide, -1.0, _bounded(low)),
            np.where(wide, 1.0, _bounded(high)),
        )

    def take(self, chosen: Indices) -> Bounds:
        """Bounds of some triangles."""
        return Bounds(self.azimuth[chosen], self.width[chosen], self.low[chosen], self.high[chosen])


def _bounded(tangent: FloatArray) -> FloatArray:
    """Map tangents of elevations to numbers from -1 to 1. The order does not change."""
    return tangent / (1 + np.abs(tangent))


class RayIndex:
    """Finds rays by their direction. ``directions``: (N, 3) in the scanner's frame."""

    def __init__(self, directions: Array) -> None:
        angles = Angles.of(directions)
        steep = np.isinf(angles.tangent)
        height = np.where(steep, np.sign(directions[:, 2]), _bounded(np.where(steep, 0.0, angles.tangent)))
        row = _rows(height)
        count = int(row.max()) + 1 if len(row) else 0
        azimuth = np.mod(angles.azimuth, _TURN)
        column = np.minimum((azimuth * (_COLUMNS / _TURN)).astype(np.int64), _COLUMNS - 1)
        # two turns, so that a range of azimuths is always one run
        cell = np.concatenate([row, row]) * (2 * _COLUMNS) + np.concatenate([column, column + _COLUMNS])
        order = np.argsort(cell, kind="stable")
        self._rays: Indices = np.where(order < len(row), order, order - len(row))
        self._azimuths, self._heights = (part[self._rays].astype(np.float32) for part in (azimuth, height))
        counts = np.bincount(cell, minlength=count * 2 * _COLUMNS)
        self._starts = np.concatenate([[0], np.cumsum(counts)])
        self._low, self._high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(self._low, row, height)
        np.maximum.at(self._high, row, height)

    def pairs(self, bounds: Bounds) -> Iterator[tuple[Indices, Indices]]:
        """Batches of pairs of a ray and a triangle with bounds around the ray: numbers of both.

        Raises:
            SceneError: There are too many pairs, so that the test would take seconds.
        """
        triangle, start, count = self._runs(bounds)
        ends = np.cumsum(count)
        if len(ends) and ends[-1] > _MAX_PAIRS:
            raise SceneError("too many triangles are around a laser scanner: is it within a mesh?")
        begin = 0
        while begin < len(count):
            before = ends[begin - 1] if begin else 0
            end = max(begin + 1, int(np.searchsorted(ends, before + _BATCH, side="right")))
            counts, total = count[begin:end], int(ends[end - 1] - before)
            run = np.repeat(np.arange(begin, end), counts)
            place = start[run] + np.arange(total) - (ends[run] - count[run] - before)
            yield self._within(bounds, place, triangle[run])
            begin = end

    def _within(self, bounds: Bounds, place: Indices, triangle: Indices) -> tuple[Indices, Indices]:
        """Keep the pairs with the ray within the bounds. Columns and rows find rays near the bounds, too."""
        offset = self._azimuths[place] - bounds.azimuth[triangle]
        offset -= np.float32(_TURN) * np.floor(offset * np.float32(1 / _TURN))
        height = self._heights[place]
        inside = offset <= bounds.width[triangle]
        inside &= (height >= bounds.low[triangle]) & (height <= bounds.high[triangle])
        return self._rays[place[inside]], triangle[inside]

    def _runs(self, bounds: Bounds) -> tuple[Indices, Indices, Indices]:
        """Triangle, start and length of each run of rays within bounds."""
        first = np.searchsorted(self._high, bounds.low, side="left")
        rows = np.searchsorted(self._low, bounds.high, side="right") - first
        triangle = np.flatnonzero(rows > 0)
        rows = rows[triangle]
        scale = _COLUMNS / _TURN
        azimuth, width = bounds.azimuth[triangle], bounds.width[triangle]
        left = np.floor(azimuth * scale).astype(np.int64)
        right = np.minimum(np.floor((azimuth + width) * scale).astype(np.int64), left + _COLUMNS - 1)
        right -= left
        left = np.mod(left, _COLUMNS)
        run = np.repeat(np.arange(len(triangle)), rows)
        row = first[triangle][run] + np.arange(len(run)) - np.repeat(np.cumsum(rows) - rows, rows)
        cell = row * (2 * _COLUMNS) + left[run]
        start = self._starts[cell]
        count = self._starts[cell + right[run] + 1] - start
        some = count > 0
        return triangle[run[some]], start[some], count[some]


def _rows(height: Array) -> Indices:
    """Row (N,) of each ray. Each elevation has its row; if there are many, a range of elevations has one
    row."""
    _, row = np.unique(np.rint(height * 1e7).astype(np.int64), return_inverse=True)
    if row.size and row.max() >= _MOST_ROWS:
        low, high = height.min(), height.max()
        _, row = np.unique(((height - low) / (high - low) * (_ROWS - 1e-6)).astype(int), return_inverse=True)
    return np.asarray(row.ravel(), dtype=np.intp)
