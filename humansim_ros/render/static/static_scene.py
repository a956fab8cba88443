"""The static scene on the device: all meshes that never move, in common buffers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.files.mesh import Mesh, closed_surfaces, padded, welded
from humansim_ros.render.device.lens_tessellation import NEAR, LensView, TessellatedMesh
from humansim_ros.render.device.mesh_buffers import (
    ExpandedMesh,
    MaterialBuffers,
    PosedMesh,
    Topology,
    TriangleBuffers,
)
from humansim_ros.render.static.charts import Charts
from humansim_ros.render.static.static_edges import StaticEdges
from humansim_ros.types import Array, Float32Array, Indices

#: Level triangles are a floor if their height is within this of z = 0, metres.
FLOOR_SLACK = 0.02
#: Texels of the light map along the longest side of the scene.
_LIGHT_TEXELS = 208
_WHITE = np.full((1, 3), 255, np.uint8)


class StaticScene:
    """Meshes in ``map`` with their materials on the device.

    Args:
        ctx: OpenGL context.
        meshes: The meshes.
    """

    def __init__(self, ctx: moderngl.Context, meshes: Sequence[Mesh]) -> None:
        self._ctx = ctx
        # small meshes first, since they hide parts of large ones; and meshes of one material together
        made = MaterialBuffers.of_meshes(ctx, meshes)
        number = {id(one): number for number, (one, _) in enumerate(made)}
        keys = [(_size_class(mesh), number[id(one)]) for mesh, (one, _) in zip(meshes, made, strict=True)]
        order = sorted(range(len(meshes)), key=keys.__getitem__)
        meshes = [meshes[number] for number in order]
        self._materials = [made[number][0] for number in order]
        self._counts = [len(mesh.triangles) for mesh in meshes]
        self._owner: Indices = np.repeat(np.arange(len(meshes)), self._counts)
        self._opaque = np.array([mesh.material is None for mesh in meshes], bool)
        self._attributes, self._corners = np.zeros((0, 12), np.float32), np.zeros((0, 3), np.int32)
        if meshes:
            whole = _joined(meshes)
            expanded, posed = ExpandedMesh(whole), PosedMesh(Topology(whole), whole.vertices.astype("f4"))
            layers = np.repeat([made[number][1] for number in order], [len(mesh.vertices) for mesh in meshes])
            self._attributes = np.column_stack([expanded.attributes(posed), layers[expanded.source]])
            self._attributes = self._attributes.astype(np.float32)
            self._corners = expanded.corners
        self._buffers = TriangleBuffers(ctx, self._attributes, self._corners)

    def chart(self) -> Charts:
        """Compute the charts of the light map. From then on, each vertex has a place in the light map."""
        positions = self._attributes[:, :3]
        texel = max(float(np.ptp(positions, axis=0).max()), 1e-3) / _LIGHT_TEXELS
        charts = Charts.of(positions, self._corners, texel)
        places = charts.coordinates / np.array(charts.size, np.float32)
        self._attributes = np.concatenate([self._attributes[charts.source], places], axis=1)
        self._corners = charts.corners
        self._buffers.release()
        self._buffers = TriangleBuffers(self._ctx, self._attributes, self._corners)
        return charts

    @property
    def box(self) -> Float32Array | None:
        """(3, 8) corners of the bounding box. None if there is no mesh."""
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
        """Edges of the triangles. None if there are none."""
        if not len(self._corners):
            return None
        return StaticEdges(self._attributes[:, :3], self._corners, self._owner)

    @cached_property
    def _areas(self) -> tuple[Array, Array]:
        """(N, 3) outward normals of the triangles, with twice the area as length; and (N, 3) a corner of
        each."""
        a, b, c = (self._attributes[self._corners[:, i], :3].astype(float) for i in range(3))
        return np.cross(b - a, c - a), a

    @cached_property
    def _closed_boxes(self) -> Array:
        """(M, 2, 3) lowest and highest corner of the bounding box of each closed mesh. NaN for open
        meshes."""
        points = self._attributes[self._corners, :3].astype(float)
        starts = np.cumsum([0, *self._counts])[:-1]
        boxes = np.stack(
            [bound.reduceat(points, starts).reshape(-1, 3, 3) for bound in (np.minimum, np.maximum)]
        )
        boxes = np.stack([boxes[0].min(axis=1), boxes[1].max(axis=1)], axis=1)
        owner = np.repeat(self._owner, 3)
        places = welded(np.column_stack([points.reshape(-1, 3), owner])).reshape(-1, 3)
        boxes[~self._opaque | ~closed_surfaces(points, places, self._owner)] = np.nan
        return boxes

    def _visible(self, eye: Array) -> Indices:
        """Triangles that may be visible from ``eye`` (3,). The backs of closed meshes are left out if the eye
        is outside."""
        low, high = self._closed_boxes.transpose(1, 0, 2)
        outside = ((eye < low - NEAR) | (eye > high + NEAR)).any(axis=1)  # false for NaN
        normals, corner = self._areas
        front = np.einsum("ij,ij->i", normals, eye - corner) > 0
        return np.flatnonzero(front | ~outside[self._owner])

    def facing(self, direction: Array) -> StaticTriangles:
        """Return the triangles with their fronts towards a direction."""
        towards = np.flatnonzero(self._areas[0] @ direction > 0)
        buffers = TriangleBuffers(self._ctx, self._attributes, self._corners[towards])
        return StaticTriangles(buffers, self._materials, self._count(towards), towards)

    def tessellated(self, camera: Camera, tolerance: float, checked: bool = False) -> StaticTriangles:
        """Return the triangles that a camera may see, tessellated if its lens bends edges.

        ``tolerance``, ``checked``: see :meth:`LensView.tessellate`.
        """
        visible = self._visible(camera.center)
        corners = self._corners[visible].astype(np.intp)
        mesh = TessellatedMesh(self._attributes, corners, np.arange(len(visible)))
        if camera.distorted:
            mesh = LensView(camera).tessellate(mesh.attributes, mesh.triangles, tolerance, checked)
        parents = visible[mesh.parents]
        order = np.argsort(self._owner[parents].astype(np.int32), kind="stable")
        buffers = TriangleBuffers(self._ctx, mesh.attributes, mesh.triangles[order])
        return StaticTriangles(buffers, self._materials, self._count(parents), parents[order])

    def _count(self, triangles: Indices) -> list[int]:
        """Number of triangles of each mesh."""
        counts: list[int] = np.bincount(self._owner[triangles], minlength=len(self._materials)).tolist()
        return counts


class StaticTriangles:
    """Triangles of a static scene on the device. ``with`` releases them unless they are shared. ``parents``:
    (N,) number of each triangle in the scene."""

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

    @cached_property
    def _opaque(self) -> list[bool]:
        """Whether the material of each mesh is opaque (does not blend)."""
        return [not one.blends for one in self._materials]

    def __enter__(self) -> StaticTriangles:
        return self

    def __exit__(self, *_: object) -> None:
        if not self._shared:
            self._buffers.release()

    def draw(self, program: moderngl.Program) -> None:
        """Draw all triangles with an opaque material."""
        self._buffers.draw(program, self._materials, self._counts, self._opaque, first_id=1)

    def triangles(self, ids: NDArray[np.uint32]) -> Indices:
        """(H * W,) triangle of the scene at each pixel of an image (H, W) of ids; -1 for none."""
        return np.append(np.intp(-1), self._parents)[ids.ravel()]

    def draw_all(self, program: moderngl.Program, mode: int = moderngl.TRIANGLES) -> None:
        """Draw all triangles, or points at their corners."""
        self._buffers.draw(program, self._materials, self._counts, mode=mode)

    def draw_transparent(self, program: moderngl.Program, eye: Array) -> None:
        """Draw the triangles with a blending material, sorted by distance from ``eye``, farthest first."""
        transparent = [one.blends for one in self._materials]
        self._buffers.draw(program, self._materials, self._counts, transparent, eye)


def _size_class(mesh: Mesh) -> int:
    """Class of the size of a mesh: its logarithm, rounded down."""
    return int(np.floor(np.log2(max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-3))))


def _joined(meshes: Sequence[Mesh]) -> Mesh:
    """Join the shape, texture coordinates and colours of several meshes that share no vertices."""
    from scipy.sparse import block_diag

    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    uvs = [np.zeros((1, 2)) if mesh.uv is None else mesh.uv for mesh in meshes]
    first_uvs = np.cumsum([0, *map(len, uvs)])
    faces = [mesh.triangles + first for mesh, first in zip(meshes, firsts, strict=False)]
    uv_faces = [
        (np.zeros_like(mesh.triangles) if mesh.uv_triangles is None else mesh.uv_triangles) + first
        for mesh, first in zip(meshes, first_uvs, strict=False)
    ]
    colors = [
        _WHITE.repeat(len(mesh.vertices), axis=0) if mesh.colors is None else mesh.colors for mesh in meshes
    ]
    shading = None
    if any(mesh.shading is not None for mesh in meshes):
        shading = block_diag([Topology(mesh).shading for mesh in meshes], format="csr")
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        padded(np.concatenate(faces)),
        np.concatenate(uvs),
        padded(np.concatenate(uv_faces)),
        np.concatenate(colors),
        shading=shading,
    )


def bounding_box(points: Sequence[Float32Array]) -> Float32Array:
    """(3, 8) corners of the box around clouds of points (3, N)."""
    low = np.min([cloud.min(axis=1) for cloud in points], axis=0)
    high = np.max([cloud.max(axis=1) for cloud in points], axis=0)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=0)
    return np.asarray(corners.reshape(3, 8), dtype=np.float32)
