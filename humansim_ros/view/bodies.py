"""People as skinned meshes of the page: bones per frame, not vertices."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.export.glb import split_seams
from humansim_ros.humans import Human
from humansim_ros.mesh.normals import SurfaceNormals
from humansim_ros.types import Array, Color
from humansim_ros.view.pictures import texture_jpeg

#: Bones per vertex of the page; the largest weights stay.
_INFLUENCES = 4
#: Longest side of a texture on the page, pixels.
_TEXTURE_SIDE = 1024
_GREY: Color = (186, 160, 145)


@dataclass(frozen=True)
class PageBody:
    """A human as the page shows it: N vertices, those at seams of the texture copied.

    Attributes:
        human: The human at rest, in body space.
        size: Scale of the body.
    """

    human: Human
    size: float = 1.0

    @cached_property
    def _split(self) -> tuple[NDArray[np.int64], Array | None, NDArray[np.uint32]]:
        return split_seams(self.human.mesh)

    @property
    def vertices(self) -> NDArray[np.float32]:
        """(N, 3) at rest."""
        return np.asarray(self.size * self.human.mesh.vertices[self._split[0]], dtype=np.float32)

    @property
    def faces(self) -> NDArray[np.uint32]:
        """(T, 3) triangles."""
        return self._split[2]

    @property
    def rest(self) -> Array:
        """Bone frames (B, 4, 4) at rest."""
        rest = self.human.skeleton.rest.copy()
        rest[:, :3, 3] *= self.size
        return rest

    @property
    def weights(self) -> NDArray[np.float32]:
        """(N, B) weights of the strongest bones; rows sum to one."""
        weights = self.human.weights.toarray()
        if weights.shape[1] > _INFLUENCES:
            least = np.partition(weights, -_INFLUENCES, axis=1)[:, -_INFLUENCES, None]
            weights = np.where(weights >= least, weights, 0.0)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.asarray(weights[self._split[0]], dtype=np.float32)

    @property
    def surface(self) -> bytes:
        """Number of vertices (uint32), normals (N, 3) and texture coordinates (N, 2), v down, as float32."""
        original, uv, _ = self._split
        mesh = self.human.mesh
        normals = SurfaceNormals(mesh.triangles, len(mesh.vertices))(mesh.vertices)[original]
        flipped = np.zeros((len(original), 2)) if uv is None else uv
        return b"".join(
            [
                np.uint32(len(original)).tobytes(),
                np.asarray(normals, dtype=np.float32).tobytes(),
                np.asarray(flipped, dtype=np.float32).tobytes(),
            ]
        )

    @property
    def texture(self) -> bytes | None:
        """JPEG of the texture; None without one."""
        image = self.human.mesh.texture
        return None if image is None else texture_jpeg(image, _TEXTURE_SIDE)

    @property
    def color(self) -> Color:
        """Mean colour, for pages that have no texture of it yet."""
        mesh = self.human.mesh
        if mesh.texture is not None:
            used = mesh.texture[::8, ::8].reshape(-1, 3)
        elif mesh.colors is not None:
            used = mesh.colors
        else:
            return _GREY
        red, green, blue = np.median(used, axis=0).astype(int)
        return int(red), int(green), int(blue)


def keyed_color(color: Color, number: int) -> Color:
    """Colour near ``color`` whose lowest bits are the number (below 512) of a body."""
    red, green, blue = (channel & ~7 for channel in color)
    return red | number & 7, green | number >> 3 & 7, blue | number >> 6 & 7
