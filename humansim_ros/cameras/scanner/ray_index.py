"""Rays by direction, and the rays that may meet each triangle.

Rays with similar elevations form a row, in which they are sorted by azimuth. A triangle, with the space
through which it moves, has bounds in both angles. The rays within the bounds are a few runs of consecutive
rays, so that no tree is needed.

Along an arc between two directions the tangent of the elevation is A cos(azimuth - a), so on the arc it is at
most 1 / cos(half of the difference of azimuths) times its larger end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import SceneError
from humansim_ros.types import Array, FloatArray, Indices

#: Number of rows of rays, but one row per elevation if there are at most ``_MOST_ROWS`` elevations; and
#: columns of a turn.
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
        """Bounds of all that lies between points at several moments.

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
    """Rays by direction. ``directions``: (N, 3) in the scanner's frame."""

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
        """Batches of pairs: numbers of rays, and of the triangles with bounds around them.

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
        """Keep the pairs with the ray within the bounds of the triangle, since columns and rows are
        coarser."""
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
