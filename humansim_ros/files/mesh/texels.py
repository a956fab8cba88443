"""Texels of a mesh: for each texel of a texture, the triangle at its centre, and the place in it.

The module also makes atlases, which hold the images of several materials in one texture, and divides
triangles into four.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.files.mesh.mesh import FaceIndices, Mesh, padded
from humansim_ros.types import Array, Indices

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
        vertices: (V, 3).
        faces: (F, 4) vertex indices, triangles padded with -1.
        uv: Texture coordinates (T, 2), v up.
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
    """Put images in rows into one image. They are made smaller if they are too large for one texture.

    Args:
        tiles: Images (H, W, 3), at least one.

    Returns:
        Image with all tiles, and the box (x, y, width, height) of each tile.
    """
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


@dataclass(frozen=True, eq=False)
class Subdivision:
    """A mesh of triangles that was made by dividing another mesh.

    Attributes:
        mesh: The finer mesh. Its faces are triangles.
        owner: (N,) triangle of the first mesh that contains each triangle of the finer mesh.
        edges: For each round, pairs of vertices (E, 2). A new vertex lies between each pair.
    """

    mesh: Mesh
    owner: Indices
    edges: tuple[Indices, ...]

    def points(self, points: Array) -> Array:
        """Vertices of the finer mesh from vertices (V, 3) of the first mesh, which may be posed."""
        for pairs in self.edges:
            points = np.concatenate([points, points[pairs].mean(axis=1)])
        return points


def subdivide(mesh: Mesh, rounds: int) -> Subdivision:
    """Divide each triangle into four, ``rounds`` times. Texture coordinates are divided, too.

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
        faces=padded(triangles),
        uv=uv,
        uv_faces=None if uv_triangles is None else padded(uv_triangles),
        colors=None,
        shading=None,
        materials=None,
        off_body=None,
    )
    return Subdivision(finer, owner, tuple(edges))


def _divided(triangles: Indices, count: int) -> tuple[Indices, Indices]:
    """Triangles (4 N, 3), and pairs (E, 2) of the ``count`` points. A new point lies between each pair."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, number = np.unique(sides, axis=0, return_inverse=True)
    ab, bc, ca = (count + number.reshape(-1, 3)).T
    a, b, c = triangles.T
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(part, axis=1) for part in parts]), pairs


#: Number of texels that are computed at once.
_CHUNK = 50_000
#: Tolerance of barycentric coordinates, so that no texel is lost between triangles.
_INSIDE = 1e-9


@dataclass(frozen=True, eq=False)
class SurfaceTexels:
    """M texels that lie in triangles, in the order of the rows of the texture.

    Attributes:
        row: (M,) row of the texel; row 0 is the top, v = 1.
        column: (M,) column.
        triangle: (M,) index of the triangle.
        weights: (M, 3) barycentric coordinates of the centre of the texel.
    """

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    triangle: NDArray[np.intp]
    weights: Array

    def part(self, start: int, stop: int) -> SurfaceTexels:
        """Texels from ``start`` to before ``stop``."""
        chosen = slice(start, stop)
        return SurfaceTexels(
            self.row[chosen], self.column[chosen], self.triangle[chosen], self.weights[chosen]
        )

    def mix(self, values: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.floating]:
        """Interpolate values of corners (T, ...) at the texels (M, ...). ``triangles``: (N, 3), indices of
        corners."""
        corners = triangles[self.triangle]
        out = values[corners[:, 0]] * _column(self.weights[:, 0], values)
        out += values[corners[:, 1]] * _column(self.weights[:, 1], values)
        out += values[corners[:, 2]] * _column(self.weights[:, 2], values)
        return out


def _column(weights: Array, values: NDArray[np.floating]) -> NDArray[np.floating]:
    return weights.reshape(-1, *(1,) * (values.ndim - 1)).astype(values.dtype)


def rasterise_uv(uv: Array, triangles: NDArray[np.integer], size: int) -> SurfaceTexels:
    """Find the triangle at the centre of each texel. Where triangles overlap, the last one counts.

    Args:
        uv: Texture coordinates (T, 2), v up.
        triangles: (N, 3) indices of texture coordinates.
        size: Side of the texture, texels.
    """
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
