"""Posed meshes, and their vertices, triangles and materials on the device (a GPU, or Mesa on the CPU).

Quantities that are the same for all cameras are computed once per frame.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.files.mesh import Material, Mesh, split_seams
from humansim_ros.render.device.context import MAP_UNITS, set_uniform
from humansim_ros.types import Array, Float32Array, Indices

_WHITE = b"\xff\xff\xff"
_PLAIN = np.full((1, 1, 3), 255, np.uint8)
#: Number of texture layers that every device supports.
_MAX_LAYERS = 256
#: Vertex attributes of the shaders, with their numbers of components. The first ones are the columns of
#: :meth:`ExpandedMesh.attributes`. Static meshes have two more: the layer of the texture, and the place in
#: the light map.
_LAYOUT = (("position", 3), ("normal", 3), ("uv", 2), ("color", 3), ("layer", 1), ("light_uv", 2))


class ExpandedMesh:
    """Vertices of a mesh as they are rendered. A vertex on a texture seam is repeated for each
    texture coordinate. ``source``: (E,) index of each vertex in the mesh. ``corners``: (N, 3) vertices of the
    triangles. ``uv_colors``: (E, 5) float32, texture coordinates and colour."""

    def __init__(self, mesh: Mesh) -> None:
        self.source, uv, corners = split_seams(mesh)
        if uv is None:
            uv = np.zeros((len(self.source), 2))
        colors = np.full((len(mesh.vertices), 3), 255, np.uint8) if mesh.colors is None else mesh.colors
        self.uv_colors: Float32Array = np.concatenate([uv, colors[self.source] / 255.0], axis=1).astype("f4")
        self.corners = np.ascontiguousarray(corners, dtype=np.int32)

    def attributes(self, posed: PosedMesh) -> Float32Array:
        """(E, 11) vertex attributes in a pose: position, normal, texture coordinates and colour."""
        both = np.concatenate([posed.vertices, posed.normals], axis=1).take(self.source, axis=0)
        return np.concatenate([both, self.uv_colors], axis=1)


class MaterialBuffers:
    """Texture and material of a mesh on the device. ``images``: images of several static meshes, which become
    the layers of one texture. If None, the texture is the image of ``mesh``."""

    def __init__(
        self, ctx: moderngl.Context, mesh: Mesh, images: Sequence[NDArray[np.uint8]] | None = None
    ) -> None:
        self.material = material = mesh.material
        self.texture: moderngl.Texture | moderngl.TextureArray
        if images is None:
            self.texture = _texture(ctx, mesh.texture, mesh.skin)
        else:
            self.texture = _texture_array(ctx, images)
        self._maps: dict[str, moderngl.Texture] = {}
        if material is not None:
            alpha = None if material.alpha_map is None else material.alpha_map[..., None].repeat(3, axis=2)
            self._maps = {
                "metal_rough": _texture(ctx, material.metal_rough),
                "normal_map": _texture(ctx, material.normals, plain=b"\x80\x80\xff"),
                "emissive_map": _texture(ctx, material.emissive_map),
                "alpha_map": _texture(ctx, alpha),
            }
            for one in (self.texture, *self._maps.values()):
                one.repeat_x, one.repeat_y = material.wrap

    @classmethod
    def of_meshes(cls, ctx: moderngl.Context, meshes: Sequence[Mesh]) -> list[tuple[MaterialBuffers, int]]:
        """Create the materials of static meshes. Returns for each mesh its material, and the layer of its
        image in the texture. Meshes without a material share one texture if their images have the same size,
        since each draw call takes long."""
        images: dict[Any, list[NDArray[np.uint8]]] = {}
        places: dict[int, tuple[Any, int]] = {}
        made: dict[Any, MaterialBuffers] = {}
        found: list[tuple[Any, int]] = []
        for number, mesh in enumerate(meshes):
            image = _PLAIN if mesh.texture is None else mesh.texture
            # a material defines how its texture repeats, so it has its own texture
            place = places.get(id(image)) if mesh.material is None else ((number,), 0)
            if place is None:
                key: tuple[int, ...] = image.shape[:2]
                while len(images.get(key, ())) == _MAX_LAYERS:
                    key = (*key, 0)
                place = places[id(image)] = key, len(images.get(key, ()))
            found.append(place)
            if place[1] == len(images.setdefault(place[0], [])):
                images[place[0]].append(image)
        for (key, _), mesh in zip(found, meshes, strict=True):
            if key not in made:
                made[key] = cls(ctx, mesh, images[key])
                # each pixel has several samples of one mip level, so their mean is as smooth as that of two
                # levels
                made[key].texture.filter = (moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR)
        return [(made[key], layer) for key, layer in found]

    @staticmethod
    def matter(program: moderngl.Program) -> bool:
        """Whether a program draws different materials differently."""
        return any(name in program for name in ("surface", "has_material", "opacity"))

    @property
    def blends(self) -> bool:
        """Whether the material blends with the surfaces behind it."""
        return self.material is not None and self.material.alpha == "blend"

    def use(self, program: moderngl.Program) -> None:
        """Bind the material for a program."""
        self.texture.use(0)
        if program.get("has_material", None) is None and program.get("opacity", None) is None:
            return
        material = self.material or Material()
        set_uniform(program, "has_material", float(self.material is not None))
        set_uniform(program, "masked", material.alpha == "mask")
        set_uniform(program, "opacity", 1.0 if material.alpha == "opaque" else material.opacity)
        set_uniform(program, "cutoff", material.cutoff)
        set_uniform(program, "one_sided", not material.double_sided)
        for name in ("metallic", "roughness", "specular", "emission"):
            set_uniform(program, name, getattr(material, name))
        set_uniform(program, "normal_scale", material.normal_scale if material.normals is not None else 0.0)
        for name, image in self._maps.items():
            image.use(MAP_UNITS[name])
            set_uniform(program, name, MAP_UNITS[name])


class TriangleBuffers:
    """Triangles (N, 3) of vertices on the device. Attributes are (V, 11). Those of static meshes are (V, 12)
    with the layer of the texture, or (V, 14) with a place in the light map as well."""

    def __init__(self, ctx: moderngl.Context, attributes: NDArray[Any], triangles: NDArray[Any]) -> None:
        self._ctx = ctx
        self._empty, self._floats = len(triangles) == 0, attributes.shape[1]
        if not self._empty:
            self._vertices = ctx.buffer(attributes.astype("f4").tobytes())
            self._index = ctx.buffer(np.ascontiguousarray(triangles, dtype=np.int32).tobytes())

    def draw(
        self,
        program: moderngl.Program,
        materials: Sequence[MaterialBuffers],
        counts: Sequence[int],
        selected: Sequence[bool] | None = None,
        eye: Array | None = None,
        mode: int = moderngl.TRIANGLES,
        first_id: int | None = None,
    ) -> None:
        """Draw runs of consecutive triangles, each run with its material.

        Args:
            program: Program that draws.
            materials: Material of each run.
            counts: Number of triangles of each run.
            selected: Whether each run is drawn. If None, all are drawn.
            eye: (3,) point that the triangles are sorted by, farthest first. If None, they are not sorted.
            mode: OpenGL primitive to draw: triangles, or the points at their corners.
            first_id: Id of the first triangle. If None, the program keeps the id that was set before.
        """
        if self._empty:
            return
        columns = np.cumsum([n for _, n in _LAYOUT])
        layouts = _LAYOUT[: int(np.searchsorted(columns, self._floats)) + 1]
        layout = " ".join(f"{n}f" if name in program else f"{4 * n}x" for name, n in layouts)
        used = [name for name, _ in layouts if name in program]
        starts = np.cumsum([0, *counts])[:-1].tolist()
        rows = zip(materials, starts, counts, selected or [True] * len(counts), strict=True)
        runs = [(material, start, count) for material, start, count, use in rows if use and count]
        if eye is None:
            index, runs = self._index, _joined(runs, MaterialBuffers.matter(program))
        else:
            index, runs = self._farthest_first(runs, eye)
        array = self._ctx.vertex_array(program, [(self._vertices, layout, *used)], index_buffer=index)
        for material, first, count in runs:
            material.use(program)
            if first_id is not None:
                set_uniform(program, "first_id", first_id + first)
            array.render(mode, vertices=3 * count, first=3 * first)

    def _farthest_first(self, runs: Sequence[_Run], eye: Array) -> tuple[moderngl.Buffer, list[_Run]]:
        """Sort the triangles of some runs by distance, farthest first. Returns their indices and the new
        runs."""
        corners = np.frombuffer(self._index.read(), np.int32).reshape(-1, 3)
        positions = np.frombuffer(self._vertices.read(), np.float32).reshape(-1, self._floats)[:, :3]
        selected = np.concatenate([np.arange(first, first + count) for _, first, count in runs])
        owner = np.repeat(np.arange(len(runs)), [count for _, _, count in runs])
        middle = positions[corners[selected]].mean(axis=1) - eye.astype(np.float32)
        order = np.argsort(-np.einsum("ij,ij->i", middle, middle), kind="stable")
        selected, owner = selected[order], owner[order]
        starts = np.flatnonzero(np.diff(owner, prepend=-1)).tolist()
        ends = [*starts[1:], len(owner)]
        new = [(runs[owner[start]][0], start, end - start) for start, end in zip(starts, ends, strict=True)]
        return self._ctx.buffer(np.ascontiguousarray(corners[selected]).tobytes()), new


#: A run of consecutive triangles: their material, the index of the first one, and how many there are.
_Run = tuple[MaterialBuffers, int, int]


def _joined(runs: Sequence[_Run], materials_matter: bool) -> list[_Run]:
    """Join runs of consecutive triangles into one, since calls of OpenGL take long."""
    out: list[_Run] = []
    for material, first, count in runs:
        follows = bool(out) and out[-1][1] + out[-1][2] == first
        if follows and (out[-1][0] is material or not materials_matter):
            out[-1] = (out[-1][0], out[-1][1], out[-1][2] + count)
        else:
            out.append((material, first, count))
    return out


def _texture(
    ctx: moderngl.Context,
    image: NDArray[np.uint8] | None,
    skin: NDArray[np.uint8] | None = None,
    plain: bytes = _WHITE,
) -> moderngl.Texture:
    """Create the texture of an image, or of one colour if there is no image. Its alpha is 0 on skin."""
    if image is None:
        return ctx.texture((1, 1), 3, plain, alignment=1)
    # the texture coordinate v points up, the image's first row is on top
    height, width = image.shape[:2]
    if skin is not None:
        image = np.dstack([image, 255 - skin])
    image = np.ascontiguousarray(image[::-1])
    made = ctx.texture((width, height), image.shape[2], image, alignment=1)
    _add_mipmaps(made, image[None])
    made.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    return made


def _texture_array(ctx: moderngl.Context, images: Sequence[NDArray[np.uint8]]) -> moderngl.TextureArray:
    """Create a texture with images (H, W, 3) of one size as its layers."""
    height, width = images[0].shape[:2]
    # alpha is added here, since Mesa would have to add it
    layers = np.asarray(
        np.stack([cv2.cvtColor(image[::-1], cv2.COLOR_RGB2RGBA) for image in images]), np.uint8
    )
    made = ctx.texture_array((width, height, len(layers)), 4, layers.tobytes())
    _add_mipmaps(made, layers)
    return made


_TEXTURE_2D, _TEXTURE_ARRAY, _UNSIGNED_BYTE = 0x0DE1, 0x8C1A, 0x1401
#: Internal format and format of OpenGL by number of components.
_FORMATS = {3: (0x8051, 0x1907), 4: (0x8058, 0x1908)}


def _add_mipmaps(texture: moderngl.Texture | moderngl.TextureArray, layers: NDArray[np.uint8]) -> None:
    """Add the smaller levels of a new texture. OpenCV computes them for a room in 0.01 s, llvmpipe in 0.5 s.
    ``layers``: (L, H, W, C) of the first level."""
    array = isinstance(texture, moderngl.TextureArray)
    upload = _tex_image("glTexImage3D" if array else "glTexImage2D")
    if upload is None or texture.components not in _FORMATS:
        texture.build_mipmaps()
        return
    internal, layout = _FORMATS[texture.components]
    texture.use(0)  # rows are not padded, as the upload of the first level has set
    level = 0
    while max(layers.shape[1:3]) > 1:
        level += 1
        height, width = (max(1, side // 2) for side in layers.shape[1:3])
        smaller = [cv2.resize(one, (width, height), interpolation=cv2.INTER_AREA) for one in layers]
        layers = np.asarray(np.stack(smaller), np.uint8).reshape(len(layers), height, width, -1)
        size = (width, height, len(layers)) if array else (width, height)
        target = _TEXTURE_ARRAY if array else _TEXTURE_2D
        upload(target, level, internal, *size, 0, layout, _UNSIGNED_BYTE, layers.ctypes.data)


@cache
def _tex_image(name: str) -> Callable[..., None] | None:
    """Find glTexImage2D or glTexImage3D. moderngl calls them for the first level only. Returns None where EGL
    does not give the function."""
    try:
        find = ctypes.CDLL("libEGL.so.1").eglGetProcAddress
    except (OSError, AttributeError):
        return None
    find.restype, find.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    address = find(name.encode())
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_int] * (8 + name.endswith("3D")), ctypes.c_void_p)
    return kind(address) if address else None


#: Largest ratio that is expected between the length of an edge in a pose and in the rest pose.
_STRETCH = 2.0
#: Distance of surface samples, metres, and most samples along an edge.
_SAMPLE, _MAX_PIECES = 0.04, 48


class Topology:
    """Triangles, edges and rest shape of a mesh of N triangles and V vertices. Holds no reference to the
    mesh.

    ``corners``: three of (N,), the vertices of the triangles. ``edges``: (E, 2) vertices. ``sides``: two of
    (E,), the triangles on both sides of each edge. ``border``: (E,) true for edges of one triangle. An edge
    that more than two triangles share is listed once for each pair of neighbours.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._triangles, self._rest_vertices = mesh.triangles, mesh.vertices
        self._shading = mesh.shading
        triangles = mesh.triangles.astype(np.intp)
        self.corners = tuple(np.ascontiguousarray(column) for column in triangles.T)
        edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        order = np.argsort(edges[:, 1] * len(mesh.vertices) + edges[:, 0], kind="stable")
        edges, owner = edges[order], order // 3
        same = (edges[1:] == edges[:-1]).all(axis=1)
        alone = ~(np.append(same, False) | np.insert(same, 0, False))
        first, second = owner[:-1][same], owner[1:][same]
        self.edges = np.concatenate([edges[:-1][same], edges[alone]])
        self.sides = (np.concatenate([first, owner[alone]]), np.concatenate([second, owner[alone]]))
        self.border = np.arange(len(self.edges)) >= len(first)

    @cached_property
    def _by_length(self) -> tuple[Float32Array, NDArray[np.intp]]:
        starts, ends = self._rest_vertices[self.edges].transpose(1, 0, 2)
        length = np.linalg.norm(ends - starts, axis=1)
        order = np.argsort(length)
        return np.asarray(length[order], dtype=np.float32), order

    def longer(self, length: float) -> Indices:
        """(M,) edges that are longer than ``length`` metres in some pose."""
        lengths, order = self._by_length
        return order[int(np.searchsorted(lengths, length / _STRETCH)) :]

    @cached_property
    def vertex_triangles(self) -> Any:
        """(V, N) sparse matrix that sums over the triangles around each vertex."""
        from scipy.sparse import csr_matrix

        n = len(self._triangles)
        rows, columns = self._triangles.ravel(), np.repeat(np.arange(n), 3)
        shape = (len(self._rest_vertices), n)
        return csr_matrix((np.ones(3 * n, dtype=np.float32), (rows, columns)), shape=shape)

    @property
    def shading(self) -> Any:
        """(V, N) sparse matrix that sums area vectors of triangles up to vertex normals."""
        return self.vertex_triangles if self._shading is None else self._shading

    @cached_property
    def vertex_areas(self) -> Float32Array:
        """(V,) area that belongs to each vertex in the rest pose, square metres: a third of the triangles
        around it."""
        area = np.linalg.norm(PosedMesh(self, self._rest_vertices.astype(np.float32)).areas, axis=0)
        return np.asarray(self.vertex_triangles @ area / 3, dtype=np.float32)


class PosedMesh:
    """A mesh in a pose: vertices (V, 3) float32 in ``map``. Most derived arrays have the coordinates in the
    first axis: (3, V), (3, N)."""

    def __init__(self, topology: Topology, vertices: Float32Array) -> None:
        self.topology = topology
        self.vertices = vertices
        #: simpler surfaces in this pose, by number of the level of detail
        self.levels: dict[int, PosedMesh] = {}
        self.points: Float32Array = np.ascontiguousarray(vertices.T)

    @cached_property
    def _first_corners(self) -> Float32Array:
        return self.points.take(self.topology.corners[0], axis=1)

    @cached_property
    def areas(self) -> Float32Array:
        """(3, N) area vectors of the triangles: outward normals, as long as the area of the triangle."""
        a = self._first_corners
        b, c = (self.points.take(corner, axis=1) - a for corner in self.topology.corners[1:])
        areas = np.empty_like(a)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            np.multiply(b[j], c[k], out=areas[i])
            areas[i] -= b[k] * c[j]
        areas *= np.float32(0.5)
        return areas

    @cached_property
    def _planes(self) -> Float32Array:
        return np.einsum("ij,ij->j", self.areas, self._first_corners)

    @cached_property
    def normals(self) -> Float32Array:
        """(V, 3) unit vertex normals: means of triangle normals, weighted by area or as the file of the mesh
        says."""
        triangles = self.topology.shading
        normals = np.stack([triangles @ component for component in self.areas])
        normals /= np.maximum(np.sqrt(np.einsum("ij,ij->j", normals, normals)), np.float32(1e-20))
        return np.ascontiguousarray(normals.T)

    @cached_property
    def box(self) -> Float32Array:
        """(2, 3) lowest and highest corner of the bounding box."""
        return np.stack([self.points.min(axis=1), self.points.max(axis=1)])

    def level(self, number: int, topology: Topology, kept: Indices) -> PosedMesh:
        """Return a simpler surface (a level of detail), cached by its ``number``. Its vertices are the
        vertices ``kept`` (v,) of this surface."""
        if number not in self.levels:
            self.levels[number] = PosedMesh(topology, self.vertices.take(kept, axis=0))
        return self.levels[number]

    @cached_property
    def human_caster(self) -> ShadowCaster:
        """The vertices of a human, as caster of a contact shadow."""
        return ShadowCaster(self.points, self.topology.vertex_areas)

    @cached_property
    def object_caster(self) -> ShadowCaster:
        """Samples of the surface of an object, as caster of a contact shadow. Vertices are not used, since an
        object may have few of them."""
        return ShadowCaster(*self.samples)

    @property
    def samples(self) -> tuple[Float32Array, Float32Array]:
        """Points (3, M) spread evenly over the surface, and the area (M,) of each."""
        corners = np.stack([self.points.take(corner, axis=1) for corner in self.topology.corners])
        area = np.linalg.norm(self.areas, axis=0)
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max(axis=0)
        pieces = np.clip(np.ceil(longest / _SAMPLE), 1, _MAX_PIECES).astype(np.intp)
        points, areas = [], []
        for n in np.unique(pieces).tolist():
            chosen = np.flatnonzero(pieces == n)
            i, j = np.divmod(np.arange(n * n), n)
            # a square of cell centers, folded over its diagonal
            u, v = (i + 0.5) / n, (j + 0.5) / n
            u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
            weights = np.stack([1 - u - v, u, v]).astype(np.float32)
            points.append(np.einsum("ks,kcn->cns", weights, corners[..., chosen]).reshape(3, -1))
            areas.append(np.repeat(area[chosen] / (n * n), n * n))
        return np.concatenate(points, axis=1), np.concatenate(areas).astype(np.float32)

    def facing(self, eye: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(N,) whether each triangle shows its front side to a viewer at ``eye``, (3,)."""
        # einsum does not use BLAS, which rounds differently with another number of threads
        return np.asarray(np.einsum("i,ij->j", eye.astype(np.float32), self.areas) > self._planes)

    def contour(self, facing: NDArray[np.bool_]) -> tuple[Indices, Indices]:
        """Start and end vertices (C,) of the contour edges. All outlines lie on these edges. A contour edge
        separates a front face from a back face, or lies on the border of the surface."""
        first, second = self.topology.sides
        chosen = np.flatnonzero((facing.take(first) != facing.take(second)) | self.topology.border)
        starts, ends = self.topology.edges.take(chosen, axis=0).T
        return starts, ends


#: Cells along a side of a shadow.
CELLS = 64
#: Height at which the shadow is drawn, metres: above a rug.
_HEIGHT = 0.01
#: Metres around a body that its shadow covers.
_AROUND = 0.35
#: Height in metres at which the shadow of a surface has faded to 1/e.
_FADE = 0.22
#: A surface higher than this has no shadow, metres. The shadow would have a strength of 1 % there.
REACH = 1.0
_STRENGTH = 0.62


@dataclass(frozen=True)
class ContactShadow:
    """A square image of a shadow on the floor. ``corner``: lowest x and y of the square, metres. ``side``:
    length of its sides, metres. ``darkness``: (64, 64) uint8, 255 is black, rows along y."""

    corner: tuple[float, float]
    side: float
    darkness: NDArray[np.uint8]

    @cached_property
    def corners(self) -> Float32Array:
        """(4, 3) corners of the smallest rectangle that contains all dark cells."""
        columns, rows = (np.flatnonzero(self.darkness.any(axis=axis)) for axis in (0, 1))
        low = np.array([each.min(initial=CELLS) for each in (columns, rows)])
        high = np.array([each.max(initial=0) for each in (columns, rows)])
        # each cell is interpolated up to the centers of its neighbours
        cells = np.clip([low - 0.5, np.maximum(high, low) + 1.5], 0, CELLS)
        (left, top), (right, bottom) = np.array(self.corner) + cells * (self.side / CELLS)
        return np.array([(x, y, _HEIGHT) for x in (left, right) for y in (top, bottom)], dtype=np.float32)


@dataclass(frozen=True, eq=False)
class ShadowCaster:
    """A body that casts a contact shadow. The shadow is computed when it is needed. ``points``: (3, V) points
    on its surface. ``areas``: (V,) surface area around each point, square metres."""

    points: Float32Array
    areas: Float32Array

    @cached_property
    def _square(self) -> tuple[Float32Array, float]:
        """Lowest x and y (2,) of a square around the shadow, and the length of its sides, metres."""
        low, high = self.points[:2].min(axis=1) - _AROUND, self.points[:2].max(axis=1) + _AROUND
        return low, float((high - low).max())

    @property
    def corners(self) -> Float32Array:
        """(4, 3) corners of the square, row by row along y."""
        (x, y), side = self._square
        places = [(x + i * side, y + j * side, _HEIGHT) for j in (0, 1) for i in (0, 1)]
        return np.array(places, dtype=np.float32)

    @cached_property
    def shadow(self) -> ContactShadow:
        """The shadow on the floor z = 0: the body seen from below, faded with height and blurred."""
        low, side = self._square
        cell = side / CELLS
        below = np.flatnonzero(self.points[2] < REACH)
        x, y = ((self.points[:2, below] - low[:, None]) / np.float32(cell)).astype(np.intp)
        amount = self.areas[below] * np.exp(-np.maximum(self.points[2, below], 0) / np.float32(_FADE))
        grid = np.bincount(y * CELLS + x, amount, CELLS * CELLS).reshape(CELLS, CELLS)
        # a closed surface covers each cell at least twice
        coverage = np.minimum(grid / (2 * cell * cell), 1.0).astype(np.float32)
        near = cv2.GaussianBlur(coverage, (0, 0), 0.03 / cell)
        wide = cv2.GaussianBlur(coverage, (0, 0), 0.11 / cell)
        darkness = _STRENGTH * np.clip(0.55 * near + 0.9 * wide, 0, 1)
        return ContactShadow((float(low[0]), float(low[1])), side, np.rint(255 * darkness).astype(np.uint8))
