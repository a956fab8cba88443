"""The part of a scene that stands still: many small meshes, put together once and drawn as one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.mesh.material import Material
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.lens_tessellation import LensView
from humansim_ros.render.posed_mesh import PosedMesh, Topology
from humansim_ros.render.shadow_map import encloses
from humansim_ros.render.uniforms import set_uniform
from humansim_ros.types import Array, Float32Array, Indices

#: Metres from z = 0 within which something level is a floor.
FLOOR_SLACK = 0.02
_WHITE = b"\xff\xff\xff"
#: Texture unit of the first of a look's maps.
_FIRST_MAP = 9
#: What shaders know of a vertex, in the order of :data:`Attributes`, and how many numbers each is.
_LAYOUT = (("position", 3), ("normal", 3), ("uv", 2), ("color", 3))
_FLOATS = sum(n for _, n in _LAYOUT)


class ExpandedMesh:
    """The vertices of a mesh as they are drawn: those on texture seams are there once per texture coordinate.

    ``source``: (E,) the mesh's vertex of each. ``corners``: (N, 3) of the triangles. ``looks``: (E, 5)
    float32, texture coordinates and colour.
    """

    def __init__(self, mesh: Mesh) -> None:
        triangles = mesh.triangles
        uv: Array
        if mesh.uv is None or mesh.uv_triangles is None:
            self.source: NDArray[Any] = np.arange(len(mesh.vertices))
            corners: NDArray[Any] = triangles
            uv = np.zeros((len(mesh.vertices), 2))
        else:
            pairs = np.stack([triangles.ravel(), mesh.uv_triangles.ravel()], axis=1)
            unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
            self.source = unique[:, 0]
            corners, uv = inverse.reshape(triangles.shape), mesh.uv[unique[:, 1]]
        colors = np.full((len(mesh.vertices), 3), 255, np.uint8) if mesh.colors is None else mesh.colors
        self.looks: Float32Array = np.concatenate([uv, colors[self.source] / 255.0], axis=1).astype("f4")
        self.corners = np.ascontiguousarray(corners, dtype=np.int32)

    def attributes(self, posed: PosedMesh) -> Float32Array:
        """(E, 11) what shaders know of each vertex as a body stands: position, normal, uv and colour."""
        both = np.concatenate([posed.vertices, posed.normals], axis=1).take(self.source, axis=0)
        return np.concatenate([both, self.looks], axis=1)


class TriangleBuffers:
    """Triangles (N, 3) of vertices with attributes (V, 11) on the device, for as long as ``with`` lasts."""

    def __init__(self, ctx: moderngl.Context, attributes: NDArray[Any], triangles: NDArray[Any]) -> None:
        self._ctx = ctx
        self._empty = len(triangles) == 0
        if not self._empty:
            self._vertices = ctx.buffer(attributes.astype("f4").tobytes())
            self._index = ctx.buffer(np.ascontiguousarray(triangles, dtype=np.int32).tobytes())

    def __enter__(self) -> TriangleBuffers:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        if not self._empty:
            self._vertices.release()
            self._index.release()

    def draw(
        self,
        program: moderngl.Program,
        looks: Sequence[MaterialBuffers],
        counts: Sequence[int],
        chosen: Sequence[bool] | None = None,
        eye: Array | None = None,
    ) -> None:
        """Draw so many triangles, one after the other, with each of the looks, or those ``chosen``; with an
        ``eye`` the farthest of them first.
        """
        if self._empty:
            return
        layout = " ".join(f"{n}f" if name in program else f"{4 * n}x" for name, n in _LAYOUT)
        used = [name for name, _ in _LAYOUT if name in program]
        starts = np.cumsum([0, *counts])[:-1].tolist()
        runs = [run for run in zip(looks, starts, counts, strict=True) if run[2]]
        if chosen is not None:
            wanted = {id(look) for look, use in zip(looks, chosen, strict=True) if use}
            runs = [run for run in runs if id(run[0]) in wanted]
        index = self._index
        if eye is not None:
            index, runs = self._farthest_first(runs, eye)
        array = self._ctx.vertex_array(program, [(self._vertices, layout, *used)], index_buffer=index)
        for look, first, count in runs:
            look.use(program)
            array.render(moderngl.TRIANGLES, vertices=3 * count, first=3 * first)
        array.release()
        if index is not self._index:
            index.release()

    def _farthest_first(
        self, runs: Sequence[tuple[MaterialBuffers, int, int]], eye: Array
    ) -> tuple[moderngl.Buffer, list[tuple[MaterialBuffers, int, int]]]:
        """The triangles of some runs in a new order, and runs of those that follow each other in one look."""
        corners = np.frombuffer(self._index.read(), np.int32).reshape(-1, 3)
        places = np.frombuffer(self._vertices.read(), np.float32).reshape(-1, _FLOATS)[:, :3]
        chosen = np.concatenate([np.arange(first, first + count) for _, first, count in runs])
        owner = np.repeat(np.arange(len(runs)), [count for _, _, count in runs])
        middle = places[corners[chosen]].mean(axis=1) - eye.astype(np.float32)
        order = np.argsort(-np.einsum("ij,ij->i", middle, middle), kind="stable")
        chosen, owner = chosen[order], owner[order]
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        ends = np.append(starts[1:], len(owner))
        new = [
            (runs[int(owner[start])][0], int(start), int(end - start))
            for start, end in zip(starts, ends, strict=True)
        ]
        return self._ctx.buffer(np.ascontiguousarray(corners[chosen]).tobytes()), new


class MaterialBuffers:
    """What a mesh looks like, on the device."""

    def __init__(self, ctx: moderngl.Context, mesh: Mesh) -> None:
        self.material = mesh.material
        self.texture = texture(ctx, mesh.texture, mesh.skin)
        self._maps: dict[str, moderngl.Texture] = {}
        finish = mesh.material
        if finish is not None:
            images = {
                "metal_rough": finish.metal_rough,
                "normal_map": finish.normals,
                "glow": finish.emissive_map,
                "cut": None
                if finish.alpha_map is None
                else np.repeat(finish.alpha_map[..., None], 3, axis=2),
            }
            plain = {"normal_map": b"\x80\x80\xff"}
            for name, image in images.items():
                self._maps[name] = texture(ctx, image, plain=plain.get(name, _WHITE))
            for one in (self.texture, *self._maps.values()):
                one.repeat_x, one.repeat_y = finish.wrap

    @property
    def blends(self) -> bool:
        """Whether it lets through what is behind."""
        return self.material is not None and self.material.alpha == "blend"

    def use(self, program: moderngl.Program) -> None:
        """Let a program draw with it."""
        self.texture.use(0)
        finish = self.material or Material()
        set_uniform(program, "shines", float(self.material is not None))
        set_uniform(program, "masked", finish.alpha == "mask")
        set_uniform(program, "opacity", 1.0 if finish.alpha == "opaque" else finish.opacity)
        set_uniform(program, "cutoff", finish.cutoff)
        set_uniform(program, "one_sided", not finish.double_sided)
        for name in ("metallic", "roughness", "specular", "emission"):
            set_uniform(program, name, getattr(finish, name))
        set_uniform(program, "bump", finish.normal_scale if finish.normals is not None else 0.0)
        for unit, (name, image) in enumerate(self._maps.items(), _FIRST_MAP):
            image.use(unit)
            set_uniform(program, name, unit)


class StaticScene:
    """Meshes in world coordinates, with their textures on the device."""

    def __init__(self, ctx: moderngl.Context, meshes: Sequence[Mesh]) -> None:
        self._ctx = ctx
        self._looks = [MaterialBuffers(ctx, mesh) for mesh in meshes]
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
        # up to which triangle each mesh goes
        self._ends = np.cumsum([len(mesh.triangles) for mesh in meshes], dtype=np.intp)
        self._counts = [len(mesh.triangles) for mesh in meshes]
        self._whole = TriangleBuffers(ctx, self._attributes, self._corners)

    @property
    def box(self) -> Float32Array | None:
        """(3, 8) corners of the box around it, None if there is nothing."""
        return encloses([self._attributes[:, :3].T]) if len(self._attributes) else None

    @cached_property
    def has_floor(self) -> bool:
        """Whether some of it lies level on the ground, z = 0."""
        return bool((np.abs(self._attributes[self._corners, 2]) < FLOOR_SLACK).all(axis=1).any())

    def facing(self, direction: Array) -> StaticDraw:
        """Its triangles that turn their outside to a direction."""
        a, b, c = (self._attributes[self._corners[:, i], :3] for i in range(3))
        towards = np.einsum("ij,j->i", np.cross(b - a, c - a), direction) > 0
        owner = np.repeat(np.arange(len(self._counts)), self._counts)[towards]
        counts = np.bincount(owner, minlength=len(self._counts)).tolist()
        pieces = TriangleBuffers(self._ctx, self._attributes, self._corners[towards])
        return StaticDraw(pieces, self._looks, counts, kept=False)

    @property
    def whole(self) -> StaticDraw:
        """All of it."""
        return StaticDraw(self._whole, self._looks, self._counts, kept=True)

    @property
    def switches(self) -> list[str]:
        """What programs that draw it have to know: whether some of it is not simply matt."""
        return ["FINISH"] if any(look.material is not None for look in self._looks) else []

    @property
    def blends(self) -> bool:
        """Whether some of it lets through what is behind."""
        return any(look.blends for look in self._looks)

    def seen_by(self, camera: Camera, tolerance: float) -> StaticDraw:
        """What is to be drawn for a camera: cut to pieces where its lens bends them, that no line is off by
        more than a tolerance, in pixels.
        """
        if not camera.distorted:
            return self.whole
        whole = self._attributes.astype(float), self._corners.astype(np.intp)
        refined = LensView(camera).refine(*whole, tolerance)
        owner: Indices = np.searchsorted(self._ends, refined.parents, side="right")
        order = np.argsort(owner, kind="stable")
        counts = np.bincount(owner, minlength=len(self._looks)).tolist()
        pieces = TriangleBuffers(self._ctx, refined.attributes, refined.triangles[order])
        return StaticDraw(pieces, self._looks, counts, kept=False)


class StaticDraw:
    """A still scene as one camera needs it, for as long as ``with`` lasts."""

    def __init__(
        self, pieces: TriangleBuffers, looks: Sequence[MaterialBuffers], counts: Sequence[int], kept: bool
    ) -> None:
        self._pieces, self._looks, self._counts, self._kept = pieces, looks, counts, kept

    def __enter__(self) -> StaticDraw:
        return self

    def __exit__(self, *_: object) -> None:
        if not self._kept:
            self._pieces.release()

    def draw(self, program: moderngl.Program) -> None:
        """Draw it all, but for what lets through what is behind."""
        counts = self._counts
        self._pieces.draw(program, self._looks, counts, [not look.blends for look in self._looks])

    def draw_over(self, program: moderngl.Program, eye: Array) -> None:
        """Draw what lets through what is behind, the farthest from an eye first."""
        self._pieces.draw(program, self._looks, self._counts, [look.blends for look in self._looks], eye)


def texture(
    ctx: moderngl.Context,
    image: NDArray[np.uint8] | None,
    skin: NDArray[np.uint8] | None = None,
    plain: bytes = _WHITE,
) -> moderngl.Texture:
    """A texture on the device, of a plain colour where there is none; its alpha is 0 where there is skin."""
    if image is None:
        return ctx.texture((1, 1), 3, plain, alignment=1)
    # the texture coordinate v points up, the image's first row is on top
    height, width = image.shape[:2]
    if skin is not None:
        image = np.dstack([image, 255 - skin])
    made = ctx.texture(
        (width, height), image.shape[2], np.ascontiguousarray(image[::-1]).tobytes(), alignment=1
    )
    made.build_mipmaps()
    made.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    return made
