"""Soft shadows of the sun: what is nearest to it, drawn as it sees the scene, and looked up by what is lit.

The still scene is looked at once. What moves is looked at once a frame, for all cameras; it shades the
pictures that are kept of the still scene where it touches them (shaders/cast.frag), and itself.
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

#: Texels along a side of the maps of what is still and of what moves.
STILL_SIDE, MOVING_SIDE = 2048, 1024
#: Metres around what casts shadows that a map goes on, for their blurred rims.
_MARGIN = 0.1
#: Sine of the height of the sun below which the ends of shadows are not looked for on the floor.
_LOW = 0.05
#: Texture units: 0 is what surfaces look like.
_UNITS = {"still": (1, 2), "moving": (3, 4)}


@dataclass(frozen=True)
class ShadowView:
    """What a map of the sun covers. ``place``: (4, 4) from the world to x and y from 0 to 1, z in metres away
    from the sun. ``size``: (3,) metres. ``texel``: metres.
    """

    place: Array
    size: Array
    texel: float

    @classmethod
    def of(cls, points: NDArray[np.floating], direction: Array, side: int) -> ShadowView:
        """A view of points (3, N) against the ``direction`` (3,) to the sun, in a map of ``side`` texels."""
        helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
        x = np.cross(helper, direction)
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(direction, x), -direction])
        seen = axes @ points
        low, high = seen.min(axis=1) - _MARGIN, seen.max(axis=1) + _MARGIN
        size = high - low
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = axes, -low
        place[:2] /= size[:2, None]
        return cls(place, size, float(size[:2].max() / side))

    @property
    def clip(self) -> Array:
        """(4, 4) from the world to OpenGL's clip coordinates."""
        scale = np.array([2, 2, 2 / self.size[2]])
        to_clip = np.diag([*scale, 1.0])
        to_clip[:3, 3] = -1
        return to_clip @ self.place


class ShadowMap:
    """Depths as the sun sees them, on the device. ``name``: what its uniforms begin with."""

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
        """Look at what ``draw`` draws, which lies within points (3, N)."""
        self._view = ShadowView.of(points, direction, self._side)
        self._framebuffer.use()
        self._framebuffer.clear(depth=1.0)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        set_uniform(program, "clip", columns(self._view.clip))
        draw()

    def use(self, program: moderngl.Program) -> None:
        """Let a program look it up."""
        if f"{self._name}_shadows" not in program:
            return
        for sampler, unit, kind in zip(
            self._samplers, _UNITS[self._name], ("shadows", "depths"), strict=True
        ):
            sampler.use(unit)
            set_uniform(program, f"{self._name}_{kind}", unit)
        view = self._view
        set_uniform(program, f"{self._name}_map.place", columns(view.place))
        set_uniform(program, f"{self._name}_map.size", tuple(view.size.tolist()))
        set_uniform(program, f"{self._name}_map.texel", view.texel)


def shadow_ends(points: Float32Array, lighting: Lighting, lowest: float, farthest: float) -> Float32Array:
    """(3, M) around where the shadow of a body of points (3, N) ends, on a floor at the height ``lowest`` and
    at most ``farthest`` metres away: with the points themselves it encloses all that the body can shade.
    """
    direction = lighting.direction
    z = direction[2]
    fall = np.full(points.shape[1], farthest)
    if z > _LOW:
        fall = np.minimum(np.maximum(points[2] - lowest, 0) / z, farthest)
    there = (points - direction[:, None] * fall).astype(np.float32)
    blur = 0.03 + float(fall.max()) * spread(lighting)
    if z > _LOW and fall.max() < farthest:
        # all on one level: their convex hull says as much, in some dozens of points
        hull = cv2.convexHull(np.ascontiguousarray(there[:2].T)).reshape(-1, 2).T
        there = np.concatenate([hull, np.full((1, hull.shape[1]), there[2].min(), np.float32)])
    low, high = there.min(axis=1, keepdims=True), there.max(axis=1, keepdims=True)
    away = np.sign(there - (low + high) / 2) * np.float32(blur)
    return np.asarray(there + away, dtype=np.float32)


def spread(lighting: Lighting) -> float:
    """Metres that the rim of a shadow is wider on either side for each metre from what casts it."""
    return float(np.tan(np.radians(lighting.sun_size_deg) / 2))


def encloses(points: Sequence[Float32Array]) -> Float32Array:
    """(3, 8) corners of the box around clouds of points (3, N)."""
    low = np.min([cloud.min(axis=1) for cloud in points], axis=0)
    high = np.max([cloud.max(axis=1) for cloud in points], axis=0)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=0)
    return np.asarray(corners.reshape(3, 8), dtype=np.float32)
