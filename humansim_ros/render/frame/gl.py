"""The default renderer: OpenGL 3.3 through EGL, without a display, on a GPU if there is one.

The static scene is rendered once per camera and cached. Each frame renders only the rectangle that bodies may
touch. One pass with one sample at each pixel center draws colour, depth, and the triangle id, which gives all
labels. Outlines of bodies are anti-aliased afterwards (edge_antialiasing.py). Triangles that cannot be
visible are not sent to the device. With optical flow, a frame is rendered once and used up to three times.

:class:`CoveragePass` counts the pixels of each triangle, also where another triangle hides it. OpenGL decides
which pixel centers a triangle covers, as for the channel ``face``, so that both counts of a triangle that
nothing hides are equal.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

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
    contour,
    image_bounds,
    straight_angle,
)
from humansim_ros.render.frame.detail import coarsest, pays
from humansim_ros.render.frame.edge_antialiasing import edge_crossings
from humansim_ros.render.frame.rendered_frame import (
    AdjacentFrames,
    Passes,
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
    View,
    comparing_with,
)
from humansim_ros.render.interface.lighting import Lighting, RendererName
from humansim_ros.render.interface.renderer import Body, Renderer, RenderRequest, check_bodies
from humansim_ros.types import Float32Array, Indices

if TYPE_CHECKING:
    from humansim_ros.render.frame.pyrender import PyrenderRenderer


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

    @property
    def meshes_on_device(self) -> int:
        """Number of meshes of bodies that have buffers on the device."""
        return len(self._bodies)

    def close(self) -> None:
        self._context.close()

    def check_usable(self) -> None:
        self._context.check()

    def prepare(self, requests: Sequence[RenderRequest]) -> None:
        """Draw several requests before the first image is read. On a processor this does nothing. Each
        request has its own target: in one large image, the device would round positions differently. Images
        are read while others are drawn. They wait in the cache for :meth:`render`."""
        with self._context.current():
            count = self._targets.together([request.camera.size for request in requests])
            if count < 2:
                return
            self._bodies.release_unused()
            waiting: list[Callable[[], RenderedFrame]] = []
            for request in requests[:count]:
                request.check(self)
                bodies = self._moving(request.bodies)
                for channels, levels in self._drawings(bodies, request):
                    passes, target = Passes.of(channels), len(waiting) + 1
                    waiting.append(self._start_frame(bodies, request.camera, passes, request, levels, target))
            for wait in waiting:
                wait()

    def render_request(self, request: RenderRequest) -> View:
        bodies = self._moving(request.bodies)
        with self._context.current():
            self._bodies.release_unused()
            view, *others = (
                self._view(bodies, replace(request, channels=channels), levels)
                for channels, levels in self._drawings(bodies, request)
            )
            for other in others:
                view = view.with_channels(**{name: getattr(other, name) for name in other.channels})
            return view

    def _drawings(
        self, bodies: Sequence[Body], request: RenderRequest
    ) -> list[tuple[Collection[str], tuple[int, ...]]]:
        """Groups of channels that are drawn together, each with the level of detail of each body (empty: all
        whole)."""
        coloured = {name for name in request.channels if "lit" in CHANNEL_TABLE[name].passes}
        levels = self._levels(bodies, request.camera) if coloured else ()
        if not any(levels):
            return [(request.channels, ())]
        exact = set(request.channels) - coloured
        return [*([(exact, ())] if exact else []), (coloured, levels)]

    def _view(self, bodies: Sequence[Body], request: RenderRequest, levels: tuple[int, ...]) -> View:
        """Channels of bodies at some levels of detail."""
        passes = Passes.of(request.channels)
        frame = self._frame(bodies, request.camera, passes, request, levels)
        adjacent: AdjacentFrames = {}
        for name in ADJACENT_NAMES:
            channels, other = comparing_with(name, request.channels), request.adjacent(name)
            if other is None or not channels:
                continue
            other, rendered = replace(other, bodies=self._moving(other.bodies)), None
            if any(CHANNEL_TABLE[channel].occlusion for channel in channels):
                # keep the passes of this frame, since it will be requested next
                rendered = self._frame(other.bodies, other.camera, passes, request)
            adjacent = {**adjacent, name: (other, rendered)}
        return frame.view(bodies, request.channels, adjacent)

    def _levels(self, bodies: Sequence[Body], camera: Camera) -> tuple[int, ...]:
        """Level of detail of each body for colours. Empty if all are drawn whole, as with shadows of the
        sun."""
        if self._static.sun_shadows is not None or all(body.levels is None for body in bodies):
            return ()
        posed = [self._bodies.pose(body).posed for body in bodies]
        levels = coarsest([body.levels for body in bodies], np.stack([each.box for each in posed]), camera)
        return levels if pays([body.levels for body in bodies], levels) else ()

    def coverage(self, body: Body, camera: Camera) -> Indices:
        """Count the pixels that each triangle of a body covers, also where another surface hides it.

        It counts the same pixel centers as ``face``, so that both counts of a triangle that nothing hides are
        equal.

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
            bent = None
            if camera.distorted and not rectangle.empty:
                bent = posed.bent(camera, straight_angle(camera, rectangle))
            mesh = posed.whole if bent is None else posed.tessellated(camera, np.arange(len(bent)))
            return self._coverage.count(posed, mesh, camera, rectangle)

    def _moving(self, bodies: Sequence[Body]) -> Sequence[Body]:
        """Bodies that are not part of the static scene."""
        if not self._static_bodies:
            return bodies
        static = {id(body) for body in self._static_bodies}
        return [body for body in bodies if id(body) not in static]

    def _frame(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        passes: Passes,
        request: RenderRequest,
        levels: tuple[int, ...] = (),
    ) -> RenderedFrame:
        """Rendered frame from the cache, or a new one. ``levels``: level of each body; empty if all are
        whole."""
        return self._start_frame(bodies, camera, passes, request, levels)()

    def _start_frame(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        passes: Passes,
        request: RenderRequest,
        levels: tuple[int, ...],
        number: int = 0,
    ) -> Callable[[], RenderedFrame]:
        """Start to draw a frame into target ``number``, unless it is cached. The result waits for the
        images."""
        moving, backdrop = request.moving_camera, request.backdrop
        view = camera_key(camera), moving, id(backdrop), levels
        cached = self._frames.get(bodies, view)
        if cached is not None and cached.passes.covers(passes):
            return lambda: cached
        layer = self._static.layer(camera, moving, backdrop, passes.lit)
        target = self._targets.of(camera.size, number)
        finish = self._render(bodies, camera, passes, layer, levels, target)

        def wait() -> RenderedFrame:
            frame = finish()
            if self._static_bodies:
                frame.static_labels = self._static_labels(camera, passes, moving, layer)
            if passes.uncovered:
                frame.body_part = self._uncovered(frame, bodies, camera, moving)
            return self._frames.put(bodies, view, frame)

        return wait

    def _render(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        passes: Passes,
        layer: StaticLayer,
        levels: tuple[int, ...],
        target: RenderTarget,
        uncovered: bool = False,
    ) -> Callable[[], RenderedFrame]:
        """Start to draw a frame. The result waits for the images. ``uncovered``: without off-body
        surfaces."""
        posed = [self._bodies.pose(body) for body in bodies]
        if levels:
            posed = [body.level(number) for body, number in zip(posed, levels, strict=True)]
        projected = [ProjectedPoints(body.posed.points, camera) for body in posed]
        drawn = [not points.is_hidden(layer.depth) for points in projected]
        shadows = []
        if passes.lit and self._static.contact_shadows:
            shadows = _contact_shadows(posed, camera, layer.depth)
        shaded = [shadow.corners.T for shadow in shadows]
        sun = self._static.sun_shadows if passes.lit else None
        if sun is not None and posed:
            shaded += sun.update(posed)
        clouds = [points for points, draw in zip(projected, drawn, strict=True) if draw]
        touched = image_bounds(clouds, camera)
        rectangle = image_bounds([*clouds, *(ProjectedPoints(points, camera) for points in shaded)], camera)
        target.start(rectangle, layer.depth_buffer, layer.rgba, touched, layer.kept)
        ids, outline = TriangleIds(), None
        if not rectangle.empty:
            self._contact_shadows.draw(shadows, camera)
            if sun is not None and layer.shadow_inputs is not None:
                sun.apply(layer.shadow_inputs, target, camera)
            target.use(passes.lit)
            numbers = [number for number, draw in enumerate(drawn) if draw]
            ids, facing = self._draw(
                posed, projected, numbers, target, rectangle, passes.lit, layer.depth, uncovered
            )
            if passes.outlined and clouds:
                angle = straight_angle(camera, rectangle)
                edges = [
                    contour(posed[number].posed, projected[number], front, angle)
                    for number, front in sorted(facing.items())
                ]
                outline = edge_crossings([part for body in edges for part in body], camera.size)
        wait = target.read_together(("triangle_id", "depth", "rgba")[: 2 + passes.lit], passes.lit)
        alone = None
        if passes.alone:
            labelled = [pair for pair in zip(posed, projected, strict=True) if pair[0].body.instance]
            alone = {body.body.instance: self._alone(body, points) for body, points in labelled}

        def finish() -> RenderedFrame:
            triangle_ids, depth, *colours = wait()
            rgba = colours[0] if passes.lit else None
            instances = tuple(body.instance for body in bodies)
            return RenderedFrame(
                *(passes, instances, camera, layer, touched, rectangle),
                *(ids, triangle_ids, depth, rgba, outline, alone),
            )

        return finish

    def _static_labels(
        self, camera: Camera, passes: Passes, moving_camera: bool, layer: StaticLayer
    ) -> StaticLabels:
        """Labels of the static bodies in a layer, from the cache or new."""
        passes = Passes(lit=False, outlined=True, alone=passes.alone)
        if layer.labels is None or not layer.labels.passes.covers(passes):
            target = self._targets.of(camera.size)
            self._static.draw_unlabelled(target, camera, moving_camera)
            frame = self._render(self._static_bodies, camera, passes, StaticLayer(target, None), (), target)()
            layer.labels = StaticLabels(replace(frame, layer=layer), self._static_bodies)
        return layer.labels

    def _uncovered(
        self, frame: RenderedFrame, bodies: Sequence[Body], camera: Camera, moving_camera: bool
    ) -> NDArray[np.uint8] | None:
        """(H, W) part labels without off-body surfaces. None if no pixel of the frame shows such a
        surface."""
        moving, static = (
            any(body.mesh.off_body is not None for body in each) for each in (bodies, self._static_bodies)
        )
        if not (static or (moving and frame.ids.table("off_body").take(frame.triangle_ids).any())):
            return None
        target, layer = self._targets.of(camera.size), frame.layer
        parts = np.zeros(camera.size[::-1], np.uint8)
        if static:  # the layer shows off-body surfaces of static bodies too
            self._static.draw_unlabelled(target, camera, moving_camera)
            layer, bodies = StaticLayer(target, None), [*bodies, *self._static_bodies]
        elif frame.static_labels is not None:
            parts = frame.static_labels.images(("body_part",))["body_part"]
        drawn = self._render(bodies, camera, Passes(), layer, (), target, uncovered=True)()
        values = drawn.ids.table("part").take(drawn.triangle_ids)
        np.copyto(parts[drawn.rectangle.slices], values, where=drawn.triangle_ids > 0)
        return parts

    def _alone(self, body: PosedBody, projected: ProjectedPoints) -> NDArray[np.bool_]:
        """(H, W) mask of a body without occluders."""
        camera = projected.camera
        mask = np.zeros(camera.size[::-1], bool)
        rectangle = image_bounds([projected], camera)
        if not rectangle.empty:
            target = self._targets.of(camera.size)
            target.start(rectangle)
            target.use(False)
            nothing = np.full(camera.size[::-1], np.inf, np.float32)
            self._draw([body], [projected], [0], target, rectangle, False, nothing)
            mask[rectangle.slices] = target.read("triangle_id", False) > 0
        return mask

    def _draw(
        self,
        bodies: Sequence[PosedBody],
        projected: Sequence[ProjectedPoints],
        numbers: Sequence[int],
        target: RenderTarget,
        rectangle: Rectangle,
        lit: bool,
        behind: Float32Array,
        uncovered: bool = False,
    ) -> tuple[TriangleIds, dict[int, NDArray[np.bool_]]]:
        """Draw those triangles of some bodies that may be visible, each with its own id. Returns the
        triangles that were drawn. And by number of each body that is not hidden, (N,) whether each triangle
        shows its front.

        Args:
            bodies: The bodies of the frame.
            projected: Their vertices in the image.
            numbers: The bodies to draw.
            target: Target that is in use.
            rectangle: Pixels that the bodies may touch.
            lit: Draw colours too.
            behind: (H, W) depth of the static scene, which may hide bodies, metres.
            uncovered: Leave out off-body surfaces.
        """
        ids, facing = TriangleIds(), dict[int, NDArray[np.bool_]]()
        if not numbers:
            return ids, facing
        camera, program = projected[0].camera, self._lit if lit else self._ids
        use_camera(self._ctx, program, camera)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        straight = straight_angle(camera, rectangle)
        # the nearest body first, so that hidden pixels are not shaded
        order = sorted(numbers, key=lambda number: projected[number].closest)
        hidden = HiddenBodies(
            *([projected[number] for number in order], behind),
            *(target.identified, lambda: target.read("depth", lit)),
        )
        for number in order:
            body, points = bodies[number], projected[number]
            if hidden.contains(points):
                continue
            front = facing[number] = body.posed.facing(camera.center)
            set_uniform(program, "first_id", ids.count)
            set_uniform(program, "has_skin_mask", float(body.has_skin_mask))
            # a closed surface never shows its back faces to a camera outside; a near camera may be inside
            visible = np.flatnonzero(front) if body.closed and not points.near else np.arange(len(front))
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
                corners = body.topology.corners
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


#: A number above all triangle ids. Single precision is exact up to this number.
_NONE = float(1 << 24)
#: Texture unit of the triangles that were found. No material uses this unit.
_UNIT = 8


class CoveragePass:
    """Counts covered pixels on the device, also those of hidden triangles. All triangles are drawn together.
    Each draw finds up to four more triangles at each pixel, so that the number of draws depends on the number
    of surfaces behind a pixel."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._program = link(ctx, "triangle_ids.vert", "triangle_layers.frag")

    def count(self, body: PosedBody, mesh: TessellatedMesh, camera: Camera, rectangle: Rectangle) -> Indices:
        """Count the pixels of each triangle of a body.

        Args:
            body: The body.
            mesh: Its triangles as they are drawn.
            camera: Camera that sees it.
            rectangle: Pixels that it may touch.

        Returns:
            (N,) number of pixels of each triangle of the body's mesh.
        """
        pixels = np.zeros(len(mesh.triangles) + 1, np.intp)
        if not rectangle.empty and len(mesh.triangles):
            with TriangleBuffers(self._ctx, mesh.attributes, mesh.triangles) as pieces:
                for lowest, highest in self._layers(body, pieces, len(mesh.triangles), camera, rectangle):
                    pixels += np.bincount(lowest, minlength=len(pixels))
                    pixels += np.bincount(highest[highest != lowest], minlength=len(pixels))
        count = len(body.topology.corners[0])
        return np.bincount(mesh.parents, pixels[1:], count).astype(np.intp)

    def _layers(
        self, body: PosedBody, pieces: TriangleBuffers, count: int, camera: Camera, rectangle: Rectangle
    ) -> Iterator[tuple[Indices, Indices]]:
        """Draw again until all triangles are found. Yields the lowest and highest new ids (M,) at pixels."""
        use_camera(self._ctx, self._program, camera)
        set_uniform(self._program, "none", _NONE)
        set_uniform(self._program, "found", _UNIT)
        with ExitStack() as stack:
            textures = [self._ctx.texture(camera.size, 4, dtype="f4") for _ in range(2)]
            targets = [self._ctx.framebuffer([texture]) for texture in textures]
            for texture, target in zip(textures, targets, strict=True):
                stack.callback(texture.release)
                stack.callback(target.release)
                target.scissor = rectangle.xywh
            before, after = 0, 1
            targets[before].clear(0, -_NONE, 0, -_NONE)
            self._ctx.enable_only(moderngl.BLEND)
            self._ctx.blend_equation = moderngl.MIN, moderngl.MIN
            stack.callback(setattr, self._ctx, "blend_equation", (moderngl.FUNC_ADD, moderngl.FUNC_ADD))
            while True:
                targets[after].use()
                targets[after].clear(_NONE, _NONE, _NONE, _NONE)
                textures[before].use(_UNIT)
                pieces.draw(self._program, [body.material], [count])
                ids = np.frombuffer(
                    targets[after].read(rectangle.xywh, components=4, dtype="f4", alignment=1), np.float32
                ).reshape(-1, 4)
                found = False
                for lowest, highest in (ids[:, :2].T, ids[:, 2:].T):
                    shown = lowest < _NONE
                    if shown.any():
                        found = True
                        yield lowest[shown].astype(np.intp), -highest[shown].astype(np.intp)
                if not found:
                    return
                before, after = after, before


#: Most frames in the cache, most memory, and the number of frames that stay even if they need more memory.
_MAX_FRAMES, _MAX_BYTES, _MIN_FRAMES = 48, 256 << 20, 3

_Entry = tuple[RenderedFrame, tuple["weakref.ref[Body]", ...]]


class FrameCache:
    """The most recently used frames. A frame is dropped when one of its bodies is gone."""

    def __init__(self) -> None:
        self._frames: LruCache[tuple[object, ...], _Entry] = LruCache(
            _MAX_FRAMES, _MAX_BYTES, _MIN_FRAMES, lambda entry: entry[0].nbytes
        )

    def get(self, bodies: Sequence[Body], view: tuple[object, ...]) -> RenderedFrame | None:
        """Return a cached frame of bodies. ``view``: key of the camera and the static scene."""
        entry = self._frames.get(_key(bodies, view))
        if entry is None or any(ref() is not body for ref, body in zip(entry[1], bodies, strict=True)):
            return None
        return entry[0]

    def put(self, bodies: Sequence[Body], view: tuple[object, ...], frame: RenderedFrame) -> RenderedFrame:
        """Put a frame into the cache. The arguments are those of :meth:`get`."""
        key, frames = _key(bodies, view), self._frames
        frames.put(key, (frame, tuple(weakref.ref(body, lambda _: frames.discard(key)) for body in bodies)))
        return frame


def _key(bodies: Sequence[Body], view: tuple[object, ...]) -> tuple[object, ...]:
    return (*(id(body) for body in bodies), *view)


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
        static_meshes: Meshes of the static scene, in ``map``, metres.
        lighting: Light. If None, the default light.
        device: Number of the GPU in the order of EGL. If None, the first one that works.
        static_bodies: Bodies that never move. They are rendered with the static scene, once per camera.

    Raises:
        RenderError: A library or the device is missing. The message says what to install.
    """
    if name == "pyrender":
        from humansim_ros.render.frame.pyrender import PyrenderRenderer

        return PyrenderRenderer(static_meshes, lighting, device, static_bodies)
    return GLRenderer(static_meshes, lighting, device, static_bodies)
