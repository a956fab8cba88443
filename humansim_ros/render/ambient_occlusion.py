"""Ambient occlusion of the static scene: the visible share of sky and ground at its points.

Depth maps of the scene are rendered once from many directions, side by side in one texture. Each pixel of a
camera tests one ninth of the directions, its neighbours test the others, at a lower resolution than the
image. Like the sun, ambient light passes through the back faces of surfaces.
"""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render.programs import depth_program, shader, use_camera
from humansim_ros.render.static_scene import StaticScene, StaticTriangles
from humansim_ros.render.uniforms import columns, set_uniform
from humansim_ros.types import Array, Float32Array

#: Maps along a side of the common texture, and texels along a side of each map.
_SIDE, _TEXELS = 12, 208
#: Relative difference of depth below which two points belong to one surface.
_SAME_SURFACE = 0.03
#: Metres that the maps cover around the scene.
_MARGIN = 0.1
#: Texture unit; 0 has the texture of the surface, 1 to 4 have shadow maps.
UNIT = 5


class AmbientOcclusion:
    """Depth maps of a static scene from many directions."""

    def __init__(self, ctx: moderngl.Context, static: StaticScene) -> None:
        self._ctx = ctx
        box = static.box
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
            vertex_shader=shader(["lens.glsl", "ambient_occlusion.vert"]),
            fragment_shader=shader(
                ["ambient_occlusion.frag"], [f"COUNT {_SIDE**2}", f"SIDE {_SIDE}", f"INSET {1 / _TEXELS}"]
            ),
        )
        set_uniform(self._program, "directions", self._directions.astype("f4").tobytes())
        set_uniform(self._program, "centre", tuple(self._centre))
        set_uniform(self._program, "extent", tuple(self._extent))
        set_uniform(self._program, "texel", 2 * float(self._extent.max()) / _TEXELS)
        set_uniform(self._program, "maps", UNIT)
        self._draw_maps(static)

    def _draw_maps(self, static: StaticScene) -> None:
        depths = depth_program(self._ctx, static.switches)
        framebuffer = self._ctx.framebuffer(depth_attachment=self._map)
        framebuffer.use()
        framebuffer.clear(depth=1.0)
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        self._ctx.cull_face = "front"  # images are mirrored, and with them the winding of front faces
        for number, direction in enumerate(self._directions):
            row, column = divmod(number, _SIDE)
            framebuffer.viewport = column * _TEXELS, row * _TEXELS, _TEXELS, _TEXELS
            set_uniform(depths, "clip", columns(self._clip(direction)))
            static.whole.draw(depths)
        self._ctx.cull_face = "back"
        framebuffer.release()

    def _clip(self, direction: Array) -> Array:
        """(4, 4) from the world to a map's clip coordinates (the same as in ambient_occlusion.frag)."""
        u = np.array([-direction[1], direction[0], 0.0])
        u /= np.linalg.norm(u)
        axes = np.stack([u, np.cross(direction, u), -direction])
        axes /= (np.abs(axes) @ self._extent)[:, None]
        clip = np.eye(4)
        clip[:3, :3], clip[:3, 3] = axes, -axes @ self._centre
        return clip

    def image(self, camera: Camera, static: StaticTriangles, scale: int) -> moderngl.Texture:
        """Render the ambient occlusion for a camera, see :func:`packed`. ``scale``: pixels per texel."""
        size = -(-camera.size[0] // scale), -(-camera.size[1] // scale)
        sums_image, depth = self._ctx.texture(size, 4, dtype="f4"), self._ctx.texture(size, 1, dtype="f4")
        buffer = self._ctx.depth_renderbuffer(size)
        framebuffer = self._ctx.framebuffer([sums_image, depth], buffer)
        framebuffer.use()
        framebuffer.clear()
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        use_camera(self._ctx, self._program, camera)
        self._sampler.use(UNIT)
        static.draw(self._program)
        self._sampler.clear(UNIT)
        sums = np.frombuffer(framebuffer.read(components=4, dtype="f4"), np.float32).reshape(*size[::-1], 4)
        far = np.frombuffer(framebuffer.read(components=1, attachment=1, dtype="f4"), np.float32)
        for one in (framebuffer, sums_image, depth, buffer):
            one.release()
        made = self._ctx.texture(size, 1, packed(sums, far.reshape(size[::-1])).tobytes(), dtype="u4")
        made.filter = moderngl.NEAREST, moderngl.NEAREST
        return made


def directions(count: int) -> Array:
    """(N, 3) unit vectors evenly over the sphere, on a spiral; none is vertical."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def packed(sums: Float32Array, depth: Float32Array) -> NDArray[np.uint32]:
    """Combine each pixel with its neighbours on the same surface, and pack the result.

    ``sums``: (H, W, 4) sky visible and total, ground visible and total, of one ninth of the directions each.
    ``depth``: (H, W) metres.

    Returns:
        (H, W): visible share of sky in the low 8 bits, of ground in the next 8, 1 / (1 + depth) in 16.
    """
    padded, far = np.pad(sums, ((1, 1), (1, 1), (0, 0))), np.pad(depth, 1)
    height, width = depth.shape
    total = np.zeros_like(sums)
    for y in range(3):
        for x in range(3):
            near = np.abs(far[y : y + height, x : x + width] - depth) < _SAME_SURFACE * depth
            total += np.where(near[..., None], padded[y : y + height, x : x + width], 0)
    shares = np.where(total[..., 1::2] > 1e-3, total[..., ::2] / np.maximum(total[..., 1::2], 1e-3), 1)
    sky, ground = np.moveaxis(np.rint(255 * shares).astype(np.uint32), -1, 0)
    return np.asarray(
        sky | ground << 8 | np.rint(65535 / (1 + depth)).astype(np.uint32) << 16, dtype=np.uint32
    )
