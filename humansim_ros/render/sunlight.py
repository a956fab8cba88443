"""The soft shadows of a scene, drawn once a frame for all cameras."""

from __future__ import annotations

from collections.abc import Sequence

import moderngl
import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.render.light import Lighting
from humansim_ros.render.posed import Floats
from humansim_ros.render.programs import shader, unit_square
from humansim_ros.render.renderer import Body
from humansim_ros.render.still import StillScene
from humansim_ros.render.sun import MOVING_SIDE, STILL_SIDE, SunMap, encloses, shadow_ends, spread
from humansim_ros.render.surface import Surface
from humansim_ros.render.target import StaticLayer, Target
from humansim_ros.render.uniforms import columns, set_uniform


class Sunlight:
    """The soft shadows of a renderer's scene."""

    def __init__(
        self, ctx: moderngl.Context, still: StillScene, lighting: Lighting, lit: Sequence[moderngl.Program]
    ) -> None:
        self._ctx, self._lighting, self._box = ctx, lighting, still.box
        self._depths = ctx.program(vertex_shader=shader(["sun.vert"]), fragment_shader=shader(["sun.frag"]))
        self._cast = ctx.program(
            vertex_shader=shader(["whole.vert"]), fragment_shader=shader(["sunshine.glsl", "cast.frag"])
        )
        self._whole = ctx.vertex_array(self._cast, [(ctx.buffer(unit_square(1)), "2f", "corner")])
        for unit, name in enumerate(("sunny", "sunless", "depths", "rays"), 5):
            set_uniform(self._cast, name, unit)
        self._programs = (*lit, self._cast)
        for program in self._programs:
            set_uniform(program, "spread", spread(lighting))
        self._still, self._moving = SunMap(ctx, "still", STILL_SIDE), SunMap(ctx, "moving", MOVING_SIDE)
        self._bodies: list[Body] = []
        self._ends: list[Floats] = []
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

    def shine_on(self, surfaces: Sequence[Surface]) -> list[Floats]:
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
        if self._box is not None:
            lowest, farthest = float(self._box[2].min()), float(np.linalg.norm(np.ptp(self._box, axis=1)))
            self._ends = [shadow_ends(points, self._lighting, lowest, farthest) for points in clouds]
        return self._ends

    def shade(self, layer: StaticLayer, target: Target, camera: Camera) -> None:
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
