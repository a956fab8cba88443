"""Divide the triangles of a mesh into four, without a change of its shape."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array, Indices


@dataclass(frozen=True, eq=False)
class Subdivision:
    """A mesh of triangles made of another one.

    Attributes:
        mesh: The finer mesh, whose faces are triangles.
        owner: (N,) triangle of the first mesh of each of its triangles.
        edges: For each round, pairs of vertices (E, 2) between which it adds vertices.
    """

    mesh: Mesh
    owner: Indices
    edges: tuple[Indices, ...]

    def points(self, points: Array) -> Array:
        """Points of the vertices of the finer mesh from those (V, 3) of the first mesh, also in a pose."""
        for pairs in self.edges:
            points = np.concatenate([points, points[pairs].mean(axis=1)])
        return points


def subdivide(mesh: Mesh, rounds: int) -> Subdivision:
    """Divide each triangle into four, ``rounds`` times; texture coordinates follow.

    Raises:
        MeshError: The mesh cannot be made.
    """
    triangles = np.asarray(mesh.triangles, np.intp)
    uv_triangles = None if mesh.uv_triangles is None else np.asarray(mesh.uv_triangles, np.intp)
    vertices, uv, owner = mesh.vertices, mesh.uv, np.arange(len(triangles))
    edges: list[Indices] = []
    for _ in range(rounds):
        triangles, pairs = _divided(triangles, len(vertices))
        vertices = np.concatenate([vertices, vertices[pairs].mean(axis=1)])
        edges.append(pairs)
        if uv is not None and uv_triangles is not None:
            uv_triangles, uv_pairs = _divided(uv_triangles, len(uv))
            uv = np.concatenate([uv, uv[uv_pairs].mean(axis=1)])
        owner = np.tile(owner, 4)
    finer = replace(
        mesh,
        vertices=vertices,
        faces=_faces(triangles),
        uv=uv,
        uv_faces=None if uv_triangles is None else _faces(uv_triangles),
        colors=None,
    )
    return Subdivision(finer, owner, tuple(edges))


def _divided(triangles: Indices, count: int) -> tuple[Indices, Indices]:
    """Triangles (4 N, 3), and the pairs (E, 2) of the ``count`` points between which new points are."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, number = np.unique(sides, axis=0, return_inverse=True)
    ab, bc, ca = (count + number.reshape(-1, 3)).T
    a, b, c = triangles.T
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(part, axis=1) for part in parts]), pairs


def _faces(triangles: Indices) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    return np.pad(triangles.astype(np.int32), ((0, 0), (0, 1)), constant_values=-1)
