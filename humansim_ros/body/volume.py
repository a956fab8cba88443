"""Voxels of the inside of a mesh; robust for open surfaces and surfaces in many pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array

#: Limit for all voxels; a person of 160 voxels' height has a twentieth of it.
_MAX_VOXELS = 20_000_000
#: Directions out of six in which an inner voxel must have surface.
_SIDES = 5


@dataclass(frozen=True)
class Volume:
    """Voxel grid of a solid.

    ``filled``: (X, Y, Z) whether a voxel is inside or contains surface. ``origin``: (3,) centre of voxel
    0 0 0. ``spacing``: edge length of a voxel.
    """

    filled: NDArray[np.bool_]
    origin: Array
    spacing: float

    def centres(self, voxels: NDArray[np.integer]) -> Array:
        """Centres (N, 3) of voxels (N, 3)."""
        return np.asarray(self.origin + self.spacing * voxels)

    def voxel_of(self, points: Array) -> NDArray[np.intp]:
        """Voxels (N, 3) that contain points (N, 3), or the nearest voxels of the grid."""
        voxels = np.rint((points - self.origin) / self.spacing).astype(np.intp)
        return np.clip(voxels, 0, np.array(self.filled.shape) - 1)


def solid(mesh: Mesh, spacing: float) -> Volume:
    """Fill a mesh with voxels of edge length ``spacing``.

    A voxel is inside if the surface encloses it in a slice across at least one axis, and if there is surface
    in at least five of the six axis directions. So holes (an open neck, an empty sleeve) do not empty the
    body. Raises MeshError if there would be too many voxels.
    """
    points = surface_points(mesh, 0.7 * spacing)
    low = spacing * (np.floor(points.min(0) / spacing) - 2)  # same grid left and right
    shape = np.ceil((points.max(0) - low) / spacing).astype(np.int64) + 3
    if np.prod(shape.astype(float)) > _MAX_VOXELS:
        raise MeshError("the mesh is far wider or deeper than a person of its height")
    surface = np.zeros(tuple(shape), dtype=bool)
    surface[tuple(np.rint((points - low) / spacing).astype(np.intp).T)] = True
    sides, enclosed = np.zeros(surface.shape, dtype=np.uint8), np.zeros(surface.shape, dtype=bool)
    for axis in range(3):
        sides += np.logical_or.accumulate(surface, axis=axis)
        sides += np.flip(np.logical_or.accumulate(np.flip(surface, axis), axis=axis), axis)
        enclosed |= _enclosed(surface, axis)
    return Volume(surface | (enclosed & (sides >= _SIDES)), low, spacing)


def _enclosed(surface: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    """Voxels that cannot be reached from the border within slices across an axis."""
    neighbours = np.array(scipy.ndimage.generate_binary_structure(3, 1))
    index = [slice(None)] * 3
    for side in (0, 2):
        index[axis] = slice(side, side + 1)
        neighbours[tuple(index)] = False
    # the border is empty, so the outside of a slice has the label of its corner
    label, _ = scipy.ndimage.label(~surface, structure=neighbours)
    corner = [slice(0, 1)] * 3
    corner[axis] = slice(None)
    return np.asarray(~surface & (label != label[tuple(corner)]))


def surface_points(mesh: Mesh, spacing: float) -> Array:
    """Sample all faces with points (P, 3), at most ``spacing`` apart."""
    corners = mesh.vertices[mesh.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.ceil(sides / spacing).astype(np.int64)
    if (parts.astype(float) ** 2 / 2).sum() > _MAX_VOXELS:
        raise MeshError("the mesh has faces far larger than a person's")
    points = [mesh.vertices[np.unique(mesh.triangles)]]
    for count in np.unique(parts[parts > 1]):
        i, j = np.indices((count + 1, count + 1)).reshape(2, -1)
        inside = i + j <= count
        shares = np.stack([i, j, count - i - j], axis=1)[inside] / count
        points.append(np.einsum("pk,nkd->npd", shares, corners[parts == count]).reshape(-1, 3))
    return np.concatenate(points)
