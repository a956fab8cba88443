"""The default renderer: OpenGL 3.3 through EGL, without a display, on a GPU if there is one.

The static scene is rendered once per camera and cached. Each frame renders only the rectangle that bodies may
touch, in one pass with one sample at each pixel center: colour, depth, and the triangle id, from which all
labels follow. Outlines of bodies are anti-aliased afterwards (edge_antialiasing.py). Triangles that cannot be
visible are not sent to the device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.body_buffers import BodyCache, PosedBody
from humansim_ros.render.caches import LruCache
from humansim_ros.render.channels import ADJACENT_NAMES, ALL_CHANNELS, CHANNEL_TABLE, View, comparing_with
from humansim_ros.render.contact_shadow_pass import ContactShadowPass
from humansim_ros.render.context import OpenGLContext
from humansim_ros.render.coverage import CoveragePass
from humansim_ros.render.edge_antialiasing import edge_crossings
from humansim_ros.render.frame_cache import FrameCache
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.memory import keep_image_blocks
from humansim_ros.render.programs import link, lit_program, use_camera
from humansim_ros.render.projected_points import ProjectedPoints, contour, image_bounds, straight_angle
from humansim_ros.render.rendered_frame import (
    AdjacentFrames,
    Passes,
    RenderedFrame,
    StaticLabels,
    StaticLayer,
    TriangleIds,
)
from humansim_ros.render.renderer import Body, Renderer, RenderRequest, check_bodies
from humansim_ros.render.static_layers import StaticLayers, camera_key
from humansim_ros.render.target import Rectangle, RenderTarget
from humansim_ros.render.uniforms import set_uniform
from humansim_ros.types import Indices

#: Image sizes whose render targets are cached.
_MAX_SIZES = 32


class GLRenderer(Renderer):
    """Renders bodies in a static scene with OpenGL, in a context of its own, in the thread that makes it.

    Args:
        static_meshes: Meshes of the static scene, in ``map``, metres.
        lighting: Light; the default light if None.
        device: Number of the GPU in the order of EGL; the first one that works if None.
        static_bodies: Bodies that never move. They are rendered with the static scene, once per camera.

    Raises:
        RenderError: OpenGL or the device is missing. The message names the packages to install.
    """

    channels = ALL_CHANNELS
    name = "moderngl"

    def __init__(
        self,
        static_meshes: Sequence[Mesh] = (),
        lighting: Lighting | None = None,
        device: int | None = None,
        static_bodies: Sequence[Body] = (),
    ) -> None:
        keep_image_blocks()
        light = lighting or Lighting()
        self._context = OpenGLContext(device)
        self._ctx = self._context.gl
        check_bodies(static_bodies)
        self._static_bodies = tuple(static_bodies)
        shadows = ["STATIC_SHADOWS", "MOVING_SHADOWS"] if light.shadow == "soft" else []
        skin = ["SKIN_AND_CLOTH"] if light.materials and light.mode == "lit" else []
        with self._context.current():
            # rows of an image run down, those of OpenGL run up: images are mirrored
            self._ctx.front_face = "cw"
            self._lit = lit_program(self._ctx, light, (*shadows, *skin))
            self._ids = link(self._ctx, "triangle_ids.vert", "triangle_ids.frag")
            self._static = StaticLayers(
                self._ctx, static_meshes, self._static_bodies, light, self._ids, self._lit
            )
            self._contact_shadows = ContactShadowPass(self._ctx)
            self._coverage = CoveragePass(self._ctx)
        self._bodies = BodyCache(self._ctx, self._lit, self._ids)
        self._frames = FrameCache()
        self._targets: LruCache[tuple[int, int], RenderTarget] = LruCache(
            _MAX_SIZES, release=lambda target: target.release()
        )

    @property
    def device(self) -> str:
        """Name of the device, such as ``llvmpipe (LLVM 15.0.6, 256 bits)``."""
        return self._context.device

    @property
    def meshes_on_device(self) -> int:
        """Number of meshes of bodies that have buffers on the device."""
        return len(self._bodies)

    def close(self) -> None:
        self._context.close()

    def check_usable(self) -> None:
        self._context.check()

    def render_request(self, request: RenderRequest) -> View:
        bodies, passes = self._moving(request.bodies), Passes.of(request.channels)
        with self._context.current():
            self._bodies.release_unused()
            frame = self._frame(bodies, request.camera, passes, request)
            adjacent: AdjacentFrames = {}
            for name in ADJACENT_NAMES:
                channels, other = comparing_with(name, request.channels), request.adjacent(name)
                if other is None or not channels:
                    continue
                other, rendered = replace(other, bodies=self._moving(other.bodies)), None
                if any(CHANNEL_TABLE[channel].occlusion for channel in channels):
                    # with the passes of this frame: it will be requested next
                    rendered = self._frame(other.bodies, other.camera, passes, request)
                adjacent = {**adjacent, name: (other, rendered)}
            return frame.view(bodies, request.channels, adjacent)

    def coverage(self, body: Body, camera: Camera) -> Indices:
        """Count the pixels that each triangle of a body covers, also where another surface hides it.

        The same pixel centres count as in ``face``: the counts of a triangle that nothing hides are equal.

        Returns:
            (N,) pixels within the image of each triangle of the mesh.

        Raises:
            RenderError: The body is not valid, or OpenGL failed.
        """
        check_bodies([body])
        with self._context.current():
            self._bodies.release_unused()
            posed = self._bodies.pose(body)
            rectangle = image_bounds([ProjectedPoints(posed.posed.points, camera)], camera)
            tessellated = None
            if camera.distorted and not rectangle.empty:
                tessellated = posed.tessellated(camera, straight_angle(camera, rectangle))
            return self._coverage.count(posed, tessellated or posed.whole, camera, rectangle)

    def _moving(self, bodies: Sequence[Body]) -> Sequence[Body]:
        """Bodies that are not part of the static scene."""
        if not self._static_bodies:
            return bodies
        static = {id(body) for body in self._static_bodies}
        return [body for body in bodies if id(body) not in static]

    def _frame(
        self, bodies: Sequence[Body], camera: Camera, passes: Passes, request: RenderRequest
    ) -> RenderedFrame:
        """Cached rendering of a frame; renders on a miss."""
        moving, backdrop = request.moving_camera, request.backdrop
        view = camera_key(camera), moving, id(backdrop)
        frame = self._frames.get(bodies, view)
        if frame is None or not frame.passes.covers(passes):
            layer = self._static.layer(camera, moving, backdrop)
            frame = self._render(bodies, camera, passes, layer)
            if self._static_bodies:
                frame.static_labels = self._static_labels(camera, passes, moving, layer)
            self._frames.put(bodies, view, frame)
        return frame

    def _render(
        self, bodies: Sequence[Body], camera: Camera, passes: Passes, layer: StaticLayer
    ) -> RenderedFrame:
        posed = [self._bodies.pose(body) for body in bodies]
        shadows = []
        if passes.lit and self._static.contact_shadows:
            shadows = [body.contact_shadow for body in posed if body.near_floor]
        shaded = [shadow.corners.T for shadow in shadows]
        sun = self._static.sun_shadows if passes.lit else None
        if sun is not None and posed:
            shaded += sun.update(posed)
        projected = [ProjectedPoints(body.posed.points, camera) for body in posed]
        rectangle = image_bounds(
            [*projected, *(ProjectedPoints(points, camera) for points in shaded)], camera
        )
        target = self._target(camera.size)
        target.start(rectangle, layer.depth_buffer, layer.rgba)
        ids, outline = TriangleIds(), None
        if not rectangle.empty:
            self._contact_shadows.draw(shadows, camera)
            if sun is not None and layer.shadow_inputs is not None:
                sun.apply(layer.shadow_inputs, layer.target, target, camera)
            target.use(passes.lit)
            facing = [body.posed.facing(camera.center) for body in posed]
            ids = self._draw(posed, projected, facing, rectangle, passes.lit)
            if passes.outlined:
                angle = straight_angle(camera, rectangle)
                each = zip(posed, projected, facing, strict=True)
                edges = [contour(body.posed, points, front, angle) for body, points, front in each]
                outline = edge_crossings([part for body in edges for part in body], camera.size)
        triangle_ids, depth = (target.read(name, passes.lit) for name in ("triangle_id", "depth"))
        rgba = target.read("rgba", True) if passes.lit else None
        alone = None
        if passes.alone:
            labelled = [pair for pair in zip(posed, projected, strict=True) if pair[0].body.instance]
            alone = {body.body.instance: self._alone(body, points) for body, points in labelled}
        instances = tuple(body.instance for body in bodies)
        return RenderedFrame(
            passes, instances, camera, layer, rectangle, ids, triangle_ids, depth, rgba, outline, alone
        )

    def _static_labels(
        self, camera: Camera, passes: Passes, moving_camera: bool, layer: StaticLayer
    ) -> StaticLabels:
        """Cached labels of the static bodies in a layer; renders on a miss."""
        passes = Passes(lit=False, outlined=True, alone=passes.alone)
        if layer.labels is None or not layer.labels.passes.covers(passes):
            target = self._target(camera.size)
            self._static.draw_unlabelled(target, camera, moving_camera)
            frame = self._render(self._static_bodies, camera, passes, StaticLayer(target, None, None))
            layer.labels = StaticLabels(replace(frame, layer=layer), self._static_bodies)
        return layer.labels

    def _alone(self, body: PosedBody, projected: ProjectedPoints) -> NDArray[np.bool_]:
        """(H, W) mask of a body without occluders."""
        camera = projected.camera
        mask = np.zeros(camera.size[::-1], bool)
        rectangle = image_bounds([projected], camera)
        if not rectangle.empty:
            target = self._target(camera.size)
            target.start(rectangle)
            target.use(False)
            facing = body.posed.facing(camera.center)
            self._draw([body], [projected], [facing], rectangle, False)
            mask[rectangle.slices] = target.read("triangle_id", False) > 0
        return mask

    def _draw(
        self,
        bodies: Sequence[PosedBody],
        projected: Sequence[ProjectedPoints],
        facing: Sequence[NDArray[np.bool_]],
        rectangle: Rectangle,
        lit: bool,
    ) -> TriangleIds:
        """Draw the triangles that may be visible, each with its own id.

        Args:
            bodies: Bodies to draw, at least one.
            projected: Projected vertices of each.
            facing: Of each, (N,) whether a triangle shows its front to the camera.
            rectangle: Pixels that the bodies may touch.
            lit: Draw colours too.
        """
        ids = TriangleIds()
        if not bodies:
            return ids
        camera, program = projected[0].camera, self._lit if lit else self._ids
        use_camera(self._ctx, program, camera)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        straight = straight_angle(camera, rectangle)
        for body, points, front in zip(bodies, projected, facing, strict=True):
            set_uniform(program, "first_id", ids.count)
            set_uniform(program, "has_skin_mask", float(body.has_skin_mask))
            tessellated = body.tessellated(camera, straight) if camera.distorted else None
            if tessellated is not None:
                body.draw_tessellated(program, tessellated)
                ids.add(body.body, tessellated.parents)
                continue
            # from outside a closed surface its back faces never show; a near camera may be inside
            culled = body.closed and not rectangle.near
            visible = np.flatnonzero(front) if culled else np.arange(len(front))
            if not rectangle.near:
                visible = visible[points.covering([c.take(visible) for c in body.topology.corners])]
            body.draw(lit, visible)
            ids.add(body.body, visible)
        return ids

    def _target(self, size: tuple[int, int]) -> RenderTarget:
        return self._targets.get_or_make(size, lambda: RenderTarget(self._ctx, size))
