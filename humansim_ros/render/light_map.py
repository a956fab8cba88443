"""Ambient occlusion of the static scene: a light map, made once for all cameras.

Ambient occlusion is the visible share of sky and ground at a point. Depth maps of the scene are rendered from
many directions, side by side in one texture. Each texel of the light map looks itself up in all of them, for
both sides of its surface. Like the sun, ambient light passes through the back faces of surfaces.
"""

from __future__ import annotations

import cv2
import moderngl
import numpy as np

from humansim_ros.render.programs import columns, depth_program, set_uniform, shader, unit_square
from humansim_ros.render.static_scene import StaticScene
from humansim_ros.types import Array, Float32Array

#: Depth maps along a side of the common texture, and texels along a side of each.
_SIDE, _TEXELS = 12, 208
#: Metres that the depth maps cover around the scene, and the least share of its size.
_MARGIN, _MARGIN_SHARE = 0.1, 0.02
#: Texture unit; 0 has the texture of the surface, 1 to 4 have shadow maps. Units from the second on are free
#: while the map is baked.
UNIT, _BAKING = 5, 12


class LightMap:
    """Visible share of sky and of ground on the fronts, and on the backs, of a static scene.

    Args:
        ctx: OpenGL context.
        static: The scene. It gets charts.
    """

    def __init__(self, ctx: moderngl.Context, static: StaticScene) -> None:
        self._ctx = ctx
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
        surface = self._surface(static, charts.size)
        known = surface[0, ..., 3:].copy()
        weight, unknown = _sum(known)[..., None], known[..., 0] == 0
        # texels around a chart repeat its border: each texel has all its neighbours
        for image in surface:
            image[unknown] = (_sum(image) / np.maximum(weight, 1))[unknown]
        light = self._light(surface, maps)
        maps.release()
        del surface
        for image in light:
            image[:] = _sum(image * (weight > 0))
        shares = _shares(light)
        shares = np.where(known > 0, shares, _sum(shares * known) / np.maximum(weight, 1))
        self._texture = ctx.texture(charts.size, 4, np.rint(255 * shares).astype(np.uint8).tobytes())

    def use(self) -> None:
        """Bind the map to its texture unit."""
        self._texture.use(UNIT)

    def _map_axes(self, direction: Array) -> Array:
        """(3, 3) axes of a direction's map, so that the scene is within -1 and 1 along each."""
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
        self._ctx.cull_face = "front"  # images are mirrored, and with them the winding of front faces
        for number, axes in enumerate(self._axes):
            row, column = divmod(number, _SIDE)
            framebuffer.viewport = column * _TEXELS, row * _TEXELS, _TEXELS, _TEXELS
            clip = np.eye(4)
            clip[:3, :3], clip[:3, 3] = axes, -axes @ self._centre
            set_uniform(depths, "clip", columns(clip))
            whole.draw(depths)
        self._ctx.cull_face = "back"
        framebuffer.release()

    def _surface(self, static: StaticScene, size: tuple[int, int]) -> Float32Array:
        """(2, H, W, 4) points and normals of the texels; the fourth component is 0 where no surface is."""
        images = [self._ctx.texture(size, 4, dtype="f4") for _ in range(2)]
        program = self._ctx.program(
            vertex_shader=shader(["chart.vert"]), fragment_shader=shader(["chart.frag"])
        )
        framebuffer = self._ctx.framebuffer(images)
        framebuffer.use()
        framebuffer.clear()
        self._ctx.enable_only(moderngl.NOTHING)
        # first the texels that triangles touch beside their centres
        static.whole.draw_all(program, moderngl.POINTS)
        self._ctx.wireframe = True
        static.whole.draw_all(program)
        self._ctx.wireframe = False
        static.whole.draw_all(program)
        surface = np.stack([_pixels(framebuffer, number) for number in range(2)])
        framebuffer.release()
        for image in images:
            image.release()
        return surface

    def _light(self, surface: Float32Array, maps: moderngl.Texture) -> Float32Array:
        """(2, H, W, 4) light of sky and ground: visible and total on the front, the same on the back.

        Each texel tests one ninth of the directions, its neighbours test the others.
        """
        height, width = surface.shape[1:3]
        count = _SIDE * _SIDE // 9
        program = self._ctx.program(
            vertex_shader=shader(["fullscreen.vert"]),
            fragment_shader=shader(["ambient_light.frag"], [f"COUNT {count}", f"TEXELS {_TEXELS}"]),
        )
        set_uniform(program, "centre", tuple(self._centre))
        set_uniform(program, "texel", 2 * float(self._extent.max()) / _TEXELS)
        inputs = [self._ctx.texture((width, height), 4, image.tobytes(), dtype="f4") for image in surface]
        for unit, (name, image) in enumerate(
            zip(("points", "normals", "maps"), (*inputs, maps), strict=True), _BAKING
        ):
            image.use(unit)
            set_uniform(program, name, unit)
        images = [self._ctx.texture((-(-width // 3), -(-height // 3)), 4, dtype="f4") for _ in range(2)]
        framebuffer = self._ctx.framebuffer(images)
        framebuffer.use()
        self._ctx.enable_only(moderngl.NOTHING)
        corners = _TEXELS * np.stack(np.divmod(np.arange(_SIDE * _SIDE), _SIDE)[::-1], axis=1)
        whole = self._ctx.vertex_array(program, [(self._ctx.buffer(unit_square(1)), "2f", "corner")])
        light = np.empty_like(surface)
        for row, column in np.ndindex(3, 3):
            own = slice(3 * row + column, None, 9)
            set_uniform(program, "first", (column, row))
            set_uniform(program, "directions", self._directions[own].astype("f4").tobytes())
            set_uniform(program, "axes", self._axes[own].astype("f4").tobytes())
            set_uniform(program, "corners", corners[own].astype("i4").tobytes())
            whole.render()
            for number, whole_light in enumerate(light):
                part = whole_light[row::3, column::3]
                part[:] = _pixels(framebuffer, number)[: part.shape[0], : part.shape[1]]
        framebuffer.release()
        for image in (*inputs, *images):
            image.release()
        return light


def _pixels(framebuffer: moderngl.Framebuffer, number: int) -> Float32Array:
    """(H, W, 4) of an attachment."""
    pixels = framebuffer.read(components=4, attachment=number, dtype="f4")
    return np.frombuffer(pixels, np.float32).reshape(*framebuffer.size[::-1], 4)


def _sum(image: Float32Array) -> Float32Array:
    """(H, W, C) sums over each pixel and its neighbours."""
    return np.asarray(cv2.boxFilter(image, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT))


def _shares(light: Float32Array) -> Float32Array:
    """(H, W, 4) visible over total light: sky and ground on the front, sky and ground on the back.

    ``light``: (2, H, W, 4).
    """
    visible, total = light[..., ::2], light[..., 1::2]
    shares = np.where(total > 1e-3, visible / np.maximum(total, 1e-3), 1)
    return shares.transpose(1, 2, 3, 0).reshape(*light.shape[1:])


def directions(count: int) -> Array:
    """(N, 3) unit vectors evenly over the sphere, on a spiral from top to bottom; none is vertical."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
