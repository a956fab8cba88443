"""The static scene on the device: all meshes that never move, in common buffers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.charts import Charts
from humansim_ros.render.lens_tessellation import LensView
from humansim_ros.render.mesh_buffers import (
    ExpandedMesh,
    MaterialBuffers,
    PosedMesh,
    Topology,
    TriangleBuffers,
)
from humansim_ros.render.static_edges import StaticEdges
from humansim_ros.types import Array, Float32Array, Indices

#: Metres from z = 0 within which level triangles are a floor.
FLOOR_SLACK = 0.02
#: Texels of the light map along the longest side of the scene.
_LIGHT_TEXELS = 208


class StaticScene:
    """Meshes in ``map`` with their materials on the device.

    Args:
        ctx: OpenGL context.
        meshes: The meshes.
        charted: Lay out the triangles for a light map.
    """

    def __init__(self, ctx: moderngl.Context, meshes: Sequence[Mesh], charted: bool = False) -> None:
        self._ctx = ctx
        self._materials = MaterialBuffers.of_meshes(ctx, meshes)
        attributes: list[Float32Array] = [np.zeros((0, 11), np.float32)]
        corners: list[NDArray[Any]] = [np.zeros((0, 3), np.int32)]
        first = 0
        for mesh in meshes:
            expanded = ExpandedMesh(mesh)
            attributes.append(
                expanded.attributes(PosedMesh(Topology(mesh), mesh.vertices.astype(np.float32)))
            )
            corners.append(expanded.corners + np.int32(first))
            first += len(attributes[-1])
        self._attributes, self._corners = np.concatenate(attributes), np.concatenate(corners)
        self._counts = [len(mesh.triangles) for mesh in meshes]
        #: where the triangles are in the light map
        self.charts: Charts | None = None
        if charted and len(self._corners):
            self._chart()
        self._ends: Indices = np.cumsum(self._counts, dtype=np.intp)
        self._buffers = TriangleBuffers(ctx, self._attributes, self._corners)

    def _chart(self) -> None:
        positions = self._attributes[:, :3]
        texel = max(float(np.ptp(positions, axis=0).max()), 1e-3) / _LIGHT_TEXELS
        self.charts = charts = Charts.of(positions, self._corners, texel)
        places = charts.coordinates / np.array(charts.size, np.float32)
        self._attributes = np.concatenate([self._attributes[charts.source], places], axis=1)
        self._corners = charts.corners

    @property
    def box(self) -> Float32Array | None:
        """(3, 8) corners of the bounding box, None if there is no mesh."""
        return bounding_box([self._attributes[:, :3].T]) if len(self._attributes) else None

    @cached_property
    def has_floor(self) -> bool:
        """Whether a triangle lies in the plane z = 0."""
        return bool((np.abs(self._attributes[self._corners, 2]) < FLOOR_SLACK).all(axis=1).any())

    @property
    def switches(self) -> list[str]:
        """Shader switches that the materials need."""
        return ["PBR"] if any(one.material is not None for one in self._materials) else []

    @property
    def blends(self) -> bool:
        """Whether a material blends with the surfaces behind it."""
        return any(one.blends for one in self._materials)

    @property
    def whole(self) -> StaticTriangles:
        """All triangles."""
        parents = np.arange(len(self._corners))
        return StaticTriangles(self._buffers, self._materials, self._counts, parents, shared=True)

    @cached_property
    def edges(self) -> StaticEdges | None:
        """Edges of the triangles, None if there are none."""
        if not len(self._corners):
            return None
        owner = np.repeat(np.arange(len(self._counts)), self._counts)
        return StaticEdges(self._attributes[:, :3], self._corners, owner)

    def facing(self, direction: Array) -> StaticTriangles:
        """Return the triangles whose front faces a direction."""
        a, b, c = (self._attributes[self._corners[:, i], :3] for i in range(3))
        towards = np.einsum("ij,j->i", np.cross(b - a, c - a), direction) > 0
        owner = np.repeat(np.arange(len(self._counts)), self._counts)[towards]
        counts = np.bincount(owner, minlength=len(self._counts)).tolist()
        buffers = TriangleBuffers(self._ctx, self._attributes, self._corners[towards])
        return StaticTriangles(buffers, self._materials, counts, np.flatnonzero(towards))

    def tessellated(self, camera: Camera, tolerance: float) -> StaticTriangles:
        """Return the triangles for a camera, tessellated if its lens bends edges by more than ``tolerance``
        pixels.
        """
        if not camera.distorted:
            return self.whole
        whole = self._attributes.astype(float), self._corners.astype(np.intp)
        tessellated = LensView(camera).tessellate(*whole, tolerance)
        owner: Indices = np.searchsorted(self._ends, tessellated.parents, side="right")
        order = np.argsort(owner, kind="stable")
        counts = np.bincount(owner, minlength=len(self._materials)).tolist()
        buffers = TriangleBuffers(self._ctx, tessellated.attributes, tessellated.triangles[order])
        return StaticTriangles(buffers, self._materials, counts, tessellated.parents[order])


class StaticTriangles:
    """Triangles of a static scene on the device; ``with`` releases them unless they are shared.

    ``parents``: (N,) number of each triangle in the scene.
    """

    def __init__(
        self,
        buffers: TriangleBuffers,
        materials: Sequence[MaterialBuffers],
        counts: Sequence[int],
        parents: Indices,
        shared: bool = False,
    ) -> None:
        self._buffers, self._materials, self._counts = buffers, materials, counts
        self._parents, self._shared = parents, shared

    def __enter__(self) -> StaticTriangles:
        return self

    def __exit__(self, *_: object) -> None:
        if not self._shared:
            self._buffers.release()

    def draw(self, program: moderngl.Program) -> None:
        """Draw all triangles whose material does not blend."""
        opaque = [not one.blends for one in self._materials]
        self._buffers.draw(program, self._materials, self._counts, opaque, first_id=1)

    def triangles(self, ids: NDArray[np.uint32]) -> Indices:
        """(H * W,) triangle of the scene at each pixel of an image (H, W) of ids; -1 for none."""
        return np.append(np.intp(-1), self._parents)[ids.ravel()]

    def draw_all(self, program: moderngl.Program, mode: int = moderngl.TRIANGLES) -> None:
        """Draw all triangles, or points at their corners."""
        self._buffers.draw(program, self._materials, self._counts, mode=mode)

    def draw_transparent(self, program: moderngl.Program, eye: Array) -> None:
        """Draw the triangles whose material blends, sorted by distance from ``eye``, farthest first."""
        transparent = [one.blends for one in self._materials]
        self._buffers.draw(program, self._materials, self._counts, transparent, eye)


def bounding_box(points: Sequence[Float32Array]) -> Float32Array:
    """(3, 8) corners of the box around clouds of points (3, N)."""
    low = np.min([cloud.min(axis=1) for cloud in points], axis=0)
    high = np.max([cloud.max(axis=1) for cloud in points], axis=0)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=0)
    return np.asarray(corners.reshape(3, 8), dtype=np.float32)
