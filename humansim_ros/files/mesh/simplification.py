"""Levels of detail of a mesh: edges have collapsed into one of their vertices, so that the vertices of a
level are a subset. ``tools/assets/simplify_humans.py`` makes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.types import Array, Indices


@dataclass(frozen=True)
class Simplification:
    """Simpler versions of a mesh. Level 0 is the mesh itself.

    ``parents``: (V,) vertex that each vertex collapses into. A vertex that stays at all levels has its own
    number. ``coordinate_parents``: (T,) the same for texture coordinates. ``removed_at``: (V,) first level
    without the vertex, 255 if the vertex stays. ``errors``: (K + 1,) metres, one per level. 95 % of the
    vertices are nearer to the surface of the level than this, in all poses.
    """

    parents: Indices
    coordinate_parents: Indices
    removed_at: NDArray[np.uint8]
    errors: Array

    @cached_property
    def counts(self) -> Indices:
        """(K + 1,) number of vertices of each level, of the mesh itself first."""
        return np.array([int((self.removed_at > number).sum()) for number in range(len(self.errors))])

    def level(
        self, number: int, triangles: NDArray[np.integer], coordinates: NDArray[np.integer]
    ) -> tuple[Indices, Indices]:
        """Triangles (N, 3) of a level, and their texture coordinates (N, 3), as indices into the arrays of
        the mesh."""
        vertices = self.vertices_of(number)
        stays = self.removed_at > number
        owner = np.zeros(len(self.coordinate_parents), np.intp)
        owner[coordinates] = triangles
        found = followed(self.coordinate_parents, stays[owner])
        return without_degenerate(vertices[triangles], found[coordinates])

    def vertices_of(self, number: int) -> Indices:
        """(V,) vertex of a level that stands for each vertex."""
        return followed(self.parents, self.removed_at > number)


def without_degenerate(triangles: Indices, coordinates: Indices) -> tuple[Indices, Indices]:
    """Triangles (N, 3) with three different vertices, and their texture coordinates (N, 3)."""
    a, b, c = triangles.T
    keep = (a != b) & (b != c) & (c != a)
    return triangles[keep], coordinates[keep]


def followed(parents: Indices, stays: NDArray[np.bool_]) -> Indices:
    """(V,) vertex that each vertex collapses into in the end: its first ancestor that stays."""
    found = np.where(stays, np.arange(len(parents)), parents)
    while not stays[found].all() and not np.array_equal(
        further := np.where(stays[found], found, parents[found]), found
    ):
        found = further
    return found


def compact(triangles: Indices) -> tuple[Indices, NDArray[np.int32]]:
    """Vertices (v,) that triangles use, and the triangles (N, 3) as indices into these vertices."""
    kept, inverse = np.unique(triangles, return_inverse=True)
    return kept, inverse.reshape(-1, 3).astype(np.int32)
