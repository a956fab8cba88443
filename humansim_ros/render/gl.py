"""The default renderer: OpenGL 3.3 through EGL, without a display; a GPU is used where there is one.

The static scene is drawn once per camera and kept. Each frame redraws only the rectangle that the bodies can
touch, in two passes over their triangles: colour with four samples a pixel, labels and depth with exactly one
at its centre.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.mesh import Mesh, NormalMaker
from humansim_ros.camera import Camera
from humansim_ros.errors import RenderError
from humansim_ros.render.renderer import CHANNELS, Body, View, check_request
from humansim_ros.render.shadow import contact_shadow, vertex_areas
from humansim_ros.rotations import Array

_SHADERS = Path(__file__).parent / "shaders"
_NEAR, _FAR = 0.05, 200.0
_SAMPLES = 4
#: The static scene is drawn this many times finer and averaged: it is drawn once, so quality costs nothing.
_STATIC_SUPERSAMPLING = 4
_MAX_STATIC_SIDE = 8192
#: Width of the texture that holds a label per triangle; truth.frag knows it too.
_ROW = 1024


@dataclass(frozen=True)
class Lighting:
    """Linear-light colours and the direction to the sun, ``map`` frame."""

    sun: tuple[float, float, float] = (0.45, 0.3, 0.84)
    sun_color: tuple[float, float, float] = (0.62, 0.59, 0.54)
    sky_color: tuple[float, float, float] = (0.62, 0.64, 0.68)
    ground_color: tuple[float, float, float] = (0.34, 0.31, 0.28)
    background: tuple[int, int, int] = (168, 176, 184)


class GLRenderer:
    """Renders bodies in a static scene of meshes (world coordinates). One OpenGL context; use it from one
    thread.

    Raises RenderError, naming the system packages, where no OpenGL can be had.
    """

    def __init__(self, static: Sequence[Mesh] = (), lighting: Lighting | None = None) -> None:
        self._lighting = lighting or Lighting()
        self._ctx = create_context()
        self._ctx.front_face = (
            "cw"  # the image's rows run down where OpenGL's run up: everything is mirrored once
        )
        self._static = tuple(static)
        self._surfaces: dict[int, _Surface] = {}
        self._targets: dict[tuple[int, int], _Targets] = {}
        self._layers: dict[bytes, _StaticLayer] = {}
        self._rgb = self._program("surface.vert", "rgb.frag")
        self._truth = self._program("surface.vert", "truth.frag")
        self._static_rgb = self._program("window.vert", "static_rgb.frag")
        self._static_truth = self._program("window.vert", "static_truth.frag")
        self._window_rgb = self._ctx.vertex_array(self._static_rgb, [])
        self._window_truth = self._ctx.vertex_array(self._static_truth, [])
        self._shadow = self._program("shadow.vert", "shadow.frag")
        corners = self._ctx.buffer(np.array([0, 0, 1, 0, 0, 1, 1, 1], dtype="f4").tobytes())
        self._shadow_quad = self._ctx.vertex_array(self._shadow, [(corners, "2f", "corner")])
        self._shadow_texture = self._ctx.texture((64, 64), 1, alignment=1)
        light = self._lighting
        sun = np.array(light.sun) / np.linalg.norm(light.sun)
        for name, value in (("sun", sun), ("sun_color", light.sun_color), ("sky_color", light.sky_color)):
            _set(self._rgb, name, tuple(value))
        _set(self._rgb, "ground_color", light.ground_color)

    @property
    def device(self) -> str:
        """What draws, such as ``llvmpipe (LLVM 15.0.6, 256 bits)``."""
        return str(self._ctx.info["GL_RENDERER"])

    def close(self) -> None:
        self._ctx.release()

    def render(self, bodies: Sequence[Body], camera: Camera, channels: Collection[str] = CHANNELS) -> View:
        """See :class:`humansim_ros.render.Renderer`."""
        check_request(bodies, channels)
        layer = self._layer(camera)
        wants_rgb = "rgb" in channels
        wants_truth = bool(set(channels) - {"rgb"})
        shadows = (
            [contact_shadow(b.vertices, self._surface(b.mesh).areas) for b in bodies] if wants_rgb else []
        )
        near = [
            np.array([[s.corner[0] + dx, s.corner[1] + dy, 0] for dx in (0, s.side) for dy in (0, s.side)])
            for s in shadows
        ]
        for body in bodies:
            self._surface(body.mesh).upload(body.vertices, with_normals=wants_rgb)
        view: dict[str, Any] = {}
        if wants_rgb:
            rectangle = _touched([b.vertices for b in bodies] + near, camera)
            view["rgb"] = self._draw_rgb(bodies, shadows, layer, camera, rectangle)
        if wants_truth:
            rectangle = _touched([b.vertices for b in bodies], camera)
            view |= self._draw_truth(bodies, layer, camera, rectangle, channels)
        return View(**view)

    def _draw_rgb(
        self,
        bodies: Sequence[Body],
        shadows: Sequence[Any],
        layer: _StaticLayer,
        camera: Camera,
        rectangle: _Rectangle,
    ) -> NDArray[np.uint8]:
        image = layer.rgb.copy()
        if rectangle.empty:
            return image
        targets = self._target(camera.size)
        targets.samples.use()
        targets.samples.scissor = rectangle.xywh
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        self._draw_layer(self._static_rgb, self._window_rgb, layer)
        self._draw_shadows(shadows, camera)
        self._use_camera(self._rgb, camera)
        _set(self._rgb, "eye", tuple(camera.center))
        for body in bodies:
            self._cull(body, rectangle)
            self._surface(body.mesh).draw_rgb()
        targets.resolved.scissor = rectangle.xywh
        self._ctx.copy_framebuffer(targets.resolved, targets.samples)
        pixels = targets.resolved.read(rectangle.xywh, components=3, alignment=1)
        image[rectangle.slices] = np.frombuffer(pixels, np.uint8).reshape(*rectangle.shape, 3)
        return image

    def _draw_truth(
        self,
        bodies: Sequence[Body],
        layer: _StaticLayer,
        camera: Camera,
        rectangle: _Rectangle,
        channels: Collection[str],
    ) -> dict[str, Any]:
        height, width = layer.depth.shape
        out: dict[str, Any] = {}
        if "depth" in channels:
            out["depth"] = layer.depth.copy()
        if "instance" in channels:
            out["instance"] = np.zeros((height, width), np.uint16)
        if "part" in channels:
            out["part"] = np.zeros((height, width), np.uint8)
        if rectangle.empty:
            return out
        target = self._target(camera.size).truth
        target.use()
        target.scissor = rectangle.xywh
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        self._draw_layer(self._static_truth, self._window_truth, layer)
        self._use_camera(self._truth, camera)
        for body in bodies:
            _set(self._truth, "instance", body.instance)
            self._cull(body, rectangle)
            self._surface(body.mesh).draw_truth(body.parts)
        if "depth" in out:
            pixels = target.read(rectangle.xywh, components=1, attachment=1, dtype="f4", alignment=1)
            out["depth"][rectangle.slices] = np.frombuffer(pixels, np.float32).reshape(rectangle.shape)
        if "instance" in out or "part" in out:
            pixels = target.read(rectangle.xywh, components=1, attachment=0, dtype="u4", alignment=1)
            labels = np.frombuffer(pixels, np.uint32).reshape(rectangle.shape)
            if "instance" in out:
                out["instance"][rectangle.slices] = labels >> 8
            if "part" in out:
                out["part"][rectangle.slices] = labels & 255
        return out

    def _cull(self, body: Body, rectangle: _Rectangle) -> None:
        """Leave out back faces where they cannot show: on a closed body that the camera is well outside of."""
        if body.mesh.closed and not rectangle.near:
            self._ctx.enable(moderngl.CULL_FACE)
        else:
            self._ctx.disable(moderngl.CULL_FACE)

    def _draw_layer(
        self, program: moderngl.Program, window: moderngl.VertexArray, layer: _StaticLayer
    ) -> None:
        """Fill the rectangle with the static scene, depth buffer included, whatever was there."""
        self._ctx.depth_func = "1"  # always
        layer.use(program)
        window.render(moderngl.TRIANGLES, vertices=3)
        self._ctx.depth_func = "<"

    def _draw_shadows(self, shadows: Sequence[Any], camera: Camera) -> None:
        if not shadows:
            return
        self._ctx.enable(moderngl.BLEND)
        self._ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        _set(self._shadow, "clip", _clip(camera))
        for shadow in shadows:
            self._shadow_texture.write(shadow.darkness.tobytes())
            self._shadow_texture.use(0)
            _set(self._shadow, "place", (*shadow.corner, shadow.side, shadow.side))
            self._shadow_quad.render(moderngl.TRIANGLE_STRIP)
        self._ctx.disable(moderngl.BLEND)

    def _use_camera(self, program: moderngl.Program, camera: Camera) -> None:
        _set(program, "clip", _clip(camera))
        _set(program, "optical_z", (*camera.R[2], camera.t[2]))

    def _surface(self, mesh: Mesh) -> _Surface:
        """The mesh on the device; kept, with the mesh so that its id stays its own."""
        if id(mesh) not in self._surfaces:
            self._surfaces[id(mesh)] = _Surface(self._ctx, mesh, self._rgb, self._truth)
        return self._surfaces[id(mesh)]

    def _target(self, size: tuple[int, int]) -> _Targets:
        if size not in self._targets:
            self._targets[size] = _Targets(self._ctx, size)
        return self._targets[size]

    def _layer(self, camera: Camera) -> _StaticLayer:
        key = b"".join(
            (np.array(camera.size).tobytes(), camera.K.tobytes(), camera.R.tobytes(), camera.t.tobytes())
        )
        if key not in self._layers:
            self._layers[key] = self._draw_static(camera)
        return self._layers[key]

    def _draw_static(self, camera: Camera) -> _StaticLayer:
        width, height = camera.size
        factor = max(1, min(_STATIC_SUPERSAMPLING, _MAX_STATIC_SIDE // max(width, height)))
        fine = (width * factor, height * factor)
        ctx = self._ctx
        surfaces = [_Surface(ctx, mesh, self._rgb, self._truth) for mesh in self._static]
        for surface in surfaces:
            surface.upload(surface.mesh.vertices.astype(np.float32), with_normals=True)
        color = ctx.framebuffer([ctx.texture(fine, 4)], ctx.depth_renderbuffer(fine))
        color.use()
        ctx.enable_only(moderngl.DEPTH_TEST)
        color.clear(*(c / 255 for c in self._lighting.background), 1.0)
        # the same window, only finer: clip coordinates do not know how many pixels there are
        self._use_camera(self._rgb, camera)
        _set(self._rgb, "eye", tuple(camera.center))
        for surface in surfaces:
            surface.draw_rgb()
        image = np.frombuffer(color.read(components=3, alignment=1), np.uint8).reshape(fine[1], fine[0], 3)
        rgb = np.ascontiguousarray(
            cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )

        target = self._target(camera.size).truth
        target.scissor = None
        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0)
        target.color_attachments[1].write(np.full((height, width), np.inf, np.float32).tobytes())
        self._use_camera(self._truth, camera)
        _set(self._truth, "instance", 0)
        for surface in surfaces:
            surface.draw_truth(np.zeros(len(surface.mesh.triangles), np.uint8))
        pixels = target.read(components=1, attachment=1, dtype="f4", alignment=1)
        depth = np.frombuffer(pixels, np.float32).reshape(height, width).copy()
        for surface in surfaces:
            surface.release()
        color.release()
        return _StaticLayer(ctx, rgb, depth)

    def _program(self, vertex: str, fragment: str) -> moderngl.Program:
        return self._ctx.program(
            vertex_shader=(_SHADERS / vertex).read_text(), fragment_shader=(_SHADERS / fragment).read_text()
        )


def create_context() -> moderngl.Context:
    """A standalone OpenGL 3.3 context through EGL. RenderError, naming the packages to install, where there
    is none.
    """
    try:
        return moderngl.create_context(require=330, standalone=True, backend="egl")  # type: ignore[call-arg]
    except Exception as reason:  # moderngl and glcontext raise bare Exceptions
        raise RenderError(
            f"no OpenGL through EGL ({str(reason).splitlines()[0]}). "
            "On Debian or Ubuntu: sudo apt-get install -y libegl1 libgl1-mesa-dri"
        ) from None


@dataclass(frozen=True)
class _Rectangle:
    """Pixels x0 <= x < x1, y0 <= y < y1."""

    x0: int
    y0: int
    x1: int
    y1: int
    #: a surface comes so near that the camera may be inside it
    near: bool = False

    @property
    def empty(self) -> bool:
        return self.x1 <= self.x0 or self.y1 <= self.y0

    @property
    def xywh(self) -> tuple[int, int, int, int]:
        return self.x0, self.y0, self.x1 - self.x0, self.y1 - self.y0

    @property
    def shape(self) -> tuple[int, int]:
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.y0, self.y1), slice(self.x0, self.x1)


def _touched(clouds: Sequence[NDArray[np.floating]], camera: Camera) -> _Rectangle:
    """The pixels that surfaces spanned by clouds of points (N, 3) can touch: the whole image if one comes too
    near.
    """
    width, height = camera.size
    p = camera.P.astype(np.float32)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for points in clouds:
        homogeneous = np.asarray(points, np.float32) @ p[:, :3].T + p[:, 3]
        depth = homogeneous[:, 2]
        if (depth < 2 * _NEAR).any():
            if (depth < 0).all():
                continue
            return _Rectangle(0, 0, width, height, near=True)
        pixels = homogeneous[:, :2] / depth[:, None]
        low, high = np.minimum(low, pixels.min(0)), np.maximum(high, pixels.max(0))
    if not np.isfinite(low).all():
        return _Rectangle(0, 0, 0, 0)
    x0, y0 = np.clip(np.floor(low) - 2, 0, camera.size).astype(int)
    x1, y1 = np.clip(np.ceil(high) + 3, 0, camera.size).astype(int)
    return _Rectangle(int(x0), int(y0), int(x1), int(y1))


def _clip(camera: Camera) -> bytes:
    matrix: Array = camera.opengl_clip(_NEAR, _FAR) @ camera.optical_from_world
    return matrix.T.astype("f4").tobytes()


def _set(program: moderngl.Program, name: str, value: Any) -> None:
    """Set a uniform, unless the compiler found the shader does not need it."""
    if name in program:
        uniform = program[name]
        if isinstance(value, bytes):
            uniform.write(value)  # type: ignore[union-attr]
        else:
            uniform.value = value  # type: ignore[union-attr]


class _Targets:
    """What frames of one size are drawn into."""

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int]) -> None:
        samples = min(_SAMPLES, ctx.max_samples)
        self.samples = ctx.framebuffer(
            [ctx.renderbuffer(size, 4, samples=samples)], ctx.depth_renderbuffer(size, samples=samples)
        )
        self.resolved = ctx.framebuffer([ctx.renderbuffer(size, 4)])
        label, depth = ctx.texture(size, 1, dtype="u4"), ctx.texture(size, 1, dtype="f4")
        self.truth = ctx.framebuffer([label, depth], ctx.depth_renderbuffer(size))


class _StaticLayer:
    """The static scene as one camera sees it, kept on both sides: ``rgb`` (H, W, 3) uint8 and ``depth`` (H,
    W) float32.
    """

    def __init__(self, ctx: moderngl.Context, rgb: NDArray[np.uint8], depth: NDArray[np.float32]) -> None:
        self.rgb, self.depth = rgb, depth
        size = depth.shape[::-1]
        self._rgb = ctx.texture(size, 3, rgb.tobytes(), alignment=1)
        self._depth = ctx.texture(size, 1, depth.tobytes(), alignment=1, dtype="f4")
        for texture in (self._rgb, self._depth):
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)

    def use(self, program: moderngl.Program) -> None:
        self._rgb.use(0)
        self._depth.use(1)
        _set(program, "static_rgb", 0)
        _set(program, "static_depth", 1)
        # window depth of the standard perspective row: half of it plus a half
        row = (_FAR + _NEAR) / (_FAR - _NEAR), -2 * _FAR * _NEAR / (_FAR - _NEAR)
        _set(program, "depth_row", (row[0] / 2 + 0.5, row[1] / 2))


class _Surface:
    """A mesh on the device. Vertices on texture seams are there twice, once per texture coordinate."""

    def __init__(
        self, ctx: moderngl.Context, mesh: Mesh, rgb: moderngl.Program, truth: moderngl.Program
    ) -> None:
        self.mesh = mesh
        self._ctx = ctx
        triangles = mesh.triangles
        if mesh.uv is None or mesh.uv_triangles is None:
            self._source = np.arange(len(mesh.vertices))
            corners, uv = triangles, np.zeros((len(mesh.vertices), 2))
        else:
            pairs = np.stack([triangles.ravel(), mesh.uv_triangles.ravel()], axis=1)
            unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
            self._source = unique[:, 0]
            corners, uv = inverse.reshape(triangles.shape), mesh.uv[unique[:, 1]]
        colors = np.full((len(mesh.vertices), 3), 255, np.uint8) if mesh.colors is None else mesh.colors
        looks = np.concatenate([uv, colors[self._source] / 255.0], axis=1).astype("f4")
        self._texture = _texture(ctx, mesh.texture)
        self._dynamic = np.zeros((len(self._source), 6), np.float32)
        self._moving = ctx.buffer(reserve=self._dynamic.nbytes, dynamic=True)
        self._looks = ctx.buffer(looks.tobytes())
        self._index = ctx.buffer(np.ascontiguousarray(corners, dtype=np.int32).tobytes())
        self._rgb = ctx.vertex_array(
            rgb,
            [(self._moving, "3f 3f", "position", "normal"), (self._looks, "2f 3f", "uv", "color")],
            index_buffer=self._index,
        )
        self._truth = ctx.vertex_array(
            truth, [(self._moving, "3f 3x4", "position")], index_buffer=self._index
        )
        # one texel per triangle, in rows of 1024: a plain texture, as moderngl has no buffer textures
        self._parts = ctx.texture((_ROW, -(-len(triangles) // _ROW)), 1, dtype="u1", alignment=1)
        self._parts_of: NDArray[np.uint8] | None = None

    @cached_property
    def areas(self) -> NDArray[np.float32]:
        return vertex_areas(self.mesh)

    @cached_property
    def _normals(self) -> NormalMaker:
        return NormalMaker(self.mesh.faces, len(self.mesh.vertices))

    def upload(self, vertices: NDArray[np.float32], with_normals: bool) -> None:
        np.take(vertices, self._source, axis=0, out=self._dynamic[:, :3])
        if with_normals:
            np.take(self._normals(vertices), self._source, axis=0, out=self._dynamic[:, 3:])
        self._moving.orphan()
        self._moving.write(self._dynamic)

    def draw_rgb(self) -> None:
        self._texture.use(0)
        self._rgb.render(moderngl.TRIANGLES)

    def draw_truth(self, parts: NDArray[np.uint8]) -> None:
        if parts is not self._parts_of:
            padded = np.zeros(self._parts.width * self._parts.height, np.uint8)
            padded[: len(parts)] = parts
            self._parts.write(padded.tobytes())
            self._parts_of = parts
        self._parts.use(0)
        self._truth.render(moderngl.TRIANGLES)

    def release(self) -> None:
        for thing in (
            self._rgb,
            self._truth,
            self._moving,
            self._looks,
            self._index,
            self._texture,
            self._parts,
        ):
            thing.release()


def _texture(ctx: moderngl.Context, image: NDArray[np.uint8] | None) -> moderngl.Texture:
    if image is None:
        return ctx.texture((1, 1), 3, b"\xff\xff\xff", alignment=1)
    # the texture coordinate v points up, the image's first row is on top
    texture = ctx.texture(image.shape[1::-1], 3, np.ascontiguousarray(image[::-1]).tobytes(), alignment=1)
    texture.build_mipmaps()
    texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    return texture


def threads_for(processes: int) -> int:
    """How many threads each of several rendering processes should give the software rasteriser on this
    machine.
    """
    return max(1, (os.cpu_count() or 1) // processes)
