"""Shadow maps: depths of the scene from the direction of the sun.

The map of the static scene is rendered once. That of bodies is rendered once per frame, for all cameras: it
shades the bodies, and the cached images of the static scene (shaders/apply_shadows.frag).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.render.lighting import Lighting
from humansim_ros.render.uniforms import columns, set_uniform
from humansim_ros.types import Array, Float32Array

#: Texels along a side of the maps of the static scene and of bodies.
STATIC_SIDE, MOVING_SIDE = 2048, 1024
#: Metres that a map covers around the occluders, for penumbras.
_MARGIN = 0.1
#: Sine of the sun's elevation below which shadows do not end on the floor.
_LOW = 0.05
#: Texture units of the samplers; unit 0 has the texture of the surface.
_UNITS = {"static": (1, 2), "moving": (3, 4)}


@dataclass(frozen=True)
class ShadowView:
    """Volume of a shadow map. ``from_world``: (4, 4) from ``map`` to x and y from 0 to 1, z in metres away
    from the sun. ``size``: (3,) metres. ``texel``: metres.
    """

    from_world: Array
    size: Array
    texel: float

    @classmethod
    def of(cls, points: NDArray[np.floating], direction: Array, side: int) -> ShadowView:
        """View of points (3, N) with ``direction`` (3,) to the sun, in a map of ``side`` texels."""
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
    """A shadow map on the device. ``name``: prefix of its uniforms."""

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
            points: (3, N) points whose bounding box contains all that ``draw`` draws.
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
    """Return points around the end of a body's shadow. With the body they enclose all that it may shade.

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
        # all ends are on one level: their convex hull, of some dozens of points, is enough
        hull = cv2.convexHull(np.ascontiguousarray(ends[:2].T)).reshape(-1, 2).T
        ends = np.concatenate([hull, np.full((1, hull.shape[1]), ends[2].min(), np.float32)])
    low, high = ends.min(axis=1, keepdims=True), ends.max(axis=1, keepdims=True)
    away = np.sign(ends - (low + high) / 2) * np.float32(blur)
    return np.asarray(ends + away, dtype=np.float32)


def penumbra_slope(lighting: Lighting) -> float:
    """Half width of the penumbra per metre of distance from the occluder."""
    return float(np.tan(np.radians(lighting.sun_size_deg) / 2))


def bounding_box(points: Sequence[Float32Array]) -> Float32Array:
    """(3, 8) corners of the box around clouds of points (3, N)."""
    low = np.min([cloud.min(axis=1) for cloud in points], axis=0)
    high = np.max([cloud.max(axis=1) for cloud in points], axis=0)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=0)
    return np.asarray(corners.reshape(3, 8), dtype=np.float32)
