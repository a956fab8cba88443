"""Texels of a mesh: the triangle, and the place in it, at the centre of each texel of a texture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.types import Array

#: Texels that are computed at once.
_CHUNK = 2_000_000
#: Tolerance of barycentric coordinates, so that no texel is lost between triangles.
_INSIDE = 1e-9


@dataclass(frozen=True, eq=False)
class SurfaceTexels:
    """M texels that lie in triangles, in the order of the rows of the texture.

    Attributes:
        row: (M,) row of the texel; row 0 is the top, v = 1.
        column: (M,) column.
        triangle: (M,) index of the triangle.
        weights: (M, 3) barycentric coordinates of the centre of the texel.
    """

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    triangle: NDArray[np.intp]
    weights: Array

    def part(self, start: int, stop: int) -> SurfaceTexels:
        """Texels from ``start`` to before ``stop``."""
        chosen = slice(start, stop)
        return SurfaceTexels(
            self.row[chosen], self.column[chosen], self.triangle[chosen], self.weights[chosen]
        )

    def mix(self, values: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.floating]:
        """Values of corners (T, ...) at the texels (M, ...). ``triangles``: (N, 3), indices of corners."""
        corners = triangles[self.triangle]
        out = values[corners[:, 0]] * _column(self.weights[:, 0], values)
        out += values[corners[:, 1]] * _column(self.weights[:, 1], values)
        out += values[corners[:, 2]] * _column(self.weights[:, 2], values)
        return out


def _column(weights: Array, values: NDArray[np.floating]) -> NDArray[np.floating]:
    return weights.reshape(-1, *(1,) * (values.ndim - 1)).astype(values.dtype)


def rasterise_uv(uv: Array, triangles: NDArray[np.integer], size: int) -> SurfaceTexels:
    """Find the triangle at the centre of each texel; of triangles that overlap, the last one.

    Args:
        uv: Texture coordinates (T, 2), v up.
        triangles: (N, 3) indices of texture coordinates.
        size: Side of the texture, texels.
    """
    # texel centres are at whole numbers
    corners = uv[triangles] * [size, -size] + [-0.5, size - 0.5]
    low = np.maximum(np.ceil(corners.min(axis=1) - 1e-6).astype(int), 0)
    high = np.minimum(np.floor(corners.max(axis=1) + 1e-6).astype(int), size - 1)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    extent = np.maximum(high - low + 1, 0)
    extent[area == 0] = 0
    counts = extent[:, 0] * extent[:, 1]
    owner = np.full(size * size, -1)
    weights = np.zeros((size * size, 3))
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        done = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, done + _CHUNK, side="right")), start + 1)
        own = counts[start:stop]
        number = np.repeat(np.arange(start, stop), own)
        within = np.arange(len(number)) - np.repeat(np.cumsum(own) - own, own)
        width = extent[number, 0]
        x, y = low[number, 0] + within % width, low[number, 1] + within // width
        first, second, third = a[number], b[number], c[number]
        dx, dy = x - first[:, 0], y - first[:, 1]
        wb = (dx * (third[:, 1] - first[:, 1]) - dy * (third[:, 0] - first[:, 0])) / area[number]
        wc = ((second[:, 0] - first[:, 0]) * dy - (second[:, 1] - first[:, 1]) * dx) / area[number]
        inside = (wb >= -_INSIDE) & (wc >= -_INSIDE) & (wb + wc <= 1 + _INSIDE)
        at = y[inside] * size + x[inside]
        owner[at] = number[inside]  # of repeated places, the last one stays
        wb, wc = wb[inside], wc[inside]
        weights[at] = np.stack([1 - wb - wc, wb, wc], axis=-1)
        start = stop
    found = np.flatnonzero(owner >= 0)
    return SurfaceTexels(found // size, found % size, owner[found], weights[found])
