"""Contact shadows: a dark patch on the floor under each body. They are a visual cue, no simulation of
light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.render.device.programs import link, set_uniform, unit_square, use_camera
from humansim_ros.types import Array, Float32Array

#: Cells along a side of a shadow.
CELLS = 64
#: Height at which the shadow is drawn, metres: above a rug.
_HEIGHT = 0.01
#: Metres around the body that the shadow covers.
_MARGIN = 0.35
#: Height in metres at which the shadow of a surface has faded to 1/e.
_FADE = 0.22
#: A surface higher than this has no shadow, metres. The shadow would have a strength of 1 % there.
REACH = 1.0
_STRENGTH = 0.62


@dataclass(frozen=True)
class ContactShadow:
    """A shadow on the floor.

    ``corner``: lowest x and y, metres. ``side``: length of a side, metres. ``darkness``: (64, 64) uint8, 255
    is black, rows along y.
    """

    corner: tuple[float, float]
    side: float
    darkness: NDArray[np.uint8]

    @property
    def corners(self) -> NDArray[np.float32]:
        """(4, 3) corners of the part of the square that is dark."""
        (left, top), (right, bottom) = self._dark
        return np.array([(x, y, _HEIGHT) for x in (left, right) for y in (top, bottom)], dtype=np.float32)

    @cached_property
    def _dark(self) -> tuple[Array, Array]:
        """Low and high corner (x, y) of the shadow in ``map``, metres."""
        columns, rows = (np.flatnonzero(self.darkness.any(axis=axis)) for axis in (0, 1))
        low = np.array([each.min(initial=CELLS) for each in (columns, rows)])
        high = np.array([each.max(initial=0) for each in (columns, rows)])
        # each cell is interpolated up to the centers of its neighbours
        cells = np.clip([low - 0.5, np.maximum(high, low) + 1.5], 0, CELLS)
        corners = np.array(self.corner) + cells * (self.side / CELLS)
        return corners[0], corners[1]


@dataclass(frozen=True, eq=False)
class ShadowCaster:
    """A body that casts a contact shadow. The shadow is computed when it is needed.

    ``points``: (3, V) points on its surface. ``areas``: (V,) surface area of each, square metres.
    """

    points: Float32Array
    areas: Float32Array

    @cached_property
    def _square(self) -> tuple[Float32Array, float]:
        """Lowest x and y of a square around the shadow, and the length of its sides, metres."""
        low, high = self.points[:2].min(axis=1) - _MARGIN, self.points[:2].max(axis=1) + _MARGIN
        return low, float((high - low).max())

    @property
    def corners(self) -> Float32Array:
        """(4, 3) corners of the square, row by row along y."""
        (x, y), side = self._square
        places = [(x + i * side, y + j * side, _HEIGHT) for j in (0, 1) for i in (0, 1)]
        return np.array(places, dtype=np.float32)

    @cached_property
    def shadow(self) -> ContactShadow:
        """The shadow on the floor z = 0: the body seen from below, faded with height and blurred."""
        low, side = self._square
        cell = side / CELLS
        below = np.flatnonzero(self.points[2] < REACH)
        x, y = ((self.points[:2, below] - low[:, None]) / np.float32(cell)).astype(np.intp)
        amount = self.areas[below] * np.exp(-np.maximum(self.points[2, below], 0) / np.float32(_FADE))
        grid = np.bincount(y * CELLS + x, amount, CELLS * CELLS).reshape(CELLS, CELLS)
        # a closed surface covers each cell at least twice
        coverage = np.minimum(grid / (2 * cell * cell), 1.0).astype(np.float32)
        near = cv2.GaussianBlur(coverage, (0, 0), 0.03 / cell)
        wide = cv2.GaussianBlur(coverage, (0, 0), 0.11 / cell)
        darkness = _STRENGTH * np.clip(0.55 * near + 0.9 * wide, 0, 1)
        return ContactShadow((float(low[0]), float(low[1])), side, np.rint(255 * darkness).astype(np.uint8))


#: Cells along a side of a rectangle that a lens may bend.
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
