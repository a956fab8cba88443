"""Surfaces of meshes: normals, tangents, finer triangles, and texels with their places in triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.mesh import FaceIndices, Mesh, padded
from humansim_ros.geometry import cross
from humansim_ros.types import Array, FloatArray, Indices

#: Side of a tile of one colour, and largest side of the atlas, texels.
PLAIN, _MAX_SIDE = 8, 4096


def plain_tile(color: Sequence[float] | Array) -> NDArray[np.uint8]:
    """Small texture (PLAIN, PLAIN, 3) of one colour, sRGB 0 to 1."""
    rgb = np.rint(255 * np.clip(np.asarray(color, dtype=float), 0.0, 1.0)).astype(np.uint8)
    return np.broadcast_to(rgb, (PLAIN, PLAIN, 3)).copy()


def atlas_mesh(
    vertices: Array,
    faces: FaceIndices,
    uv: Array,
    uv_faces: FaceIndices,
    face_material: NDArray[np.integer],
    tiles: Sequence[NDArray[np.uint8]],
) -> Mesh:
    """Create a mesh with one texture from faces with several textures.

    With more than one material, a texture that repeats within one face is clipped at its edge.

    Args:
        vertices, faces, uv: The same as in :class:`Mesh`.
        uv_faces: (F, 4) indices into ``uv``; -1 for corners without texture coordinates.
        face_material: (F,) index into ``tiles`` of each face.
        tiles: Texture (H, W, 3) of each material.
    """
    used = np.unique(face_material)
    if len(used) == 1 and (uv_faces[:, :3] >= 0).all():
        return Mesh(vertices, faces, uv, uv_faces, texture=tiles[int(used[0])])
    atlas, boxes = pack_images([tiles[int(n)] for n in used])
    height, width = atlas.shape[:2]
    x, y, w, h = np.array(boxes, dtype=float)[np.searchsorted(used, face_material)].T[:, :, None]
    has = (uv_faces >= 0).all(axis=1) | ((faces[:, 3] < 0) & (uv_faces[:, :3] >= 0).all(axis=1))
    corner_uv: Array = np.full((len(faces), 4, 2), 0.5)
    corner_uv[has] = uv[np.maximum(uv_faces[has], 0)]
    corner_uv -= np.floor(corner_uv[:, :3].mean(axis=1, keepdims=True))  # shift whole tiles into 0..1
    corner_uv = np.clip(corner_uv, 0.0, 1.0)
    # half a texel inside, so that neighbouring tiles do not bleed in
    across = (x + 0.5 + corner_uv[..., 0] * (w - 1)) / width
    down = (y + 0.5 + (1 - corner_uv[..., 1]) * (h - 1)) / height
    corners = np.stack([across, 1 - down], axis=-1).reshape(-1, 2)
    numbers = np.arange(4 * len(faces), dtype=np.int32).reshape(-1, 4)
    return Mesh(vertices, faces, corners, np.where(faces < 0, -1, numbers).astype(np.int32), texture=atlas)


def pack_images(
    tiles: Sequence[NDArray[np.uint8]],
) -> tuple[NDArray[np.uint8], list[tuple[int, int, int, int]]]:
    """Put images (H, W, 3), at least one, in rows into one image. Images that are too large for one texture
    are made smaller. Returns the image, and the box (x, y, width, height) of each tile."""
    import cv2  # imported here, since modules without images import this one

    limit = int(_MAX_SIDE / max(1.0, np.ceil(np.sqrt(len(tiles)))))
    scaled = []
    for tile in tiles:
        shrink = min(1.0, limit / max(tile.shape[:2]))
        size = (max(1, int(tile.shape[1] * shrink)), max(1, int(tile.shape[0] * shrink)))
        resized = tile if shrink == 1.0 else cv2.resize(tile, size, interpolation=cv2.INTER_AREA)
        scaled.append(np.asarray(resized, dtype=np.uint8))
    area = sum(tile.shape[0] * tile.shape[1] for tile in scaled)
    row_width = max(int(1.2 * np.sqrt(area)), *(tile.shape[1] for tile in scaled), 1)
    boxes = [(0, 0, 0, 0)] * len(scaled)
    x = y = row = 0
    for number in sorted(range(len(scaled)), key=lambda n: -scaled[n].shape[0]):
        height, width = scaled[number].shape[:2]
        if x + width > row_width and x:
            x, y, row = 0, y + row, 0
        boxes[number] = (x, y, width, height)
        x, row = x + width, max(row, height)
    atlas = np.zeros((y + row, max(p[0] + p[2] for p in boxes), 3), np.uint8)
    for (x, y, width, height), tile in zip(boxes, scaled, strict=True):
        atlas[y : y + height, x : x + width] = tile
    return atlas, boxes


def subdivide(mesh: Mesh, poses: Sequence[Array], rounds: int) -> tuple[Mesh, list[Array], Indices]:
    """Divide each triangle of a mesh with texture coordinates into four, ``rounds`` times. Returns the finer
    mesh, its vertices in the poses, and the triangle (N,) of ``mesh`` that contains each triangle. ``poses``:
    vertices (V, 3) of the mesh in other poses."""
    assert mesh.uv is not None and mesh.uv_triangles is not None
    triangles, uv_triangles = (np.asarray(each, np.intp) for each in (mesh.triangles, mesh.uv_triangles))
    points, uv, owner = [mesh.vertices, *poses], mesh.uv, np.arange(len(triangles))
    for _ in range(rounds):
        triangles, points = _divided(triangles, points)
        uv_triangles, [uv] = _divided(uv_triangles, [uv])
        owner = np.tile(owner, 4)
    faces, uv_faces = padded(triangles), padded(uv_triangles)
    finer = Mesh(points[0], faces, uv, uv_faces, texture=mesh.texture, skin=mesh.skin, hair=mesh.hair)
    return finer, points[1:], owner


def _divided(triangles: Indices, points: Sequence[Array]) -> tuple[Indices, list[Array]]:
    """Divide N triangles into 4 N. New points, which lie between two corners, come after the ``points``: one
    or more arrays (V, ...) with a row for each corner."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, number = np.unique(sides, axis=0, return_inverse=True)
    ab, bc, ca = (len(points[0]) + number.reshape(-1, 3)).T
    a, b, c = triangles.T
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    finer = np.concatenate([np.stack(part, axis=1) for part in parts])
    return finer, [np.concatenate([each, each[pairs].mean(axis=1)]) for each in points]


#: Number of texels that are computed at once.
_CHUNK = 50_000
#: Tolerance of barycentric coordinates, so that no texel is lost between triangles.
_INSIDE = 1e-9


@dataclass(frozen=True, eq=False)
class SurfaceTexels:
    """M texels that lie in triangles, in the order of the rows of the texture. ``row``: (M,), row 0 is the
    top, v = 1. ``column``: (M,). ``triangle``: (M,) triangle at the centre of each texel. ``weights``: (M, 3)
    barycentric coordinates of the centres."""

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    triangle: NDArray[np.intp]
    weights: Array

    def part(self, start: int, stop: int) -> SurfaceTexels:
        """Texels from ``start`` to before ``stop``."""
        some = slice(start, stop)
        return SurfaceTexels(self.row[some], self.column[some], self.triangle[some], self.weights[some])

    def mix(self, values: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.floating]:
        """Interpolate values of corners (T, ...) at the texels (M, ...). ``triangles``: (N, 3), indices of
        corners."""
        corners = triangles[self.triangle].T
        shares = self.weights.T.reshape(3, -1, *(1,) * (values.ndim - 1)).astype(values.dtype)
        out = values[corners[0]] * shares[0]
        for corner in (1, 2):
            out += values[corners[corner]] * shares[corner]
        return out


def rasterise_uv(uv: Array, triangles: NDArray[np.integer], size: int) -> SurfaceTexels:
    """Find the triangle at the centre of each texel. Where triangles overlap, the last one counts. ``uv``:
    (T, 2), v up. ``triangles``: (N, 3) indices of texture coordinates. ``size``: side of the texture."""
    # texel centres are at whole numbers
    corners = uv[triangles] * [size, -size] + [-0.5, size - 0.5]
    low = np.maximum(np.ceil(corners.min(axis=1) - 1e-6).astype(int), 0)
    high = np.minimum(np.floor(corners.max(axis=1) + 1e-6).astype(int), size - 1)
    ax, ay = np.ascontiguousarray(corners[:, 0].T)
    (bx, by), (cx, cy) = (np.ascontiguousarray((corners[:, k] - corners[:, 0]).T) for k in (1, 2))
    area = bx * cy - by * cx
    extent = np.maximum(high - low + 1, 0)
    extent[area == 0] = 0
    counts = extent[:, 0] * extent[:, 1]
    owner = np.full(size * size, -1)
    weights = np.zeros((size * size, 3))
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        done = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, done + _CHUNK, side="right")), start + 1)
        own = counts[start:stop]
        number = np.repeat(np.arange(start, stop), own)
        within = np.arange(len(number)) - np.repeat(np.cumsum(own) - own, own)
        down, across = np.divmod(within, extent[number, 0])
        x, y = low[number, 0] + across, low[number, 1] + down
        dx, dy = x - ax[number], y - ay[number]
        wb = (dx * cy[number] - dy * cx[number]) / area[number]
        wc = (bx[number] * dy - by[number] * dx) / area[number]
        inside = np.flatnonzero((wb >= -_INSIDE) & (wc >= -_INSIDE) & (wb + wc <= 1 + _INSIDE))
        at = y[inside] * size + x[inside]
        owner[at] = number[inside]  # if a texel comes more than once, the last triangle stays
        wb, wc = wb[inside], wc[inside]
        weights[at] = np.stack([1 - wb - wc, wb, wc], axis=-1)
        start = stop
    found = np.flatnonzero(owner >= 0)
    return SurfaceTexels(found // size, found % size, owner[found], weights[found])


Weighting = Literal["angle", "area"]

_PREVIOUS = (2, 0, 1)


@dataclass(frozen=True, init=False)
class SurfaceNormals:
    """Unit vertex normals of a surface with N triangles: weighted means of the normals of the triangles at
    each vertex.

    ``weighting``: ``angle`` weights a triangle by its angle at the vertex [Thürmer 1998], as Blender does, so
    that the result does not depend on how polygons are divided into triangles. ``area`` weights a triangle by
    its area and takes half the time.
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
        around = csr_matrix((ones, (rows, columns)), shape=(n_vertices, count))
        corners = tuple(np.ascontiguousarray(c) for c in triangles.T)
        vars(self).update(corners=corners, around=around, weighting=weighting)

    def __call__(self, vertices: FloatArray) -> FloatArray:
        """Normals (..., V, 3) of vertices (..., V, 3). Zero at vertices without triangles. Raises MeshError
        if the number of vertices is wrong."""
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


def welded(positions: NDArray[np.floating]) -> Indices:
    """Numbers (V,) of vertices with positions (V, 3). Vertices at the same position have the same number."""
    order = np.lexsort(positions.T)
    new = (np.diff(positions[order], axis=0, prepend=np.nan) != 0).any(axis=1)
    places = np.empty(len(positions), np.intp)
    places[order] = np.cumsum(new) - 1
    return places


def mean_normals(face_normals: Array, faces: NDArray[np.integer], n_vertices: int) -> Array:
    """Unit vertex normals (V, 3) from weighted face normals (F, 3) of faces (F, K). Zero for vertices without
    faces."""
    normals = np.zeros((n_vertices, 3))
    for corner in range(faces.shape[1]):
        np.add.at(normals, faces[:, corner], face_normals)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))


#: Vertices at one place share their triangles. If there are more vertices than this, each has only its own.
_MOST_AT_PLACE = 32
#: If normals differ by less than this (degrees) from area-weighted means, nothing is fitted; steps of the
#: fit.
_SAME, _STEPS = 1.0, 300


def shading_weights(vertices: Array, triangles: NDArray[np.integer], normals: Array) -> csr_matrix:
    """Weights (V, N) of the area vectors of triangles (N, 3). Their weighted sums have the directions of
    ``normals`` (V, 3) of unit length, or zero where unknown: there the result is the area-weighted mean.

    Unlike the normals themselves, weights stay valid when the mesh moves or deforms. They are at least 0, so
    that a normal that is not between the normals of its triangles becomes the nearest one between them.
    Triangles at other vertices of the same place count too, so that normals are smooth across seams.
    """
    count = len(vertices)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a) / 2
    size = np.maximum(np.linalg.norm(area, axis=1), 1e-30)
    place = welded(vertices)
    crowded = np.bincount(place)[place] > _MOST_AT_PLACE
    place = np.where(crowded, place.max() + 1 + np.arange(count), place)
    shape = (int(place.max()) + 1, count)
    at_place = csr_matrix((np.ones(count, np.float32), (place, np.arange(count))), shape=shape)
    places = triangles.ravel(), np.repeat(np.arange(len(triangles)), 3)
    of_triangles = csr_matrix((np.ones(triangles.size, np.float32), places), shape=(count, len(triangles)))
    around = (at_place.T @ (at_place @ of_triangles)).tocsr()
    rows, columns = np.repeat(np.arange(count), np.diff(around.indptr)), around.indices
    own = np.asarray(of_triangles[rows, columns]).ravel() > 0
    plain = np.where(own, size[columns], 0.0)

    def mean(weights: Array, chosen: NDArray[np.intp]) -> Array:
        """Sums (V, 3) of the unit normals of triangles, multiplied by the weights."""
        unit = area[columns[chosen]] / size[columns[chosen], None]
        return np.stack([np.bincount(rows[chosen], weights * unit[:, k], count) for k in range(3)], axis=1)

    smooth = _unit(mean(plain, np.arange(len(rows))).T).T
    known = np.linalg.norm(normals, axis=1) > 0.5
    other = known & (np.einsum("ij,ij->i", smooth, normals) < np.cos(np.radians(_SAME)))
    chosen = np.flatnonzero(other[rows])
    unit = area[columns[chosen]] / size[columns[chosen], None]
    goal = normals[rows[chosen]]
    # projected gradient; the largest eigenvalue is at most the number of triangles
    step = 1.0 / np.maximum(np.bincount(rows[chosen], minlength=count), 1)[rows[chosen]]
    fitted = np.clip(np.einsum("ij,ij->i", unit, goal), 0.0, None) ** 4
    for _ in range(_STEPS if len(chosen) else 0):
        residual = mean(fitted, chosen)[rows[chosen]] - goal
        fitted = np.clip(fitted - step * np.einsum("ij,ij->i", unit, residual), 0.0, None)
    weights = plain
    weights[chosen] = fitted
    empty = other & (np.bincount(rows, weights, count) < 1e-6)  # normals opposite to all triangles
    weights = np.where(empty[rows], np.where(own, size[columns], 0.0), weights) / size[columns]
    made = csr_matrix((weights.astype(np.float32), columns, around.indptr), shape=around.shape)
    made.eliminate_zeros()
    return made


@dataclass(frozen=True, init=False)
class SurfaceTangents:
    """Tangents of a surface with texture coordinates, as MikkTSpace computes them for triangles [Mikkelsen
    2008].

    Normal maps in glTF and Blender use this convention. A vertex has one tangent for each of its texture
    coordinates, and two where a mirrored texture meets the original. Each tangent belongs to one of C
    corners: ``vertex`` (C,) and ``uv`` (C,) are the indices of the corner, ``sign`` (C,) its handedness, with
    bitangent = sign * cross(normal, tangent). ``triangles`` (N, 3) index the corners. MikkTSpace walks over
    common edges. Here, corners with the same vertex and texture coordinate are one, even where surfaces only
    touch.
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
        # weights of the sides b - a and c - a in the direction of u; zero where the texture has no area
        gradient = np.where(area == 0, 0.0, np.sign(area) * np.stack([v2, -v1]))
        keys = np.stack([triangles, uv_triangles, np.repeat((area < 0)[:, None], 3, axis=1)], axis=-1)
        corners, index = np.unique(keys.reshape(-1, 3), axis=0, return_inverse=True)
        vertex, coordinate = (np.ascontiguousarray(corners[:, column]) for column in (0, 1))
        sign = np.where(corners[:, 2], -1, 1).astype(np.float32)
        vars(self).update(vertex=vertex, uv=coordinate, sign=sign, triangles=index.reshape(-1, 3))
        vars(self).update(n_vertices=n_vertices, _gradient=gradient)

    def __call__(self, vertices: FloatArray, normals: FloatArray) -> FloatArray:
        """Tangents (..., C, 4): a unit vector perpendicular to the normal, towards increasing u, and the
        sign. ``vertices``, ``normals``: (..., V, 3). The tangent is zero where the texture has no area.
        Raises MeshError for wrong shapes."""
        batch, shape = _checked_frames(vertices, self.n_vertices)
        batch_normals, other = _checked_frames(normals, self.n_vertices)
        if shape != other:
            raise MeshError(f"normals of shape {other} do not fit vertices of shape {shape}")
        out = np.empty((len(batch), len(self.vertex), 4), dtype=batch.dtype)
        gradient = self._gradient.astype(batch.dtype)
        corners = tuple(self.vertex[self.triangles.T])
        count = len(self.vertex)
        for points, normal, frame in zip(batch, batch_normals.astype(batch.dtype), out, strict=True):
            first, second, third = _sides(points, corners)
            along = _unit(gradient[0] * first - gradient[1] * third)
            sums = np.zeros((3, count))
            edges = (first, second, third)
            for corner in range(3):
                up = np.ascontiguousarray(normal[corners[corner]].T)
                flat = _unit(_perpendicular(along, up))
                out_of, into = (_unit(_perpendicular(edges[k], up)) for k in (corner, _PREVIOUS[corner]))
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
    """Reshape vertices to (F, V, 3), float32 or float64. Returns also the original shape."""
    array = np.asarray(vertices)
    if array.ndim < 2 or array.shape[-2:] != (count, 3):
        raise MeshError(f"an array of shape {array.shape} does not fit {count} vertices: (..., {count}, 3)")
    if array.dtype != np.float32:
        array = array.astype(np.float64)
    return array.reshape(int(np.prod(array.shape[:-2])), count, 3), array.shape


def _sides(points: FloatArray, corners: tuple[Indices, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sides (3, N) of triangles, as vectors from corner 0 to 1, 1 to 2 and 2 to 0. The first axis is x, y,
    z."""
    columns = np.ascontiguousarray(points.T)
    a, b, c = (columns.take(corner, axis=1) for corner in corners)
    return b - a, c - b, a - c


def _angles(sides: tuple[FloatArray, FloatArray, FloatArray]) -> list[FloatArray]:
    """Angles (N,) at corners 0, 1 and 2, radians. 0 where a side has no length."""
    units = [_unit(side) for side in sides]
    cosines = (-np.einsum("ij,ij->j", units[i], units[_PREVIOUS[i]]) for i in range(3))
    return [np.arccos(np.clip(cosine, -1, 1)) for cosine in cosines]


def _perpendicular(vectors: FloatArray, up: FloatArray) -> FloatArray:
    """Component of vectors (3, N) that is perpendicular to unit vectors ``up`` (3, N)."""
    perpendicular: FloatArray = vectors - np.einsum("ij,ij->j", vectors, up) * up
    return perpendicular


def _unit(vectors: FloatArray) -> FloatArray:
    """Normalise vectors (3, N). A zero vector stays zero."""
    length = np.sqrt(np.einsum("ij,ij->j", vectors, vectors))
    unit: FloatArray = vectors / np.where(length > 0, length, 1)
    return unit
