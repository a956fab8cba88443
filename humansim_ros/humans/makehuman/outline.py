"""How far a body reaches out from an upright axis, and skins drawn taut over it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.ndimage import gaussian_filter, grey_closing, map_coordinates

from humansim_ros.humans.makehuman.data import VertexIndices
from humansim_ros.types import Array

_HIGH, _WIDE = 0.008, np.radians(3.0)  # cells: metres up, radians round


@dataclass(frozen=True)
class Outline:
    """The farthest that anything reaches (H, W), by height and direction, metres from a vertical axis at
    x = 0 and ``axis`` (z).
    """

    bottom: float
    axis: float
    reach: Array

    @classmethod
    def of(cls, vertices: Array, faces: VertexIndices, axis: float) -> Outline:
        """Of a surface of quads (F, 4) that go all round."""
        corners = vertices[faces]
        sides = [(corners[:, k] + corners[:, k - 1]) / 2 for k in range(4)]
        points = np.concatenate([vertices[np.unique(faces)], corners.mean(axis=1), *sides])
        bottom = float(points[:, 1].min())
        rows = ((points[:, 1] - bottom) / _HIGH).astype(int)
        columns = round(2 * np.pi / _WIDE)
        turn, reach = around(points, axis)
        grid = np.zeros((rows.max() + 1, columns))
        np.maximum.at(grid, (rows, (turn / _WIDE).astype(int) % columns), reach)
        padded = np.pad(np.pad(grid, ((3, 3), (0, 0)), "edge"), ((0, 0), (6, 6)), "wrap")
        smooth = gaussian_filter(grey_closing(padded, (5, 5)), 0.7)
        return cls(bottom, axis, smooth[3:-3, 6:-6])

    def falling(self) -> Outline:
        """Of what hangs down from it: nowhere less wide than above."""
        return replace(self, reach=np.maximum.accumulate(self.reach[::-1])[::-1])

    def at(self, points: Array) -> Array:
        """(N,) the reach at the height and in the direction of points (N, 3)."""
        row = ((points[:, 1] - self.bottom) / _HIGH - 0.5).clip(0, len(self.reach) - 1)
        column = around(points, self.axis)[0] / _WIDE - 0.5
        wrapped = np.pad(self.reach, ((0, 0), (1, 1)), "wrap")
        return np.asarray(map_coordinates(wrapped, np.stack([row, column + 1]), order=1, mode="nearest"))


def around(points: Array, axis: float) -> tuple[Array, Array]:
    """Direction (N,) from 0 to two pi, and distance (N,), of points (N, 3) from the axis."""
    x, z = points[:, 0], points[:, 2] - axis
    return np.arctan2(x, z) % (2 * np.pi), np.hypot(x, z)


def neighbours(faces: VertexIndices, count: int) -> sparse.csr_matrix:
    """(V, V) 1 where two vertices share a side of a quad (F, 4)."""
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    return ((graph + graph.T) > 0).astype(float).tocsr()


def averaging(graph: sparse.csr_matrix) -> sparse.csr_matrix:
    """(V, V) the matrix that gives each vertex the mean of its neighbours."""
    return (sparse.diags(1 / np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)) @ graph).tocsr()


def drawn_taut(vertices: Array, mean: sparse.csr_matrix, loose: Array, over: Outline, rounds: int) -> Array:
    """Vertices (V, 3) of a skin that shrinks where it is ``loose`` (V,), 0..1, but not into what is ``over``.

    Small faces that were folded spread over the surface.
    """
    skin = vertices.copy()
    rows = np.flatnonzero(loose > 0)
    mean, pull = mean[rows], 0.5 * loose[rows, None]
    for _ in range(rounds):
        moved = skin[rows] + pull * (mean @ skin - skin[rows])
        skin[rows] = pushed_out(moved, over.at(moved), over.axis)
    return skin


def pushed_out(points: Array, reach: Array, axis: float) -> Array:
    """Points (N, 3) that are no nearer to the axis than `reach` (N,)."""
    factor = np.maximum(reach / np.maximum(around(points, axis)[1], 1e-6), 1.0)
    out = points.copy()
    out[:, 0] *= factor
    out[:, 2] = axis + (points[:, 2] - axis) * factor
    return out
