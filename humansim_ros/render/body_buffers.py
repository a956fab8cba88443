"""Bodies on the device, for as long as their meshes live."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.caches import LruCache, WeakCache
from humansim_ros.render.contact_shadow import REACH, ContactShadow
from humansim_ros.render.lens_tessellation import LensView, TessellatedMesh
from humansim_ros.render.mesh_buffers import ExpandedMesh, MaterialBuffers, TriangleBuffers
from humansim_ros.render.posed_mesh import PosedMesh, Topology
from humansim_ros.render.projected_points import wider_than
from humansim_ros.render.renderer import Body
from humansim_ros.types import Float32Array

#: Poses of a body whose derived arrays are cached: those of some frames, and of an exposure.
_MAX_POSES = 12


class BodyCache:
    """Buffers of bodies on the device. They are released some time after their mesh is gone.

    ``lit``, ``ids``: programs that draw bodies with colour, and without.
    """

    def __init__(self, ctx: moderngl.Context, lit: moderngl.Program, ids: moderngl.Program) -> None:
        self._ctx, self._programs = ctx, (lit, ids)
        self._meshes: WeakCache[_MeshBuffers] = WeakCache()

    def __len__(self) -> int:
        return len(self._meshes)

    def pose(self, body: Body) -> PosedBody:
        """Upload a body. It must be drawn before another body with its mesh and instance is uploaded."""
        buffers = self._meshes.get(body.mesh)
        if buffers is None:
            buffers = self._meshes.put(body.mesh, _MeshBuffers(self._ctx, body.mesh, self._programs))
        return buffers.body(body.instance).pose(body)

    def release_unused(self) -> None:
        """Release the buffers of meshes that are gone. The OpenGL context must be current."""
        for buffers in self._meshes.take_orphans():
            buffers.release()


class _MeshBuffers:
    """Parts of bodies that follow from their mesh alone."""

    def __init__(
        self, ctx: moderngl.Context, mesh: Mesh, programs: tuple[moderngl.Program, moderngl.Program]
    ) -> None:
        self.ctx, self.programs = ctx, programs
        self.topology, self.expanded, self.material = (
            Topology(mesh),
            ExpandedMesh(mesh),
            MaterialBuffers(ctx, mesh),
        )
        self.closed = mesh.closed
        self.has_skin_mask = mesh.texture is not None and mesh.skin is not None
        self.uv_colors = ctx.buffer(self.expanded.uv_colors.tobytes())
        self._bodies: dict[int, _BodyBuffers] = {}

    def body(self, instance: int) -> _BodyBuffers:
        """Return the buffers of an instance: bodies of one frame may share a mesh."""
        if instance not in self._bodies:
            self._bodies[instance] = _BodyBuffers(self)
        return self._bodies[instance]

    def release(self) -> None:
        for body in self._bodies.values():
            body.release()
        self.material.release()
        self.uv_colors.release()


class _BodyBuffers:
    """Positions, normals and visible triangles of a body on the device."""

    def __init__(self, mesh: _MeshBuffers) -> None:
        ctx, expanded, (lit, ids) = mesh.ctx, mesh.expanded, mesh.programs
        self.mesh = mesh
        size = len(expanded.source) * 12
        self.positions, self.normals = (ctx.buffer(reserve=size, dynamic=True) for _ in range(2))
        self._index = ctx.buffer(expanded.corners.tobytes(), dynamic=True)
        self._lit = ctx.vertex_array(
            lit,
            [
                (self.positions, "3f", "position"),
                # (unlit shaders have no normals)
                *([(self.normals, "3f", "normal")] if "normal" in lit else []),
                (mesh.uv_colors, "2f 3f", "uv", "color"),
            ],
            index_buffer=self._index,
        )
        self._ids = ctx.vertex_array(ids, [(self.positions, "3f", "position")], index_buffer=self._index)
        self._depths: moderngl.VertexArray | None = None
        self._all: moderngl.Buffer | None = None
        self._poses: LruCache[int, tuple[weakref.ref[Body], PosedMesh]] = LruCache(_MAX_POSES)
        self._uploaded: PosedMesh | None = None
        self._normals_of: PosedMesh | None = None

    def pose(self, body: Body) -> PosedBody:
        """Upload the positions of a body."""
        key = id(body)
        entry = self._poses.get(key)
        if entry is None or entry[0]() is not body:
            poses = self._poses
            reference = weakref.ref(body, lambda _: poses.discard(key))
            entry = poses.put(key, (reference, PosedMesh(self.mesh.topology, body.vertices)))
        posed = entry[1]
        if posed is not self._uploaded:
            self._upload(self.positions, posed.vertices)
            self._uploaded = posed
        return PosedBody(body, posed, self)

    def upload_normals(self, posed: PosedMesh) -> None:
        if self._normals_of is not posed:
            self._upload(self.normals, posed.normals)
            self._normals_of = posed

    def draw(self, lit: bool, triangles: NDArray[np.intp]) -> None:
        corners = self.mesh.expanded.corners.take(triangles, axis=0)
        if not len(corners):
            return
        self._index.orphan()
        self._index.write(corners)
        self.mesh.material.texture.use(0)
        (self._lit if lit else self._ids).render(moderngl.TRIANGLES, vertices=corners.size)

    def draw_depths(self, program: moderngl.Program) -> None:
        if self._depths is None:
            ctx = self.mesh.ctx
            self._all = ctx.buffer(self.mesh.expanded.corners.tobytes())
            self._depths = ctx.vertex_array(
                program, [(self.positions, "3f", "position")], index_buffer=self._all
            )
        self._depths.render(moderngl.TRIANGLES)

    def release(self) -> None:
        for one in (self._lit, self._ids, self._depths, self._all, self.positions, self.normals, self._index):
            if one is not None:
                one.release()

    def _upload(self, buffer: moderngl.Buffer, values: Float32Array) -> None:
        buffer.orphan()
        buffer.write(values.take(self.mesh.expanded.source, axis=0))


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A body whose pose is on the device, for the duration of one draw."""

    body: Body
    posed: PosedMesh
    _buffers: _BodyBuffers

    @property
    def topology(self) -> Topology:
        """Topology of the mesh."""
        return self._buffers.mesh.topology

    @property
    def closed(self) -> bool:
        """See :attr:`humansim_ros.mesh.mesh.Mesh.closed`."""
        return self._buffers.mesh.closed

    @property
    def has_skin_mask(self) -> bool:
        """Whether the texture says where skin is."""
        return self._buffers.mesh.has_skin_mask

    @property
    def near_floor(self) -> bool:
        """Whether the body may cast a contact shadow."""
        return self.body.kind == "human" or float(self.posed.points[2].min()) < REACH

    @property
    def contact_shadow(self) -> ContactShadow:
        """Contact shadow of the body on the floor."""
        return self.posed.human_shadow if self.body.kind == "human" else self.posed.object_shadow

    def draw(self, lit: bool, triangles: NDArray[np.intp]) -> None:
        """Draw the triangles of some indices (M,)."""
        if lit:
            self._buffers.upload_normals(self.posed)
        self._buffers.draw(lit, triangles)

    def draw_depths(self, program: moderngl.Program) -> None:
        """Draw all triangles with a program that needs positions only. It must be the same in each call."""
        self._buffers.draw_depths(program)

    def tessellated(self, camera: Camera, angle: float) -> TessellatedMesh | None:
        """Return the body tessellated for a lens; None if the lens bends no edge visibly.

        ``angle``: radians below which edges are visibly straight.
        """
        offsets = self.posed.points - camera.center.astype(np.float32)[:, None]
        closest = float(np.sqrt(np.einsum("ij,ij->j", offsets, offsets).min()))
        vertices = self.posed.vertices
        # objects may have any size
        edges = self.topology.edges
        if self.body.kind == "human":
            edges = self.topology.edges_longer(angle * closest)
        starts, ends = vertices[edges.T]
        wide = wider_than(angle, starts, ends, camera)
        view, expanded = LensView(camera), self._buffers.mesh.expanded
        if not view.bent(camera.to_optical(starts[wide]), camera.to_optical(ends[wide])).any():
            return None
        return view.tessellate(
            expanded.attributes(self.posed).astype(float), expanded.corners.astype(np.intp)
        )

    @property
    def whole(self) -> TessellatedMesh:
        """All triangles as they are, not tessellated."""
        expanded = self._buffers.mesh.expanded
        corners = expanded.corners.astype(np.intp)
        return TessellatedMesh(
            expanded.attributes(self.posed).astype(float), corners, np.arange(len(corners))
        )

    @property
    def material(self) -> MaterialBuffers:
        """Texture and material of the mesh."""
        return self._buffers.mesh.material

    def draw_tessellated(self, program: moderngl.Program, tessellated: TessellatedMesh) -> None:
        """Draw tessellated triangles."""
        mesh = self._buffers.mesh
        with TriangleBuffers(mesh.ctx, tessellated.attributes, tessellated.triangles) as pieces:
            pieces.draw(program, [mesh.material], [len(tessellated.triangles)])
