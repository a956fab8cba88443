"""Texture layout: texels of each part of the body."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from humansim_ros.humans.makehuman.data import VertexIndices
from humansim_ros.mesh.texels import rasterise_uv
from humansim_ros.types import Array

TEXTURE_SIZE = 1024
# MakeHuman's layout gives the face a sixth of the width. Here clothes have less, and the face more:
# old -> new coordinates (u from the left, h = 1 - v from the top), monotone so that no island folds.
NARROW_U = ((0.0, 0.76), (0.0, 0.608))
HEAD_U = ((0.63, 0.80, 0.97, 1.0), (0.615, 0.735, 0.985, 0.998))
HEAD_H = ((0.17, 0.43, 0.60, 0.86), (0.008, 0.205, 0.585, 0.79))
HANDS_SHIFT = -0.064
EYE_BOX = 0.06


def uv_islands(uv_faces: VertexIndices, count: int) -> VertexIndices:
    """Island (T,) of each texture coordinate."""
    edges = np.concatenate([uv_faces[:, [k, (k + 1) % 4]] for k in range(4)])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    return csgraph.connected_components(graph, directed=False)[1]


def relay_uv(uv: Array, uv_faces: VertexIndices, is_eye: NDArray[np.bool_]) -> Array:
    """Enlarge face and eyes in the texture. uv (T, 2), uv_faces (F, 4), is_eye (F,) -> uv (T, 2)."""
    u, h = uv[:, 0].copy(), 1 - uv[:, 1]
    island = uv_islands(uv_faces, len(uv))
    new_u, new_h = u.copy(), h.copy()
    eyes = np.unique(island[uv_faces[is_eye]])
    for number in np.unique(island):
        rows = island == number
        centre_u, centre_h = u[rows].mean(), h[rows].mean()
        if number in eyes:
            k = int(np.searchsorted(eyes, number))
            size = max(np.ptp(u[rows]), np.ptp(h[rows]))
            new_u[rows] = 0.73 + 0.065 * k + (u[rows] - u[rows].min()) / size * EYE_BOX
            new_h[rows] = 0.90 + (h[rows] - h[rows].min()) / size * EYE_BOX
        elif centre_u > 0.7 and centre_h < 0.85:  # head
            new_u[rows], new_h[rows] = np.interp(u[rows], *HEAD_U), np.interp(h[rows], *HEAD_H)
        elif centre_u > 0.75 and centre_h > 0.85:  # inside of the mouth
            new_u[rows] = 0.74 + 0.2 * (u[rows] - u[rows].min())
            new_h[rows] = 0.965 + 0.2 * (h[rows] - h[rows].min())
        elif centre_u > 0.4 and centre_h > 0.85:  # hands
            new_u[rows] = u[rows] + HANDS_SHIFT
        else:
            new_u[rows] = np.interp(u[rows], *NARROW_U)
    return np.c_[new_u, 1 - new_h]


@dataclass(frozen=True)
class Texels:
    """Texels of faces: row, column, face (N,), corners of the triangle (N, 3), barycentrics (N, 3)."""

    row: VertexIndices
    column: VertexIndices
    face: VertexIndices
    vertices: VertexIndices
    uv: VertexIndices
    weights: Array

    def mix(self, values: Array) -> Array:
        """Vertex values (V, ...) interpolated at the texels (N, ...)."""
        return np.einsum("nk,nk...->n...", self.weights, values[self.vertices])


def rasterise(faces: VertexIndices, uv: Array, uv_faces: VertexIndices, size: int) -> Texels:
    """Find the triangle at the centre of each texel.

    Args:
        faces: Quads (F, 4).
        uv: Texture coordinates (T, 2), v up.
        uv_faces: Quads (F, 4) of texture coordinates.
        size: Side of the texture, texels.
    """
    fan = ([0, 1, 2], [0, 2, 3])
    triangles = np.concatenate([faces[:, c] for c in fan])
    uv_triangles = np.concatenate([uv_faces[:, c] for c in fan])
    found = rasterise_uv(uv, uv_triangles, size)
    number = found.triangle
    corners, uv_corners = triangles[number], uv_triangles[number]
    return Texels(found.row, found.column, number % len(faces), corners, uv_corners, found.weights)


def downsample(texels: Texels, colour: Array) -> NDArray[np.uint8]:
    """Make an image of half the raster size from texel colours (N, 3); gaps take the nearest texel."""
    size = 2 * TEXTURE_SIZE
    empty = np.ones((size, size), np.uint8)
    empty[texels.row, texels.column] = 0
    _, labels = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.zeros((int(labels.max()) + 1, 3))
    nearest[labels[texels.row, texels.column]] = colour
    half = nearest[labels].reshape(TEXTURE_SIZE, 2, TEXTURE_SIZE, 2, 3).mean(axis=(1, 3))
    return np.clip(np.rint(half), 0, 255).astype(np.uint8)
