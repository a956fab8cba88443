"""Cached images of the static scene, one per camera and backdrop.

The colours of a still camera are the mean of images that are shifted by fractions of a pixel, so that they
need no more memory than one image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.caches import LruCache
from humansim_ros.render.edge_antialiasing import mix
from humansim_ros.render.lens_tessellation import TOLERANCE, VISIBLE, LensView
from humansim_ros.render.light_map import UNIT, LightMap
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.pixel_geometry import ray_grid
from humansim_ros.render.programs import lit_program, set_uniform, use_camera
from humansim_ros.render.rendered_frame import StaticLayer
from humansim_ros.render.renderer import Backdrop, Body
from humansim_ros.render.static_scene import StaticScene, StaticTriangles
from humansim_ros.render.sun_shadows import ShadowInputs, SunShadows
from humansim_ros.render.target import RenderTarget
from humansim_ros.types import Image

#: Shifted images of a still camera, which are averaged: a number of Fibonacci spreads them best. And of a
#: moving camera if surfaces are transparent, or if the image is so small (pixels along its longer side) that
#: much of a room is narrower than a pixel.
_OFFSETS, _MOVING_OFFSETS, _SMALL = 13, 4, 128
#: Largest side of images through a lens that are drawn twice as large with a quarter of the offsets: a lens
#: makes so many triangles that the number of draws matters.
_MAX_LENS_SIDE = 1024
#: Mip levels by which the textures of the single image of a moving camera are finer than usual.
_MOVING_MIP_BIAS = -1.0
#: Largest number of cached images.
_MAX_LAYERS = 32
#: Blending of transparent surfaces; alpha stays.
_BLENDING = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ZERO, moderngl.ONE)


class _View(NamedTuple):
    """The triangles of the scene for a camera, and a target of its size.

    ``single``: one image shows colours and depths, and its edges are anti-aliased.
    """

    camera: Camera
    moving_camera: bool
    single: bool
    triangles: StaticTriangles
    target: RenderTarget


class StaticLayers:
    """Renders and caches images of the static scene.

    Args:
        ctx: OpenGL context.
        meshes: Meshes without labels.
        bodies: Labelled bodies that never move.
        lighting: Light.
        ids: Program that draws depth and triangle ids.
        lit_bodies: Program that draws bodies; it looks up soft shadows.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        meshes: Sequence[Mesh],
        bodies: Sequence[Body],
        lighting: Lighting,
        ids: moderngl.Program,
        lit_bodies: moderngl.Program,
    ) -> None:
        self._ctx, self._lighting, self._ids = ctx, lighting, ids
        lit = lighting.ambient_occlusion and lighting.mode == "lit"
        self._unlabelled = self._scene = StaticScene(ctx, tuple(meshes), lit and not bodies)
        if bodies:
            labelled = (replace(body.mesh, vertices=body.vertices.astype(float)) for body in bodies)
            self._scene = StaticScene(ctx, (*meshes, *labelled), lit)
        self._layers: LruCache[tuple[bytes, int], StaticLayer] = LruCache(
            _MAX_LAYERS, release=lambda layer: layer.release()
        )
        self._moving: StaticLayer | None = None
        soft = lighting.shadow == "soft"
        occlusion = ["AMBIENT_OCCLUSION"] if self._scene.charts is not None else []
        switches = ["STATIC_SCENE", *occlusion, *self._scene.switches]
        self._lit = self._programs([*switches, *(["STATIC_SHADOWS"] if soft else [])])
        self._without_sun = self._programs(switches, sun=False) if soft else self._lit
        for program in (*self._lit, *self._without_sun):
            set_uniform(program, "light_map", UNIT)
        #: soft shadows, if the light has them
        self.sun_shadows = SunShadows(ctx, self._scene, lighting, (lit_bodies, *self._lit)) if soft else None
        #: whether bodies cast contact shadows: there is a floor for them
        self.contact_shadows = lighting.shadow == "contact" and (
            self._scene.has_floor or lighting.shadow_catcher
        )

    def _programs(self, switches: Sequence[str], sun: bool = True) -> tuple[moderngl.Program, ...]:
        """Programs for opaque surfaces, for their colours alone, and for transparent ones if any."""
        kinds = ((), ("COLOUR",), *((("COLOUR", "TRANSPARENT"),) if self._scene.blends else ()))
        return tuple(lit_program(self._ctx, self._lighting, (*switches, *kind), sun) for kind in kinds)

    @cached_property
    def _light_map(self) -> LightMap | None:
        """The light map: baked when colours are needed first."""
        return None if self._scene.charts is None else LightMap(self._ctx, self._scene)

    def layer(self, camera: Camera, moving_camera: bool, backdrop: Backdrop | None, lit: bool) -> StaticLayer:
        """Return the image for a camera.

        Args:
            camera: The camera.
            moving_camera: The camera moves: the image is not cached.
            backdrop: Image behind the scene.
            lit: Render colours, not depths alone.
        """
        if moving_camera:
            self._moving = self._render(camera, backdrop, self._moving_target(camera.size), True, lit)
            return self._moving
        key = camera_key(camera), id(backdrop)
        layer = self._layers.get(key)
        if layer is not None and (layer.rgba is not None or not lit):
            return layer
        made = self._render(camera, backdrop, RenderTarget(self._ctx, camera.size), False, lit)
        if layer is not None:
            layer.release()
        return self._layers.put(key, made)

    def _moving_target(self, size: tuple[int, int]) -> RenderTarget:
        """Target of the image before, if it has the same size: memory on the device is slow to get."""
        layer, self._moving = self._moving, None
        if layer is None:
            return RenderTarget(self._ctx, size)
        if layer.target.size == size:
            layer.release_inputs()
            return layer.target
        layer.release()
        return RenderTarget(self._ctx, size)

    def draw_unlabelled(self, target: RenderTarget, camera: Camera, moving_camera: bool) -> None:
        """Draw depths of the meshes without labels."""
        with self._unlabelled.tessellated(camera, _tolerance(moving_camera)) as triangles:
            self._draw_depths(target, triangles, camera)

    def _render(
        self,
        camera: Camera,
        backdrop: Backdrop | None,
        target: RenderTarget,
        moving_camera: bool,
        lit: bool,
    ) -> StaticLayer:
        if not lit:
            with self._scene.tessellated(camera, _tolerance(moving_camera)) as triangles:
                self._draw_depths(target, triangles, camera)
            return StaticLayer(target, None, backdrop)
        behind = None if backdrop is None else backdrop.picture(camera)
        behind_without_sun, visibility = behind, None
        if self.sun_shadows is not None and self._lighting.shadow_catcher:
            if behind is None:
                behind = np.full((*camera.size[::-1], 3), self._lighting.background, np.uint8)
            visibility = self.sun_shadows.on_ground(camera)
            behind, behind_without_sun = (
                self._ground(behind, camera, sun) for sun in (visibility, np.zeros_like(visibility))
            )
        with self._scene.tessellated(camera, _tolerance(moving_camera)) as triangles:
            if self._light_map is not None:
                self._light_map.use()
            single = moving_camera and not self._scene.blends and max(camera.size) > _SMALL
            view = _View(camera, moving_camera, single, triangles, target)
            rgba = self._colour(self._lit, view, behind)
            shadow_inputs = None
            if self.sun_shadows is not None:
                shaded = self._colour(self._without_sun, view, behind_without_sun)
                shadow_inputs = ShadowInputs(self._ctx, camera, shaded[..., :3])
            if not view.single:
                self._draw_depths(target, triangles, camera)
        if self.sun_shadows is None:
            rgba[..., 3] = 255
        if visibility is not None:
            empty = target.read("depth", lit=True) == 0
            rgba[..., 3][empty] = np.rint(255 * visibility[empty]).astype(np.uint8)
        if shadow_inputs is not None:
            target.write(rgba)
        return StaticLayer(target, rgba, backdrop, shadow_inputs)

    def _colour(
        self, programs: Sequence[moderngl.Program], view: _View, behind: Image | None
    ) -> NDArray[np.uint8]:
        """(H, W, 4) colours before an image (H, W, 3), before the background colour if None; black beyond
        the field of view of the lens.
        """
        rgba: NDArray[np.uint8]
        if view.single:
            rgba = self._image(programs, view, behind, (0.0, 0.0), _MOVING_MIP_BIAS).copy()
            if self._scene.edges is not None:
                ids = view.target.read("triangle_id", lit=True)
                mix(rgba, self._scene.edges.crossings(view.camera, view.triangles.triangles(ids)))
        else:
            rgba = self._mean(programs, view, behind)
        if view.camera.distorted and LensView(view.camera).partly_dark:
            rgba[..., :3][~np.isfinite(ray_grid(view.camera)[..., 0])] = 0
        return rgba

    def _mean(
        self, programs: Sequence[moderngl.Program], view: _View, behind: Image | None
    ) -> NDArray[np.uint8]:
        """(H, W, 4) mean of shifted images."""
        size, count, factor = view.camera.size, _MOVING_OFFSETS if view.moving_camera else _OFFSETS, 1
        if view.camera.distorted and max(size) <= _MAX_LENS_SIDE:
            factor, count = 2, -(-count // 4)
            view = view._replace(target=RenderTarget(self._ctx, (2 * size[0], 2 * size[1])))
        # the samples of a pixel share its texels: finer ones than usual
        mip_bias = -0.75 * float(np.log2(count * factor**2)) + factor - 1
        total = np.zeros((*view.target.size[::-1], 4), np.uint16)
        for x, y in offsets(count):
            total += self._image(programs, view, behind, (x / factor, y / factor), mip_bias)
        mean = ((total + count // 2) // count).astype(np.uint8)
        if factor == 1:
            return mean
        view.target.release()
        return np.asarray(cv2.resize(mean, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def _image(
        self,
        programs: Sequence[moderngl.Program],
        view: _View,
        behind: Image | None,
        offset: tuple[float, float],
        mip_bias: float,
    ) -> NDArray[np.uint8]:
        """(H, W, 4) colours of an image that is shifted by an offset (x, y) in pixels."""
        camera, target = view.camera, view.target
        for program in programs:
            use_camera(self._ctx, program, camera, offset)
            set_uniform(program, "mip_bias", mip_bias)
        colour = self._lighting.background if behind is None else (0, 0, 0)
        self._draw(target, view.triangles, programs[not view.single], colour, colours_only=not view.single)
        if behind is not None:
            target.fill(behind)
        if len(programs) > 2:
            target.use_colour()
            self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
            self._ctx.blend_func = _BLENDING  # type: ignore[assignment]  # four factors are allowed
            view.triangles.draw_transparent(programs[2], camera.center)
        return target.read("rgba", lit=True)

    def _ground(self, image: Image, camera: Camera, visibility: NDArray[np.floating]) -> Image:
        """Image (H, W, 3) of sunny ground z = 0, darkened to a visible share (H, W) of the sun."""
        down = (ray_grid(camera) @ camera.R)[..., 2] * camera.center[2] < 0
        share = np.where(down[..., None], np.sqrt(self._lighting.on_ground(visibility)), 1.0)
        return np.rint(image * share).astype(np.uint8)

    def _draw(
        self,
        target: RenderTarget,
        triangles: StaticTriangles,
        program: moderngl.Program,
        colour: Sequence[int] = (0, 0, 0),
        colours_only: bool = False,
    ) -> None:
        """Clear a target to a colour and draw the opaque triangles."""
        target.clear(colour)
        if colours_only:
            target.use_visible_colour()
        else:
            target.use(program is not self._ids)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        triangles.draw(program)

    def _draw_depths(self, target: RenderTarget, triangles: StaticTriangles, camera: Camera) -> None:
        """Draw depths; with glTF materials by the lit program, which applies alpha masks."""
        program = self._lit[0] if self._scene.switches else self._ids
        use_camera(self._ctx, program, camera)
        self._draw(target, triangles, program)


def camera_key(camera: Camera) -> bytes:
    """Return the same bytes for cameras with the same image."""
    numbers = (np.array(camera.size), camera.K, camera.R, camera.t, np.array(camera.distortion))
    return b"".join((*(n.tobytes() for n in numbers), str(camera.model).encode()))


def _tolerance(moving_camera: bool) -> float:
    return VISIBLE if moving_camera else TOLERANCE


def offsets(count: int) -> list[tuple[float, float]]:
    """Offsets (x, y) within a pixel, evenly in rows, in columns and over the area: a lattice."""
    step = max((n for n in range(1, count + 1) if np.gcd(n, count) == 1), key=lambda n: _spread(n, count))
    x = (np.arange(count) + 0.5) / count - 0.5
    y = (np.arange(count) * step % count + 0.5) / count - 0.5
    return list(zip(x.tolist(), y.tolist(), strict=True))


def _spread(step: int, count: int) -> int:
    """Least squared distance between points of the lattice of a step."""
    x = np.arange(1, count)
    y = x * step % count
    return int((np.minimum(x, count - x) ** 2 + np.minimum(y, count - y) ** 2).min(initial=2 * count**2))
