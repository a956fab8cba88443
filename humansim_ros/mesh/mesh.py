"""Surface mesh: vertices, faces, texture coordinates, colours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.mesh.material import Material
from humansim_ros.types import Array

FaceIndices = NDArray[np.int32]
#: Larger coordinates are mistakes in any unit, and their squares may be infinite.
LARGEST = 1e9


@dataclass(frozen=True, repr=False)
class Mesh:
    """A surface of triangles and quads.

    ``vertices``: (V, 3). ``faces``: (F, 4) vertex indices, triangles padded with -1. ``uv``: (T, 2) texture
    coordinates, v up, or None; ``uv_faces``: (F, 4) indices into them. ``colors``: (V, 3) uint8 sRGB or None.
    ``texture``: (H, W, 3) uint8 sRGB, first row on top, or None. ``skin``: (H, W) uint8, share of skin in
    each texel (the rest is cloth and hair), or None. ``material``: reflection of static meshes; matt if None.

    Raises:
        MeshError: An index is out of range, a vertex is not finite, or shapes do not match.

    Example:
        >>> import numpy as np
        >>> mesh = Mesh(np.eye(3), np.array([[0, 1, 2, -1]], dtype=np.int32))
        >>> mesh.triangles
        array([[0, 1, 2]], dtype=int32)
    """

    vertices: Array
    faces: FaceIndices
    uv: Array | None = None
    uv_faces: FaceIndices | None = None
    colors: NDArray[np.uint8] | None = None
    texture: NDArray[np.uint8] | None = None
    skin: NDArray[np.uint8] | None = None
    material: Material | None = None

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or len(self.vertices) == 0:
            raise MeshError(f"a mesh needs vertices of shape (V, 3), not {self.vertices.shape}")
        if self.faces.ndim != 2 or self.faces.shape[1] != 4 or len(self.faces) == 0:
            raise MeshError("the mesh has no faces")
        for values, what in ((self.vertices, "a vertex"), (self.uv, "a texture coordinate")):
            if values is not None and not (np.abs(values) <= LARGEST).all():
                raise MeshError(f"{what} is not finite (NaN or infinity), or beyond {LARGEST:g}")
        if self.faces[:, :3].min() < 0 or self.faces.min() < -1 or self.faces.max() >= len(self.vertices):
            raise MeshError(f"a face uses a vertex outside 0..{len(self.vertices) - 1}")
        if (self.uv is None) != (self.uv_faces is None):
            raise MeshError("uv and uv_faces must be given together")
        if self.uv is not None and self.uv_faces is not None:
            used = self.uv_faces[self.faces >= 0]
            if self.uv_faces.shape != self.faces.shape or used.min() < 0 or used.max() >= len(self.uv):
                raise MeshError("a face uses a texture coordinate that does not exist")
        if self.texture is not None and self.skin is not None and self.skin.shape != self.texture.shape[:2]:
            raise MeshError(f"skin of {self.skin.shape} does not fit a texture of {self.texture.shape[:2]}")

    def __repr__(self) -> str:
        appearance = ""
        if self.texture is not None:
            appearance = f", texture {self.texture.shape[1]}x{self.texture.shape[0]}"
        elif self.colors is not None:
            appearance = ", vertex colours"
        size = " x ".join(f"{side:.3g}" for side in np.ptp(self.vertices, axis=0))
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces, size {size}{appearance})"

    @cached_property
    def triangles(self) -> FaceIndices:
        """(N, 3) vertex indices: each quad a b c d as a b c and a c d."""
        return self._split(self.faces)

    @cached_property
    def uv_triangles(self) -> FaceIndices | None:
        """(N, 3) indices into ``uv`` of the same triangles."""
        return None if self.uv_faces is None else self._split(self.uv_faces)

    @cached_property
    def triangle_faces(self) -> FaceIndices:
        """(N,) index of the face that each triangle belongs to."""
        quads = self.faces[:, 3] >= 0
        return np.repeat(np.arange(len(self.faces), dtype=np.int32), 1 + quads)

    @cached_property
    def closed(self) -> bool:
        """Whether the surface is closed and faces outwards: each edge has two faces of opposite direction.

        From outside, back faces of a closed surface are never visible and need not be drawn.
        """
        edges = self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        forward = edges[:, 0] * len(self.vertices) + edges[:, 1]
        backward = edges[:, 1] * len(self.vertices) + edges[:, 0]
        if len(np.unique(forward)) < len(forward) or not np.array_equal(np.sort(forward), np.sort(backward)):
            return False
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c))) > 0

    def _split(self, faces: FaceIndices) -> FaceIndices:
        both = faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 2, 3)
        keep = np.stack([np.ones(len(faces), dtype=bool), self.faces[:, 3] >= 0], axis=1)
        return np.ascontiguousarray(both[keep])
