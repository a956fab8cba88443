"""Contact shadows on the device: a dark rectangle on the floor under each body."""

from __future__ import annotations

from collections.abc import Sequence

import moderngl

from humansim_ros.camera import Camera
from humansim_ros.render.contact_shadow import CELLS, ContactShadow
from humansim_ros.render.programs import link, unit_square, use_camera
from humansim_ros.render.uniforms import set_uniform

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
        """Draw shadows into the target in use. Its alpha becomes the share of light that they leave."""
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
