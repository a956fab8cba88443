"""The default renderer: OpenGL 3.3 through EGL, without a display, on a GPU if there is one.

The static scene is rendered once per camera and cached. Each frame renders only the rectangle that bodies may
touch. One pass with one sample at each pixel center draws colour, depth, and triangle ids. All labels follow
from the triangle ids. Outlines of bodies are anti-aliased afterwards (edge_antialiasing.py). Triangles that
cannot be visible are not sent to the device. For optical flow, a frame is rendered once and used up to three
times: as this, next and previous frame.

:class:`CoveragePass` counts the pixels of each triangle, also where another triangle hides it. OpenGL decides
which pixel centers a triangle covers, as for the channel ``face``. So a triangle that nothing hides has the
same number of pixels in both.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.files.mesh import Mesh
from humansim_ros.render.device.caches import LruCache
from humansim_ros.render.device.context import (
    OpenGLContext,
    keep_image_blocks,
    link,
    lit_program,
    set_uniform,
    use_camera,
)
from humansim_ros.render.device.lens_tessellation import TessellatedMesh
from humansim_ros.render.device.mesh_buffers import ContactShadow, TriangleBuffers
from humansim_ros.render.device.target import Rectangle, RenderTarget, RenderTargets
from humansim_ros.render.frame.body_buffers import (
    BodyCache,
    HiddenBodies,
    PosedBody,
    ProjectedPoints,
    coarsest,
    contour,
    image_bounds,
    pays,
    straight_angle,
)
from humansim_ros.render.frame.edge_antialiasing import edge_crossings
from humansim_ros.render.frame.rendered_frame import (
    AdjacentFrames,
    RenderedFrame,
    StaticLabels,
    StaticLayer,
    TriangleIds,
)
from humansim_ros.render.frame.shadows import ContactShadowPass
from humansim_ros.render.frame.static_layers import StaticLayers, camera_key
from humansim_ros.render.interface.channels import (
    ADJACENT_NAMES,
    ALL_CHANNELS,
    CHANNEL_TABLE,
    Pass,
    View,
    comparing_with,
    passes_of,
)
from humansim_ros.render.interface.lighting import Lighting, RendererName
from humansim_ros.render.interface.renderer import Body, Renderer, RenderRequest, check_bodies
from humansim_ros.types import Float32Array, Indices

if TYPE_CHECKING:
    from humansim_ros.render.frame.pyrender import PyrenderRenderer


class _SeenBody(NamedTuple):
    """A body in its pose, and its points in the image. ``number``: index of the body in the frame."""

    number: int
    body: PosedBody
    points: ProjectedPoints


class GLRenderer(Renderer):
    """Renders bodies in a static scene with OpenGL. It has its own context and belongs to the thread that
    makes it.

    Args:
        static_meshes: Meshes of the static scene, in ``map``, metres.
        lighting: Light. If None, the default light.
        device: Number of the GPU in the order of EGL. If None, the first one that works.
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
        self._targets = RenderTargets(self._context)
        shadows = ["STATIC_SHADOWS", "MOVING_SHADOWS"] if light.shadow == "soft" else []
        skin = ["SKIN_AND_CLOTH"] if light.materials and light.mode == "lit" else []
        with self._context.current():
            # rows of an image run down and rows of OpenGL run up, so images are mirrored
            self._ctx.front_face = "cw"
            self._lit = lit_program(self._ctx, light, (*shadows, *skin))
            self._ids = link(self._ctx, "triangle_ids.vert", "triangle_ids.frag")
            self._static = StaticLayers(
                self._ctx, static_meshes, self._static_bodies, light, self._ids, self._lit, self._targets
            )
            self._contact_shadows = ContactShadowPass(self._ctx)
            self._coverage = CoveragePass(self._ctx)
        self._bodies = BodyCache(self._ctx, self._lit, self._ids)
        self._frames = FrameCache()

    @property
    def device(self) -> str:
        """Name of the device, such as ``llvmpipe (LLVM 15.0.6, 256 bits)``."""
        return self._context.device

    def close(self) -> None:
        self._context.close()

    def check_usable(self) -> None:
        self._context.check()

    def render_request(self, request: RenderRequest) -> View:
        with self._context.current():
            view, *others = (self._view(part, levels) for part, levels in self._parts(request))
            for other in others:
                view = view.with_channels(**{name: getattr(other, name) for name in other.channels})
            return view

    def _parts(self, request: RenderRequest) -> list[tuple[RenderRequest, tuple[int, ...]]]:
        """Split a request into requests for channels that are drawn together, without static bodies. Returns
        each with the levels of detail of its bodies; an empty tuple stands for full meshes."""
        request = replace(request, bodies=self._moving(request.bodies))
        coloured = {name for name in request.channels if "lit" in CHANNEL_TABLE[name].passes}
        levels = self._levels(request.bodies, request.camera) if coloured else ()
        if not any(levels):
            return [(request, ())]
        parts = ((set(request.channels) - coloured, ()), (coloured, levels))
        return [(replace(request, channels=channels), chosen) for channels, chosen in parts if channels]

    def _view(self, request: RenderRequest, levels: tuple[int, ...]) -> View:
        """Render the channels of a request. ``levels``: level of detail of each body; empty for full
        meshes."""
        frame = self._frame(request, levels)
        adjacent: AdjacentFrames = {}
        for name in ADJACENT_NAMES:
            channels, other = comparing_with(name, request.channels), request.adjacent(name)
            if other is None or not channels:
                continue
            other, rendered = replace(other, bodies=self._moving(other.bodies)), None
            if any(CHANNEL_TABLE[channel].occlusion for channel in channels):
                # keep the channels of this frame, since it will be requested next
                rendered = self._frame(replace(request, bodies=other.bodies, camera=other.camera))
            adjacent = {**adjacent, name: (other, rendered)}
        return frame.view(request.bodies, request.channels, adjacent)

    def _levels(self, bodies: Sequence[Body], camera: Camera) -> tuple[int, ...]:
        """Level of detail of each body for colours. The tuple is empty if all bodies are drawn with full
        meshes, as is necessary for shadows of the sun."""
        known = [body.levels for body in bodies]
        if self._static.sun_shadows is not None or all(each is None for each in known):
            return ()
        boxes = np.stack([self._bodies.pose(body).posed.box for body in bodies])
        levels = coarsest(known, boxes, camera)
        return levels if pays(known, levels) else ()

    def coverage(self, body: Body, camera: Camera) -> Indices:
        """Count the pixels that each triangle of a body covers, also where another surface hides it.

        It counts pixel centers like the channel ``face``. So a triangle that nothing hides has the same
        number of pixels in both.

        Returns:
            (N,) number of pixels that each triangle of the mesh covers within the image.

        Raises:
            RenderError: The body is not valid, or OpenGL failed.
        """
        check_bodies([body])
        with self._context.current():
            posed = self._bodies.pose(body)
            rectangle = image_bounds([ProjectedPoints(posed.posed.points, camera)], camera)
            bent = None
            if camera.distorted and not rectangle.empty:
                bent = posed.bent(camera, straight_angle(camera, rectangle))
            mesh = posed.whole if bent is None else posed.tessellated(camera, np.arange(len(bent)))
            return self._coverage.count(posed, mesh, camera, rectangle)

    def _moving(self, bodies: Sequence[Body]) -> Sequence[Body]:
        """Bodies that are not part of the static scene."""
        static = {id(body) for body in self._static_bodies}
        return [body for body in bodies if id(body) not in static] if static else bodies

    def _frame(self, request: RenderRequest, levels: tuple[int, ...] = ()) -> RenderedFrame:
        """Frame of a request, from the cache or drawn now. ``levels``: as in :meth:`_view`."""
        bodies, camera, passes = request.bodies, request.camera, passes_of(request.channels)
        moving, backdrop = request.moving_camera, request.backdrop
        view = camera_key(camera), moving, id(backdrop), levels
        cached = self._frames.get(bodies, view)
        if cached is not None and cached.passes >= passes:
            return cached
        layer = self._static.layer(camera, moving, backdrop, "lit" in passes)
        frame = self._render(bodies, passes, layer, self._targets.of(camera.size), camera, levels)
        if self._static_bodies:
            frame.static_labels = self._static_labels(frame, moving)
        if "uncovered" in passes:
            frame.body_part = self._uncovered(frame, bodies, moving)
        return self._frames.put(bodies, view, frame)

    def _render(
        self,
        bodies: Sequence[Body],
        passes: frozenset[Pass],
        layer: StaticLayer,
        target: RenderTarget,
        camera: Camera,
        levels: tuple[int, ...] = (),
        uncovered: bool = False,
    ) -> RenderedFrame:
        """Draw a frame. ``levels``: as in :meth:`_view`. ``uncovered``: leave out off-body surfaces such as
        skirts and hats."""
        lit, posed = "lit" in passes, [self._bodies.pose(body) for body in bodies]
        if levels:
            posed = [body.level(number) for body, number in zip(posed, levels, strict=True)]
        everybody = [
            _SeenBody(number, body, ProjectedPoints(body.posed.points, camera))
            for number, body in enumerate(posed)
        ]
        drawn = [each for each in everybody if not each.points.is_hidden(layer.depth)]
        shadows = []
        if lit and self._static.contact_shadows:
            shadows = _contact_shadows(posed, camera, layer.depth)
        shaded = [shadow.corners.T for shadow in shadows]
        sun = self._static.sun_shadows if lit else None
        if sun is not None and posed:
            shaded += sun.update(posed)
        clouds = [each.points for each in drawn]
        touched = image_bounds(clouds, camera)
        rectangle = image_bounds([*clouds, *(ProjectedPoints(points, camera) for points in shaded)], camera)
        target.start(rectangle, layer.depth_buffer, layer.rgba, touched, layer.kept)
        ids, outline = TriangleIds(), None
        if not rectangle.empty:
            self._contact_shadows.draw(shadows, camera)
            if sun is not None and layer.shadow_inputs is not None:
                sun.apply(layer.shadow_inputs, target, camera)
            target.use(lit)
            ids, facing = self._draw(drawn, target, lit, layer.depth, uncovered)
            if "outlined" in passes and drawn:
                angle = straight_angle(camera, rectangle)
                edges = [
                    contour(each.body.posed, each.points, facing[each.number], angle)
                    for each in drawn
                    if each.number in facing
                ]
                outline = edge_crossings([part for body in edges for part in body], camera.size)
        triangle_ids, depth, *colours = target.read_all(lit)
        alone = None
        if "alone" in passes:
            labelled = [each for each in everybody if each.body.body.instance]
            alone = {each.body.body.instance: self._alone(each) for each in labelled}
        instances = tuple(body.instance for body in bodies)
        return RenderedFrame(
            *(passes, instances, camera, layer, touched, rectangle, ids, triangle_ids, depth),
            *(colours[0] if lit else None, outline, alone),
        )

    def _static_labels(self, frame: RenderedFrame, moving_camera: bool) -> StaticLabels:
        """Labels of the static bodies in a frame, from the cache or computed now."""
        camera, layer = frame.camera, frame.layer
        passes = passes_of(("alpha", "amodal") if "alone" in frame.passes else ("alpha",))
        if layer.labels is None or not layer.labels.passes >= passes:
            target = self._targets.of(camera.size)
            self._static.draw_unlabelled(target, camera, moving_camera)
            own = self._render(self._static_bodies, passes, StaticLayer(target, None), target, camera)
            # a copy, so that the layer is not in a circle of references, and is freed when nobody needs it
            layer.labels = StaticLabels(replace(own, layer=copy(layer)), self._static_bodies)
        return layer.labels

    def _uncovered(
        self, frame: RenderedFrame, bodies: Sequence[Body], moving_camera: bool
    ) -> NDArray[np.uint8] | None:
        """(H, W) part labels without off-body surfaces. None if no pixel of the frame shows such a
        surface."""
        moving, static = (
            any(body.mesh.off_body is not None for body in each) for each in (bodies, self._static_bodies)
        )
        if not (static or (moving and frame.ids.table("off_body").take(frame.triangle_ids).any())):
            return None
        camera, layer = frame.camera, frame.layer
        target, parts = self._targets.of(camera.size), np.zeros(camera.size[::-1], np.uint8)
        if static:  # the layer shows off-body surfaces of static bodies too
            self._static.draw_unlabelled(target, camera, moving_camera)
            layer, bodies = StaticLayer(target, None), [*bodies, *self._static_bodies]
        elif frame.static_labels is not None:
            parts = frame.static_labels.images(("body_part",))["body_part"]
        drawn = self._render(bodies, frozenset(), layer, target, camera, uncovered=True)
        values = drawn.ids.table("part").take(drawn.triangle_ids)
        np.copyto(parts[drawn.rectangle.slices], values, where=drawn.triangle_ids > 0)
        return parts

    def _alone(self, seen: _SeenBody) -> NDArray[np.bool_]:
        """Draw a body alone. Returns (H, W) mask of its pixels, as if nothing occluded it."""
        camera = seen.points.camera
        mask, rectangle = np.zeros(camera.size[::-1], bool), seen.points.rectangle
        if not rectangle.empty:
            target = self._targets.of(camera.size)
            target.start(rectangle)
            target.use(False)
            self._draw([seen], target, False, np.full(mask.shape, np.inf, np.float32))
            mask[rectangle.slices] = target.read("triangle_id", False) > 0
        return mask

    def _draw(
        self,
        bodies: Sequence[_SeenBody],
        target: RenderTarget,
        lit: bool,
        behind: Float32Array,
        uncovered: bool = False,
    ) -> tuple[TriangleIds, dict[int, NDArray[np.bool_]]]:
        """Draw into the target in use those triangles of some bodies that may be visible, each with its own
        id. ``lit``: draw colours too. ``behind``: (H, W) depth of the static scene, metres; bodies behind it
        are not drawn. ``uncovered``: leave out off-body surfaces.

        Returns:
            The triangles that were drawn; and for each body that is not hidden, by its index: (N,) whether
            each triangle of its mesh shows its front.
        """
        ids, facing = TriangleIds(), dict[int, NDArray[np.bool_]]()
        if not bodies:
            return ids, facing
        camera, program = bodies[0].points.camera, self._lit if lit else self._ids
        use_camera(self._ctx, program, camera)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        straight = straight_angle(camera, target.coloured)
        # the nearest body first, so that hidden pixels are not shaded
        order = sorted(bodies, key=lambda each: each.points.closest)
        hidden = HiddenBodies(
            *([each.points for each in order], behind),
            *(target.identified, lambda: target.read("depth", lit)),
        )
        for number, body, points in order:
            if hidden.contains(points):
                continue
            front = facing[number] = body.posed.facing(camera.center)
            set_uniform(program, "first_id", ids.count)
            set_uniform(program, "has_skin_mask", float(body.mesh.has_skin_mask))
            # a closed surface never shows its back faces to a camera outside; a near camera may be inside
            visible = np.flatnonzero(front) if body.mesh.closed and not points.near else np.arange(len(front))
            if uncovered and body.body.kind == "human" and body.body.mesh.off_body is not None:
                visible = visible[~body.body.mesh.triangles_off_body[visible]]
            bent = body.bent(camera, straight) if camera.distorted else None
            if bent is not None:
                pieces = body.tessellated(camera, visible[bent[visible]])
                body.draw_tessellated(program, pieces)
                ids.add(number, body.body, pieces.parents)
                set_uniform(program, "first_id", ids.count)
                visible = visible[~bent[visible]]
            if not points.near:
                corners = body.mesh.topology.corners
                visible = visible[points.covering([c.take(visible) for c in corners])]
                visible = visible[points.unhidden([c.take(visible) for c in corners], hidden.depth)]
            body.draw(lit, visible)
            ids.add(number, body.body, visible)
        return ids, facing


def _contact_shadows(
    bodies: Sequence[PosedBody], camera: Camera, static: Float32Array
) -> list[ContactShadow]:
    """Contact shadows that may be visible. ``static``: (H, W) depth of the static scene, metres."""

    def shown(corners: Float32Array) -> bool:
        return not ProjectedPoints(corners.T, camera).is_hidden(static)

    casters = (body.shadow_caster for body in bodies if body.near_floor)
    shadows = (caster.shadow for caster in casters if shown(caster.corners))
    return [shadow for shadow in shadows if shown(shadow.corners)]


#: A number larger than all triangle ids. Single precision is exact up to this number.
_NONE = float(1 << 24)
#: Texture unit for the triangle ids found so far. No material uses this unit.
_UNIT = 8


class CoveragePass:
    """Counts covered pixels on the device, also those of hidden triangles. All triangles are drawn together.
    Each draw finds up to four more triangles at each pixel, so that the number of draws depends on the number
    of surfaces behind a pixel."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._program = link(ctx, "triangle_ids.vert", "triangle_layers.frag")

    def count(self, body: PosedBody, mesh: TessellatedMesh, camera: Camera, rectangle: Rectangle) -> Indices:
        """Count the pixels (N,) of each triangle of the mesh of a body.

        Args:
            body, mesh: The body, and its triangles as they are drawn.
            camera, rectangle: Camera that sees the body, and the pixels that the body may touch.
        """
        pixels = np.zeros(len(mesh.triangles) + 1, np.intp)
        if not rectangle.empty and len(mesh.triangles):
            pieces = TriangleBuffers(self._ctx, mesh.attributes, mesh.triangles)
            for lowest, highest in self._layers(body, pieces, len(mesh.triangles), camera, rectangle):
                pixels += np.bincount(lowest, minlength=len(pixels))
                pixels += np.bincount(highest[highest != lowest], minlength=len(pixels))
        count = len(body.mesh.topology.corners[0])
        return np.bincount(mesh.parents, pixels[1:], count).astype(np.intp)

    def _layers(
        self, body: PosedBody, pieces: TriangleBuffers, count: int, camera: Camera, rectangle: Rectangle
    ) -> Iterator[tuple[Indices, Indices]]:
        """Draw again until all triangles are found. After each draw, yields the lowest and the highest new
        triangle ids (M,) at pixels."""
        use_camera(self._ctx, self._program, camera)
        set_uniform(self._program, "none", _NONE)
        set_uniform(self._program, "found", _UNIT)
        textures = [self._ctx.texture(camera.size, 4, dtype="f4") for _ in range(2)]
        targets = [self._ctx.framebuffer([texture]) for texture in textures]
        for target in targets:
            target.scissor = rectangle.xywh
        before, after = 0, 1
        targets[before].clear(0, -_NONE, 0, -_NONE)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_equation = moderngl.MIN, moderngl.MIN
        found = True
        try:
            while found:
                targets[after].use()
                targets[after].clear(_NONE, _NONE, _NONE, _NONE)
                textures[before].use(_UNIT)
                pieces.draw(self._program, [body.mesh.material], [count])
                ids = np.frombuffer(
                    targets[after].read(rectangle.xywh, components=4, dtype="f4", alignment=1), np.float32
                ).reshape(-1, 4)
                found = False
                for lowest, highest in (ids[:, :2].T, ids[:, 2:].T):
                    shown = lowest < _NONE
                    if shown.any():
                        found = True
                        yield lowest[shown].astype(np.intp), -highest[shown].astype(np.intp)
                before, after = after, before
        finally:
            self._ctx.blend_equation = moderngl.FUNC_ADD, moderngl.FUNC_ADD


#: Most frames in the cache, most memory, and the number of frames that stay even if they need more memory.
_MAX_FRAMES, _MAX_BYTES, _MIN_FRAMES = 48, 256 << 20, 3

_Entry = tuple[RenderedFrame, tuple["weakref.ref[Body]", ...]]


class FrameCache:
    """A cache of the most recently used frames. A frame is dropped when one of its bodies is freed. ``view``
    in its methods is a key of the camera and the static scene."""

    def __init__(self) -> None:
        self._frames: LruCache[tuple[object, ...], _Entry] = LruCache(
            _MAX_FRAMES, _MAX_BYTES, _MIN_FRAMES, lambda entry: entry[0].nbytes
        )

    def get(self, bodies: Sequence[Body], view: tuple[object, ...]) -> RenderedFrame | None:
        """Return the cached frame of these bodies; None if there is none."""
        entry = self._frames.get((*map(id, bodies), *view))
        if entry is None or any(ref() is not body for ref, body in zip(entry[1], bodies, strict=True)):
            return None
        return entry[0]

    def put(self, bodies: Sequence[Body], view: tuple[object, ...], frame: RenderedFrame) -> RenderedFrame:
        """Put a frame into the cache, and return the frame."""
        key, frames = (*map(id, bodies), *view), self._frames
        frames.put(key, (frame, tuple(weakref.ref(body, lambda _: frames.discard(key)) for body in bodies)))
        return frame


def make_renderer(
    name: RendererName = "moderngl",
    static_meshes: Sequence[Mesh] = (),
    lighting: Lighting | None = None,
    device: int | None = None,
    static_bodies: Sequence[Body] = (),
) -> GLRenderer | PyrenderRenderer:
    """Create a renderer.

    Args:
        name: Name of the renderer.
        static_meshes: The same as in :class:`GLRenderer`.
        lighting: The same as in :class:`GLRenderer`.
        device: The same as in :class:`GLRenderer`.
        static_bodies: The same as in :class:`GLRenderer`.

    Raises:
        RenderError: A library or the device is missing. The message says what to install.
    """
    if name == "pyrender":
        from humansim_ros.render.frame.pyrender import PyrenderRenderer

        return PyrenderRenderer(static_meshes, lighting, device, static_bodies)
    return GLRenderer(static_meshes, lighting, device, static_bodies)
