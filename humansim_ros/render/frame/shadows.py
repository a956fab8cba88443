"""Soft shadows of the sun, and contact shadows.

Soft shadows come from shadow maps: depths of the scene from the direction of the sun. The map of the static
scene is rendered once. The map of the bodies is rendered once per frame, for all cameras. With both maps,
shadows are drawn on the bodies and on the cached images of the static scene (shaders/apply_shadows.frag).
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.render.device.context import (
    columns,
    depth_program,
    link,
    set_uniform,
    unit_square,
    use_camera,
)
from humansim_ros.render.device.mesh_buffers import CELLS, ContactShadow
from humansim_ros.render.device.pixel_geometry import ray_grid
from humansim_ros.render.device.target import RenderTarget
from humansim_ros.render.frame.body_buffers import PosedBody
from humansim_ros.render.frame.static_scene import StaticScene, bounding_box
from humansim_ros.render.interface.lighting import Lighting
from humansim_ros.render.interface.renderer import Body
from humansim_ros.types import Array, Float32Array, Image

#: Largest length of a shadow on the shadow catcher, metres.
_MAX_LENGTH = 30.0
#: First texture unit of the inputs of apply_shadows.frag, and the unit of the rays of shadow_catcher.frag.
_FIRST_INPUT, _RAYS_UNIT = 5, 8


class ShadowInputs:
    """Inputs of apply_shadows.frag on the device: images of the static scene, and the pixels' rays.

    Args:
        ctx: OpenGL context.
        camera: Camera of the images.
        sunlit: (H, W, 4) colours with sunlight; alpha is the visible share of the sun.
        shaded: (H, W, 3) colours without sunlight.
        depth: (H, W) metres, 0 where nothing is.
    """

    def __init__(
        self, ctx: moderngl.Context, camera: Camera, sunlit: Image, shaded: Image, depth: Float32Array
    ) -> None:
        self.textures = (
            ctx.texture(camera.size, 4, sunlit.tobytes()),
            ctx.texture(camera.size, 3, shaded.tobytes(), alignment=1),
            ctx.texture(camera.size, 1, depth.tobytes(), dtype="f4"),
            _ray_texture(ctx, camera),
        )


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
        self._apply = link(ctx, "fullscreen.vert", "apply_shadows.frag")
        self._catch = link(ctx, "fullscreen.vert", "shadow_catcher.frag")
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
            facing = static.facing(lighting.direction)
            self._static_map.draw(self._box, lighting.direction, depths, lambda: facing.draw(depths))
        for program in self._programs:
            self._static_map.use(program)
            self._moving_map.use(program)

    def _reach(self) -> tuple[float | None, float]:
        """Lowest height that shadows fall on (None if the scene is empty), and the largest length of a
        shadow."""
        if self._box is None:
            return (0.0, _MAX_LENGTH) if self._lighting.shadow_catcher else (None, 0.0)
        lowest, size = float(self._box[2].min()), float(np.linalg.norm(np.ptp(self._box, axis=1)))
        return (min(lowest, 0.0), max(size, _MAX_LENGTH)) if self._lighting.shadow_catcher else (lowest, size)

    def update(self, bodies: Sequence[PosedBody]) -> list[Float32Array]:
        """Render the shadow map of bodies, unless it shows these bodies already.

        Returns:
            For each body, points (3, M) around the end of its shadow.
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
        """(H, W) visible share of the sun at the point of the ground z = 0 that the pixel sees. Only the
        static scene hides the sun."""
        rays, image = _ray_texture(self._ctx, camera), self._ctx.texture(camera.size, 1, dtype="f4")
        framebuffer = self._ctx.framebuffer([image])
        framebuffer.use()
        self._ctx.enable_only(moderngl.NOTHING)
        rays.use(_RAYS_UNIT)
        set_uniform(self._catch, "world_from_optical", columns(camera.world_from_optical))
        self._catch_image.render(moderngl.TRIANGLES)
        visibility = np.frombuffer(framebuffer.read(components=1, dtype="f4"), np.float32)
        return visibility.reshape(camera.size[::-1])

    def apply(self, inputs: ShadowInputs, target: RenderTarget, camera: Camera) -> None:
        """Draw the static scene, as ``camera`` sees it, with the shadows of bodies."""
        self._ctx.enable_only(moderngl.NOTHING)
        target.use_colour()
        for unit, texture in enumerate(inputs.textures, _FIRST_INPUT):
            texture.use(unit)
        set_uniform(self._apply, "world_from_optical", columns(camera.world_from_optical))
        self._apply_image.render(moderngl.TRIANGLES)


def _ray_texture(ctx: moderngl.Context, camera: Camera) -> moderngl.Texture:
    rays: Array = np.nan_to_num(ray_grid(camera)[..., :2])
    return ctx.texture(camera.size, 2, np.ascontiguousarray(rays.astype("f4")).tobytes(), dtype="f4")


#: Texels along a side of the maps of the static scene and of bodies.
STATIC_SIDE, MOVING_SIDE = 2048, 1024
#: Distance that a map covers around the occluders, metres, since penumbras are wider than occluders.
_MARGIN = 0.1
#: If the sine of the sun's elevation is below this, shadows do not end on the floor.
_LOW = 0.05
#: Texture units of the samplers; unit 0 has the texture of the surface.
_UNITS = {"static": (1, 2), "moving": (3, 4)}


@dataclass(frozen=True)
class ShadowView:
    """The box that a shadow map covers. ``from_world``: (4, 4) from ``map`` to x and y from 0 to 1, and z in
    metres away from the sun. ``size``: (3,) metres. ``texel``: size of a texel, metres."""

    from_world: Array
    size: Array
    texel: float

    @classmethod
    def of(cls, points: NDArray[np.floating], direction: Array, side: int) -> ShadowView:
        """View of points (3, N) from the sun. ``direction``: (3,) to the sun. ``side``: texels of the map."""
        helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
        x = np.cross(helper, direction)
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(direction, x), -direction])
        inside = axes @ points
        low, high = inside.min(axis=1) - _MARGIN, inside.max(axis=1) + _MARGIN
        size = high - low
        from_world = np.eye(4)
        from_world[:3, :3], from_world[:3, 3] = axes, -low
        from_world[:2] /= size[:2, None]
        return cls(from_world, size, float(size[:2].max() / side))

    @property
    def clip(self) -> Array:
        """(4, 4) from ``map`` to OpenGL's clip coordinates."""
        scale = np.array([2, 2, 2 / self.size[2]])
        to_clip = np.diag([*scale, 1.0])
        to_clip[:3, 3] = -1
        return to_clip @ self.from_world


class ShadowMap:
    """A shadow map on the device. ``name``: prefix of the names of its uniforms in the shaders."""

    def __init__(self, ctx: moderngl.Context, name: str, side: int) -> None:
        self._ctx, self._name, self._side = ctx, name, side
        self._texture = ctx.depth_texture((side, side))
        self._texture.repeat_x = self._texture.repeat_y = False
        self._framebuffer = ctx.framebuffer(depth_attachment=self._texture)
        linear, nearest = moderngl.LINEAR, moderngl.NEAREST
        self._samplers = (
            ctx.sampler(False, False, filter=(linear, linear), compare_func="<=", texture=self._texture),
            ctx.sampler(False, False, filter=(nearest, nearest), texture=self._texture),
        )
        self._view = ShadowView.of(np.zeros((3, 1)), np.array([0.0, 0.0, 1.0]), side)
        self._framebuffer.clear(depth=1.0)

    def draw(
        self,
        points: NDArray[np.floating],
        direction: Array,
        program: moderngl.Program,
        draw: Callable[[], None],
    ) -> None:
        """Render the map.

        Args:
            points: (3, N) points. Their bounding box contains all that ``draw`` draws.
            direction: (3,) unit vector to the sun.
            program: Program that ``draw`` uses.
            draw: Draws the occluders.
        """
        self._view = ShadowView.of(points, direction, self._side)
        self._framebuffer.use()
        self._framebuffer.clear(depth=1.0)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        set_uniform(program, "clip", columns(self._view.clip))
        draw()

    def use(self, program: moderngl.Program) -> None:
        """Bind the map to the samplers of a program, if the program has them."""
        if f"{self._name}_shadows" not in program:
            return
        for sampler, unit, kind in zip(
            self._samplers, _UNITS[self._name], ("shadows", "depths"), strict=True
        ):
            sampler.use(unit)
            set_uniform(program, f"{self._name}_{kind}", unit)
        view = self._view
        set_uniform(program, f"{self._name}_map.from_world", columns(view.from_world))
        set_uniform(program, f"{self._name}_map.size", tuple(view.size.tolist()))
        set_uniform(program, f"{self._name}_map.texel", view.texel)


def shadow_ends(points: Float32Array, lighting: Lighting, lowest: float, longest: float) -> Float32Array:
    """Return points around the end of a body's shadow. The convex hull of these points and the body contains
    all points that the body may shade.

    Args:
        points: (3, N) points of the body.
        lighting: Light.
        lowest: Height of the lowest floor.
        longest: Largest length of a shadow, metres.

    Returns:
        Points (3, M).
    """
    direction = lighting.direction
    z = direction[2]
    length = np.full(points.shape[1], longest)
    if z > _LOW:
        length = np.minimum(np.maximum(points[2] - lowest, 0) / z, longest)
    ends = (points - direction[:, None] * length).astype(np.float32)
    blur = 0.03 + float(length.max()) * penumbra_slope(lighting)
    if z > _LOW and length.max() < longest:
        # all ends have the same height, so their convex hull (some dozens of points) is enough
        hull = cv2.convexHull(np.ascontiguousarray(ends[:2].T)).reshape(-1, 2).T
        ends = np.concatenate([hull, np.full((1, hull.shape[1]), ends[2].min(), np.float32)])
    low, high = ends.min(axis=1, keepdims=True), ends.max(axis=1, keepdims=True)
    away = np.sign(ends - (low + high) / 2) * np.float32(blur)
    return np.asarray(ends + away, dtype=np.float32)


def penumbra_slope(lighting: Lighting) -> float:
    """Half width of the penumbra (soft border of a shadow) per metre of distance from the occluder."""
    return float(np.tan(np.radians(lighting.sun_size_deg) / 2))


#: A rectangle that a lens may bend is divided into this number of cells along each side.
_LENS_CELLS = 32


class ContactShadowPass:
    """Draws contact shadows over the colours of the static scene."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._program = link(ctx, "contact_shadow.vert", "contact_shadow.frag")
        self._whole, self._cells = (
            ctx.vertex_array(self._program, [(ctx.buffer(unit_square(cells)), "2f", "corner")])
            for cells in (1, _LENS_CELLS)
        )
        self._texture = ctx.texture((CELLS, CELLS), 1, alignment=1)

    def draw(self, shadows: Sequence[ContactShadow], camera: Camera) -> None:
        """Draw shadows into the target in use. Its alpha becomes the share of light that the shadows let
        through."""
        if not shadows:
            return
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        self._ctx.blend_func = (  # type: ignore[assignment]  # four factors are allowed
            moderngl.SRC_ALPHA,
            moderngl.ONE_MINUS_SRC_ALPHA,
            moderngl.ZERO,
            moderngl.ONE_MINUS_SRC_ALPHA,
        )
        use_camera(self._ctx, self._program, camera)
        rectangle = self._cells if camera.distorted else self._whole
        for shadow in shadows:
            self._texture.write(shadow.darkness.tobytes())
            self._texture.use(0)
            set_uniform(self._program, "rectangle", (*shadow.corner, shadow.side, shadow.side))
            rectangle.render(moderngl.TRIANGLES)
