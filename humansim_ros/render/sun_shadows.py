"""The soft shadows of a scene, drawn once a frame for all cameras."""

from __future__ import annotations

from collections.abc import Sequence

import moderngl
import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.render.body_buffers import BodyBuffers
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.programs import shader, unit_square
from humansim_ros.render.renderer import Body
from humansim_ros.render.shadow_map import MOVING_SIDE, STILL_SIDE, ShadowMap, encloses, shadow_ends, spread
from humansim_ros.render.static_scene import StaticScene
from humansim_ros.render.target import RenderTarget, ShadowTarget, StaticLayer
from humansim_ros.render.uniforms import columns, set_uniform
from humansim_ros.types import Float32Array

#: Metres that shadows go at most on ground that is not drawn.
_FARTHEST = 30.0


class SunShadows:
    """The soft shadows of a renderer's scene."""

    def __init__(
        self, ctx: moderngl.Context, still: StaticScene, lighting: Lighting, lit: Sequence[moderngl.Program]
    ) -> None:
        self._ctx, self._lighting, self._box = ctx, lighting, still.box
        self._depths = ctx.program(vertex_shader=shader(["sun.vert"]), fragment_shader=shader(["sun.frag"]))
        self._cast = ctx.program(
            vertex_shader=shader(["whole.vert"]), fragment_shader=shader(["sunshine.glsl", "cast.frag"])
        )
        self._caught = ctx.program(
            vertex_shader=shader(["whole.vert"]), fragment_shader=shader(["sunshine.glsl", "caught.frag"])
        )
        set_uniform(self._caught, "rays", 8)
        set_uniform(self._cast, "ground", lighting.shadow_catcher)
        corners = [(ctx.buffer(unit_square(1)), "2f", "corner")]
        self._whole_ground = ctx.vertex_array(self._caught, corners)
        self._whole = ctx.vertex_array(self._cast, [(ctx.buffer(unit_square(1)), "2f", "corner")])
        for unit, name in enumerate(("sunny", "sunless", "depths", "rays"), 5):
            set_uniform(self._cast, name, unit)
        self._programs = (*lit, self._cast, self._caught)
        for program in self._programs:
            set_uniform(program, "spread", spread(lighting))
        self._still, self._moving = ShadowMap(ctx, "still", STILL_SIDE), ShadowMap(ctx, "moving", MOVING_SIDE)
        self._lowest, self._farthest = self._reach()
        self._bodies: list[Body] = []
        self._ends: list[Float32Array] = []
        if self._box is not None:
            depths = ctx.program(
                vertex_shader=shader(["sun.vert"], still.switches),
                fragment_shader=shader(["sun.frag"], still.switches),
            )
            with still.facing(lighting.direction) as facing:
                self._still.draw(self._box, lighting.direction, depths, lambda: facing.draw(depths))
        for program in self._programs:
            self._still.use(program)
            self._moving.use(program)

    def _reach(self) -> tuple[float | None, float]:
        """The height of the lowest that shadows fall on, and how far they may; None if there is nothing."""
        if self._box is None:
            return (0.0, _FARTHEST) if self._lighting.shadow_catcher else (None, 0.0)
        lowest, size = float(self._box[2].min()), float(np.linalg.norm(np.ptp(self._box, axis=1)))
        return (min(lowest, 0.0), max(size, _FARTHEST)) if self._lighting.shadow_catcher else (lowest, size)

    def shine_on(self, surfaces: Sequence[BodyBuffers]) -> list[Float32Array]:
        """Look at surfaces from the sun, once for all cameras: where their shadows end, (3, N) each."""
        bodies = [surface.body for surface in surfaces]
        if len(bodies) == len(self._bodies) and all(
            a is b for a, b in zip(bodies, self._bodies, strict=True)
        ):
            return self._ends
        clouds = [surface.posed.points for surface in surfaces]

        def draw() -> None:
            for surface in surfaces:
                surface.draw_depths(self._depths)

        self._moving.draw(encloses(clouds), self._lighting.direction, self._depths, draw)
        for program in self._programs:
            self._moving.use(program)
        self._bodies, self._ends = bodies, []
        if self._lowest is not None:
            lowest, farthest = self._lowest, self._farthest
            self._ends = [shadow_ends(points, self._lighting, lowest, farthest) for points in clouds]
        return self._ends

    def on_ground(self, camera: Camera) -> Float32Array:
        """(H, W) how much of the sun the still scene leaves to the ground z = 0 that each pixel would see."""
        shades = ShadowTarget(self._ctx, camera, np.zeros((*camera.size[::-1], 3), np.uint8))
        picture = self._ctx.texture(camera.size, 1, dtype="f4")
        framebuffer = self._ctx.framebuffer([picture])
        framebuffer.use()
        self._ctx.enable_only(moderngl.NOTHING)
        shades.rays.use(8)
        set_uniform(self._caught, "world", columns(camera.world_from_optical))
        self._whole_ground.render(moderngl.TRIANGLES)
        left = np.frombuffer(framebuffer.read(components=1, dtype="f4"), np.float32)
        for thing in (framebuffer, picture, shades):
            thing.release()
        return left.reshape(camera.size[::-1])

    def shade(self, layer: StaticLayer, target: RenderTarget, camera: Camera) -> None:
        """Let the shadows of what moves fall on a picture of the still scene."""
        if layer.shades is None:
            return
        self._ctx.enable_only(moderngl.NOTHING)
        target.use_colour()
        pictures = (layer.target.colour, layer.shades.sunless, layer.target.depth, layer.shades.rays)
        for unit, picture in enumerate(pictures, 5):
            picture.use(unit)
        set_uniform(self._cast, "world", columns(camera.world_from_optical))
        self._whole.render(moderngl.TRIANGLES)
