"""Normals and tangents of a surface that moves, worked out anew from its vertices.

Quicker, and nearly as good, are those that the bones carry along: ``Skinner.directions``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.rotations import cross
from humansim_ros.types import FloatArray, Indices

Weighting = Literal["angle", "area"]

_PREVIOUS = (2, 0, 1)


@dataclass(frozen=True, init=False)
class SurfaceNormals:
    """Unit vertex normals of a surface of N triangles: the weighted mean of the triangles around each vertex.

    ``weighting``: "angle" weighs a triangle by its angle at the vertex, so that the result does not depend on
    how polygons are cut into triangles (Thürmer and Wüthrich 1998; what Blender does with a mesh of
    triangles); "area" by its area, in half the time.
    """

    corners: tuple[Indices, Indices, Indices]
    around: csr_matrix
    weighting: Weighting

    def __init__(self, triangles: NDArray[Any], n_vertices: int, weighting: Weighting = "angle") -> None:
        triangles = _checked_triangles(triangles, n_vertices, "triangle")
        rows = triangles.T.ravel()
        count = len(triangles) * (3 if weighting == "angle" else 1)
        columns = np.arange(len(rows)) % max(count, 1)
        ones = np.ones(len(rows), dtype=np.float32)
        object.__setattr__(self, "corners", tuple(np.ascontiguousarray(c) for c in triangles.T))
        object.__setattr__(self, "around", csr_matrix((ones, (rows, columns)), shape=(n_vertices, count)))
        object.__setattr__(self, "weighting", weighting)

    def __call__(self, vertices: FloatArray) -> FloatArray:
        """Normals (..., V, 3) of vertices (..., V, 3), of their precision; zero where there is no surface.

        Raises MeshError on another number of vertices.
        """
        batch, shape = _checked_frames(vertices, self.around.shape[0])
        out = np.empty_like(batch)
        around = self.around.astype(batch.dtype)
        for points, normals in zip(batch, out, strict=True):
            sides = _sides(points, self.corners)
            faces = cross(sides[0], sides[1])
            if self.weighting == "angle":
                faces = np.concatenate([_unit(faces) * angle for angle in _angles(sides)], axis=1)
            normals[:] = _unit(np.stack([around @ component for component in faces])).T
        return out.reshape(shape)


@dataclass(frozen=True, init=False)
class SurfaceTangents:
    """Tangents of a surface with texture coordinates, as MikkTSpace makes them of triangles (Mikkelsen 2008;
    the convention of glTF, Blender and normal maps).

    A vertex has one tangent for each texture coordinate it is used with, and two where mirrored texture
    meets: so C corners, of which ``vertex`` (C,) and ``uv`` (C,) are the indices and ``sign`` (C,) is the
    handedness: bitangent = sign * cross(normal, tangent). ``triangles`` (N, 3) index the corners. Unlike
    MikkTSpace, which goes from triangle to triangle over common edges, corners at one vertex with one texture
    coordinate are one even where surfaces only touch.
    """

    vertex: Indices
    uv: Indices
    sign: NDArray[np.float32]
    triangles: Indices
    n_vertices: int
    _gradient: NDArray[np.float64]

    def __init__(
        self, triangles: NDArray[Any], uv: FloatArray, uv_triangles: NDArray[Any], n_vertices: int
    ) -> None:
        triangles = _checked_triangles(triangles, n_vertices, "triangle")
        uv = np.asarray(uv, dtype=float)
        uv_triangles = _checked_triangles(uv_triangles, len(uv), "texture triangle")
        if uv_triangles.shape != triangles.shape:
            raise MeshError(f"{len(uv_triangles)} texture triangles do not fit {len(triangles)} triangles")
        a, b, c = (uv[uv_triangles[:, i]].T for i in range(3))
        (u1, v1), (u2, v2) = b - a, c - a
        area = u1 * v2 - u2 * v1
        # of which sides b - a and c - a the direction of u is the sum; nothing where the texture has no area
        gradient = np.where(area == 0, 0.0, np.sign(area) * np.stack([v2, -v1]))
        keys = np.stack([triangles, uv_triangles, np.repeat((area < 0)[:, None], 3, axis=1)], axis=-1)
        corners, index = np.unique(keys.reshape(-1, 3), axis=0, return_inverse=True)
        object.__setattr__(self, "vertex", np.ascontiguousarray(corners[:, 0]))
        object.__setattr__(self, "uv", np.ascontiguousarray(corners[:, 1]))
        object.__setattr__(self, "sign", np.where(corners[:, 2], -1, 1).astype(np.float32))
        object.__setattr__(self, "triangles", index.reshape(-1, 3))
        object.__setattr__(self, "n_vertices", n_vertices)
        object.__setattr__(self, "_gradient", gradient)

    def __call__(self, vertices: FloatArray, normals: FloatArray) -> FloatArray:
        """Tangents (..., C, 4): a unit vector across the normal, along growing u, and the sign.

        ``vertices``, ``normals``: (..., V, 3). Zero where the texture has no area. Raises MeshError on other
        shapes.
        """
        batch, shape = _checked_frames(vertices, self.n_vertices)
        given, other = _checked_frames(normals, self.n_vertices)
        if shape != other:
            raise MeshError(f"normals of shape {other} do not fit vertices of shape {shape}")
        out = np.empty((len(batch), len(self.vertex), 4), dtype=batch.dtype)
        gradient = self._gradient.astype(batch.dtype)
        corners = tuple(self.vertex[self.triangles.T])
        count = len(self.vertex)
        for points, normal, frame in zip(batch, given.astype(batch.dtype), out, strict=True):
            first, second, third = _sides(points, corners)
            along = _unit(gradient[0] * first - gradient[1] * third)
            sums = np.zeros((3, count))
            edges = (first, second, third)
            for corner in range(3):
                up = np.ascontiguousarray(normal[corners[corner]].T)
                flat = _unit(_across(along, up))
                out_of, into = _unit(_across(edges[corner], up)), _unit(_across(edges[_PREVIOUS[corner]], up))
                angle = np.arccos(np.clip(-np.einsum("ij,ij->j", out_of, into), -1, 1))
                index = self.triangles[:, corner]
                sums += [np.bincount(index, part, count) for part in flat * angle]
            frame[:, :3] = _unit(sums).T
            frame[:, 3] = self.sign
        return out.reshape(*shape[:-2], *out.shape[1:])


def _checked_triangles(triangles: NDArray[Any], count: int, what: str) -> Indices:
    triangles = np.asarray(triangles)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise MeshError(f"{what}s are (N, 3) indices, not {triangles.shape} {triangles.dtype}")
    bad = ((triangles < 0) | (triangles >= count)).any(axis=1)
    if bad.any():
        raise MeshError(f"{what} {int(np.argmax(bad))} has an index outside 0..{count - 1}")
    return triangles.astype(np.intp)


def _checked_frames(vertices: FloatArray, count: int) -> tuple[FloatArray, tuple[int, ...]]:
    """As (F, V, 3) of float32 or float64, and the shape they had."""
    array = np.asarray(vertices)
    if array.ndim < 2 or array.shape[-2:] != (count, 3):
        raise MeshError(f"an array of shape {array.shape} does not fit {count} vertices: (..., {count}, 3)")
    if array.dtype != np.float32:
        array = array.astype(np.float64)
    return array.reshape(int(np.prod(array.shape[:-2])), count, 3), array.shape


def _sides(points: FloatArray, corners: tuple[Indices, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sides (3, N) of triangles, coordinates first: from corner 0 to 1, 1 to 2, 2 to 0."""
    columns = np.ascontiguousarray(points.T)
    a, b, c = (columns.take(corner, axis=1) for corner in corners)
    return b - a, c - b, a - c


def _angles(sides: tuple[FloatArray, FloatArray, FloatArray]) -> list[FloatArray]:
    """Angles (N,) at corners 0, 1 and 2, radians; 0 where a side has no length."""
    units = [_unit(side) for side in sides]
    cosines = (-np.einsum("ij,ij->j", units[i], units[_PREVIOUS[i]]) for i in range(3))
    return [np.arccos(np.clip(cosine, -1, 1)) for cosine in cosines]


def _across(vectors: FloatArray, up: FloatArray) -> FloatArray:
    """What of vectors (3, N) is across unit vectors (3, N)."""
    across: FloatArray = vectors - np.einsum("ij,ij->j", vectors, up) * up
    return across


def _unit(vectors: FloatArray) -> FloatArray:
    """Vectors (3, N) of length one; zero stays zero."""
    length = np.sqrt(np.einsum("ij,ij->j", vectors, vectors))
    unit: FloatArray = vectors / np.where(length > 0, length, 1)
    return unit
