"""Layout of triangles in one image (the light map), without overlaps.

A chart is a set of connected triangles that face the same side of a cube. It is projected along the axis of
that side. The bounds of a chart run through centres of texels, with a free texel on each side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.files.mesh import welded
from humansim_ros.types import Array, Float32Array, Indices

#: Largest side of the image, and free texels on each side of a chart.
MAX_SIDE, GUTTER = 2048, 1
#: Factor by which texels grow until the charts have room.
_GROWTH = 1.2
#: Texels between the points at which charts are tested for overlaps, and how many times charts are split.
_STEP, _SPLITS = 2, 8


@dataclass(frozen=True, eq=False)
class Charts:
    """Triangles in an image of ``size`` (width, height) texels.

    ``corners``: (N, 3) vertices of the triangles; a vertex on the border of two charts exists twice.
    ``source``: (E,) index of the vertex that each one was copied from. ``coordinates``: (E, 2) texels; (0.5,
    0.5) is the centre of the first one. ``owner``: (N,) chart of each triangle. ``texel``: metres.
    """

    size: tuple[int, int]
    corners: NDArray[np.int32]
    source: Indices
    coordinates: Float32Array
    owner: Indices
    texel: float

    @classmethod
    def of(cls, positions: NDArray[np.floating], corners: NDArray[Any], texel: float) -> Charts:
        """Lay out triangles.

        Args:
            positions: (V, 3) metres.
            corners: (N, 3) vertices of the triangles.
            texel: Side of a texel in metres; larger texels are used if the triangles need too much room.
        """
        points = positions[corners].astype(float)
        normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        axis = np.abs(normals).argmax(axis=1)
        turned = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] < 0
        owner = _connected(welded(positions)[corners], 2 * axis + turned)
        flat = np.stack([np.where(axis == 0, 1, 0), np.where(axis == 2, 1, 2)], axis=1)
        plane = np.take_along_axis(points, np.repeat(flat[:, None], 3, axis=1), axis=2)
        depth = np.take_along_axis(points.mean(axis=1), axis[:, None], axis=1)[:, 0]
        layout = _Layout.of(plane, owner, texel)
        for _ in range(_SPLITS):
            # split in halves by depth, since the windings of a spiral lie above each other
            middle = np.bincount(owner, depth) / np.bincount(owner)
            upper = _overlapping(layout.coordinates, owner)[owner] & (depth > middle[owner] + 1e-6)
            if not upper.any():
                break
            owner = np.unique(2 * owner + upper, return_inverse=True)[1]
            layout = _Layout.of(plane, owner, texel)
        keys = corners.astype(np.int64) * (len(owner) + 1) + owner[:, None]
        _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        return cls(
            layout.size,
            inverse.reshape(-1, 3).astype(np.int32),
            corners.reshape(-1)[first].astype(np.intp),
            layout.coordinates.reshape(-1, 2)[first].astype(np.float32),
            owner,
            layout.texel,
        )


def _connected(corners: Indices, side: Indices) -> Indices:
    """(N,) component of each triangle. The triangles of a component share edges and face the same side."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = np.column_stack([ends, np.repeat(side, 3)])
    order = np.lexsort(keys.T)
    same = (keys[order[1:]] == keys[order[:-1]]).all(axis=1)
    first, second = order[:-1][same] // 3, order[1:][same] // 3
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(len(corners),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


@dataclass(frozen=True, eq=False)
class _Layout:
    """``coordinates``: (N, 3, 2) of the corners of triangles, in texels."""

    size: tuple[int, int]
    coordinates: Array
    texel: float

    @classmethod
    def of(cls, plane: Array, owner: Indices, texel: float) -> _Layout:
        """Place charts side by side. ``plane``: (N, 3, 2) metres along the two axes of each chart."""
        count = int(owner.max()) + 1
        low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
        np.minimum.at(low, owner, plane.min(axis=1))
        np.maximum.at(high, owner, plane.max(axis=1))
        extent = high - low
        while True:
            steps = np.where(extent > texel / 2, np.ceil(extent / texel), 0.0)
            places, size = _shelves(steps.astype(np.intp) + 1 + 2 * GUTTER)
            if max(size) <= MAX_SIDE or not steps.any():
                break
            texel *= _GROWTH
        scale = steps / np.maximum(extent, 1e-12)
        inside = (plane - low[owner, None]) * scale[owner, None]
        return cls(size, inside + (places[owner, None] + GUTTER + 0.5), texel)


def _shelves(sizes: Indices) -> tuple[Indices, tuple[int, int]]:
    """Place rectangles (N, 2) in rows: their first corners (N, 2), and the size of the whole layout."""
    order = np.lexsort((-sizes[:, 0], -sizes[:, 1]))
    widths, heights = sizes[order].T
    width = max(int(np.sqrt(sizes.prod(axis=1).sum())), int(widths.max()))
    ends, places = np.cumsum(widths), np.empty_like(sizes)
    first = top = 0
    while first < len(order):
        left = ends[first] - widths[first]
        end = int(np.searchsorted(ends, left + width, side="right"))
        row = slice(first, end)
        places[order[row]] = np.column_stack([ends[row] - widths[row] - left, np.full(end - first, top)])
        top, first = top + int(heights[first]), end
    return places, (width, top)


def _overlapping(coordinates: Array, owner: Indices) -> NDArray[np.bool_]:
    """(C,) whether each chart covers some point twice. ``coordinates``: (N, 3, 2) texels."""
    first, end = (np.ceil(bound(coordinates / _STEP, axis=1)).astype(np.intp) for bound in (np.min, np.max))
    columns, rows = np.maximum(end - first, 0).T
    triangle = np.repeat(np.arange(len(owner)), columns * rows)
    number = np.arange(len(triangle)) - np.repeat(np.cumsum(columns * rows) - columns * rows, columns * rows)
    cell = first[triangle] + np.stack(np.divmod(number, np.maximum(columns, 1)[triangle])[::-1], axis=1)
    a, b, c = (coordinates[triangle, i] - _STEP * cell for i in range(3))
    areas = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a))])
    within = (areas > 1e-6).all(axis=0) | (areas < -1e-6).all(axis=0)
    cell, triangle = cell[within], triangle[within]
    _, inverse, counts = np.unique(
        cell[:, 0] * (int(cell.max(initial=0)) + 1) + cell[:, 1], return_inverse=True, return_counts=True
    )
    twice = np.zeros(int(owner.max()) + 1, bool)
    twice[owner[triangle[counts[inverse] > 1]]] = True
    return twice
