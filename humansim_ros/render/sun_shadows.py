"""Soft shadows of the sun, rendered once per frame for all cameras."""

from __future__ import annotations

import weakref
from collections.abc import Sequence

import moderngl
import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.render.body_buffers import PosedBody
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.pixel_geometry import ray_grid
from humansim_ros.render.programs import depth_program, shader, unit_square
from humansim_ros.render.renderer import Body
from humansim_ros.render.shadow_map import (
    MOVING_SIDE,
    STATIC_SIDE,
    ShadowMap,
    bounding_box,
    penumbra_slope,
    shadow_ends,
)
from humansim_ros.render.static_scene import StaticScene
from humansim_ros.render.target import RenderTarget
from humansim_ros.render.uniforms import columns, set_uniform
from humansim_ros.types import Array, Float32Array, Image

#: Largest length of a shadow on the shadow catcher, metres.
_MAX_LENGTH = 30.0
#: First texture unit of the inputs of apply_shadows.frag, and the unit of the rays of shadow_catcher.frag.
_FIRST_INPUT, _RAYS_UNIT = 5, 8


class ShadowInputs:
    """Inputs of apply_shadows.frag on the device: the static scene without sun, and the pixels' rays."""

    def __init__(self, ctx: moderngl.Context, camera: Camera, shaded_colour: Image) -> None:
        self.shaded_colour = ctx.texture(camera.size, 3, shaded_colour.tobytes(), alignment=1)
        self.rays = _ray_texture(ctx, camera)

    def release(self) -> None:
        """Free the memory on the device."""
        self.shaded_colour.release()
        self.rays.release()


class SunShadows:
    """Soft shadows of the static scene and of bodies.

    Args:
        ctx: OpenGL context.
        static: The static scene.
        lighting: Light.
        lit: Programs that look up the shadow maps.
    """

    def __init__(
        self, ctx: moderngl.Context, static: StaticScene, lighting: Lighting, lit: Sequence[moderngl.Program]
    ) -> None:
        self._ctx, self._lighting, self._box = ctx, lighting, static.box
        self._depth_program = depth_program(ctx)
        self._apply, self._catch = (
            ctx.program(
                vertex_shader=shader(["fullscreen.vert"]), fragment_shader=shader(["soft_shadow.glsl", name])
            )
            for name in ("apply_shadows.frag", "shadow_catcher.frag")
        )
        set_uniform(self._catch, "rays", _RAYS_UNIT)
        set_uniform(self._apply, "shadow_catcher", lighting.shadow_catcher)
        self._apply_image, self._catch_image = (
            ctx.vertex_array(program, [(ctx.buffer(unit_square(1)), "2f", "corner")])
            for program in (self._apply, self._catch)
        )
        for unit, name in enumerate(("sunlit_colour", "shaded_colour", "depths", "rays"), _FIRST_INPUT):
            set_uniform(self._apply, name, unit)
        self._programs = (*lit, self._apply, self._catch)
        for program in self._programs:
            set_uniform(program, "penumbra_slope", penumbra_slope(lighting))
        self._static_map = ShadowMap(ctx, "static", STATIC_SIDE)
        self._moving_map = ShadowMap(ctx, "moving", MOVING_SIDE)
        self._lowest, self._max_length = self._reach()
        self._bodies: list[weakref.ref[Body]] = []
        self._ends: list[Float32Array] = []
        if self._box is not None:
            depths = depth_program(ctx, static.switches)
            with static.facing(lighting.direction) as facing:
                self._static_map.draw(self._box, lighting.direction, depths, lambda: facing.draw(depths))
        for program in self._programs:
            self._static_map.use(program)
            self._moving_map.use(program)

    def _reach(self) -> tuple[float | None, float]:
        """Lowest height that shadows fall on, None if there is nothing; and their largest length."""
        if self._box is None:
            return (0.0, _MAX_LENGTH) if self._lighting.shadow_catcher else (None, 0.0)
        lowest, size = float(self._box[2].min()), float(np.linalg.norm(np.ptp(self._box, axis=1)))
        return (min(lowest, 0.0), max(size, _MAX_LENGTH)) if self._lighting.shadow_catcher else (lowest, size)

    def update(self, bodies: Sequence[PosedBody]) -> list[Float32Array]:
        """Render the shadow map of bodies unless it is theirs.

        Returns:
            Points (3, M) around the end of each body's shadow.
        """
        known = [reference() for reference in self._bodies]
        if len(bodies) == len(known) and all(a.body is b for a, b in zip(bodies, known, strict=True)):
            return self._ends
        clouds = [body.posed.points for body in bodies]

        def draw() -> None:
            for body in bodies:
                body.draw_depths(self._depth_program)

        self._moving_map.draw(bounding_box(clouds), self._lighting.direction, self._depth_program, draw)
        for program in self._programs:
            self._moving_map.use(program)
        self._bodies, self._ends = [weakref.ref(body.body) for body in bodies], []
        if self._lowest is not None:
            lowest, longest = self._lowest, self._max_length
            self._ends = [shadow_ends(points, self._lighting, lowest, longest) for points in clouds]
        return self._ends

    def on_ground(self, camera: Camera) -> Float32Array:
        """(H, W) share of the sun that the static scene leaves to the ground z = 0 at each pixel."""
        rays, image = _ray_texture(self._ctx, camera), self._ctx.texture(camera.size, 1, dtype="f4")
        framebuffer = self._ctx.framebuffer([image])
        framebuffer.use()
        self._ctx.enable_only(moderngl.NOTHING)
        rays.use(_RAYS_UNIT)
        set_uniform(self._catch, "world_from_optical", columns(camera.world_from_optical))
        self._catch_image.render(moderngl.TRIANGLES)
        visibility = np.frombuffer(framebuffer.read(components=1, dtype="f4"), np.float32)
        for one in (framebuffer, image, rays):
            one.release()
        return visibility.reshape(camera.size[::-1])

    def apply(self, inputs: ShadowInputs, static: RenderTarget, target: RenderTarget, camera: Camera) -> None:
        """Draw the static scene with the shadows of bodies.

        Args:
            inputs: Of the static scene from this camera.
            static: Image of the static scene with sun.
            target: Target to draw into.
            camera: The camera.
        """
        self._ctx.enable_only(moderngl.NOTHING)
        target.use_colour()
        images = (static.colour, inputs.shaded_colour, static.depth, inputs.rays)
        for unit, image in enumerate(images, _FIRST_INPUT):
            image.use(unit)
        set_uniform(self._apply, "world_from_optical", columns(camera.world_from_optical))
        self._apply_image.render(moderngl.TRIANGLES)


def _ray_texture(ctx: moderngl.Context, camera: Camera) -> moderngl.Texture:
    rays: Array = np.nan_to_num(ray_grid(camera)[..., :2])
    return ctx.texture(camera.size, 2, np.ascontiguousarray(rays.astype("f4")).tobytes(), dtype="f4")
