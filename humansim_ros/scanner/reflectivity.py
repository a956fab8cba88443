"""Reflectivity of surfaces for the light of a scanner."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from humansim_ros.io.images import decode_srgb
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array

#: Shares of red, green and blue in the luminance (ITU-R BT.709).
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
#: Reflectivity of a surface without colours.
_PLAIN = 0.5


def reflectivity(mesh: Mesh, triangles: NDArray[np.integer], weights: Array) -> Array:
    """Diffuse reflectivity (N,), 0 to 1, of points of a mesh: the luminance of its colour in linear light.

    Scanners measure in the near infrared, which meshes do not have. Luminance keeps the order of dark and
    bright surfaces.

    Args:
        mesh: Mesh with vertex colours or a texture.
        triangles: (N,) triangles.
        weights: (N, 2) barycentric weights of their second and third corners.
    """
    shares = np.column_stack([1 - weights.sum(axis=1), weights])
    if mesh.texture is not None and mesh.uv is not None and mesh.uv_triangles is not None:
        u, v = np.einsum("nk,nkc->cn", shares, mesh.uv[mesh.uv_triangles[triangles]])
        height, width = mesh.texture.shape[:2]
        column = np.minimum((np.mod(u, 1.0) * width).astype(int), width - 1)
        row = np.minimum((np.mod(1 - v, 1.0) * height).astype(int), height - 1)
        return _luminance(mesh.texture[row, column])
    if mesh.colors is not None:
        corners = _luminance(mesh.colors[mesh.triangles[triangles]])
        return np.asarray((shares * corners).sum(axis=1))
    return np.full(len(triangles), _PLAIN)


def _luminance(colors: NDArray[np.uint8]) -> Array:
    return np.asarray(decode_srgb(colors / 255.0) @ _LUMINANCE)
