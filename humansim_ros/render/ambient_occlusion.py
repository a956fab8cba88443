"""Ambient occlusion of the still scene: how much of sky and ground its points see.

The scene is drawn once from each of many directions, side by side in one map. For each camera its points look
into that map: in a ninth of the directions each, of which those beside them have the others, at a smaller
size than the picture. Like the sun, light from around falls through surfaces that turn their backs to it.
"""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render.programs import shader, use_camera
from humansim_ros.render.static_scene import StaticDraw, StaticScene
from humansim_ros.render.uniforms import columns, set_uniform
from humansim_ros.types import Array, Float32Array

#: Maps along a side of the common one, and texels of a side of each.
_SIDE, _TEXELS = 12, 208
#: Share of the depth within which points are of one surface.
_AS_DEEP = 0.03
#: Metres around the scene that maps go on.
_MARGIN = 0.1
#: Texture unit of what is found; 0 is what surfaces look like, 1 to 4 are maps of the sun.
UNIT = 5


class AmbientOcclusion:
    """What stands around the points of a still scene."""

    def __init__(self, ctx: moderngl.Context, still: StaticScene) -> None:
        self._ctx = ctx
        box = still.box
        assert box is not None
        low, high = box.min(axis=1).astype(float), box.max(axis=1).astype(float)
        self._centre, self._extent = (low + high) / 2, (high - low) / 2 + _MARGIN
        self._directions = directions(_SIDE * _SIDE)
        side = _SIDE * _TEXELS
        self._map = ctx.depth_texture((side, side))
        self._sampler = ctx.sampler(
            False, False, filter=(moderngl.LINEAR, moderngl.LINEAR), compare_func="<=", texture=self._map
        )
        self._program = ctx.program(
            vertex_shader=shader(["lens.glsl", "around.vert"]),
            fragment_shader=shader(
                ["around.frag"], [f"COUNT {_SIDE**2}", f"SIDE {_SIDE}", f"INSET {1 / _TEXELS}"]
            ),
        )
        set_uniform(self._program, "directions", self._directions.astype("f4").tobytes())
        set_uniform(self._program, "centre", tuple(self._centre))
        set_uniform(self._program, "extent", tuple(self._extent))
        set_uniform(self._program, "texel", 2 * float(self._extent.max()) / _TEXELS)
        set_uniform(self._program, "maps", UNIT)
        self._draw_maps(still)

    def _draw_maps(self, still: StaticScene) -> None:
        depths = self._ctx.program(
            vertex_shader=shader(["sun.vert"], still.switches),
            fragment_shader=shader(["sun.frag"], still.switches),
        )
        framebuffer = self._ctx.framebuffer(depth_attachment=self._map)
        framebuffer.use()
        framebuffer.clear(depth=1.0)
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        self._ctx.cull_face = "front"  # fronts run the other way in pictures, which are mirrored
        for number, direction in enumerate(self._directions):
            row, column = divmod(number, _SIDE)
            framebuffer.viewport = column * _TEXELS, row * _TEXELS, _TEXELS, _TEXELS
            set_uniform(depths, "clip", columns(self._clip(direction)))
            still.whole.draw(depths)
        self._ctx.cull_face = "back"
        framebuffer.release()

    def _clip(self, direction: Array) -> Array:
        """(4, 4) from the world to a map's clip coordinates (around.frag has the same formula)."""
        u = np.array([-direction[1], direction[0], 0.0])
        u /= np.linalg.norm(u)
        axes = np.stack([u, np.cross(direction, u), -direction])
        axes /= (np.abs(axes) @ self._extent)[:, None]
        clip = np.eye(4)
        clip[:3, :3], clip[:3, 3] = axes, -axes @ self._centre
        return clip

    def seen_by(self, camera: Camera, still: StaticDraw, coarser: int) -> moderngl.Texture:
        """What is found of the points that a camera sees, at a size so many times coarser: see packed."""
        size = -(-camera.size[0] // coarser), -(-camera.size[1] // coarser)
        seen, depth = self._ctx.texture(size, 4, dtype="f4"), self._ctx.texture(size, 1, dtype="f4")
        buffer = self._ctx.depth_renderbuffer(size)
        framebuffer = self._ctx.framebuffer([seen, depth], buffer)
        framebuffer.use()
        framebuffer.clear()
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        use_camera(self._ctx, self._program, camera)
        self._sampler.use(UNIT)
        still.draw(self._program)
        self._sampler.clear(UNIT)
        sums = np.frombuffer(framebuffer.read(components=4, dtype="f4"), np.float32).reshape(*size[::-1], 4)
        far = np.frombuffer(framebuffer.read(components=1, attachment=1, dtype="f4"), np.float32)
        for thing in (framebuffer, seen, depth, buffer):
            thing.release()
        found = self._ctx.texture(size, 1, packed(sums, far.reshape(size[::-1])).tobytes(), dtype="u4")
        found.filter = moderngl.NEAREST, moderngl.NEAREST
        return found


def directions(count: int) -> Array:
    """(N, 3) evenly over the sphere, none straight up: a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def packed(sums: Float32Array, depth: Float32Array) -> NDArray[np.uint32]:
    """(H, W) of what a ninth of the directions found each (H, W, 4), together with those beside them that are
    as deep: the share of sky in the low 8 bits, that of ground in the next 8, then 1 / (1 + depth) in 16.
    """
    padded, far = np.pad(sums, ((1, 1), (1, 1), (0, 0))), np.pad(depth, 1)
    height, width = depth.shape
    total = np.zeros_like(sums)
    for y in range(3):
        for x in range(3):
            near = np.abs(far[y : y + height, x : x + width] - depth) < _AS_DEEP * depth
            total += np.where(near[..., None], padded[y : y + height, x : x + width], 0)
    shares = np.where(total[..., 1::2] > 1e-3, total[..., ::2] / np.maximum(total[..., 1::2], 1e-3), 1)
    sky, ground = np.moveaxis(np.rint(255 * shares).astype(np.uint32), -1, 0)
    return np.asarray(
        sky | ground << 8 | np.rint(65535 / (1 + depth)).astype(np.uint32) << 16, dtype=np.uint32
    )
