"""Texture atlas: the images of several materials in one texture, with new texture coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.mesh.mesh import FaceIndices, Mesh
from humansim_ros.types import Array

#: Side of a plain colour tile, and maximum side of the atlas, texels.
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
    """Put images into one, in rows, smaller if they are too large for one texture.

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
