"""Reflectivity of surfaces for the light of a scanner."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.sensor.depth import infrared_reflectivity
from humansim_ros.files.mesh import Mesh
from humansim_ros.types import Array

#: Reflectivity of a surface without colours.
_PLAIN = 0.5


def reflectivity(mesh: Mesh, triangles: NDArray[np.integer], weights: Array) -> Array:
    """Diffuse reflectivity (N,), 0 to 1, of points of a mesh in the near infrared, from its colours.

    Args:
        mesh: Mesh with vertex colours or a texture.
        triangles: (N,) triangles.
        weights: (N, 2) barycentric weights of the second and third corners of the triangles.
    """
    shares = np.column_stack([1 - weights.sum(axis=1), weights])
    if mesh.texture is not None and mesh.uv is not None and mesh.uv_triangles is not None:
        u, v = np.einsum("nk,nkc->cn", shares, mesh.uv[mesh.uv_triangles[triangles]])
        height, width = mesh.texture.shape[:2]
        column = np.minimum((np.mod(u, 1.0) * width).astype(int), width - 1)
        row = np.minimum((np.mod(1 - v, 1.0) * height).astype(int), height - 1)
        return _infrared(mesh.texture[row, column])
    if mesh.colors is not None:
        corners = _infrared(mesh.colors[mesh.triangles[triangles]])
        return np.asarray((shares * corners).sum(axis=1))
    return np.full(len(triangles), _PLAIN)


def _infrared(colors: NDArray[np.uint8]) -> Array:
    """Reflectivity (...) of sRGB colours (..., 3)."""
    return np.asarray(infrared_reflectivity(colors.reshape(1, -1, 3)).reshape(colors.shape[:-1]), dtype=float)
