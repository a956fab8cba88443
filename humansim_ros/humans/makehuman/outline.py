"""Radial outline of a body around a vertical axis, and surfaces that shrink onto it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.ndimage import gaussian_filter, grey_closing, map_coordinates

from humansim_ros.humans.makehuman.data import VertexIndices
from humansim_ros.types import Array

_HIGH, _WIDE = 0.008, np.radians(3.0)  # cell size: metres, radians


@dataclass(frozen=True)
class Outline:
    """Largest distance ``reach`` (H, W) by height and direction, metres from the vertical axis x = 0,
    z = ``axis``.
    """

    bottom: float
    axis: float
    reach: Array

    @classmethod
    def of(cls, vertices: Array, faces: VertexIndices, axis: float) -> Outline:
        """Outline of a surface of quads (F, 4) around the axis."""
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

    def hanging(self) -> Outline:
        """Outline of a surface that hangs down from this one: nowhere narrower than above."""
        return replace(self, reach=np.maximum.accumulate(self.reach[::-1])[::-1])

    def at(self, points: Array) -> Array:
        """Reach (N,) at the height and in the direction of points (N, 3)."""
        row = ((points[:, 1] - self.bottom) / _HIGH - 0.5).clip(0, len(self.reach) - 1)
        column = around(points, self.axis)[0] / _WIDE - 0.5
        wrapped = np.pad(self.reach, ((0, 0), (1, 1)), "wrap")
        return np.asarray(map_coordinates(wrapped, np.stack([row, column + 1]), order=1, mode="nearest"))


def around(points: Array, axis: float) -> tuple[Array, Array]:
    """Direction (N,), 0 to two pi, and distance (N,) of points (N, 3) from the axis."""
    x, z = points[:, 0], points[:, 2] - axis
    return np.arctan2(x, z) % (2 * np.pi), np.hypot(x, z)


def neighbours(faces: VertexIndices, count: int) -> sparse.csr_matrix:
    """Adjacency matrix (V, V) of the sides of quads (F, 4)."""
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    return ((graph + graph.T) > 0).astype(float).tocsr()


def mean_matrix(graph: sparse.csr_matrix) -> sparse.csr_matrix:
    """Matrix (V, V) that gives each vertex the mean of its neighbours."""
    return (sparse.diags(1 / np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)) @ graph).tocsr()


def shrink_onto(
    vertices: Array, mean: sparse.csr_matrix, free: Array, outline: Outline, rounds: int
) -> Array:
    """Smooth a surface towards the mean of its neighbours, but not into an outline.

    Folded small faces spread over the surface.

    Args:
        vertices: (V, 3).
        mean: Matrix (V, V) from :func:`mean_matrix`.
        free: Mobility of each vertex, (V,), 0 to 1.
        outline: Vertices stay outside.
        rounds: Number of smoothing steps.

    Returns:
        Vertices (V, 3).
    """
    skin = vertices.copy()
    rows = np.flatnonzero(free > 0)
    mean, pull = mean[rows], 0.5 * free[rows, None]
    for _ in range(rounds):
        moved = skin[rows] + pull * (mean @ skin - skin[rows])
        skin[rows] = push_outwards(moved, outline.at(moved), outline.axis)
    return skin


def push_outwards(points: Array, reach: Array, axis: float) -> Array:
    """Move points (N, 3) away from the axis to at least ``reach`` (N,)."""
    factor = np.maximum(reach / np.maximum(around(points, axis)[1], 1e-6), 1.0)
    out = points.copy()
    out[:, 0] *= factor
    out[:, 2] = axis + (points[:, 2] - axis) * factor
    return out
