"""Solids of meshes: their closed parts, the points inside them, and the segments that cross a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from humansim_ros.types import Array, Indices

#: Vertices closer than this share of the size of a mesh are one vertex.
_SAME_VERTEX = 1e-6
#: Point-triangle or segment-triangle pairs that are computed at once.
_BATCH = 200_000


def closed_parts(vertices: Array, triangles: Indices) -> list[Array]:
    """Connected parts of a mesh that are closed: each edge joins two triangles, in opposite directions.

    Args:
        vertices: (V, 3). Vertices at the same place count as one.
        triangles: (T, 3) vertex indices.

    Returns:
        Corners (T_part, 3, 3) of the triangles of each closed part.
    """
    if not len(triangles):
        return []
    scale = max(float(np.ptp(vertices, axis=0).max()), 1e-12) * _SAME_VERTEX
    _, merged = np.unique(np.round(vertices / scale).astype(np.int64), axis=0, return_inverse=True)
    merged = merged.ravel()[triangles]
    keep = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    merged, corners = merged[keep], vertices[triangles[keep]]
    if not len(merged):
        return []
    count = int(merged.max()) + 1
    starts, ends = merged.ravel(), np.roll(merged, -1, axis=1).ravel()
    edges = coo_matrix((np.ones(len(starts)), (starts, ends)), shape=(count, count)).tocsr()
    _, part_of_vertex = connected_components(edges, directed=False)
    difference = (edges - edges.T).tocoo()
    open_parts = np.unique(part_of_vertex[difference.row[difference.data != 0]])
    part = part_of_vertex[merged[:, 0]]
    order = np.argsort(part, kind="stable")
    numbers, first = np.unique(part[order], return_index=True)
    groups = np.split(order, first[1:])
    return [corners[group] for number, group in zip(numbers, groups, strict=True) if number not in open_parts]


def volume(corners: Array) -> float:
    """Volume of a closed part (T, 3, 3), without sign."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return abs(float(np.einsum("ij,ij->", a - corners[0, 0], np.cross(b - a, c - a)))) / 6


def points_inside(points: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether points (N, 3) are inside a closed part (T, 3, 3).

    The winding number is the sum of the solid angles of the triangles [Van Oosterom 1983].
    """
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    inside = ((points > low) & (points < high)).all(axis=1)
    candidates = np.flatnonzero(inside)
    for chunk in np.array_split(candidates, max(1, len(candidates) * len(corners) // _BATCH)):
        inside[chunk] = np.abs(_winding_numbers(points[chunk], corners)) > 0.5
    return inside


def _winding_numbers(points: Array, corners: Array) -> Array:
    a, b, c = (corners[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    triple = np.einsum("nti,nti->nt", a, np.cross(b, c))
    dots = (np.einsum("nti,nti->nt", u, v) for u, v in ((a, b), (b, c), (c, a)))
    ab, bc, ca = dots
    angles = 2 * np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb)
    return np.asarray(angles.sum(axis=1) / (4 * np.pi))


def segments_crossing(starts: Array, ends: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether segments (N, 3) to (N, 3) cross a triangle of a surface (T, 3, 3) [Moller 1997]."""
    crossing = np.zeros(len(starts), bool)
    if not len(corners) or not len(starts):
        return crossing
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    t_low, t_high = corners.min(axis=1), corners.max(axis=1)
    near = ((t_high >= low.min(axis=0)) & (t_low <= high.max(axis=0))).all(axis=1)
    corners, t_low, t_high = corners[near], t_low[near], t_high[near]
    if not len(corners):
        return crossing
    candidates = np.flatnonzero(((high >= t_low.min(axis=0)) & (low <= t_high.max(axis=0))).all(axis=1))
    for chunk in np.array_split(candidates, max(1, len(candidates) * len(corners) // _BATCH)):
        boxes = ((high[chunk, None] >= t_low) & (low[chunk, None] <= t_high)).all(axis=-1)
        segment, triangle = np.nonzero(boxes)
        segment = chunk[segment]
        hits = _crosses(starts[segment], ends[segment] - starts[segment], corners[triangle])
        crossing[segment[hits]] = True
    return crossing


def _crosses(origin: Array, direction: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether each segment (N, 3) crosses its triangle (N, 3, 3)."""
    side_1, side_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, side_2)
    determinant = np.einsum("ij,ij->i", side_1, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin - corners[:, 0]
        u = np.einsum("ij,ij->i", offset, across) / determinant
        other = np.cross(offset, side_1)
        v = np.einsum("ij,ij->i", direction, other) / determinant
        t = np.einsum("ij,ij->i", side_2, other) / determinant
        return np.asarray((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1))
