"""The inside of a mesh as small cubes: sound for open, torn and many-piece surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from humansim_ros.errors import MeshError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array

#: Cubes at most; a person of 160 cubes' height has a twentieth of it.
_MAX_CUBES = 20_000_000
#: Sides of six to which the inside sees the surface.
_SIDES = 5


@dataclass(frozen=True)
class Volume:
    """``filled``: (X, Y, Z) whether a cube is inside or holds surface. ``origin``: (3,) centre of cube 0 0 0;
    ``spacing``: edge of the cubes.
    """

    filled: NDArray[np.bool_]
    origin: Array
    spacing: float

    def centres(self, cubes: NDArray[np.integer]) -> Array:
        """Points (N, 3) at the centres of cubes (N, 3)."""
        return np.asarray(self.origin + self.spacing * cubes)

    def cube_of(self, points: Array) -> NDArray[np.intp]:
        """The cubes (N, 3) that points (N, 3) lie in, or the nearest ones at the border."""
        cubes = np.rint((points - self.origin) / self.spacing).astype(np.intp)
        return np.clip(cubes, 0, np.array(self.filled.shape) - 1)


def solid(mesh: Mesh, spacing: float) -> Volume:
    """The inside of a mesh, in cubes of edge ``spacing``.

    A cube is inside if the surface encloses it in a slice along one of the axes at least, and if it sees
    surface to five sides of six at least: a hole (an open neck, a sleeve without a hand) does not empty the
    body. Raises MeshError if there would be too many cubes.
    """
    points = surface_points(mesh, 0.7 * spacing)
    low = spacing * (np.floor(points.min(0) / spacing) - 2)  # cubes lie alike left and right
    shape = np.ceil((points.max(0) - low) / spacing).astype(np.int64) + 3
    if np.prod(shape.astype(float)) > _MAX_CUBES:
        raise MeshError("the mesh is far wider or deeper than a person of its height")
    surface = np.zeros(tuple(shape), dtype=bool)
    surface[tuple(np.rint((points - low) / spacing).astype(np.intp).T)] = True
    seen, enclosed = np.zeros(surface.shape, dtype=np.uint8), np.zeros(surface.shape, dtype=bool)
    for axis in range(3):
        seen += np.logical_or.accumulate(surface, axis=axis)
        seen += np.flip(np.logical_or.accumulate(np.flip(surface, axis), axis=axis), axis)
        enclosed |= _enclosed(surface, axis)
    return Volume(surface | (enclosed & (seen >= _SIDES)), low, spacing)


def _enclosed(surface: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    """The cubes that cannot be reached from the border within slices across an axis."""
    neighbours = np.array(ndimage.generate_binary_structure(3, 1))
    index = [slice(None)] * 3
    for side in (0, 2):
        index[axis] = slice(side, side + 1)
        neighbours[tuple(index)] = False
    # the border is empty all round, so all that is outside a slice has the number of its corner
    number, _ = ndimage.label(~surface, structure=neighbours)
    corner = [slice(0, 1)] * 3
    corner[axis] = slice(None)
    return np.asarray(~surface & (number != number[tuple(corner)]))


def surface_points(mesh: Mesh, spacing: float) -> Array:
    """Points (P, 3) all over the faces, none of them farther than ``spacing`` from its neighbours."""
    corners = mesh.vertices[mesh.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.ceil(sides / spacing).astype(np.int64)
    if (parts.astype(float) ** 2 / 2).sum() > _MAX_CUBES:
        raise MeshError("the mesh has faces far larger than a person's")
    points = [mesh.vertices[np.unique(mesh.triangles)]]
    for count in np.unique(parts[parts > 1]):
        i, j = np.indices((count + 1, count + 1)).reshape(2, -1)
        inside = i + j <= count
        shares = np.stack([i, j, count - i - j], axis=1)[inside] / count
        points.append(np.einsum("pk,nkd->npd", shares, corners[parts == count]).reshape(-1, 3))
    return np.concatenate(points)
