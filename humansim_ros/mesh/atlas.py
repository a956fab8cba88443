"""Several materials as one texture: their images side by side, and texture coordinates to match."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.mesh.mesh import FaceIndices, Mesh
from humansim_ros.types import Array

#: Texels of a side of a plain colour, and the most of a side of the common texture.
PLAIN, _WIDEST = 8, 4096


def plain_tile(color: Sequence[float] | Array) -> NDArray[np.uint8]:
    """A small texture of one colour, sRGB 0 to 1."""
    rgb = np.rint(255 * np.clip(np.asarray(color, dtype=float), 0.0, 1.0)).astype(np.uint8)
    return np.broadcast_to(rgb, (PLAIN, PLAIN, 3)).copy()


def textured(
    vertices: Array,
    faces: FaceIndices,
    uv: Array,
    uv_faces: FaceIndices,
    face_material: NDArray[np.integer],
    tiles: Sequence[NDArray[np.uint8]],
) -> Mesh:
    """A mesh whose faces have the materials ``face_material`` (F,): indices into ``tiles``, (H, W, 3) images.

    ``uv`` (T, 2), v up, with ``uv_faces`` (F, 4); -1 where a corner has none. With more than one material,
    textures that repeat within one face are cut off at their edge.
    """
    used = np.unique(face_material)
    if len(used) == 1 and (uv_faces[:, :3] >= 0).all():
        return Mesh(vertices, faces, uv, uv_faces, texture=tiles[int(used[0])])
    atlas, places = _side_by_side([tiles[int(n)] for n in used])
    height, width = atlas.shape[:2]
    x, y, w, h = np.array(places, dtype=float)[np.searchsorted(used, face_material)].T[:, :, None]
    has = (uv_faces >= 0).all(axis=1) | ((faces[:, 3] < 0) & (uv_faces[:, :3] >= 0).all(axis=1))
    own: Array = np.full((len(faces), 4, 2), 0.5)
    own[has] = uv[np.maximum(uv_faces[has], 0)]
    own -= np.floor(own[:, :3].mean(axis=1, keepdims=True))  # by whole tiles into 0..1
    own = np.clip(own, 0.0, 1.0)
    # half a texel inside, so that no neighbour shows at the edges
    across = (x + 0.5 + own[..., 0] * (w - 1)) / width
    down = (y + 0.5 + (1 - own[..., 1]) * (h - 1)) / height
    corners = np.stack([across, 1 - down], axis=-1).reshape(-1, 2)
    numbers = np.arange(4 * len(faces), dtype=np.int32).reshape(-1, 4)
    return Mesh(vertices, faces, corners, np.where(faces < 0, -1, numbers).astype(np.int32), texture=atlas)


def _side_by_side(
    tiles: Sequence[NDArray[np.uint8]],
) -> tuple[NDArray[np.uint8], list[tuple[int, int, int, int]]]:
    """One image with all tiles in rows, and where each is (x, y, width, height)."""
    most = int(_WIDEST / max(1.0, np.ceil(np.sqrt(len(tiles)))))
    small = []
    for tile in tiles:
        shrink = min(1.0, most / max(tile.shape[:2]))
        size = (max(1, int(tile.shape[1] * shrink)), max(1, int(tile.shape[0] * shrink)))
        resized = tile if shrink == 1.0 else cv2.resize(tile, size, interpolation=cv2.INTER_AREA)
        small.append(np.asarray(resized, dtype=np.uint8))
    area = sum(tile.shape[0] * tile.shape[1] for tile in small)
    limit = max(int(1.2 * np.sqrt(area)), *(tile.shape[1] for tile in small), 1)
    places = [(0, 0, 0, 0)] * len(small)
    x = y = row = 0
    for number in sorted(range(len(small)), key=lambda n: -small[n].shape[0]):
        height, width = small[number].shape[:2]
        if x + width > limit and x:
            x, y, row = 0, y + row, 0
        places[number] = (x, y, width, height)
        x, row = x + width, max(row, height)
    atlas = np.zeros((y + row, max(p[0] + p[2] for p in places), 3), np.uint8)
    for (x, y, width, height), tile in zip(places, small, strict=True):
        atlas[y : y + height, x : x + width] = tile
    return atlas, places
