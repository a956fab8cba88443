"""A body as it stands in a frame, ready to be drawn: what is the same for all cameras is worked out once."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.contact_shadow import ContactShadow, contact_shadow
from humansim_ros.types import Float32Array, Indices

#: How much longer than at rest skin may get.
_STRETCH = 2.0
#: Metres between points of things whose shadows are looked for, and the most of them along an edge.
_SAMPLE, _MAX_PIECES = 0.04, 48


class Topology:
    """What never changes about a mesh of N triangles and V vertices.

    ``corners``: three of (N,), the triangles' vertices. ``edges``: (E, 2) vertices. ``sides``: two of (E,),
    the triangles on either side of each edge; ``border``: (E,) where there is only one. Where more than two
    triangles share an edge it is there once for each pair of neighbours.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
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
        starts, ends = self.mesh.vertices[self.edges].transpose(1, 0, 2)
        length = np.linalg.norm(ends - starts, axis=1)
        order = np.argsort(length)
        return np.asarray(length[order], dtype=np.float32), self.edges[order]

    def edges_longer(self, length: float) -> NDArray[np.intp]:
        """(E, 2) the edges that are longer than that, or may be when the body moves."""
        lengths, edges = self._by_length
        return edges[int(np.searchsorted(lengths, length / _STRETCH)) :]

    @cached_property
    def around(self) -> Any:
        """(V, N) sparse: sums over the triangles around each vertex."""
        from scipy.sparse import csr_matrix

        n = len(self.mesh.triangles)
        rows, columns = self.mesh.triangles.ravel(), np.repeat(np.arange(n), 3)
        shape = (len(self.mesh.vertices), n)
        return csr_matrix((np.ones(3 * n, dtype=np.float32), (rows, columns)), shape=shape)

    @cached_property
    def vertex_areas(self) -> Float32Array:
        """(V,) surface area that each vertex stands for at rest, square metres."""
        area = np.linalg.norm(PosedMesh(self, self.mesh.vertices.astype(np.float32)).areas, axis=0)
        return np.asarray(self.around @ area / 3, dtype=np.float32)


class PosedMesh:
    """Vertices (V, 3) float32 of a topology. Arrays here have the coordinates first: (3, V), (3, N)."""

    def __init__(self, topology: Topology, vertices: Float32Array) -> None:
        self.topology = topology
        self.vertices = vertices
        self.points: Float32Array = np.ascontiguousarray(vertices.T)

    @cached_property
    def _first_corners(self) -> Float32Array:
        return self.points.take(self.topology.corners[0], axis=1)

    @cached_property
    def areas(self) -> Float32Array:
        """(3, N) area vectors: along each triangle's outward normal, as long as its area."""
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
        """(V, 3) unit vertex normals: the area-weighted mean of the triangles around each."""
        around = self.topology.around
        normals = np.stack([around @ component for component in self.areas])
        normals /= np.maximum(np.sqrt(np.einsum("ij,ij->j", normals, normals)), np.float32(1e-20))
        return np.ascontiguousarray(normals.T)

    @cached_property
    def shadow(self) -> ContactShadow:
        """What it leaves on the floor."""
        return contact_shadow(self.points, self.topology.vertex_areas)

    @cached_property
    def shadow_of_thing(self) -> ContactShadow:
        """The same of a surface that may have few vertices, far from each other, and have been resized."""
        return contact_shadow(*self.samples)

    @property
    def samples(self) -> tuple[Float32Array, Float32Array]:
        """Points (3, M) all over the surface, and the area (M,) that each stands for."""
        corners = np.stack([self.points.take(corner, axis=1) for corner in self.topology.corners])
        area = np.linalg.norm(self.areas, axis=0)
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max(axis=0)
        pieces = np.clip(np.ceil(longest / _SAMPLE), 1, _MAX_PIECES).astype(np.intp)
        points, areas = [], []
        for n in np.unique(pieces).tolist():
            chosen = np.flatnonzero(pieces == n)
            i, j = np.divmod(np.arange(n * n), n)
            # a square of middles folded over its diagonal
            u, v = (i + 0.5) / n, (j + 0.5) / n
            u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
            weights = np.stack([1 - u - v, u, v]).astype(np.float32)
            points.append(np.einsum("ks,kcn->cns", weights, corners[..., chosen]).reshape(3, -1))
            areas.append(np.repeat(area[chosen] / (n * n), n * n))
        return np.concatenate(points, axis=1), np.concatenate(areas).astype(np.float32)

    def facing(self, eye: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(N,) which triangles show their outside to a point."""
        # not by BLAS: its threads would round differently on another machine
        return np.asarray(np.einsum("i,ij->j", eye.astype(np.float32), self.areas) > self._planes)

    def contour(self, facing: NDArray[np.bool_]) -> tuple[Indices, Indices]:
        """Vertices (C,) at the starts and ends of the edges that all outlines lie on.

        They part a triangle that faces the eye from one that does not, or end the surface.
        """
        first, second = self.topology.sides
        chosen = np.flatnonzero((facing.take(first) != facing.take(second)) | self.topology.border)
        starts, ends = self.topology.edges.take(chosen, axis=0).T
        return starts, ends
