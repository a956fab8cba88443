"""Bodies on the device, and where their vertices fall in the image."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render.contact_shadow import REACH, ContactShadow
from humansim_ros.render.edge_antialiasing import ImageEdges
from humansim_ros.render.lens_tessellation import NEAR, LensView, TessellatedMesh
from humansim_ros.render.posed_mesh import PosedMesh, Topology
from humansim_ros.render.renderer import Body
from humansim_ros.render.static_scene import ExpandedMesh, MaterialBuffers, TriangleBuffers
from humansim_ros.render.target import Rectangle
from humansim_ros.types import Array, Float32Array

#: Pixels by which a triangle that is said to miss the centres of all pixels surely does: places are computed
#: in single precision, here and on the device, which rounds them to 1/256 of a pixel.
_SURELY = np.float32(1 / 64)
#: Poses of a body of which is kept what was worked out: those of some frames, and of an exposure.
_MAX_POSES = 12


class BodyBuffers:
    """A mesh on the device. Vertices on texture seams are there twice, once per texture coordinate."""

    def __init__(
        self,
        ctx: moderngl.Context,
        topology: Topology,
        body: Body,
        lit: moderngl.Program,
        truth: moderngl.Program,
    ) -> None:
        self._ctx = ctx
        self.topology = topology
        mesh = topology.mesh
        self._expanded = ExpandedMesh(mesh)
        self._source, self._corners = self._expanded.source, self._expanded.corners
        looks = self._expanded.looks
        self.dressed = mesh.texture is not None and mesh.skin is not None
        self._look = MaterialBuffers(ctx, mesh)
        self._positions, self._normals = (ctx.buffer(reserve=len(looks) * 12, dynamic=True) for _ in range(2))
        self._looks = ctx.buffer(looks.tobytes())
        self._index = ctx.buffer(self._corners.tobytes(), dynamic=True)
        self._lit = ctx.vertex_array(
            lit,
            [
                (self._positions, "3f", "position"),
                # (without light nobody asks for them)
                *([(self._normals, "3f", "normal")] if "normal" in lit else []),
                (self._looks, "2f 3f", "uv", "color"),
            ],
            index_buffer=self._index,
        )
        self._truth = ctx.vertex_array(truth, [(self._positions, "3f", "position")], index_buffer=self._index)
        self._depths: moderngl.VertexArray | None = None
        self._kept: dict[int, tuple[Body, PosedMesh]] = {}
        self._pose(body)

    @property
    def near_floor(self) -> bool:
        """Whether it may leave a shadow under it."""
        return self.body.kind == "human" or float(self.posed.points[2].min()) < REACH

    @property
    def shadow(self) -> ContactShadow:
        """What it leaves on the floor."""
        return self.posed.shadow if self.body.kind == "human" else self.posed.shadow_of_thing

    def stand(self, body: Body) -> None:
        """Take up the body's pose."""
        if body is not self.body:
            self._pose(body)

    def _pose(self, body: Body) -> None:
        kept = self._kept.pop(id(body), None)
        self.body, self.posed = body, PosedMesh(self.topology, body.vertices) if kept is None else kept[1]
        self._kept[id(body)] = body, self.posed  # with the body, so that its id stays its own
        if len(self._kept) > _MAX_POSES:
            self._kept.pop(next(iter(self._kept)))
        self._upload(self._positions, body.vertices)
        self._normals_of: PosedMesh | None = None

    def draw(self, lit: bool, shown: NDArray[np.intp]) -> None:
        """Draw the triangles of the numbers ``shown`` (M,)."""
        if lit and self._normals_of is not self.posed:
            self._upload(self._normals, self.posed.normals)
            self._normals_of = self.posed
        corners = self._corners.take(shown, axis=0)
        if not len(corners):
            return
        self._index.orphan()
        self._index.write(corners)
        self._look.texture.use(0)
        (self._lit if lit else self._truth).render(moderngl.TRIANGLES, vertices=corners.size)

    def draw_depths(self, program: moderngl.Program) -> None:
        """Draw all triangles with a program that needs their places alone, always the same one."""
        if self._depths is None:
            index = self._ctx.buffer(self._corners.tobytes())
            self._depths = self._ctx.vertex_array(
                program, [(self._positions, "3f", "position")], index_buffer=index
            )
        self._depths.render(moderngl.TRIANGLES)

    def refined(self, camera: Camera, angle: float) -> TessellatedMesh | None:
        """What is to be drawn where a lens bends edges, which are seen under more than an angle, visibly; or
        None.
        """
        away = self.posed.points - camera.center.astype(np.float32)[:, None]
        closest = float(np.sqrt(np.einsum("ij,ij->j", away, away).min()))
        vertices = self.posed.vertices
        # objects may be sized as one likes
        edges = self.topology.edges
        if self.body.kind == "human":
            edges = self.topology.edges_longer(angle * closest)
        starts, ends = vertices[edges.T]
        wide = _wide(starts, ends, camera, angle)
        view = LensView(camera)
        if not view.bent(camera.to_optical(starts[wide]), camera.to_optical(ends[wide])).any():
            return None
        return view.refine(self._expanded.attributes(self.posed).astype(float), self._corners.astype(np.intp))

    def draw_refined(self, program: moderngl.Program, refined: TessellatedMesh) -> None:
        """Draw triangles cut to pieces."""
        with TriangleBuffers(self._ctx, refined.attributes, refined.triangles) as pieces:
            pieces.draw(program, [self._look], [len(refined.triangles)])

    def _upload(self, buffer: moderngl.Buffer, values: Float32Array) -> None:
        buffer.orphan()
        buffer.write(values.take(self._source, axis=0))


class ProjectedPoints:
    """Where points (3, N) of the world fall before a camera.

    ``near``: some of them are so near that the camera may be inside what they span; ``behind``: none of them
    is before it. ``plane``: two of (N,), columns and rows, or where the lens distorts x and y of the
    normalised image plane; not to be used where ``near``.
    """

    def __init__(self, points: Float32Array, camera: Camera) -> None:
        self.camera = camera
        p = (camera.optical_from_world[:3] if camera.distorted else camera.P).astype(np.float32)
        x, y, self.depth = p[:, :3] @ points + p[:, 3:]
        self.near, self.behind = bool(self.depth.min() < 2 * NEAR), bool(self.depth.max() < 0)
        if not self.near:
            x /= self.depth
            y /= self.depth
        self.plane = x, y

    @cached_property
    def pixels(self) -> tuple[Float32Array, Float32Array]:
        """Columns and rows (N,); NaN for what the lens does not see."""
        camera = self.camera
        if not camera.distorted:
            return self.plane
        x, y = camera.K[:2, :2] @ camera.lens.distort(np.stack(self.plane, axis=1)).T + camera.K[:2, 2:]
        return x.astype(np.float32), y.astype(np.float32)

    def covering(self, corners: Sequence[NDArray[np.intp]]) -> NDArray[np.bool_]:
        """(M,) which triangles of corners, three of (M,), may cover the centre of a pixel.

        The others, half of a person's, leave no trace in the picture.
        """
        covering: NDArray[np.bool_] = np.ones(len(corners[0]), bool)
        for places in self.pixels:
            a, b, c = (places.take(corner) for corner in corners)
            low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
            covering &= ~(np.floor(high + _SURELY) < np.ceil(low - _SURELY))  # true for NaN
        return covering


def touched(clouds: Sequence[ProjectedPoints], camera: Camera) -> Rectangle:
    """The pixels that surfaces spanned by points can touch: the whole image if one comes too near."""
    width, height = camera.size
    low: Array = np.full(2, np.inf)
    high: Array = np.full(2, -np.inf)
    for cloud in clouds:
        if cloud.behind:
            continue
        if cloud.near:
            return Rectangle(0, 0, width, height, near=True)
        low = np.minimum(low, [places.min() for places in cloud.plane])
        high = np.maximum(high, [places.max() for places in cloud.plane])
    if camera.distorted:
        low, high = LensView(camera).image_of(low, high)
    if not np.isfinite(low).all():
        return Rectangle(0, 0, 0, 0)
    x0, y0 = np.clip(np.floor(low) - 2, 0, camera.size).astype(int)
    x1, y1 = np.clip(np.ceil(high) + 3, 0, camera.size).astype(int)
    return Rectangle(int(x0), int(y0), int(x1), int(y1))


def straight_angle(camera: Camera, rectangle: Rectangle) -> float:
    """Radians: edges that are seen under less a lens does not bend visibly within a rectangle."""
    return LensView(camera).straight_angle(rectangle.low, rectangle.high) if camera.distorted else 0.0


def contour(
    posed: PosedMesh, fallen: ProjectedPoints, facing: NDArray[np.bool_], angle: float
) -> list[ImageEdges]:
    """The edges of a body that all outlines lie on. ``fallen``: where its vertices do; ``facing``: (N,) its
    triangles that face the camera; ``angle``: :func:`straight_angle`.
    """
    starts, ends = posed.contour(facing)
    camera, vertices = fallen.camera, posed.vertices
    bent: NDArray[np.bool_] = np.zeros(len(starts), bool)
    if camera.distorted:
        bent = _wide(vertices.take(starts, axis=0), vertices.take(ends, axis=0), camera, angle)
    found = []
    if bent.any():
        pieces = LensView(camera).divide_edges(vertices[starts[bent]], vertices[ends[bent]])
        found.append(ImageEdges.of(camera, *pieces))
        starts, ends = starts[~bent], ends[~bent]
    if fallen.near:
        found.append(ImageEdges.of(camera, vertices.take(starts, axis=0), vertices.take(ends, axis=0)))
        return found
    (x, y), z = fallen.pixels, fallen.depth
    if camera.distorted:
        seen = np.isfinite(x.take(starts)) & np.isfinite(x.take(ends))
        starts, ends = starts[seen], ends[seen]
    found.append(ImageEdges(*((x.take(which), y.take(which), z.take(which)) for which in (starts, ends))))
    return found


def _wide(starts: Float32Array, ends: Float32Array, camera: Camera, angle: float) -> NDArray[np.bool_]:
    """Which edges (N, 3) may be seen under more than an angle, radians."""
    eye = camera.center.astype(np.float32)
    nearest = np.minimum(_squares(starts - eye), _squares(ends - eye))
    return np.asarray(_squares(ends - starts) > angle * angle * nearest)


def _squares(vectors: Float32Array) -> Float32Array:
    """(N,) squared lengths."""
    return np.asarray(np.einsum("ij,ij->i", vectors, vectors))
