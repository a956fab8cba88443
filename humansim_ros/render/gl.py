"""The default renderer: OpenGL 3.3 through EGL, without a display; a GPU is used where there is one.

The static scene is drawn once per camera and kept. Each frame redraws only the rectangle that the bodies can
touch, in one pass, with one sample at each pixel's centre: colour, depth, and the triangle's number, which
all labels follow from. The outlines of the bodies are anti-aliased afterwards (outline.py). Triangles that
cannot show are not sent at all.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.mesh import Mesh
from humansim_ros.camera import Camera
from humansim_ros.render.context import create_context, current
from humansim_ros.render.detail import Detail, Shown, optical_flow, ray_grid
from humansim_ros.render.light import Lighting
from humansim_ros.render.outline import blend, crossings
from humansim_ros.render.posed import Floats, Posed, Topology
from humansim_ros.render.refine import NEAR, TOLERANCE, VISIBLE, LensView, Refined, nearest
from humansim_ros.render.renderer import (
    CHANNELS,
    FLOWS,
    Backdrop,
    Body,
    Neighbour,
    View,
    check_neighbours,
    check_request,
)
from humansim_ros.render.shadow import CELLS, REACH, ContactShadow
from humansim_ros.render.still import Expanded, Pieces, StillScene, texture
from humansim_ros.render.sun import MOVING_SIDE, STILL_SIDE, SunMap, encloses, shadow_ends, spread
from humansim_ros.render.uniforms import columns, set_uniform
from humansim_ros.rotations import Array

_SHADERS = Path(__file__).parent / "shaders"
_FAR = 200.0
#: OpenGL's name for cutting off what the lens does not see.
_CLIP_DISTANCE = 0x3000
#: The static scene is drawn this many times finer and averaged: it is drawn once, so quality costs nothing.
_STATIC_SUPERSAMPLING = 4
_MAX_STATIC_SIDE = 8192
#: The same for a camera that is elsewhere in the next frame.
_PASSING_SUPERSAMPLING = 2
#: Bytes of depth that are kept for the flow of the next frame.
_MOST_DEPTHS = 128 << 20
#: Cameras whose static scene is kept.
_MAX_LAYERS = 32
#: Pieces along a side of a shadow that a lens may bend.
_SHADOW_GRID = 32
#: What a target is made of: the shaders' location, components read back, their type.
_ATTACHMENTS = {"depth": (0, 1, "f4"), "label": (1, 1, "u4"), "rgb": (2, 3, "f1"), "rgba": (2, 4, "f1")}


class GLRenderer:
    """Renders bodies in a static scene of meshes (world coordinates), with an OpenGL context of its own.

    Use it from one thread. Raises RenderError, naming the system packages, where no OpenGL can be had.
    """

    def __init__(
        self, static: Sequence[Mesh] = (), lighting: Lighting | None = None, device: int | None = None
    ) -> None:
        self._lighting = lighting or Lighting()
        self._ctx = create_context(device)
        self._ctx.front_face = (
            "cw"  # the image's rows run down where OpenGL's run up: everything is mirrored once
        )
        self._still = StillScene(self._ctx, tuple(static))
        self._topologies: dict[int, Topology] = {}
        self._surfaces: dict[tuple[int, int], _Surface] = {}
        self._targets: dict[tuple[int, int], _Target] = {}
        self._layers: dict[bytes, _StaticLayer] = {}
        self._passing: _StaticLayer | None = None
        self._depths: dict[tuple[tuple[int, ...], bytes], tuple[Sequence[Body], Floats]] = {}
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
        self._lit = self._program("lit.vert", "lit.frag", (*looks, "STILL", "MOVING") if soft else looks)
        self._lit_still = self._program("lit.vert", "lit.frag", (*looks, "STILL")) if soft else self._lit
        self._truth = self._program("truth.vert", "truth.frag")
        self._shadow = self._program("shadow.vert", "shadow.frag")
        self._shadow_quad, self._shadow_grid = (
            self._ctx.vertex_array(self._shadow, [(self._ctx.buffer(_unit_square(cells)), "2f", "corner")])
            for cells in (1, _SHADOW_GRID)
        )
        self._shadow_texture = self._ctx.texture((CELLS, CELLS), 1, alignment=1)
        self._shine(self._lit)
        self._shine(self._lit_still)
        self._sunless = self._program("lit.vert", "lit.frag", looks) if soft else self._lit
        if soft:
            self._shine(self._sunless, sun=False)
        self._sunlight = None
        if soft:
            self._sunlight = _Sunlight(self._ctx, self._still, light, (self._lit, self._lit_still))

    def _shine(self, program: moderngl.Program, sun: bool = True) -> None:
        """Light what a program draws, with the sun or without."""
        light = self._lighting
        set_uniform(program, "sun", tuple(light.direction))
        set_uniform(program, "sun_color", light.brightness(light.sun_color) if sun else (0.0, 0.0, 0.0))
        set_uniform(program, "sky_color", light.brightness(light.sky_color))
        set_uniform(program, "ground_color", light.brightness(light.ground_color))

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
        passing: bool = False,
        after: Neighbour | None = None,
        before: Neighbour | None = None,
        backdrop: Backdrop | None = None,
    ) -> View:
        """See :class:`humansim_ros.render.Renderer`.

        What was worked out of a body for one camera serves the next, as long as it is the same Body object.
        """
        moments = {"after": after, "before": before}
        check_request(bodies, channels)
        check_neighbours(bodies, channels, moments)
        with current(self._ctx):
            hidden = [moments[FLOWS[c]] for c in channels if c.endswith("_hidden")]
            depths = {id(m): self._depth_at(m, passing, backdrop) for m in hidden if m is not None}
            return self._render(bodies, camera, frozenset(channels), passing, moments, depths, backdrop)

    def _depth_at(self, moment: Neighbour, passing: bool, backdrop: Backdrop | None) -> Floats:
        """(H, W) depth of a neighbouring frame, drawn now unless it has been."""
        key = _frame_key(moment.bodies, moment.camera)
        if key not in self._depths:
            view = self._render(
                moment.bodies, moment.camera, frozenset({"depth"}), passing, backdrop=backdrop
            )
            assert view.depth is not None
            self._keep_depth(moment.bodies, moment.camera, view.depth)
        return self._depths[key][1]

    def _keep_depth(self, bodies: Sequence[Body], camera: Camera, depth: Floats) -> None:
        """Keep the depth of a frame for those beside it, and its bodies, so that their ids stay their own."""
        self._depths[_frame_key(bodies, camera)] = tuple(bodies), depth
        while len(self._depths) > 2 and len(self._depths) * depth.nbytes > _MOST_DEPTHS:
            self._depths.pop(next(iter(self._depths)))

    def _render(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        channels: frozenset[str],
        passing: bool,
        moments: Mapping[str, Neighbour | None] = MappingProxyType({}),
        depths: Mapping[int, Floats | None] = MappingProxyType({}),
        backdrop: Backdrop | None = None,
    ) -> View:
        layer = self._layer(camera, passing, backdrop)
        lit = bool(channels & {"rgb", "shadow"})
        flows = [which for which in ("after", "before") if any(FLOWS.get(c) == which for c in channels)]
        outlined = bool(channels & {"rgb", "alpha"})
        surfaces = [self._surface(body) for body in bodies]
        clouds = [surface.posed.points for surface in surfaces]
        shadows = (
            [surface.shadow for surface in surfaces if surface.near_floor] if lit and self._contact else []
        )
        clouds += [shadow.corners.T for shadow in shadows]
        sunlight = self._sunlight if lit else None
        if sunlight is not None and surfaces:
            clouds += sunlight.shine_on(surfaces)
        rectangle = _touched(clouds, camera)
        view: dict[str, Any] = layer.view(channels | {"depth"} if outlined or flows else channels)
        shown = Shown(*(np.zeros(0, np.intp) for _ in range(3)))
        if "alpha" in channels:
            view["alpha"] = {
                b.instance: np.zeros(view["depth"].shape, np.uint8) for b in bodies if b.instance
            }
        if not rectangle.empty:
            target = self._target(camera.size)
            target.start(layer.target, rectangle)
            if shadows:
                self._draw_shadows(shadows, camera)
            if sunlight is not None:
                sunlight.shade(layer, target, camera)
            target.use(lit)
            seen = self._draw_bodies(surfaces, camera, rectangle, lit, outlined)
            if "depth" in view:
                depth = target.read("depth", lit)
                np.copyto(view["depth"][rectangle.slices], depth, where=depth > 0)
            if "shadow" in channels:
                rgba = target.read("rgba", lit)
                view["shadow"][rectangle.slices] = 255 - rgba[..., 3]
                if "rgb" in channels:
                    view["rgb"][rectangle.slices] = rgba[..., :3]
            elif lit:
                view["rgb"][rectangle.slices] = target.read("rgb", lit)
            if channels - {"rgb", "depth", "amodal", "shadow"}:
                labels = target.read("label", lit)
                for name in channels & {"instance", "part", "face"}:
                    view[name][rectangle.slices] = seen.table(name)[labels]
                if channels & {"normal", "uv"} or flows:
                    shown = seen.shown(labels, rectangle, camera.size)
                if "alpha" in channels:
                    instances = seen.table("instance")[labels]
                    for instance, alpha in view["alpha"].items():
                        alpha[rectangle.slices] = np.where(instances == instance, 255, 0)
            if outlined:
                outline = crossings(camera, *seen.outline)
                images = [view["rgb"]] if "rgb" in channels else []
                blend([*images, *view.get("alpha", {}).values()], view["depth"], outline)
        if channels & {"normal", "uv"} or flows:
            self._add_detail(view, Detail(camera, bodies, shown), channels, flows, moments, depths)
        if "flow_back_hidden" in channels or "flow_hidden" in channels:
            self._keep_depth(bodies, camera, view["depth"].copy())  # the caller's own may be changed
        if "amodal" in channels:
            view["amodal"] = {b.instance: self._alone(b, camera) for b in bodies if b.instance}
        return View(**{name: view[name] for name in channels})

    def _add_detail(
        self,
        view: dict[str, Any],
        detail: Detail,
        channels: frozenset[str],
        flows: Sequence[str],
        moments: Mapping[str, Neighbour | None],
        depths: Mapping[int, Floats | None],
    ) -> None:
        """Fill in what follows from the triangles that are shown."""
        pixels = detail.shown.pixels
        if "normal" in channels:
            view["normal"].reshape(-1, 3)[pixels] = detail.normals()
        if "uv" in channels:
            view["uv"].reshape(-1, 2)[pixels] = detail.texture_coordinates()
        for which in flows:
            moment = moments[which]
            assert moment is not None
            name = "flow" if which == "after" else "flow_back"
            flow = optical_flow(detail.camera, detail, view["depth"], moment, depths.get(id(moment)))
            view[name], view[f"{name}_hidden"] = flow.flow, flow.hidden

    def _alone(self, body: Body, camera: Camera) -> NDArray[np.bool_]:
        """(H, W) where a body would be seen if nothing were before it."""
        mask = np.zeros(camera.size[::-1], bool)
        surface = self._surface(body)
        rectangle = _touched([surface.posed.points], camera)
        if not rectangle.empty:
            target = self._target(camera.size)
            target.start(None, rectangle)
            target.use(False)
            self._draw_bodies([surface], camera, rectangle, False, False)
            mask[rectangle.slices] = target.read("label", False) > 0
        return mask

    def _draw_bodies(
        self,
        surfaces: Sequence[_Surface],
        camera: Camera,
        rectangle: _Rectangle,
        lit: bool,
        outlined: bool,
    ) -> _Seen:
        """Draw what can be seen, every triangle with a number of its own, counted on from body to body."""
        program = self._lit if lit else self._truth
        self._use_camera(program, camera)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        eye = camera.center
        seen = _Seen()
        # edges that are seen under less a lens does not bend visibly
        straight = LensView(camera).straight_angle(rectangle.low, rectangle.high) if camera.distorted else 0.0
        for number, surface in enumerate(surfaces):
            facing = surface.posed.facing(eye)
            # from outside a closed surface its back faces never show; a camera that is near may be inside
            culled = surface.topology.mesh.closed and not rectangle.near
            set_uniform(program, "first_label", seen.count)
            refined = surface.refined(camera, straight) if camera.distorted else None
            if refined is None:
                surface.draw(lit, facing if culled else None)
                seen.add(number, surface.body, np.flatnonzero(facing) if culled else slice(None))
            else:
                surface.draw_refined(program, refined)
                seen.add(number, surface.body, refined.parents)
            if outlined:
                contour = surface.posed.contour(facing)
                seen.outlines.append(_straight(contour, camera, straight) if camera.distorted else contour)
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
        self._use_camera(self._shadow, camera)
        square = self._shadow_grid if camera.distorted else self._shadow_quad
        for shadow in shadows:
            self._shadow_texture.write(shadow.darkness.tobytes())
            self._shadow_texture.use(0)
            set_uniform(self._shadow, "place", (*shadow.corner, shadow.side, shadow.side))
            square.render(moderngl.TRIANGLES)

    def _use_camera(self, program: moderngl.Program, camera: Camera) -> None:
        set_uniform(program, "optical_z", (*camera.R[2], camera.t[2]))
        near = nearest(camera)
        clip = camera.opengl_clip(near, _FAR)
        if not camera.distorted:
            set_uniform(program, "lens", 0)
            set_uniform(program, "clip", columns(clip @ camera.optical_from_world))
            self._ctx.disable_direct(_CLIP_DISTANCE)
            return
        lens = camera.lens
        set_uniform(program, "lens", 2 if lens.model == "equidistant" else 1)
        set_uniform(program, "clip", columns(clip))
        set_uniform(program, "optical", columns(camera.optical_from_world))
        set_uniform(program, "k", np.array((*lens.coefficients, *[0.0] * 8)[:8], dtype="f4").tobytes())
        set_uniform(program, "reach", lens.valid_radius)
        set_uniform(program, "nearest", near)
        self._ctx.enable_direct(_CLIP_DISTANCE)

    def _surface(self, body: Body) -> _Surface:
        """The body on the device, standing as it should. Two bodies may share a mesh, but not a surface."""
        key = id(body.mesh), body.instance
        if key in self._surfaces:
            self._surfaces[key].stand(body)
        else:
            # kept with its mesh, so that the id stays its own
            topology = self._topologies.setdefault(id(body.mesh), Topology(body.mesh))
            self._surfaces[key] = _Surface(self._ctx, topology, body, self._lit, self._truth)
        return self._surfaces[key]

    def _target(self, size: tuple[int, int]) -> _Target:
        if size not in self._targets:
            self._targets[size] = _Target(self._ctx, size)
        return self._targets[size]

    @cached_property
    def _contact(self) -> bool:
        """Whether bodies leave shadows under them: there is a floor that these can lie on."""
        return self._lighting.shadow == "contact" and self._still.has_floor

    def _layer(self, camera: Camera, passing: bool, backdrop: Backdrop | None) -> _StaticLayer:
        if passing:
            if self._passing is not None:
                self._passing.release()
            self._passing = self._draw_static(camera, _PASSING_SUPERSAMPLING, VISIBLE, backdrop)
            return self._passing
        key = _camera_key(camera) + str(id(backdrop)).encode()
        if key not in self._layers:
            if len(self._layers) >= _MAX_LAYERS:
                self._layers.pop(next(iter(self._layers))).release()
            self._layers[key] = self._draw_static(camera, _STATIC_SUPERSAMPLING, TOLERANCE, backdrop)
        return self._layers[key]

    def _draw_static(
        self, camera: Camera, supersampling: int, tolerance: float, backdrop: Backdrop | None
    ) -> _StaticLayer:
        width, height = camera.size
        factor = max(1, min(supersampling, _MAX_STATIC_SIDE // max(width, height)))
        # the same window, only finer: clip coordinates do not know how many pixels there are
        fine = self._target((width * factor, height * factor))
        target = _Target(self._ctx, camera.size)
        behind = None if backdrop is None else backdrop.picture(camera)
        with self._still.seen_by(camera, tolerance) as still:

            def draw(into: _Target, program: moderngl.Program) -> None:
                into.clear(self._lighting.background if behind is None else (0, 0, 0))
                into.use(program is not self._truth)
                self._ctx.enable_only(moderngl.DEPTH_TEST)
                self._use_camera(program, camera)
                still.draw(program)

            draw(fine, self._lit_still)
            rgb = self._averaged(fine, camera, behind)
            sunny, sunless = None, None
            if self._sunlight is not None:
                sunny = cv2.resize(fine.read("rgba", lit=True), camera.size, interpolation=cv2.INTER_AREA)
                draw(fine, self._sunless)
                sunless = self._averaged(fine, camera, behind)
            draw(target, self._truth)
        target.take(rgb, None if sunny is None else np.asarray(sunny[..., 3], dtype=np.uint8))
        shades = None if sunless is None else _Shades(self._ctx, camera, sunless)
        return _StaticLayer(target, backdrop, shades)

    def _averaged(self, fine: _Target, camera: Camera, behind: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
        """A picture (H, W, 3) of one that is drawn finer, before what is behind it."""
        rgb = cv2.resize(fine.read("rgb", lit=True), camera.size, interpolation=cv2.INTER_AREA)
        if behind is not None:
            empty = np.where(fine.read("depth", lit=True) > 0, np.uint8(0), np.uint8(255))
            share = cv2.resize(empty, camera.size, interpolation=cv2.INTER_AREA)[..., None] / 255
            rgb = np.rint(rgb + share * behind)
        if camera.distorted and LensView(camera).partly_dark:
            rgb = np.where(_lit_pixels(camera)[..., None], rgb, 0)
        return np.ascontiguousarray(rgb, dtype=np.uint8)

    def _program(self, vertex: str, fragment: str, switches: Sequence[str] = ()) -> moderngl.Program:
        """``switches``: names that are defined in both shaders."""
        lit = fragment == "lit.frag"
        before = [*(["develop.glsl"] if lit else []), *(["sunshine.glsl"] if "STILL" in switches else [])]
        return self._ctx.program(
            vertex_shader=_shader(["lens.glsl", vertex], switches),
            fragment_shader=_shader([*before, fragment], switches),
        )


def _shader(files: Sequence[str], switches: Sequence[str] = ()) -> str:
    """Files put together as one shader."""
    head = "#version 330\n"
    texts = [(_SHADERS / file).read_text().removeprefix(head) for file in files]
    return "".join([head, *(f"#define {name}\n" for name in switches), *texts])


def _camera_key(camera: Camera) -> bytes:
    """The same for cameras that see the same."""
    numbers = (np.array(camera.size), camera.K, camera.R, camera.t, np.array(camera.distortion))
    return b"".join((*(n.tobytes() for n in numbers), str(camera.model).encode()))


def _frame_key(bodies: Sequence[Body], camera: Camera) -> tuple[tuple[int, ...], bytes]:
    """The same for what is the same before the same camera."""
    return tuple(id(body) for body in bodies), _camera_key(camera)


@dataclass(frozen=True)
class _Rectangle:
    """Pixels x0 <= x < x1, y0 <= y < y1."""

    x0: int
    y0: int
    x1: int
    y1: int
    #: a surface comes so near that the camera may be inside it
    near: bool = False

    @property
    def empty(self) -> bool:
        return self.x1 <= self.x0 or self.y1 <= self.y0

    @property
    def low(self) -> tuple[int, int]:
        return self.x0, self.y0

    @property
    def high(self) -> tuple[int, int]:
        return self.x1, self.y1

    @property
    def xywh(self) -> tuple[int, int, int, int]:
        return self.x0, self.y0, self.x1 - self.x0, self.y1 - self.y0

    @property
    def shape(self) -> tuple[int, int]:
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.y0, self.y1), slice(self.x0, self.x1)


def _touched(clouds: Sequence[Floats], camera: Camera) -> _Rectangle:
    """The pixels that surfaces spanned by points (3, N) can touch: the whole image if one comes too near."""
    width, height = camera.size
    view = LensView(camera) if camera.distorted else None
    p = (camera.P if view is None else camera.optical_from_world[:3]).astype(np.float32)
    low: Array = np.full(2, np.inf)
    high: Array = np.full(2, -np.inf)
    for points in clouds:
        x, y, depth = p[:, :3] @ points + p[:, 3:]
        if depth.min() < 2 * NEAR:
            if depth.max() < 0:
                continue
            return _Rectangle(0, 0, width, height, near=True)
        x /= depth
        y /= depth
        low, high = np.minimum(low, (x.min(), y.min())), np.maximum(high, (x.max(), y.max()))
    if view is not None:
        low, high = view.image_of(low, high)
    if not np.isfinite(low).all():
        return _Rectangle(0, 0, 0, 0)
    x0, y0 = np.clip(np.floor(low) - 2, 0, camera.size).astype(int)
    x1, y1 = np.clip(np.ceil(high) + 3, 0, camera.size).astype(int)
    return _Rectangle(int(x0), int(y0), int(x1), int(y1))


def _straight(edges: tuple[Floats, Floats], camera: Camera, angle: float) -> tuple[Floats, Floats]:
    """Starts and ends (N, 3) of edges, those that are seen under more than an angle cut as a lens bends
    them.
    """
    starts, ends = edges
    long = _wide(starts, ends, camera, angle)
    if not long.any():
        return edges
    first, second = LensView(camera).divide_edges(starts[long], ends[long])
    return np.concatenate([starts[~long], first]), np.concatenate([ends[~long], second])


def _wide(starts: Floats, ends: Floats, camera: Camera, angle: float) -> NDArray[np.bool_]:
    """Which edges (N, 3) may be seen under more than an angle, radians."""
    eye = camera.center.astype(np.float32)
    nearest = np.minimum(_squares(starts - eye), _squares(ends - eye))
    return np.asarray(_squares(ends - starts) > angle * angle * nearest)


def _squares(vectors: Floats) -> Floats:
    """(N,) squared lengths."""
    return np.asarray(np.einsum("ij,ij->i", vectors, vectors))


def _unit_square(cells: int) -> bytes:
    """Corners of the triangles of a square of so many cells a side."""
    low = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 1, 2)
    corners = low + np.array([(0, 0), (1, 0), (0, 1), (0, 1), (1, 0), (1, 1)])
    return bytes((corners / cells).astype("f4").tobytes())


def _lit_pixels(camera: Camera) -> NDArray[np.bool_]:
    """(H, W) which pixels the lens does not leave dark."""
    return np.asarray(np.isfinite(ray_grid(camera)[..., 0]))


class _Seen:
    """The triangles drawn of one picture's bodies: label 0 is no body, label n the n-th triangle drawn."""

    def __init__(self) -> None:
        self.count = 1
        self.outlines: list[tuple[Floats, Floats]] = []
        self._drawn: list[tuple[int, Body, NDArray[np.intp] | slice]] = []

    def add(self, number: int, body: Body, drawn: NDArray[np.intp] | slice) -> None:
        """The triangles ``drawn`` of the body of a number."""
        self.count += len(body.parts[drawn])
        self._drawn.append((number, body, drawn))

    def table(self, channel: str) -> NDArray[Any]:
        """What each label is in a channel, or as ``owner`` and ``triangle``."""
        make: dict[str, Callable[[int, Body, Any], NDArray[Any]]] = {
            "instance": lambda _, body, drawn: np.full(len(body.parts[drawn]), body.instance, np.uint16),
            "part": lambda _, body, drawn: body.parts[drawn],
            "owner": lambda number, body, drawn: np.full(len(body.parts[drawn]), number, np.intp),
            "triangle": lambda _, body, drawn: np.arange(len(body.parts), dtype=np.intp)[drawn],
            "face": lambda _, body, drawn: (
                np.arange(1, len(body.parts) + 1, dtype=np.int32)[drawn] * np.int32(body.instance > 0)
            ),
        }
        kind = {"instance": np.uint16, "part": np.uint8, "face": np.int32}.get(channel, np.intp)
        return np.concatenate([np.zeros(1, kind), *(make[channel](*one) for one in self._drawn)])

    def shown(self, labels: NDArray[np.uint32], rectangle: _Rectangle, size: tuple[int, int]) -> Shown:
        """Which triangles the pixels of a rectangle show, from their labels."""
        row, column = np.nonzero(labels)
        label = labels[row, column]
        pixels = (row + rectangle.y0) * size[0] + column + rectangle.x0
        return Shown(pixels, self.table("owner")[label], self.table("triangle")[label])

    @property
    def outline(self) -> tuple[Floats, Floats]:
        """Starts and ends (N, 3) of all edges that outlines lie on."""
        starts, ends = zip(*self.outlines, strict=True)
        return np.concatenate(starts), np.concatenate(ends)


class _Target:
    """What one picture is drawn into: colour, depth in metres, triangle number; and OpenGL's depth buffer.

    Without ``lit`` the colour is left out. Where nothing was drawn depth and number are 0.
    """

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int]) -> None:
        self._ctx = ctx
        self._textures = [
            ctx.texture(size, 1, dtype="f4"),
            ctx.texture(size, 1, dtype="u4"),
            ctx.texture(size, 4),
        ]
        self._buffer = ctx.depth_renderbuffer(size)
        self._framebuffers = {
            lit: ctx.framebuffer(self._textures[: 2 + lit], self._buffer) for lit in (False, True)
        }
        self._colour = ctx.framebuffer(self._textures[2:], self._buffer)
        self._colour.depth_mask = False  # shadows colour what is there, they hide nothing
        self._rectangle = _Rectangle(0, 0, *size)

    def start(self, background: _Target | None, rectangle: _Rectangle) -> None:
        """Keep to a rectangle, and fill it with the colour of a background that hides what is behind it."""
        self._rectangle = rectangle
        for framebuffer in (*self._framebuffers.values(), self._colour):
            framebuffer.scissor = rectangle.xywh
        self._clear()  # cheaper than to copy these as well
        if background is None:
            return
        # all of it: with a scissor Mesa would not copy but draw, at several times the cost
        self._colour.scissor = None  # type: ignore[assignment]
        self._colour.use()
        self._ctx.copy_framebuffer(self._colour, background._colour)
        self._colour.scissor = rectangle.xywh
        self._colour.use()

    def clear(self, colour: Sequence[int]) -> None:
        """Start anew: nothing there but a colour, endlessly far away."""
        self._clear()
        red, green, blue = (c / 255 for c in colour)
        self._colour.clear(red, green, blue, 1.0)

    def take(self, rgb: NDArray[np.uint8], alpha: NDArray[np.uint8] | None = None) -> None:
        """Take over a picture (H, W, 3), and what its alpha (H, W) is if not 255."""
        last = np.full(rgb.shape[:2], 255, np.uint8) if alpha is None else alpha
        self._textures[2].write(np.dstack([rgb, last]).tobytes())

    @property
    def depth(self) -> moderngl.Texture:
        return self._textures[0]

    @property
    def colour(self) -> moderngl.Texture:
        return self._textures[2]

    def use_colour(self) -> None:
        """Draw colour alone."""
        self._colour.use()

    def _clear(self) -> None:
        self._framebuffers[False].use()  # or the scissor of what was in use would count
        self._framebuffers[False].clear()

    def use(self, lit: bool) -> None:
        self._framebuffers[lit].use()

    def read(self, name: str, lit: bool) -> NDArray[Any]:
        """The rectangle's pixels (H, W) or (H, W, 3)."""
        attachment, components, dtype = _ATTACHMENTS[name]
        pixels = self._framebuffers[lit].read(
            self._rectangle.xywh, components=components, attachment=attachment, dtype=dtype, alignment=1
        )
        image = np.frombuffer(pixels, np.uint8 if dtype == "f1" else dtype)
        return image.reshape(*self._rectangle.shape, *(() if components == 1 else (components,)))

    def release(self) -> None:
        for framebuffer in (*self._framebuffers.values(), self._colour):
            framebuffer.release()
        for attachment in self._textures:
            attachment.release()
        self._buffer.release()


class _StaticLayer:
    """The static scene as one camera sees it, kept on the device and as arrays."""

    def __init__(self, target: _Target, backdrop: Backdrop | None, shades: _Shades | None) -> None:
        self.target, self.shades = target, shades
        self._backdrop = backdrop  # kept, so that its id stays its own
        self._rgb, depth = (target.read(name, lit=True) for name in ("rgb", "depth"))
        self._depth = np.where(depth > 0, depth, np.float32(np.inf))

    def view(self, channels: Collection[str]) -> dict[str, NDArray[Any]]:
        """The channels of a picture without bodies, to be drawn into."""
        shape = self._depth.shape
        make: dict[str, Callable[[], NDArray[Any]]] = {
            "rgb": self._rgb.copy,
            "depth": self._depth.copy,
            "instance": lambda: np.zeros(shape, np.uint16),
            "part": lambda: np.zeros(shape, np.uint8),
            "face": lambda: np.zeros(shape, np.int32),
            "normal": lambda: np.zeros((*shape, 3), np.float32),
            "uv": lambda: np.full((*shape, 2), np.nan, np.float32),
            "shadow": lambda: np.zeros(shape, np.uint8),
        }
        return {name: make[name]() for name in channels if name in make}

    def release(self) -> None:
        self.target.release()
        if self.shades is not None:
            self.shades.release()


class _Shades:
    """What a still scene looks like in the shade: as one camera sees it without the sun, and the rays it
    sees along.
    """

    def __init__(self, ctx: moderngl.Context, camera: Camera, sunless: NDArray[np.uint8]) -> None:
        rays = np.nan_to_num(ray_grid(camera)[..., :2]).astype("f4")
        self.sunless = ctx.texture(camera.size, 3, sunless.tobytes(), alignment=1)
        self.rays = ctx.texture(camera.size, 2, np.ascontiguousarray(rays).tobytes(), dtype="f4")

    def release(self) -> None:
        self.sunless.release()
        self.rays.release()


class _Sunlight:
    """The soft shadows of a renderer's scene."""

    def __init__(
        self, ctx: moderngl.Context, still: StillScene, lighting: Lighting, lit: Sequence[moderngl.Program]
    ) -> None:
        self._ctx, self._lighting, self._box = ctx, lighting, still.box
        self._depths = ctx.program(vertex_shader=_shader(["sun.vert"]), fragment_shader=_shader(["sun.frag"]))
        self._cast = ctx.program(
            vertex_shader=_shader(["whole.vert"]), fragment_shader=_shader(["sunshine.glsl", "cast.frag"])
        )
        self._whole = ctx.vertex_array(self._cast, [(ctx.buffer(_unit_square(1)), "2f", "corner")])
        for unit, name in enumerate(("sunny", "sunless", "depths", "rays"), 5):
            set_uniform(self._cast, name, unit)
        self._programs = (*lit, self._cast)
        for program in self._programs:
            set_uniform(program, "spread", spread(lighting))
        self._still, self._moving = SunMap(ctx, "still", STILL_SIDE), SunMap(ctx, "moving", MOVING_SIDE)
        self._bodies: list[Body] = []
        self._ends: list[Floats] = []
        if self._box is not None:
            with still.facing(lighting.direction) as facing:
                self._still.draw(
                    self._box, lighting.direction, self._depths, lambda: facing.draw_alone(self._depths)
                )
        for program in self._programs:
            self._still.use(program)
            self._moving.use(program)

    def shine_on(self, surfaces: Sequence[_Surface]) -> list[Floats]:
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

    def shade(self, layer: _StaticLayer, target: _Target, camera: Camera) -> None:
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


class _Surface:
    """A mesh on the device. Vertices on texture seams are there twice, once per texture coordinate."""

    def __init__(
        self,
        ctx: moderngl.Context,
        topology: Topology,
        body: Body,
        lit: moderngl.Program,
        truth: moderngl.Program,
    ) -> None:
        self._ctx = ctx
        self.topology = topology
        mesh = topology.mesh
        self._expanded = Expanded(mesh)
        self._source, self._corners = self._expanded.source, self._expanded.corners
        looks = self._expanded.looks
        self._texture = texture(ctx, mesh.texture)
        self._positions, self._normals = (ctx.buffer(reserve=len(looks) * 12, dynamic=True) for _ in range(2))
        self._looks = ctx.buffer(looks.tobytes())
        self._index = ctx.buffer(self._corners.tobytes(), dynamic=True)
        self._lit = ctx.vertex_array(
            lit,
            [
                (self._positions, "3f", "position"),
                # (without light nobody asks for them)
                *([(self._normals, "3f", "normal")] if "normal" in lit else []),
                (self._looks, "2f 3f", "uv", "color"),
            ],
            index_buffer=self._index,
        )
        self._truth = ctx.vertex_array(truth, [(self._positions, "3f", "position")], index_buffer=self._index)
        self._depths: moderngl.VertexArray | None = None
        self._pose(body)

    @property
    def near_floor(self) -> bool:
        """Whether it may leave a shadow under it."""
        return self.body.instance > 0 or float(self.posed.points[2].min()) < REACH

    @property
    def shadow(self) -> ContactShadow:
        """What it leaves on the floor."""
        return self.posed.shadow if self.body.instance else self.posed.shadow_of_thing

    def stand(self, body: Body) -> None:
        """Take up the body's pose."""
        if body is not self.body:
            self._pose(body)

    def _pose(self, body: Body) -> None:
        self.body, self.posed = body, Posed(self.topology, body.vertices)
        self._upload(self._positions, body.vertices)
        self._normals_of: Posed | None = None

    def draw(self, lit: bool, shown: NDArray[np.bool_] | None = None) -> None:
        """Draw all triangles, or those that are ``shown`` (N,)."""
        if lit and self._normals_of is not self.posed:
            self._upload(self._normals, self.posed.normals)
            self._normals_of = self.posed
        # (taking rows by number is several times faster than by a mask)
        corners = self._corners if shown is None else self._corners.take(np.flatnonzero(shown), axis=0)
        self._index.orphan()
        self._index.write(corners)
        self._texture.use(0)
        (self._lit if lit else self._truth).render(moderngl.TRIANGLES, vertices=corners.size)

    def draw_depths(self, program: moderngl.Program) -> None:
        """Draw all triangles with a program that needs their places alone, always the same one."""
        if self._depths is None:
            index = self._ctx.buffer(self._corners.tobytes())
            self._depths = self._ctx.vertex_array(
                program, [(self._positions, "3f", "position")], index_buffer=index
            )
        self._depths.render(moderngl.TRIANGLES)

    def refined(self, camera: Camera, angle: float) -> Refined | None:
        """What is to be drawn where a lens bends edges, which are seen under more than an angle, visibly; or
        None.
        """
        away = self.posed.points - camera.center.astype(np.float32)[:, None]
        nearest = float(np.sqrt(np.einsum("ij,ij->j", away, away).min()))
        vertices = self.posed.vertices
        starts, ends = (vertices[which] for which in self.topology.edges_longer(angle * nearest).T)
        wide = _wide(starts, ends, camera, angle)
        view = LensView(camera)
        if not view.bent(camera.to_optical(starts[wide]), camera.to_optical(ends[wide])).any():
            return None
        return view.refine(self._expanded.attributes(self.posed).astype(float), self._corners.astype(np.intp))

    def draw_refined(self, program: moderngl.Program, refined: Refined) -> None:
        """Draw triangles cut to pieces."""
        with Pieces(self._ctx, refined.attributes, refined.triangles) as pieces:
            pieces.draw(program, [self._texture], [len(refined.triangles)])

    def _upload(self, buffer: moderngl.Buffer, values: Floats) -> None:
        buffer.orphan()
        buffer.write(values.take(self._source, axis=0))
