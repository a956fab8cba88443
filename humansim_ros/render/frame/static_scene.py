"""The static scene on the device: all meshes that never move, in common buffers, and their light map.

The light map has the ambient occlusion, computed once for all cameras: the visible share of sky and ground at
a point. Depth maps of the scene are rendered from many directions, side by side in one texture. Each texel of
the light map is looked up in all depth maps, for both sides of its surface. Ambient light passes through the
back faces of surfaces, as sunlight does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.files.mesh import Mesh, closed_surfaces, padded, welded
from humansim_ros.render.device.context import columns, depth_program, link, set_uniform, unit_square
from humansim_ros.render.device.lens_tessellation import NEAR, LensView, TessellatedMesh
from humansim_ros.render.device.mesh_buffers import (
    ExpandedMesh,
    MaterialBuffers,
    PosedMesh,
    Topology,
    TriangleBuffers,
)
from humansim_ros.render.frame.edge_antialiasing import StaticEdges
from humansim_ros.types import Array, Float32Array, Indices

#: Largest side of the light map, texels, and number of free texels on each side of a chart.
MAX_SIDE, GUTTER = 2048, 1
#: While the charts are too large for the image, texels are made larger by this factor.
_GROWTH = 1.2
#: Texels between the points at which charts are tested for overlaps, and how many times charts are split.
_STEP, _SPLITS = 2, 8


@dataclass(frozen=True, eq=False)
class Charts:
    """Layout of triangles in one image of ``size`` (width, height) texels, without overlaps.

    A chart is a set of connected triangles that face the same side of a cube. A chart is projected along the
    axis of that side. Its bounds run through centres of texels, with a free texel on each side.

    ``corners``: (N, 3) vertices of the triangles; a vertex on the border of two charts exists twice.
    ``source``: (E,) the original vertex of each of these vertices. ``coordinates``: (E, 2) their places in
    the image, texels; (0.5, 0.5) is the centre of the first texel. ``owner``: (N,) chart of each triangle.
    ``texel``: side of a texel, metres.
    """

    size: tuple[int, int]
    corners: NDArray[np.int32]
    source: Indices
    coordinates: Float32Array
    owner: Indices
    texel: float

    @classmethod
    def of(cls, positions: NDArray[np.floating], corners: NDArray[Any], texel: float) -> Charts:
        """Lay out triangles. ``positions``: (V, 3) metres. ``corners``: (N, 3) vertices of the triangles.
        ``texel``: side of a texel in metres; larger texels are used if the triangles need too much room."""
        points = positions[corners].astype(float)
        normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        axis = np.abs(normals).argmax(axis=1)
        turned = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] < 0
        owner = _connected(welded(positions)[corners], 2 * axis + turned)
        flat = np.stack([np.where(axis == 0, 1, 0), np.where(axis == 2, 1, 2)], axis=1)
        plane = np.take_along_axis(points, np.repeat(flat[:, None], 3, axis=1), axis=2)
        depth = np.take_along_axis(points.mean(axis=1), axis[:, None], axis=1)[:, 0]
        layout = _Layout.of(plane, owner, texel)
        for _ in range(_SPLITS):
            # split in halves by depth, since the windings of a spiral lie above each other
            middle = np.bincount(owner, depth) / np.bincount(owner)
            upper = _overlapping(layout.coordinates, owner)[owner] & (depth > middle[owner] + 1e-6)
            if not upper.any():
                break
            owner = np.unique(2 * owner + upper, return_inverse=True)[1]
            layout = _Layout.of(plane, owner, texel)
        keys = corners.astype(np.int64) * (len(owner) + 1) + owner[:, None]
        _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        source, coordinates = corners.reshape(-1)[first], layout.coordinates.reshape(-1, 2)[first]
        return cls(
            *(layout.size, inverse.reshape(-1, 3).astype(np.int32), source.astype(np.intp)),
            *(coordinates.astype(np.float32), owner, layout.texel),
        )


def _connected(corners: Indices, side: Indices) -> Indices:
    """(N,) component of each triangle. The triangles of a component share edges and face the same side."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = np.column_stack([ends, np.repeat(side, 3)])
    order = np.lexsort(keys.T)
    same = (keys[order[1:]] == keys[order[:-1]]).all(axis=1)
    first, second = order[:-1][same] // 3, order[1:][same] // 3
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(len(corners),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


@dataclass(frozen=True, eq=False)
class _Layout:
    """Charts placed side by side. ``coordinates``: (N, 3, 2) places of the corners of triangles, texels."""

    size: tuple[int, int]
    coordinates: Array
    texel: float

    @classmethod
    def of(cls, plane: Array, owner: Indices, texel: float) -> _Layout:
        """Place charts side by side. ``plane``: (N, 3, 2) metres along the two axes of each chart."""
        count = int(owner.max()) + 1
        low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
        np.minimum.at(low, owner, plane.min(axis=1))
        np.maximum.at(high, owner, plane.max(axis=1))
        extent = high - low
        while True:
            steps = np.where(extent > texel / 2, np.ceil(extent / texel), 0.0)
            places, size = _shelves(steps.astype(np.intp) + 1 + 2 * GUTTER)
            if max(size) <= MAX_SIDE or not steps.any():
                break
            texel *= _GROWTH
        scale = steps / np.maximum(extent, 1e-12)
        inside = (plane - low[owner, None]) * scale[owner, None]
        return cls(size, inside + (places[owner, None] + GUTTER + 0.5), texel)


def _shelves(sizes: Indices) -> tuple[Indices, tuple[int, int]]:
    """Place rectangles of sizes (N, 2) in rows. Returns their first corners (N, 2) and the size of all."""
    order = np.lexsort((-sizes[:, 0], -sizes[:, 1]))
    widths, heights = sizes[order].T
    width = max(int(np.sqrt(sizes.prod(axis=1).sum())), int(widths.max()))
    ends, places = np.cumsum(widths), np.empty_like(sizes)
    first = top = 0
    while first < len(order):
        left = ends[first] - widths[first]
        end = int(np.searchsorted(ends, left + width, side="right"))
        row = slice(first, end)
        places[order[row]] = np.column_stack([ends[row] - widths[row] - left, np.full(end - first, top)])
        top, first = top + int(heights[first]), end
    return places, (width, top)


def _overlapping(coordinates: Array, owner: Indices) -> NDArray[np.bool_]:
    """(C,) whether each chart covers some point twice. ``coordinates``: (N, 3, 2) texels."""
    first, end = (np.ceil(bound(coordinates / _STEP, axis=1)).astype(np.intp) for bound in (np.min, np.max))
    columns, rows = np.maximum(end - first, 0).T
    triangle = np.repeat(np.arange(len(owner)), columns * rows)
    number = np.arange(len(triangle)) - np.repeat(np.cumsum(columns * rows) - columns * rows, columns * rows)
    cell = first[triangle] + np.stack(np.divmod(number, np.maximum(columns, 1)[triangle])[::-1], axis=1)
    a, b, c = (coordinates[triangle, i] - _STEP * cell for i in range(3))
    areas = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a))])
    within = (areas > 1e-6).all(axis=0) | (areas < -1e-6).all(axis=0)
    cell, triangle = cell[within], triangle[within]
    _, inverse, counts = np.unique(
        cell[:, 0] * (int(cell.max(initial=0)) + 1) + cell[:, 1], return_inverse=True, return_counts=True
    )
    twice = np.zeros(int(owner.max()) + 1, bool)
    twice[owner[triangle[counts[inverse] > 1]]] = True
    return twice


#: Horizontal triangles are a floor if their height differs from z = 0 by at most this, metres.
FLOOR_SLACK = 0.02
#: Texels of the light map along the longest side of the scene.
_LIGHT_TEXELS = 208


class StaticScene:
    """Meshes in ``map`` with their materials on the device."""

    def __init__(self, ctx: moderngl.Context, meshes: Sequence[Mesh]) -> None:
        self._ctx = ctx
        # small meshes first, since they hide parts of large ones; and meshes of one material together
        made = MaterialBuffers.of_meshes(ctx, meshes)
        number = {id(one): number for number, (one, _) in enumerate(made)}
        extents = (max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-3) for mesh in meshes)
        sizes = (int(np.floor(np.log2(extent))) for extent in extents)
        keys = [(size, number[id(one)]) for size, (one, _) in zip(sizes, made, strict=True)]
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
        """Compute the charts of the light map, and add to each vertex its place in the light map."""
        positions = self._attributes[:, :3]
        texel = max(float(np.ptp(positions, axis=0).max()), 1e-3) / _LIGHT_TEXELS
        charts = Charts.of(positions, self._corners, texel)
        places = charts.coordinates / np.array(charts.size, np.float32)
        self._attributes = np.concatenate([self._attributes[charts.source], places], axis=1)
        self._corners = charts.corners
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
        """All triangles, not tessellated."""
        parents = np.arange(len(self._corners))
        return StaticTriangles(self._buffers, self._materials, self._counts, parents)

    @cached_property
    def edges(self) -> StaticEdges | None:
        """Edges of the triangles. None if there are none."""
        if not len(self._corners):
            return None
        return StaticEdges(self._attributes[:, :3], self._corners, self._owner)

    @cached_property
    def _areas(self) -> tuple[Array, Array]:
        """(N, 3) outward normals of the triangles, as long as twice the area; and (N, 3) one corner of each
        triangle."""
        a, b, c = (self._attributes[self._corners[:, i], :3].astype(float) for i in range(3))
        return np.cross(b - a, c - a), a

    @cached_property
    def _closed_boxes(self) -> Array:
        """(M, 2, 3) lowest and highest corner of the bounding box of each mesh. NaN for meshes that are not
        closed."""
        points = self._attributes[self._corners, :3].astype(float)
        starts = np.cumsum([0, *self._counts])[:-1]
        low, high = (bound.reduceat(points, starts).reshape(-1, 3, 3) for bound in (np.minimum, np.maximum))
        boxes = np.stack([low.min(axis=1), high.max(axis=1)], axis=1)
        owner = np.repeat(self._owner, 3)
        places = welded(np.column_stack([points.reshape(-1, 3), owner])).reshape(-1, 3)
        boxes[~self._opaque | ~closed_surfaces(points, places, self._owner)] = np.nan
        return boxes

    def _visible(self, eye: Array) -> Indices:
        """Triangles that may be visible from ``eye`` (3,). Back faces of a closed mesh are left out if the
        eye is outside the mesh."""
        low, high = self._closed_boxes.transpose(1, 0, 2)
        outside = ((eye < low - NEAR) | (eye > high + NEAR)).any(axis=1)  # false for NaN
        normals, corner = self._areas
        front = np.einsum("ij,ij->i", normals, eye - corner) > 0
        return np.flatnonzero(front | ~outside[self._owner])

    def facing(self, direction: Array) -> StaticTriangles:
        """Return the triangles that show their front when seen from a direction."""
        towards = np.flatnonzero(self._areas[0] @ direction > 0)
        buffers = TriangleBuffers(self._ctx, self._attributes, self._corners[towards])
        return StaticTriangles(buffers, self._materials, self._count(towards), towards)

    def tessellated(self, camera: Camera, tolerance: float, checked: bool = False) -> StaticTriangles:
        """Return the triangles that a camera may see, tessellated if its lens bends edges. ``tolerance``,
        ``checked``: see :meth:`LensView.tessellate`."""
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
    """Triangles of a static scene on the device. ``parents``: (N,) number of each triangle in the scene."""

    def __init__(
        self,
        buffers: TriangleBuffers,
        materials: Sequence[MaterialBuffers],
        counts: Sequence[int],
        parents: Indices,
    ) -> None:
        self._buffers, self._materials, self._counts = buffers, materials, counts
        self._parents = parents
        self._opaque, self._transparent = (
            [one.blends == blends for one in materials] for blends in (False, True)
        )

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
        self._buffers.draw(program, self._materials, self._counts, self._transparent, eye)


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
    white = np.full((1, 3), 255, np.uint8)
    colors = [
        white.repeat(len(mesh.vertices), axis=0) if mesh.colors is None else mesh.colors for mesh in meshes
    ]
    shading = None
    if any(mesh.shading is not None for mesh in meshes):
        shading = block_diag([Topology(mesh).shading for mesh in meshes], format="csr")
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    corners, uv_corners = padded(np.concatenate(faces)), padded(np.concatenate(uv_faces))
    return Mesh(vertices, corners, np.concatenate(uvs), uv_corners, np.concatenate(colors), shading=shading)


def bounding_box(points: Sequence[Float32Array]) -> Float32Array:
    """(3, 8) corners of the box around clouds of points (3, N)."""
    low = np.min([cloud.min(axis=1) for cloud in points], axis=0)
    high = np.max([cloud.max(axis=1) for cloud in points], axis=0)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=0)
    return np.asarray(corners.reshape(3, 8), dtype=np.float32)


#: Number of depth maps along a side of the common texture, and texels along a side of each depth map.
_SIDE, _TEXELS = 12, 208
#: Margin of the depth maps around the scene: metres, but at least this share of the size of the scene.
_MARGIN, _MARGIN_SHARE = 0.1, 0.02
#: Texture unit of the light map (0: texture of the surface, 1 to 4: shadow maps); and the first of the units
#: that are free while the map is computed.
UNIT, _BAKING = 5, 12


class LightMap:
    """Visible share of sky and ground, on the front and the back of each surface of a static scene.
    ``static``: the scene. Its charts are computed."""

    def __init__(self, ctx: moderngl.Context, static: StaticScene) -> None:
        self._ctx, self._corners = ctx, ctx.buffer(unit_square(1))
        box, charts = static.box, static.chart()
        assert box is not None
        low, high = box.min(axis=1).astype(float), box.max(axis=1).astype(float)
        self._centre, extent = (low + high) / 2, (high - low) / 2
        self._extent = extent + max(_MARGIN, _MARGIN_SHARE * float(extent.max()))
        self._directions = directions(_SIDE * _SIDE)
        self._axes = np.stack([self._map_axes(direction) for direction in self._directions])
        maps = ctx.depth_texture((_SIDE * _TEXELS, _SIDE * _TEXELS))
        maps.compare_func = ""
        self._draw_maps(static, maps)
        points, normals = self._surface(static, charts.size)
        # texels around a chart repeat its border, so that each texel has all its neighbours
        wide = self._spread(points, points), self._spread(normals, points)
        light = self._light(*wide, maps)
        inputs = {"sky": light[0], "ground": light[1], "points": points}
        shares = self._image(charts.size, "light_shares.frag", inputs)
        self._texture = self._spread(shares, points, "f1")

    def use(self) -> None:
        """Bind the map to its texture unit."""
        self._texture.use(UNIT)

    def _map_axes(self, direction: Array) -> Array:
        """(3, 3) axes of the depth map of a direction, scaled so that the scene is within -1 and 1 on
        each."""
        u = np.array([-direction[1], direction[0], 0.0])
        u /= np.linalg.norm(u)
        axes = np.stack([u, np.cross(direction, u), -direction])
        return np.asarray(axes / (np.abs(axes) @ self._extent)[:, None])

    def _draw_maps(self, static: StaticScene, maps: moderngl.Texture) -> None:
        depths = depth_program(self._ctx, static.switches)
        framebuffer = self._ctx.framebuffer(depth_attachment=maps)
        framebuffer.use()
        framebuffer.clear(depth=1.0)
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        whole = static.whole
        self._ctx.cull_face = "front"  # images are mirrored, so front faces have the other winding
        for number, axes in enumerate(self._axes):
            row, column = divmod(number, _SIDE)
            framebuffer.viewport = column * _TEXELS, row * _TEXELS, _TEXELS, _TEXELS
            clip = np.eye(4)
            clip[:3, :3], clip[:3, 3] = axes, -axes @ self._centre
            set_uniform(depths, "clip", columns(clip))
            whole.draw(depths)
        self._ctx.cull_face = "back"

    def _surface(self, static: StaticScene, size: tuple[int, int]) -> list[moderngl.Texture]:
        """Draw two images with the surface point and the normal of each texel. The fourth component of a
        point is 0 where there is no surface."""
        images = [self._ctx.texture(size, 4, dtype="f4") for _ in range(2)]
        program = link(self._ctx, "chart.vert", "chart.frag")
        framebuffer = self._ctx.framebuffer(images)
        framebuffer.use()
        framebuffer.clear()
        self._ctx.enable_only(moderngl.NOTHING)
        # first the texels that triangles touch without covering their centres
        static.whole.draw_all(program, moderngl.POINTS)
        self._ctx.wireframe = True
        static.whole.draw_all(program)
        self._ctx.wireframe = False
        static.whole.draw_all(program)
        return images

    def _light(
        self, points: moderngl.Texture, normals: moderngl.Texture, maps: moderngl.Texture
    ) -> list[moderngl.Texture]:
        """Render the light of sky and ground at each texel of the map.

        Each texel sums up only one ninth of the directions. Its eight neighbours sum up the other directions.
        Texels with the same directions are drawn together, so the images consist of 3 x 3 blocks: pixel (x,
        y) of block (column, row) is texel (3 x + column, 3 y + row) of the map.

        Returns:
            Image of the sky, and image of the ground. Their channels are the visible and the total light on
            the front of a surface, then the same on the back.
        """
        width, height = (-(-side // 3) for side in points.size)
        switches = [f"COUNT {_SIDE * _SIDE // 9}", f"TEXELS {_TEXELS}"]
        program = link(self._ctx, "fullscreen.vert", "ambient_light.frag", switches)
        set_uniform(program, "centre", tuple(self._centre))
        set_uniform(program, "texel", 2 * float(self._extent.max()) / _TEXELS)
        images = [self._ctx.texture((3 * width, 3 * height), 4, dtype="f4") for _ in range(2)]
        framebuffer = self._ctx.framebuffer(images)
        corners = _TEXELS * np.stack(np.divmod(np.arange(_SIDE * _SIDE), _SIDE)[::-1], axis=1)
        for row, column in np.ndindex(3, 3):
            own = slice(3 * row + column, None, 9)
            set_uniform(program, "first", (column, row))
            set_uniform(program, "origin", (column * width, row * height))
            set_uniform(program, "directions", self._directions[own].astype("f4").tobytes())
            set_uniform(program, "axes", self._axes[own].astype("f4").tobytes())
            set_uniform(program, "corners", corners[own].astype("i4").tobytes())
            framebuffer.viewport = column * width, row * height, width, height
            self._draw(framebuffer, program, {"points": points, "normals": normals, "maps": maps})
        return images

    def _spread(
        self, image: moderngl.Texture, known: moderngl.Texture, dtype: str = "f4"
    ) -> moderngl.Texture:
        """Return the image with the unknown texels set to the mean of their known neighbours."""
        return self._image(image.size, "spread.frag", {"image": image, "known": known}, dtype)

    def _image(
        self, size: tuple[int, int], file: str, inputs: Mapping[str, moderngl.Texture], dtype: str = "f4"
    ) -> moderngl.Texture:
        """Draw a fragment shader with input images. Returns its output image."""
        image = self._ctx.texture(size, 4, dtype=dtype)
        self._draw(self._ctx.framebuffer([image]), link(self._ctx, "fullscreen.vert", file), inputs)
        return image

    def _draw(
        self,
        framebuffer: moderngl.Framebuffer,
        program: moderngl.Program,
        inputs: Mapping[str, moderngl.Texture],
    ) -> None:
        """Fill the viewport of a framebuffer with a fragment shader."""
        framebuffer.use()
        self._ctx.enable_only(moderngl.NOTHING)
        for unit, (name, image) in enumerate(inputs.items(), _BAKING):
            image.use(unit)
            set_uniform(program, name, unit)
        self._ctx.vertex_array(program, [(self._corners, "2f", "corner")]).render()


def directions(count: int) -> Array:
    """(N, 3) unit vectors spread evenly over the sphere, on a spiral from top to bottom; none is vertical."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
