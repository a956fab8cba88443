"""The part of a scene that stands still: many small meshes, put together once and drawn as one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.mesh import Mesh
from humansim_ros.camera import Camera
from humansim_ros.render.posed import Floats, Indices, Posed, Topology
from humansim_ros.render.refine import LensView
from humansim_ros.render.sun import encloses
from humansim_ros.rotations import Array

#: Metres from z = 0 within which something level is a floor.
FLOOR_SLACK = 0.02
#: What shaders know of a vertex, in the order of :data:`Attributes`, and how many numbers each is.
_LAYOUT = (("position", 3), ("normal", 3), ("uv", 2), ("color", 3))


class Expanded:
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
        self.looks: Floats = np.concatenate([uv, colors[self.source] / 255.0], axis=1).astype("f4")
        self.corners = np.ascontiguousarray(corners, dtype=np.int32)

    def attributes(self, posed: Posed) -> Floats:
        """(E, 11) what shaders know of each vertex as a body stands: position, normal, uv and colour."""
        both = np.concatenate([posed.vertices, posed.normals], axis=1).take(self.source, axis=0)
        return np.concatenate([both, self.looks], axis=1)


class Pieces:
    """Triangles (N, 3) of vertices with attributes (V, 11) on the device, for as long as ``with`` lasts."""

    def __init__(self, ctx: moderngl.Context, attributes: NDArray[Any], triangles: NDArray[Any]) -> None:
        self._ctx = ctx
        self._empty = len(triangles) == 0
        if not self._empty:
            self._vertices = ctx.buffer(attributes.astype("f4").tobytes())
            self._index = ctx.buffer(np.ascontiguousarray(triangles, dtype=np.int32).tobytes())

    def __enter__(self) -> Pieces:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        if not self._empty:
            self._vertices.release()
            self._index.release()

    def draw_alone(self, program: moderngl.Program) -> None:
        """Draw all of it with a program that needs no textures."""
        if not self._empty:
            layout = " ".join(f"{n}f" if name in program else f"{4 * n}x" for name, n in _LAYOUT)
            used = [name for name, _ in _LAYOUT if name in program]
            array = self._ctx.vertex_array(
                program, [(self._vertices, layout, *used)], index_buffer=self._index
            )
            array.render(moderngl.TRIANGLES)
            array.release()

    def draw(
        self, program: moderngl.Program, textures: Sequence[moderngl.Texture], counts: Sequence[int]
    ) -> None:
        """Draw so many triangles, one after the other, with each of the textures."""
        if self._empty:
            return
        layout = " ".join(f"{n}f" if name in program else f"{4 * n}x" for name, n in _LAYOUT)
        used = [name for name, _ in _LAYOUT if name in program]
        array = self._ctx.vertex_array(program, [(self._vertices, layout, *used)], index_buffer=self._index)
        first = 0
        for texture, count in zip(textures, counts, strict=True):
            if count:
                texture.use(0)
                array.render(moderngl.TRIANGLES, vertices=3 * count, first=3 * first)
            first += count
        array.release()


class StillScene:
    """Meshes in world coordinates, with their textures on the device."""

    def __init__(self, ctx: moderngl.Context, meshes: Sequence[Mesh]) -> None:
        self._ctx = ctx
        self._textures = [texture(ctx, mesh.texture) for mesh in meshes]
        attributes: list[Floats] = [np.zeros((0, 11), np.float32)]
        corners: list[NDArray[Any]] = [np.zeros((0, 3), np.int32)]
        first = 0
        for mesh in meshes:
            expanded = Expanded(mesh)
            attributes.append(expanded.attributes(Posed(Topology(mesh), mesh.vertices.astype(np.float32))))
            corners.append(expanded.corners + np.int32(first))
            first += len(attributes[-1])
        self._attributes, self._corners = np.concatenate(attributes), np.concatenate(corners)
        # up to which triangle each mesh goes
        self._ends = np.cumsum([len(mesh.triangles) for mesh in meshes], dtype=np.intp)
        self._counts = [len(mesh.triangles) for mesh in meshes]
        self._whole = Pieces(ctx, self._attributes, self._corners)

    @property
    def box(self) -> Floats | None:
        """(3, 8) corners of the box around it, None if there is nothing."""
        return encloses([self._attributes[:, :3].T]) if len(self._attributes) else None

    @cached_property
    def has_floor(self) -> bool:
        """Whether some of it lies level on the ground, z = 0."""
        return bool((np.abs(self._attributes[self._corners, 2]) < FLOOR_SLACK).all(axis=1).any())

    def facing(self, direction: Array) -> Pieces:
        """Its triangles that turn their outside to a direction."""
        a, b, c = (self._attributes[self._corners[:, i], :3] for i in range(3))
        towards = np.einsum("ij,j->i", np.cross(b - a, c - a), direction) > 0
        return Pieces(self._ctx, self._attributes, self._corners[towards])

    def draw_alone(self, program: moderngl.Program) -> None:
        """Draw all of it with a program that needs no textures."""
        self._whole.draw_alone(program)

    def seen_by(self, camera: Camera, tolerance: float) -> Still:
        """What is to be drawn for a camera: cut to pieces where its lens bends them, that no line is off by
        more than a tolerance, in pixels.
        """
        if not camera.distorted:
            return Still(self._whole, self._textures, self._counts, kept=True)
        whole = self._attributes.astype(float), self._corners.astype(np.intp)
        refined = LensView(camera).refine(*whole, tolerance)
        owner: Indices = np.searchsorted(self._ends, refined.parents, side="right")
        order = np.argsort(owner, kind="stable")
        counts = np.bincount(owner, minlength=len(self._textures)).tolist()
        pieces = Pieces(self._ctx, refined.attributes, refined.triangles[order])
        return Still(pieces, self._textures, counts, kept=False)


class Still:
    """A still scene as one camera needs it, for as long as ``with`` lasts."""

    def __init__(
        self, pieces: Pieces, textures: Sequence[moderngl.Texture], counts: Sequence[int], kept: bool
    ) -> None:
        self._pieces, self._textures, self._counts, self._kept = pieces, textures, counts, kept

    def __enter__(self) -> Still:
        return self

    def __exit__(self, *_: object) -> None:
        if not self._kept:
            self._pieces.release()

    def draw(self, program: moderngl.Program) -> None:
        """Draw it all."""
        self._pieces.draw(program, self._textures, self._counts)


def texture(
    ctx: moderngl.Context, image: NDArray[np.uint8] | None, skin: NDArray[np.uint8] | None = None
) -> moderngl.Texture:
    """A texture on the device, white where there is none; its alpha is 0 where there is skin."""
    if image is None:
        return ctx.texture((1, 1), 3, b"\xff\xff\xff", alignment=1)
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
