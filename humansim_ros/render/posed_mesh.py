"""Meshes posed in a frame: quantities that all cameras share are computed once."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.contact_shadow import ContactShadow, contact_shadow
from humansim_ros.types import Float32Array, Indices

#: Largest ratio of the length of an edge to its length at rest.
_STRETCH = 2.0
#: Metres between surface samples, and the largest number of samples along an edge.
_SAMPLE, _MAX_PIECES = 0.04, 48


class Topology:
    """Triangles, edges and rest shape of a mesh of N triangles and V vertices. It does not refer to the mesh.

    ``corners``: three of (N,), the vertices of the triangles. ``edges``: (E, 2) vertices. ``sides``: two of
    (E,), the triangles on both sides of each edge; ``border``: (E,) true for edges of one triangle. An edge
    that more than two triangles share is listed once for each pair of neighbours.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._triangles, self._rest_vertices = mesh.triangles, mesh.vertices
        triangles = mesh.triangles.astype(np.intp)
        self.corners = tuple(np.ascontiguousarray(column) for column in triangles.T)
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        order = np.lexsort(edges.T)
        edges, owner = edges[order], order // 3
        same = (edges[1:] == edges[:-1]).all(axis=1)
        alone = ~(np.append(same, False) | np.insert(same, 0, False))
        first, second = owner[:-1][same], owner[1:][same]
        self.edges = np.concatenate([edges[:-1][same], edges[alone]])
        self.sides = (np.concatenate([first, owner[alone]]), np.concatenate([second, owner[alone]]))
        self.border = np.arange(len(self.edges)) >= len(first)

    @cached_property
    def _by_length(self) -> tuple[Float32Array, NDArray[np.intp]]:
        starts, ends = self._rest_vertices[self.edges].transpose(1, 0, 2)
        length = np.linalg.norm(ends - starts, axis=1)
        order = np.argsort(length)
        return np.asarray(length[order], dtype=np.float32), self.edges[order]

    def edges_longer(self, length: float) -> NDArray[np.intp]:
        """(E, 2) edges that are longer than ``length`` metres in some pose."""
        lengths, edges = self._by_length
        return edges[int(np.searchsorted(lengths, length / _STRETCH)) :]

    @cached_property
    def vertex_triangles(self) -> Any:
        """(V, N) sparse matrix that sums over the triangles around each vertex."""
        from scipy.sparse import csr_matrix

        n = len(self._triangles)
        rows, columns = self._triangles.ravel(), np.repeat(np.arange(n), 3)
        shape = (len(self._rest_vertices), n)
        return csr_matrix((np.ones(3 * n, dtype=np.float32), (rows, columns)), shape=shape)

    @cached_property
    def vertex_areas(self) -> Float32Array:
        """(V,) surface area of each vertex at rest: a third of its triangles, square metres."""
        area = np.linalg.norm(PosedMesh(self, self._rest_vertices.astype(np.float32)).areas, axis=0)
        return np.asarray(self.vertex_triangles @ area / 3, dtype=np.float32)


class PosedMesh:
    """A mesh with vertices (V, 3) float32. Derived arrays have the coordinates first: (3, V), (3, N)."""

    def __init__(self, topology: Topology, vertices: Float32Array) -> None:
        self.topology = topology
        self.vertices = vertices
        self.points: Float32Array = np.ascontiguousarray(vertices.T)

    @cached_property
    def _first_corners(self) -> Float32Array:
        return self.points.take(self.topology.corners[0], axis=1)

    @cached_property
    def areas(self) -> Float32Array:
        """(3, N) area vectors of the triangles: outward normal times area."""
        a = self._first_corners
        b, c = (self.points.take(corner, axis=1) - a for corner in self.topology.corners[1:])
        areas = np.empty_like(a)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            np.multiply(b[j], c[k], out=areas[i])
            areas[i] -= b[k] * c[j]
        areas *= np.float32(0.5)
        return areas

    @cached_property
    def _planes(self) -> Float32Array:
        return np.einsum("ij,ij->j", self.areas, self._first_corners)

    @cached_property
    def normals(self) -> Float32Array:
        """(V, 3) unit vertex normals: area-weighted means of the triangle normals."""
        triangles = self.topology.vertex_triangles
        normals = np.stack([triangles @ component for component in self.areas])
        normals /= np.maximum(np.sqrt(np.einsum("ij,ij->j", normals, normals)), np.float32(1e-20))
        return np.ascontiguousarray(normals.T)

    @cached_property
    def human_shadow(self) -> ContactShadow:
        """Contact shadow, from the vertices."""
        return contact_shadow(self.points, self.topology.vertex_areas)

    @cached_property
    def object_shadow(self) -> ContactShadow:
        """Contact shadow, from samples: an object may have few vertices and may be scaled."""
        return contact_shadow(*self.samples)

    @property
    def samples(self) -> tuple[Float32Array, Float32Array]:
        """Points (3, M) evenly over the surface, and the area (M,) of each."""
        corners = np.stack([self.points.take(corner, axis=1) for corner in self.topology.corners])
        area = np.linalg.norm(self.areas, axis=0)
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max(axis=0)
        pieces = np.clip(np.ceil(longest / _SAMPLE), 1, _MAX_PIECES).astype(np.intp)
        points, areas = [], []
        for n in np.unique(pieces).tolist():
            chosen = np.flatnonzero(pieces == n)
            i, j = np.divmod(np.arange(n * n), n)
            # a square of cell centers, folded over its diagonal
            u, v = (i + 0.5) / n, (j + 0.5) / n
            u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
            weights = np.stack([1 - u - v, u, v]).astype(np.float32)
            points.append(np.einsum("ks,kcn->cns", weights, corners[..., chosen]).reshape(3, -1))
            areas.append(np.repeat(area[chosen] / (n * n), n * n))
        return np.concatenate(points, axis=1), np.concatenate(areas).astype(np.float32)

    def facing(self, eye: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(N,) whether each triangle shows its front to a point."""
        # without BLAS: the rounding of its threads depends on the machine
        return np.asarray(np.einsum("i,ij->j", eye.astype(np.float32), self.areas) > self._planes)

    def contour(self, facing: NDArray[np.bool_]) -> tuple[Indices, Indices]:
        """Start and end vertices (C,) of the contour edges, on which all outlines lie.

        A contour edge separates a front face from a back face, or is a border of the surface.
        """
        first, second = self.topology.sides
        chosen = np.flatnonzero((facing.take(first) != facing.take(second)) | self.topology.border)
        starts, ends = self.topology.edges.take(chosen, axis=0).T
        return starts, ends
