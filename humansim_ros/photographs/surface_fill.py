"""Colours of parts of a person that no photograph shows: from the other side of the body and from nearby."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array, Indices

#: Greatest distance of a vertex from the mirror image of another one, as a share of the height.
_MIRROR = 0.008


@dataclass(frozen=True, eq=False)
class Surface:
    """Topology of a mesh at rest, where vertices at the same place are one.

    Attributes:
        mesh: The mesh at rest; x is the person's left.
        place: (V,) number of the place of each vertex.
        points: (P, 3) places.
    """

    mesh: Mesh
    place: Indices
    points: Array

    @classmethod
    def of(cls, mesh: Mesh) -> Surface:
        """Surface of a mesh."""
        points, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
        return cls(mesh, place.reshape(-1), points)

    def places(self, vertices: NDArray[np.floating]) -> Array:
        """Places (P, 3) from vertices (V, 3) of the mesh in a pose."""
        points = np.zeros((len(self.points), 3))
        points[self.place] = vertices
        return points

    @cached_property
    def triangles(self) -> Indices:
        """(N, 3) places of the corners of the triangles."""
        return np.asarray(self.place[self.mesh.triangles])

    @cached_property
    def graph(self) -> csr_matrix:
        """(P, P) edges, weighted by the inverse of their length."""
        sides = self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        sides = np.unique(np.sort(sides, axis=1), axis=0)
        sides = sides[sides[:, 0] != sides[:, 1]]
        lengths = np.linalg.norm(self.points[sides[:, 0]] - self.points[sides[:, 1]], axis=1)
        values = 1 / np.maximum(lengths, 1e-6 * max(float(np.ptp(self.points)), 1e-6))
        count = len(self.points)
        half = coo_matrix((values, (sides[:, 0], sides[:, 1])), (count, count))
        return csr_matrix(half + half.T)

    @cached_property
    def mirrored(self) -> Indices:
        """(P,) place on the other side of the body; -1 where there is none."""
        distance, other = cKDTree(self.points).query(self.points * [-1, 1, 1])
        height = float(np.ptp(self.points[:, 1]))
        return np.where(distance < _MIRROR * height, other, -1)

    @cached_property
    def mirrored_triangles(self) -> tuple[Indices, Indices]:
        """Triangle (N,) on the other side of the body, -1 if there is none, and for each of its corners the
        corner of the triangle itself (N, 3).
        """
        opposite = self.mirrored[self.triangles]
        order, other = np.argsort(opposite, axis=1), np.argsort(self.triangles, axis=1)
        count = len(self.points)

        def keys(corners: Indices) -> Indices:
            return np.asarray((corners[:, 0] * count + corners[:, 1]) * count + corners[:, 2])

        own = keys(np.take_along_axis(self.triangles, other, axis=1))
        wanted = keys(np.take_along_axis(opposite, order, axis=1))
        by_key = np.argsort(own, kind="stable")
        at = np.minimum(np.searchsorted(own, wanted, sorter=by_key), len(own) - 1)
        found = by_key[at]
        exists = (own[found] == wanted) & (opposite >= 0).all(axis=1)
        corner = np.zeros_like(order)
        np.put_along_axis(corner, other[found], order, axis=1)
        return np.where(exists, found, -1), corner

    def smoothed(self, values: NDArray[np.floating], rounds: int) -> NDArray[np.floating]:
        """Values (P, ...) averaged with their neighbours."""
        step = diags(1 / np.maximum(np.asarray(self.graph.sum(axis=1)).ravel(), 1e-12)) @ self.graph
        for _ in range(rounds):
            values = 0.5 * values + 0.5 * (step @ values)
        return values


def fill_colours(surface: Surface, colours: Array, seen: NDArray[np.bool_], symmetry: bool = True) -> Array:
    """Colours (P, 3) of all places, from those that are seen.

    Hidden places continue the colours at their border as smoothly as possible. Where the other side of the
    body is seen, they also have its differences of colour (Poisson's equation on the surface [Perez 2003]).
    Parts without any seen place take the colour of the nearest one.

    Args:
        surface: The surface.
        colours: (P, 3); only those of seen places are used.
        seen: (P,) the colour is known; some are.
        symmetry: Use the other side of the body.
    """
    out = np.array(colours, dtype=float)
    hidden = ~seen
    if not hidden.any():
        return out
    count, component = connected_components(surface.graph, directed=False)
    reached = np.bincount(component[seen], minlength=count) > 0
    free = hidden & reached[component]
    if free.any():
        graph = surface.graph
        laplacian = csr_matrix(diags(np.asarray(graph.sum(axis=1)).ravel()) - graph)
        guide = np.zeros_like(out)
        if symmetry:
            guide = _guide(surface, out, seen, free)
        rows = laplacian[free]
        right = guide[free] - rows[:, seen] @ out[seen]
        matrix = rows[:, free].tocsc()
        out[free] = splu(matrix + 1e-9 * diags(matrix.diagonal())).solve(right)
    alone = hidden & ~free
    if alone.any():
        _, nearest = cKDTree(surface.points[seen]).query(surface.points[alone])
        out[alone] = out[seen][nearest]
    return np.clip(out, 0, 255)


def _guide(surface: Surface, colours: Array, seen: NDArray[np.bool_], free: NDArray[np.bool_]) -> Array:
    """Sum (P, 3) over the edges of each place of weighted differences of the mirror image, where known."""
    other = surface.mirrored
    known = (other >= 0) & seen[np.maximum(other, 0)]
    image = np.where(known[:, None], colours[np.maximum(other, 0)], 0.0)
    edges = surface.graph.tocoo()
    both = known[edges.row] & known[edges.col] & (free[edges.row] | free[edges.col])
    row, column, weight = edges.row[both], edges.col[both], edges.data[both]
    guide = np.zeros_like(colours, dtype=float)
    np.add.at(guide, row, weight[:, None] * (image[row] - image[column]))
    return guide
