"""The default renderer: OpenGL 3.3 through EGL, without a display; a GPU is used where there is one.

The static scene is drawn once per camera and kept. Each frame redraws only the rectangle that the bodies can
touch, in one pass, with one sample at each pixel's centre: colour, depth, and the triangle's number, which
all labels follow from. The outlines of the bodies are anti-aliased afterwards (outline.py). Triangles that
cannot show are not sent at all.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.ambient_occlusion import UNIT, AmbientOcclusion
from humansim_ros.render.body_buffers import BodyBuffers, ProjectedPoints, contour, straight_angle, touched
from humansim_ros.render.channels import (
    ALL_CHANNELS,
    CHANNEL_TABLE,
    CHANNELS,
    AdjacentName,
    View,
    comparing_with,
)
from humansim_ros.render.contact_shadow import CELLS, ContactShadow
from humansim_ros.render.context import create_context, current
from humansim_ros.render.edge_antialiasing import edge_crossings
from humansim_ros.render.lens_tessellation import TOLERANCE, VISIBLE, LensView
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.memory import keep_image_blocks
from humansim_ros.render.pixel_geometry import ray_grid
from humansim_ros.render.posed_mesh import Topology
from humansim_ros.render.programs import link, unit_square, use_camera
from humansim_ros.render.rendered_frame import Passes, RenderedFrame, TriangleIds
from humansim_ros.render.renderer import (
    AdjacentFrame,
    Backdrop,
    Body,
    check_adjacent_frames,
    check_request,
)
from humansim_ros.render.static_scene import StaticDraw, StaticScene
from humansim_ros.render.sun_shadows import SunShadows
from humansim_ros.render.target import Rectangle, RenderTarget, ShadowTarget, StaticLayer
from humansim_ros.render.uniforms import set_uniform

#: The static scene is drawn this many times finer and averaged: it is drawn once, so quality costs nothing.
_STATIC_SUPERSAMPLING = 4
_MAX_STATIC_SIDE = 8192
#: For a camera that is elsewhere in the next frame it is drawn with some samples a pixel, which takes half
#: the time; or finer, if before a photograph: what shows it has to be known.
_SAMPLES, _PASSING_SUPERSAMPLING = 4, 2
#: Pictures, and their bytes, that are kept: with flow a frame is seen as itself and as two others' neighbour.
_MAX_KEPT, _MAX_BYTES = 48, 256 << 20
#: Pixels of a picture along a side of one of what is around: of a picture that stays, and of one that passes.
_COARSER = {False: 2, True: 4}
#: Pixels that it has along each side if the picture has.
_LEAST_AROUND = 120
#: Cameras whose static scene is kept.
_MAX_LAYERS = 32
#: Pieces along a side of a shadow that a lens may bend.
_SHADOW_GRID = 32
#: How what is not opaque blends with what is there, whose alpha stays.
_OVER = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ZERO, moderngl.ONE)


class GLRenderer:
    """Renders bodies in a static scene of meshes (world coordinates), with an OpenGL context of its own.

    ``standing``: those of the bodies that never move. They are drawn with the static scene, once per camera,
    and so are their labels. Use it from one thread. Raises RenderError, naming the system packages, where no
    OpenGL can be had.
    """

    channels = ALL_CHANNELS

    def __init__(
        self,
        static: Sequence[Mesh] = (),
        lighting: Lighting | None = None,
        device: int | None = None,
        standing: Sequence[Body] = (),
    ) -> None:
        keep_image_blocks()
        self._lighting = lighting or Lighting()
        self._ctx = create_context(device)
        self._ctx.front_face = (
            "cw"  # the image's rows run down where OpenGL's run up: everything is mirrored once
        )
        check_request(standing, ())
        self._standing = tuple(standing)
        self._unlabelled = self._still = StaticScene(self._ctx, tuple(static))
        if standing:
            things = (replace(body.mesh, vertices=body.vertices.astype(float)) for body in standing)
            self._still = StaticScene(self._ctx, (*static, *things))
        self._topologies: dict[int, Topology] = {}
        self._surfaces: dict[tuple[int, int], BodyBuffers] = {}
        self._targets: dict[tuple[int, int], RenderTarget] = {}
        self._sampled: dict[tuple[int, int], RenderTarget] = {}
        self._layers: dict[bytes, StaticLayer] = {}
        self._passing: StaticLayer | None = None
        self._drawn: dict[tuple[object, ...], RenderedFrame] = {}
        light = self._lighting
        looks = [
            name
            for name, asked in (
                ("SHADELESS", light.mode == "shadeless"),
                ("FILMIC", light.tone_mapping == "filmic"),
            )
            if asked
        ]
        soft = light.shadow == "soft"
        people = ["PEOPLE"] if light.materials and light.mode == "lit" else []
        still, moving = (["STILL"], ["STILL", "MOVING"]) if soft else ([], [])
        self._lit = link(self._ctx, "lit.vert", "lit.frag", (*looks, *moving, *people))
        occluded = light.ambient_occlusion and light.mode == "lit" and self._still.box is not None
        looks += ["STANDS", *(["AROUND"] if occluded else []), *self._still.switches]
        self._lit_still = self._solid_and_over((*looks, *still))
        self._truth = link(self._ctx, "truth.vert", "truth.frag")
        self._shadow = link(self._ctx, "shadow.vert", "shadow.frag")
        self._shadow_quad, self._shadow_grid = (
            self._ctx.vertex_array(self._shadow, [(self._ctx.buffer(unit_square(cells)), "2f", "corner")])
            for cells in (1, _SHADOW_GRID)
        )
        self._shadow_texture = self._ctx.texture((CELLS, CELLS), 1, alignment=1)
        for program in (self._lit, *self._lit_still):
            self._shine(program)
        self._sunless = self._solid_and_over(looks) if soft else self._lit_still
        if soft:
            for program in self._sunless:
                self._shine(program, sun=False)
        self._surroundings = AmbientOcclusion(self._ctx, self._still) if occluded else None
        self._sunlight = None
        if soft:
            self._sunlight = SunShadows(self._ctx, self._still, light, (self._lit, *self._lit_still))

    def _solid_and_over(self, switches: Sequence[str]) -> tuple[moderngl.Program, ...]:
        """A program for what is solid of the still scene, and one for what lets through what is behind."""
        over = [(*switches, "OVER")] if self._still.blends else []
        return tuple(link(self._ctx, "lit.vert", "lit.frag", names) for names in (switches, *over))

    def _shine(self, program: moderngl.Program, sun: bool = True) -> None:
        """Light what a program draws, with the sun or without."""
        light = self._lighting
        set_uniform(program, "sun", tuple(light.direction))
        set_uniform(program, "sun_color", light.brightness(light.sun_color) if sun else (0.0, 0.0, 0.0))
        set_uniform(program, "sky_color", light.brightness(light.sky_color))
        set_uniform(program, "ground_color", light.brightness(light.ground_color))
        set_uniform(program, "brightness", light.brightness((1.0, 1.0, 1.0))[0])
        set_uniform(program, "sharpest", np.radians(light.sun_size_deg) / 4)

    @property
    def device(self) -> str:
        """What draws, such as ``llvmpipe (LLVM 15.0.6, 256 bits)``."""
        with self._ctx:
            return str(self._ctx.info["GL_RENDERER"])

    def close(self) -> None:
        """Free the OpenGL context and what is in it."""
        self._ctx.release()

    def render(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        channels: Collection[str] = CHANNELS,
        moving_camera: bool = False,
        next_frame: AdjacentFrame | None = None,
        previous_frame: AdjacentFrame | None = None,
        backdrop: Backdrop | None = None,
    ) -> View:
        """See :class:`humansim_ros.render.Renderer`.

        What was worked out of a body for one camera serves the next, as long as it is the same Body object.
        """
        moments: dict[AdjacentName, AdjacentFrame | None] = {
            "next_frame": next_frame,
            "previous_frame": previous_frame,
        }
        check_request(bodies, channels)
        check_adjacent_frames(bodies, channels, moments)
        bodies = self._that_move(bodies)
        asked = Passes.by(channels)
        with current(self._ctx):
            drawn = self._drawn_of(bodies, camera, asked, moving_camera, backdrop)
            others: dict[str, tuple[AdjacentFrame, RenderedFrame | None]] = {}
            for which, moment in moments.items():
                flows = comparing_with(which, channels)
                if moment is None or not flows:
                    continue
                moment = replace(moment, bodies=self._that_move(moment.bodies))
                other = None
                if any(CHANNEL_TABLE[channel].occlusion for channel in flows):
                    # as this one: it will be asked for next
                    other = self._drawn_of(moment.bodies, moment.camera, asked, moving_camera, backdrop)
                others[which] = moment, other
            return drawn.view(channels, others)

    def _that_move(self, bodies: Sequence[Body]) -> Sequence[Body]:
        """Bodies without those that stand in the static scene."""
        if not self._standing:
            return bodies
        still = {id(body) for body in self._standing}
        return [body for body in bodies if id(body) not in still]

    def _drawn_of(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        asked: Passes,
        moving_camera: bool,
        backdrop: Backdrop | None,
    ) -> RenderedFrame:
        """The picture of a frame, drawn now unless it has been."""
        key = _frame_key(bodies, camera, moving_camera, backdrop)
        drawn = self._drawn.pop(key, None)
        if drawn is None or not drawn.asked.covers(asked):
            layer = self._layer(camera, moving_camera, backdrop)
            drawn = self._draw(bodies, camera, asked, layer)
            if self._standing:
                drawn = replace(drawn, standing=self._standing_before(camera, asked, moving_camera, layer))
        self._drawn[key] = drawn  # with its bodies, so that their ids stay their own
        while len(self._drawn) > _MAX_KEPT or (
            len(self._drawn) > 3 and sum(kept.nbytes for kept in self._drawn.values()) > _MAX_BYTES
        ):
            del self._drawn[next(iter(self._drawn))]
        return drawn

    def _draw(
        self, bodies: Sequence[Body], camera: Camera, asked: Passes, layer: StaticLayer
    ) -> RenderedFrame:
        surfaces = [self._surface(body) for body in bodies]
        shadows: list[ContactShadow] = []
        if asked.lit and self._contact:
            shadows = [surface.shadow for surface in surfaces if surface.near_floor]
        around = [shadow.corners.T for shadow in shadows]
        sunlight = self._sunlight if asked.lit else None
        if sunlight is not None and surfaces:
            around += sunlight.shine_on(surfaces)
        fallen = [ProjectedPoints(surface.posed.points, camera) for surface in surfaces]
        rectangle = touched([*fallen, *(ProjectedPoints(points, camera) for points in around)], camera)
        target = self._target(camera.size)
        target.start(rectangle, layer)
        seen, outline = TriangleIds(), None
        if not rectangle.empty:
            if shadows:
                self._draw_shadows(shadows, camera)
            if sunlight is not None:
                sunlight.shade(layer, target, camera)
            target.use(asked.lit)
            facing = [surface.posed.facing(camera.center) for surface in surfaces]
            seen = self._draw_bodies(surfaces, fallen, facing, camera, rectangle, asked.lit)
            if asked.outlined:
                angle = straight_angle(camera, rectangle)
                each = zip(surfaces, fallen, facing, strict=True)
                edges = [contour(s.posed, f, front, angle) for s, f, front in each]
                outline = edge_crossings([part for body in edges for part in body], camera.size)
        labels, depth = (target.read(name, asked.lit) for name in ("label", "depth"))
        rgba = target.read("rgba", True) if asked.lit else None
        alone = None
        if asked.alone:
            labelled = [(s, f) for s, f in zip(surfaces, fallen, strict=True) if s.body.instance]
            alone = {s.body.instance: self._alone(s, f, camera) for s, f in labelled}
        return RenderedFrame(
            asked, tuple(bodies), camera, layer, rectangle, seen, labels, depth, rgba, outline, alone
        )

    def _standing_before(
        self, camera: Camera, asked: Passes, moving_camera: bool, layer: StaticLayer
    ) -> RenderedFrame:
        """What stands in the static scene that a camera sees, with labels: drawn once."""
        asked = Passes(lit=False, outlined=True, alone=asked.alone)
        if layer.standing is None or not layer.standing.asked.covers(asked):
            target = self._target(camera.size)
            with self._unlabelled.seen_by(camera, VISIBLE if moving_camera else TOLERANCE) as still:
                self._draw_still(target, still, self._true_still, camera)
            drawn = self._draw(self._standing, camera, asked, StaticLayer(target, None, None))
            layer.standing = replace(drawn, layer=layer)
        return layer.standing

    def _alone(self, surface: BodyBuffers, fallen: ProjectedPoints, camera: Camera) -> NDArray[np.bool_]:
        """(H, W) where a body would be seen if nothing were before it."""
        mask = np.zeros(camera.size[::-1], bool)
        rectangle = touched([fallen], camera)
        if not rectangle.empty:
            target = self._target(camera.size)
            target.start(rectangle)
            target.use(False)
            facing = surface.posed.facing(camera.center)
            self._draw_bodies([surface], [fallen], [facing], camera, rectangle, False)
            mask[rectangle.slices] = target.read("label", False) > 0
        return mask

    def _draw_bodies(
        self,
        surfaces: Sequence[BodyBuffers],
        fallen: Sequence[ProjectedPoints],
        facing: Sequence[NDArray[np.bool_]],
        camera: Camera,
        rectangle: Rectangle,
        lit: bool,
    ) -> TriangleIds:
        """Draw what can be seen, every triangle with a number of its own, counted on from body to body."""
        program = self._lit if lit else self._truth
        use_camera(self._ctx, program, camera)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        seen = TriangleIds()
        straight = straight_angle(camera, rectangle)
        for surface, places, front in zip(surfaces, fallen, facing, strict=True):
            set_uniform(program, "first_label", seen.count)
            set_uniform(program, "dressed", float(surface.dressed))
            refined = surface.refined(camera, straight) if camera.distorted else None
            if refined is not None:
                surface.draw_refined(program, refined)
                seen.add(surface.body, refined.parents)
                continue
            # from outside a closed surface its back faces never show; a camera that is near may be inside
            culled = surface.topology.mesh.closed and not rectangle.near
            shown = np.flatnonzero(front) if culled else np.arange(len(front))
            if not rectangle.near:
                shown = shown[places.covering([c.take(shown) for c in surface.topology.corners])]
            surface.draw(lit, shown)
            seen.add(surface.body, shown)
        return seen

    def _draw_shadows(self, shadows: Sequence[ContactShadow], camera: Camera) -> None:
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        # alpha keeps how much light is left
        self._ctx.blend_func = (  # type: ignore[assignment]  # it may be four
            moderngl.SRC_ALPHA,
            moderngl.ONE_MINUS_SRC_ALPHA,
            moderngl.ZERO,
            moderngl.ONE_MINUS_SRC_ALPHA,
        )
        use_camera(self._ctx, self._shadow, camera)
        square = self._shadow_grid if camera.distorted else self._shadow_quad
        for shadow in shadows:
            self._shadow_texture.write(shadow.darkness.tobytes())
            self._shadow_texture.use(0)
            set_uniform(self._shadow, "place", (*shadow.corner, shadow.side, shadow.side))
            square.render(moderngl.TRIANGLES)

    def _surface(self, body: Body) -> BodyBuffers:
        """The body on the device, standing as it should. Two bodies may share a mesh, but not a surface."""
        key = id(body.mesh), body.instance
        if key in self._surfaces:
            self._surfaces[key].stand(body)
        else:
            # kept with its mesh, so that the id stays its own
            topology = self._topologies.setdefault(id(body.mesh), Topology(body.mesh))
            self._surfaces[key] = BodyBuffers(self._ctx, topology, body, self._lit, self._truth)
        return self._surfaces[key]

    def _target(self, size: tuple[int, int]) -> RenderTarget:
        if size not in self._targets:
            self._targets[size] = RenderTarget(self._ctx, size)
        return self._targets[size]

    @cached_property
    def _contact(self) -> bool:
        """Whether bodies leave shadows under them: there is a floor that these can lie on."""
        light = self._lighting
        return light.shadow == "contact" and (self._still.has_floor or light.shadow_catcher)

    def _layer(self, camera: Camera, moving_camera: bool, backdrop: Backdrop | None) -> StaticLayer:
        if moving_camera:
            if self._passing is not None:
                self._passing.release()
            self._passing = self._draw_static(camera, True, backdrop)
            return self._passing
        key = _camera_key(camera) + str(id(backdrop)).encode()
        if key not in self._layers:
            if len(self._layers) >= _MAX_LAYERS:
                self._layers.pop(next(iter(self._layers))).release()
            self._layers[key] = self._draw_static(camera, False, backdrop)
        return self._layers[key]

    def _draw_static(self, camera: Camera, moving_camera: bool, backdrop: Backdrop | None) -> StaticLayer:
        behind = None if backdrop is None else backdrop.picture(camera)
        shaded, left = behind, None
        if self._sunlight is not None and self._lighting.shadow_catcher:
            if behind is None:
                behind = np.full((*camera.size[::-1], 3), self._lighting.background, np.uint8)
            left = self._sunlight.on_ground(camera)
            behind, shaded = (self._on_ground(behind, camera, sun) for sun in (left, np.zeros_like(left)))
        target = RenderTarget(self._ctx, camera.size)
        # the same window, only finer: clip coordinates do not know how many pixels there are
        fine = self._fine(camera.size, moving_camera, behind is not None)
        with (
            self._still.seen_by(camera, VISIBLE if moving_camera else TOLERANCE) as still,
            ExitStack() as stack,
        ):

            def look(
                programs: Sequence[moderngl.Program], behind: NDArray[np.uint8] | None
            ) -> NDArray[np.uint8]:
                colour = self._lighting.background if behind is None else (0, 0, 0)
                self._draw_still(fine, still, programs[0], camera, colour)
                if len(programs) == 1:
                    return _completed(self._averaged(fine, target), fine, camera, behind)
                if behind is not None:
                    fine.fill(behind)
                fine.use_colour()
                self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
                self._ctx.blend_func = _OVER  # type: ignore[assignment]  # it may be four
                use_camera(self._ctx, programs[1], camera)
                still.draw_over(programs[1], camera.center)
                return _completed(self._averaged(fine, target), fine, camera, None)

            if self._surroundings is not None:
                coarser = min(_COARSER[moving_camera], max(1, min(camera.size) // _LEAST_AROUND))
                seen = self._surroundings.seen_by(camera, still, coarser)
                stack.callback(seen.release)
                seen.use(UNIT)
                for program in (*self._lit_still, *self._sunless):
                    set_uniform(program, "seen", UNIT)
                    set_uniform(program, "coarser", (seen.width / fine.size[0], seen.height / fine.size[1]))
            sunny = look(self._lit_still, behind)
            sunless = None if self._sunlight is None else look(self._sunless, shaded)
            self._draw_still(target, still, self._true_still, camera)
        if self._sunlight is None:
            sunny[..., 3] = 255
        if left is not None:
            empty = target.read("depth", lit=True) == 0
            sunny[..., 3][empty] = np.rint(255 * left[empty]).astype(np.uint8)
        target.take(sunny)
        shades = None if sunless is None else ShadowTarget(self._ctx, camera, sunless[..., :3])
        return StaticLayer(target, backdrop, shades)

    def _on_ground(
        self, behind: NDArray[np.uint8], camera: Camera, left: NDArray[np.floating]
    ) -> NDArray[np.uint8]:
        """A picture (H, W, 3) of sunny ground z = 0 where so much of the sun (H, W) is left."""
        down = (ray_grid(camera) @ camera.R)[..., 2] * camera.center[2] < 0
        share = np.where(down[..., None], np.sqrt(self._lighting.on_ground(left)), 1.0)
        return np.rint(behind * share).astype(np.uint8)

    @property
    def _true_still(self) -> moderngl.Program:
        """What draws the truth of a still scene: what is cut out of surfaces is not in it either."""
        return self._lit_still[0] if self._still.switches else self._truth

    def _draw_still(
        self,
        into: RenderTarget,
        still: StaticDraw,
        program: moderngl.Program,
        camera: Camera,
        colour: Sequence[int] = (0, 0, 0),
    ) -> None:
        """Draw what is solid of a still scene, before a colour."""
        into.clear(colour)
        into.use(program is not self._truth)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        use_camera(self._ctx, program, camera)
        # a pixel's samples see one texel: one as fine as if each saw its own
        set_uniform(program, "blur", -0.5 * np.log2(max(into.samples, 1)))
        still.draw(program)

    def _fine(self, size: tuple[int, int], moving_camera: bool, before_picture: bool) -> RenderTarget:
        """Where a still scene is drawn: finer than the picture, or what passes with some samples a pixel."""
        if moving_camera and not before_picture:
            if size not in self._sampled:
                self._sampled[size] = RenderTarget(self._ctx, size, _SAMPLES)
            return self._sampled[size]
        wished = _PASSING_SUPERSAMPLING if moving_camera else _STATIC_SUPERSAMPLING
        factor = max(1, min(wished, _MAX_STATIC_SIDE // max(size)))
        return self._target((size[0] * factor, size[1] * factor))

    def _averaged(self, fine: RenderTarget, target: RenderTarget) -> NDArray[np.uint8]:
        """(H, W, 4) of a picture that is drawn finer. ``target``: one of the size that it is to have."""
        if fine.samples:
            target.average(fine)
            return target.read("rgba", lit=True).copy()
        fine_picture = fine.read("rgba", lit=True)
        return np.asarray(cv2.resize(fine_picture, target.size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _completed(
    rgba: NDArray[np.uint8], fine: RenderTarget, camera: Camera, behind: NDArray[np.uint8] | None
) -> NDArray[np.uint8]:
    """A picture (H, W, 4) before what is behind it, dark where the lens is."""
    if behind is not None:
        empty = np.where(fine.read("depth", lit=True) > 0, np.uint8(0), np.uint8(255))
        share = cv2.resize(empty, camera.size, interpolation=cv2.INTER_AREA)[..., None] / 255
        rgba[..., :3] = np.rint(rgba[..., :3] + share * behind)
    if camera.distorted and LensView(camera).partly_dark:
        rgba[..., :3][~_lit_pixels(camera)] = 0
    return rgba


def _camera_key(camera: Camera) -> bytes:
    """The same for cameras that see the same."""
    numbers = (np.array(camera.size), camera.K, camera.R, camera.t, np.array(camera.distortion))
    return b"".join((*(n.tobytes() for n in numbers), str(camera.model).encode()))


def _frame_key(
    bodies: Sequence[Body], camera: Camera, moving_camera: bool, backdrop: Backdrop | None
) -> tuple[object, ...]:
    """The same for what is the same before the same camera."""
    return tuple(id(body) for body in bodies), _camera_key(camera), moving_camera, id(backdrop)


def _lit_pixels(camera: Camera) -> NDArray[np.bool_]:
    """(H, W) which pixels the lens does not leave dark."""
    return np.asarray(np.isfinite(ray_grid(camera)[..., 0]))
