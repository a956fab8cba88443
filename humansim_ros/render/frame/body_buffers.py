"""Prepare bodies for drawing: buffers on the device, pixels that bodies may cover, contours, levels of
detail."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.files.mesh import Mesh, Simplification, compact, padded, split_seams
from humansim_ros.render.device.caches import LruCache, WeakCache
from humansim_ros.render.device.lens_tessellation import NEAR, TOLERANCE, VISIBLE, LensView, TessellatedMesh
from humansim_ros.render.device.mesh_buffers import (
    REACH,
    ExpandedMesh,
    MaterialBuffers,
    PosedMesh,
    ShadowCaster,
    Topology,
    TriangleBuffers,
)
from humansim_ros.render.device.target import Rectangle
from humansim_ros.render.frame.edge_antialiasing import ImageEdges
from humansim_ros.render.interface.renderer import Body
from humansim_ros.types import Array, Float32Array, FloatArray, Indices

#: Most poses of a body for which derived arrays are cached: enough for some frames and one exposure.
_MAX_POSES = 12


class BodyCache:
    """A cache of the buffers of bodies on the device. ``lit``: program that draws bodies in colour. ``ids``:
    program that draws triangle ids only."""

    def __init__(self, ctx: moderngl.Context, lit: moderngl.Program, ids: moderngl.Program) -> None:
        self._ctx, self._programs = ctx, (lit, ids)
        self._meshes: WeakCache[MeshBuffers] = WeakCache()

    def pose(self, body: Body) -> PosedBody:
        """Return the body in its pose. The pose is uploaded when the body is drawn."""
        buffers = self._meshes.get(body.mesh)
        if buffers is None:
            buffers = self._meshes.put(body.mesh, MeshBuffers(self._ctx, body.mesh, self._programs))
        return buffers.pose(body)


class MeshBuffers:
    """Buffers of a mesh that are the same in all poses."""

    def __init__(
        self,
        ctx: moderngl.Context,
        mesh: Mesh,
        programs: tuple[moderngl.Program, moderngl.Program],
        material: MaterialBuffers | None = None,
    ) -> None:
        self.ctx, self.programs = ctx, programs
        self.topology, self.expanded = Topology(mesh), ExpandedMesh(mesh)
        self.material = material or MaterialBuffers(ctx, mesh)
        self.closed = mesh.closed
        self.has_skin_mask = mesh.texture is not None and mesh.skin is not None
        self.uv_colors = ctx.buffer(self.expanded.uv_colors.tobytes())
        self._bodies: dict[int, _BodyBuffers] = {}
        self._levels: dict[int, tuple[Indices, MeshBuffers]] = {}

    def level(self, number: int, mesh: Mesh, levels: Simplification) -> tuple[Indices, MeshBuffers]:
        """Return the vertices (v,) of the mesh that a level of detail uses, and the buffers of that level."""
        if number not in self._levels:
            _, uv, corners = split_seams(mesh)
            triangles, coordinates = levels.level(number, mesh.triangles, corners)
            kept, simpler = compact(triangles)
            shown = replace(
                mesh,
                vertices=mesh.vertices[kept],
                faces=padded(simpler),
                uv=uv,
                uv_faces=None if uv is None else padded(coordinates),
                colors=None if mesh.colors is None else mesh.colors[kept],
                shading=None,
                materials=None,
                off_body=None,
            )
            self._levels[number] = kept, MeshBuffers(self.ctx, shown, self.programs, self.material)
        return self._levels[number]

    def body(self, instance: int) -> _BodyBuffers:
        """Return the buffers of one body with this mesh. Several bodies of a frame may have the same mesh."""
        if instance not in self._bodies:
            self._bodies[instance] = _BodyBuffers(self)
        return self._bodies[instance]

    def pose(self, body: Body) -> PosedBody:
        """Return a body with this mesh in its pose."""
        buffers = self.body(body.instance)
        return PosedBody(body, buffers.pose(body, self.topology), self, buffers)


class _BodyBuffers:
    """Positions, normals and visible triangles of a body on the device. Holds no reference to the buffers of
    the mesh, which hold one to this."""

    def __init__(self, mesh: MeshBuffers) -> None:
        ctx, expanded, (lit, ids) = mesh.ctx, mesh.expanded, mesh.programs
        self._ctx, self._expanded, self._material = ctx, expanded, mesh.material
        size = len(expanded.source) * 12
        self._vertices = positions, normals = tuple(ctx.buffer(reserve=size, dynamic=True) for _ in range(2))
        #: the poses with the positions and the normals that are on the device
        self._shown: list[PosedMesh | None] = [None, None]
        self._index = ctx.buffer(expanded.corners.tobytes(), dynamic=True)
        # (unlit shaders have no normals)
        shaded = [(normals, "3f", "normal")] if "normal" in lit else []
        self._lit = ctx.vertex_array(
            lit,
            [(positions, "3f", "position"), *shaded, (mesh.uv_colors, "2f 3f", "uv", "color")],
            index_buffer=self._index,
        )
        self._ids = ctx.vertex_array(ids, [(positions, "3f", "position")], index_buffer=self._index)
        self._depths: moderngl.VertexArray | None = None
        self._poses: LruCache[int, tuple[weakref.ref[Body], PosedMesh]] = LruCache(_MAX_POSES)

    def pose(self, body: Body, topology: Topology) -> PosedMesh:
        """Return the pose of the body, from the cache or made now."""
        key, poses = id(body), self._poses
        entry = poses.get(key)
        if entry is None or entry[0]() is not body:
            reference = weakref.ref(body, lambda _: poses.discard(key))
            entry = poses.put(key, (reference, PosedMesh(topology, body.vertices)))
        return entry[1]

    def draw(self, posed: PosedMesh, lit: bool, triangles: NDArray[np.intp]) -> None:
        self._upload(posed, lit)
        corners = self._expanded.corners.take(triangles, axis=0)
        self._index.orphan()
        self._index.write(corners)
        self._material.texture.use(0)
        (self._lit if lit else self._ids).render(moderngl.TRIANGLES, vertices=corners.size)

    def draw_depths(self, posed: PosedMesh, program: moderngl.Program) -> None:
        self._upload(posed, False)
        if self._depths is None:
            positions = [(self._vertices[0], "3f", "position")]
            corners = self._ctx.buffer(self._expanded.corners.tobytes())
            self._depths = self._ctx.vertex_array(program, positions, index_buffer=corners)
        self._depths.render(moderngl.TRIANGLES)

    def _upload(self, posed: PosedMesh, normals: bool) -> None:
        """Upload the positions and, if needed, the normals of a pose, unless the device has them."""
        for number, buffer in enumerate(self._vertices[: 1 + normals]):
            if self._shown[number] is not posed:
                values = posed.normals if number else posed.vertices
                buffer.orphan()
                buffer.write(values.take(self._expanded.source, axis=0))
                self._shown[number] = posed


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A body in its pose, with its buffers on the device."""

    body: Body
    posed: PosedMesh
    mesh: MeshBuffers
    _buffers: _BodyBuffers

    def level(self, number: int) -> PosedBody:
        """The body at a level of detail."""
        levels = self.body.levels
        if not number or levels is None:
            return self
        kept, mesh = self.mesh.level(number, self.body.mesh, levels)
        posed = self.posed.level(number, mesh.topology, kept)
        return PosedBody(self.body, posed, mesh, mesh.body(self.body.instance))

    @property
    def near_floor(self) -> bool:
        """Whether the body may cast a contact shadow."""
        return self.body.kind == "human" or float(self.posed.points[2].min()) < REACH

    @property
    def shadow_caster(self) -> ShadowCaster:
        """Contact shadow of the body on the floor, computed when it is needed."""
        return self.posed.human_caster if self.body.kind == "human" else self.posed.object_caster

    def draw(self, lit: bool, triangles: NDArray[np.intp]) -> None:
        """Draw the triangles with the indices ``triangles`` (M,)."""
        if len(triangles):
            self._buffers.draw(self.posed, lit, triangles)

    def draw_depths(self, program: moderngl.Program) -> None:
        """Draw all triangles with a program that needs positions only. Each call must pass the same
        program."""
        self._buffers.draw_depths(self.posed, program)

    def bent(self, camera: Camera, angle: float) -> NDArray[np.bool_] | None:
        """(N,) for each triangle, whether the lens visibly bends one of its edges; None if no triangle has
        such an edge. ``angle``: edges that span a smaller angle (radians) look straight."""
        topology, offsets = self.mesh.topology, self.posed.points - camera.center.astype(np.float32)[:, None]
        closest = float(np.sqrt(np.einsum("ij,ij->j", offsets, offsets).min()))
        for tolerance in (VISIBLE, TOLERANCE):
            smallest = angle * (tolerance / VISIBLE) ** 0.5
            # objects may have any size, so each one is tested
            human = self.body.kind == "human"
            edges = topology.longer(smallest * closest) if human else np.arange(len(topology.edges))
            starts, ends = self.posed.vertices[topology.edges[edges].T]
            wide = _wider_than(smallest, starts, ends, camera)
            edges = edges[wide][LensView(camera).bent(starts[wide], ends[wide], tolerance)]
            if not len(edges):
                return None
        found = np.zeros(len(topology.corners[0]), bool)
        for side in topology.sides:
            found[side[edges]] = True
        return found

    def tessellated(self, camera: Camera, triangles: Indices) -> TessellatedMesh:
        """The triangles (M,), tessellated so that the lens can bend their edges."""
        expanded = self.mesh.expanded
        used, corners = np.unique(expanded.corners.take(triangles, axis=0), return_inverse=True)
        attributes = expanded.attributes(self.posed).take(used, axis=0)
        mesh = LensView(camera).tessellate(attributes, corners.reshape(-1, 3))
        return replace(mesh, parents=triangles[mesh.parents])

    @property
    def whole(self) -> TessellatedMesh:
        """All triangles of the body, not tessellated."""
        expanded = self.mesh.expanded
        corners = expanded.corners.astype(np.intp)
        return TessellatedMesh(expanded.attributes(self.posed), corners, np.arange(len(corners)))

    def draw_tessellated(self, program: moderngl.Program, tessellated: TessellatedMesh) -> None:
        """Draw tessellated triangles."""
        mesh = self.mesh
        pieces = TriangleBuffers(mesh.ctx, tessellated.attributes, tessellated.triangles)
        pieces.draw(program, [mesh.material], [len(tessellated.triangles)])


#: Tolerance when testing whether a triangle covers a pixel center, pixels: projections have single precision,
#: and the device rounds them to 1/256 of a pixel.
_ROUNDING = np.float32(1 / 64)
#: Half of ``_ROUNDING``, times the length of an edge that lies between two columns and two rows of pixel
#: centers.
_NEAR_EDGE = np.float32(3 / 128)
#: A surface is certainly hidden if another surface lies at less than this share of its depth.
_BEHIND = 0.999


class ProjectedPoints:
    """World points (3, N), projected into a camera.

    ``near``: some points are so near that the camera may be inside their surface; ``plane`` is then not
    valid. ``behind``: all points are behind the camera. ``plane``: x and y, (N,) each: columns and rows in
    pixels or, if the lens distorts, coordinates in the normalised image plane.
    """

    def __init__(self, points: Float32Array, camera: Camera) -> None:
        self.camera = camera
        p = (camera.optical_from_world[:3] if camera.distorted else camera.P).astype(np.float32)
        x, y, self.depth = p[:, :3] @ points + p[:, 3:]
        #: depth of the nearest point, metres
        self.closest = float(self.depth.min())
        self.near, self.behind = self.closest < 2 * NEAR, bool(self.depth.max() < 0)
        if not self.near:
            x /= self.depth
            y /= self.depth
        self.plane = x, y

    @cached_property
    def pixels(self) -> tuple[Float32Array, Float32Array]:
        """Columns and rows (N,). NaN beyond the field of view of the lens."""
        camera = self.camera
        if not camera.distorted:
            return self.plane
        x, y = camera.K[:2, :2] @ camera.lens.distort(np.stack(self.plane, axis=1)).T + camera.K[:2, 2:]
        return x.astype(np.float32), y.astype(np.float32)

    @cached_property
    def extent(self) -> Array:
        """(2, 2) lowest and highest x and y of ``plane``."""
        return np.array([[bound(axis) for axis in self.plane] for bound in (np.min, np.max)], float)

    @cached_property
    def rectangle(self) -> Rectangle:
        """Rectangle of the pixels that a surface with these points as corners may touch."""
        return image_bounds([self], self.camera)

    @cached_property
    def _cells(self) -> NDArray[np.int64]:
        """(N,) cell of each point in a grid with lines through the pixel centers. A cell is one number: 32
        bits for the column, 32 bits for the row. The cells at the border extend to infinity. A point on a
        line of the grid, or beyond the field of view, gets a cell that no other point has."""
        cells = np.empty((len(self.depth), 2), np.int32)
        own = -1 - np.arange(len(self.depth), dtype=np.int32)
        for axis, (places, size) in enumerate(zip(self.pixels, self.camera.size, strict=True)):
            low = np.ceil(places - _ROUNDING)
            between = (low > places + _ROUNDING) | (low < 0) | (low >= size)  # false for NaN
            np.clip(low, 0, size, out=low)
            cells[:, axis] = np.where(between, np.nan_to_num(low) if self.camera.distorted else low, own)
        return cells.view(np.int64)[:, 0]

    def covering(self, corners: Sequence[NDArray[np.intp]]) -> NDArray[np.bool_]:
        """(M,) whether each triangle may cover a pixel center. ``corners``: vertices of the triangles, three
        of (M,). Most triangles of a human are too small: no column or no row of pixel centers lies between
        their corners. Such triangles leave no trace in the image."""
        first, second, third = (self._cells.take(corner) for corner in corners)
        different = ((first ^ second) | (first ^ third)).view(np.int32).reshape(-1, 2)
        return np.asarray((different[:, 0] != 0) & (different[:, 1] != 0))

    def unhidden(self, corners: Sequence[NDArray[np.intp]], nearest: Float32Array) -> NDArray[np.bool_]:
        """(M,) whether each triangle may be visible in the image, or is hidden by the surfaces known so far.

        Most small triangles have one pixel center between their corners. Only such triangles are tested: a
        triangle is hidden if it misses the center, or if a nearer surface covers the center.

        ``corners``: vertices of the triangles, three of (M,). ``nearest``: (H, W) upper bound of the depth
        that each pixel shows, metres. The call lowers it where these triangles are nearer.
        """
        x, y = ([axis.take(corner) for corner in corners] for axis in self.pixels)
        column, row = (np.ceil(_least(each) - _ROUNDING) for each in (x, y))
        width, height = self.camera.size
        single = (_greatest(x) < column + (1 - _ROUNDING)) & (_greatest(y) < row + (1 - _ROUNDING))
        single &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
        tested = np.flatnonzero(single)
        column, row = column.take(tested), row.take(tested)
        x, y = [each.take(tested) - column for each in x], [each.take(tested) - row for each in y]
        # distance to each edge times the length of that edge, which is less than 3 pixels
        sides = [x[i] * y[j] - x[j] * y[i] for i, j in ((0, 1), (1, 2), (2, 0))]
        low, high = _least(sides), _greatest(sides)
        shown = (low > -_NEAR_EDGE) | (high < _NEAR_EDGE)
        depths = [self.depth.take(corner.take(tested)) for corner in corners]
        pixels = row.astype(np.intp) * width + column.astype(np.intp)
        covers = (low > _NEAR_EDGE) | (high < -_NEAR_EDGE)
        np.minimum.at(nearest.reshape(-1), pixels[covers], _greatest(depths)[covers])
        shown &= nearest.take(pixels) >= _BEHIND * _least(depths)
        result = np.ones(len(single), bool)
        result[tested] = shown
        return result

    def crossing(self, starts: Indices, ends: Indices) -> NDArray[np.bool_]:
        """(M,) whether the straight edges from ``starts`` (M,) to ``ends`` (M,) may cross a line through
        pixel centers."""
        return np.asarray(self._cells.take(starts) != self._cells.take(ends))

    def is_hidden(self, static: Float32Array) -> bool:
        """Whether no surface with these points as corners is visible: it is outside the image, or completely
        behind the static scene. ``static``: (H, W) depth of the static scene, metres."""
        rectangle = self.rectangle
        if rectangle.empty or rectangle.near:
            return rectangle.empty
        return float(static[rectangle.slices].max()) < _BEHIND * self.closest


#: To guess which bodies are hidden, every ``_CELL``-th pixel is tested, and a body is assumed to leave a
#: border of this share of its rectangle empty on each side.
_CELL, _UNFILLED = 4, 1 / 6
#: Fewest bodies that are drawn between two reads of depths, and most reads in a frame.
_FEWEST_DRAWN, _MAX_READS = 4, 8


class HiddenBodies:
    """Finds bodies that other bodies hide, from the depths drawn so far.

    Reading depths is slow, since the device must finish drawing first. So depths are read only when they are
    likely to show that a body is hidden. ``bodies``: in the order in which they are drawn. ``static``: (H, W)
    depth of the static scene, metres. ``rectangle``: the pixels that bodies may touch. ``read``: returns the
    depths (h, w) of the bodies drawn so far in this rectangle; 0 where there is none.
    """

    def __init__(
        self,
        bodies: Sequence[ProjectedPoints],
        static: Float32Array,
        rectangle: Rectangle,
        read: Callable[[], Float32Array],
    ) -> None:
        #: (H, W) upper bound of the depth that each pixel shows, metres
        self.depth = static.copy()
        self._within, self._read = self.depth[rectangle.slices], read
        self._likely = _likely_hidden(bodies, static) if len(bodies) > _FEWEST_DRAWN else set()
        self._drawn, self._enough = 0, max(_FEWEST_DRAWN, len(bodies) / _MAX_READS)

    def contains(self, body: ProjectedPoints) -> bool:
        """Whether the next body is hidden by others. If it is not, the caller draws it before the next
        call."""
        if body in self._likely:
            if self._drawn >= self._enough:
                depth = self._read()
                np.copyto(self._within, depth, where=depth > 0)
                self._drawn = 0
            if body.is_hidden(self.depth):
                return True
        self._drawn += 1
        return False


def _likely_hidden(bodies: Sequence[ProjectedPoints], static: Float32Array) -> set[ProjectedPoints]:
    """Bodies that would be hidden if each body in front of them filled the middle of its rectangle."""
    found = set()
    nearest = static[::_CELL, ::_CELL].copy()
    for body in bodies:
        rows, columns = (slice(one.start // _CELL, one.stop // _CELL + 1) for one in body.rectangle.slices)
        if not body.near and float(nearest[rows, columns].max()) < _BEHIND * body.closest:
            found.add(body)
        borders = (round(_UNFILLED * (one.stop - one.start)) for one in (rows, columns))
        rows, columns = (
            slice(one.start + border, one.stop - border)
            for one, border in zip((rows, columns), borders, strict=True)
        )
        np.minimum(nearest[rows, columns], np.float32(body.closest), out=nearest[rows, columns])
    return found


def _least(three: Sequence[Float32Array]) -> Float32Array:
    return np.minimum(np.minimum(three[0], three[1]), three[2])


def _greatest(three: Sequence[Float32Array]) -> Float32Array:
    return np.maximum(np.maximum(three[0], three[1]), three[2])


def image_bounds(clouds: Sequence[ProjectedPoints], camera: Camera) -> Rectangle:
    """Return the rectangle that surfaces with these corners may touch: all of the image if a surface is
    near."""
    width, height = camera.size
    low: Array = np.full(2, np.inf)
    high: Array = np.full(2, -np.inf)
    for cloud in clouds:
        if cloud.behind:
            continue
        if cloud.near:
            return Rectangle(0, 0, width, height, near=True)
        low, high = np.minimum(low, cloud.extent[0]), np.maximum(high, cloud.extent[1])
    if camera.distorted:
        low, high = LensView(camera).image_of(low, high)
    if not np.isfinite(low).all():
        return Rectangle(0, 0, 0, 0)
    x0, y0 = np.clip(np.floor(low) - 2, 0, camera.size).astype(int)
    x1, y1 = np.clip(np.ceil(high) + 3, 0, camera.size).astype(int)
    return Rectangle(int(x0), int(y0), int(x1), int(y1))


def straight_angle(camera: Camera, rectangle: Rectangle) -> float:
    """Return the angle (radians) within which edges in a rectangle look straight."""
    low, high = (rectangle.x0, rectangle.y0), (rectangle.x1, rectangle.y1)
    return LensView(camera).straight_angle(low, high) if camera.distorted else 0.0


def contour(
    posed: PosedMesh, projected: ProjectedPoints, facing: NDArray[np.bool_], angle: float
) -> list[ImageEdges]:
    """Return the contour edges of a body in the image.

    Args:
        posed, projected: The body, and its vertices in the image.
        facing: (N,) whether each triangle shows its front to the camera.
        angle: See :func:`straight_angle`.
    """
    starts, ends = posed.contour(facing)
    camera, vertices = projected.camera, posed.vertices
    bent: NDArray[np.bool_] = np.zeros(len(starts), bool)
    if camera.distorted:
        bent = _wider_than(angle, vertices.take(starts, axis=0), vertices.take(ends, axis=0), camera)
    edges = []
    if bent.any():
        *pieces, _ = LensView(camera).divide_edges(vertices[starts[bent]], vertices[ends[bent]])
        edges.append(ImageEdges.of(camera, *pieces))
        starts, ends = starts[~bent], ends[~bent]
    if projected.near:
        edges.append(ImageEdges.of(camera, vertices.take(starts, axis=0), vertices.take(ends, axis=0)))
        return edges
    crossing = projected.crossing(starts, ends)
    starts, ends = starts[crossing], ends[crossing]
    (x, y), z = projected.pixels, projected.depth
    if camera.distorted:
        finite = np.isfinite(x.take(starts)) & np.isfinite(x.take(ends))
        starts, ends = starts[finite], ends[finite]
    edges.append(ImageEdges(*((x.take(which), y.take(which), z.take(which)) for which in (starts, ends))))
    return edges


def _wider_than(angle: float, starts: Float32Array, ends: Float32Array, camera: Camera) -> NDArray[np.bool_]:
    """(N,) whether edges from ``starts`` to ``ends``, (N, 3) metres in ``map``, may span more than an angle
    (radians) when a camera looks at them."""
    eye = camera.center.astype(np.float32)
    nearest = np.minimum(_squares(starts - eye), _squares(ends - eye))
    return np.asarray(_squares(ends - starts) > angle * angle * nearest)


def _squares(vectors: Float32Array) -> Float32Array:
    """(N,) squared lengths of vectors."""
    return np.asarray(np.einsum("ij,ij->i", vectors, vectors))


#: Largest error of the surface of a level of detail, pixels.
LARGEST_ERROR = 0.1
#: A level of detail with more than this share of all vertices saves no time.
LARGEST_SHARE = 0.25
#: Points are moved by this distance, metres, to measure how many pixels they move in the image.
_STEP = 1e-3
#: Corners of a box.
_CORNERS = np.stack(np.meshgrid(*[(0, 1)] * 3), axis=-1).reshape(8, 3)


def coarsest(levels: Sequence[Simplification | None], boxes: FloatArray, camera: Camera) -> tuple[int, ...]:
    """For each body, choose the coarsest level of detail with an error below a tenth of a pixel. ``levels``:
    levels of each body; None if the body has only its full mesh. ``boxes``: lowest and highest corner of each
    body, (M, 2, 3) metres in ``map``."""
    scales = pixels_per_metre(boxes, camera)
    return tuple(
        0 if known is None else int(np.searchsorted(known.errors, LARGEST_ERROR / scale, side="right")) - 1
        for known, scale in zip(levels, scales.tolist(), strict=True)
    )


def pays(levels: Sequence[Simplification | None], chosen: Sequence[int]) -> bool:
    """Whether levels of detail save time, although the full meshes must be drawn too, for labels."""
    known = [(each.counts, number) for each, number in zip(levels, chosen, strict=True) if each is not None]
    return sum(counts[number] for counts, number in known) < LARGEST_SHARE * sum(
        counts[0] for counts, _ in known
    )


def pixels_per_metre(boxes: FloatArray, camera: Camera) -> Array:
    """(M,) image scale: the largest number of pixels per metre, in any direction, within each box (M, 2, 3).
    It is infinite near the camera and beyond the field of view."""
    corners = np.where(_CORNERS == 0, boxes[:, None, 0], boxes[:, None, 1])
    moved = corners[..., None, :] + _STEP * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    pixels, depth = camera.project(moved.reshape(-1, 3))
    at, *others = np.moveaxis(pixels.reshape(*moved.shape[:-1], 2), 2, 0)
    # the largest singular value of the derivatives (2 x 3)
    x, y = np.moveaxis((np.stack(others) - at) / _STEP, -1, 0)
    xx, yy, xy = (x * x).sum(axis=0), (y * y).sum(axis=0), (x * y).sum(axis=0)
    scales = np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    unknown = np.isnan(scales) | (depth.reshape(moved.shape[:-1])[..., 0] < 2 * NEAR)
    return np.asarray(np.where(unknown, np.inf, scales).max(axis=1))
