"""Ambient occlusion of the static scene: a light map that is computed once for all cameras.

Ambient occlusion is the visible share of sky and ground at a point. Depth maps of the scene are rendered from
many directions, side by side in one texture. Each texel of the light map is looked up in all depth maps, for
both sides of its surface. Like the sun, ambient light passes through the back faces of surfaces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import moderngl
import numpy as np

from humansim_ros.render.device.programs import columns, depth_program, set_uniform, shader, unit_square
from humansim_ros.render.static.static_scene import StaticScene
from humansim_ros.types import Array

#: Depth maps along a side of the common texture, and texels along a side of each.
_SIDE, _TEXELS = 12, 208
#: The depth maps extend this far around the scene, metres, but at least by this share of its size.
_MARGIN, _MARGIN_SHARE = 0.1, 0.02
#: Texture unit of the light map (0: texture of the surface, 1 to 4: shadow maps); and the first of the units
#: that are free while the map is computed.
UNIT, _BAKING = 5, 12


class LightMap:
    """Visible share of sky and ground, on the front and the back of each surface of a static scene.

    Args:
        ctx: OpenGL context.
        static: The scene. Its charts are computed.
    """

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
        for image in (maps, points, normals, *wide, *light, shares):
            image.release()

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
        framebuffer.release()

    def _surface(self, static: StaticScene, size: tuple[int, int]) -> list[moderngl.Texture]:
        """Images of the points and of the normals of the texels. The fourth component of a point is 0 where
        there is no surface."""
        images = [self._ctx.texture(size, 4, dtype="f4") for _ in range(2)]
        program = self._ctx.program(
            vertex_shader=shader(["chart.vert"]), fragment_shader=shader(["chart.frag"])
        )
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
        framebuffer.release()
        return images

    def _light(
        self, points: moderngl.Texture, normals: moderngl.Texture, maps: moderngl.Texture
    ) -> list[moderngl.Texture]:
        """Images of the light of sky and ground: visible and total on the front, then the same on the back.
        Each texel tests one ninth of the directions, and its neighbours test the other eight. The texels of
        one ninth are side by side: ninth (column, row) has the texels (3 x + column, 3 y + row)."""
        width, height = (-(-side // 3) for side in points.size)
        switches = [f"COUNT {_SIDE * _SIDE // 9}", f"TEXELS {_TEXELS}"]
        program = self._program("ambient_light.frag", switches)
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
        framebuffer.release()
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
        framebuffer = self._ctx.framebuffer([image])
        self._draw(framebuffer, self._program(file), inputs)
        framebuffer.release()
        return image

    def _program(self, file: str, switches: Sequence[str] = ()) -> moderngl.Program:
        return self._ctx.program(
            vertex_shader=shader(["fullscreen.vert"]), fragment_shader=shader([file], switches)
        )

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
    """(N, 3) unit vectors spread evenly over the sphere, on a spiral from top to bottom. None is vertical."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
