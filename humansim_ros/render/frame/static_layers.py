"""Cached images of the static scene, one per camera and backdrop.

The colours of a still camera are the mean of images that are shifted by fractions of a pixel. The device adds
these images up, tile by tile, so that the textures of a tile stay in the cache of the processor.
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

from humansim_ros.cameras.camera import Camera
from humansim_ros.files.mesh import Mesh
from humansim_ros.render.device.caches import LruCache
from humansim_ros.render.device.context import lit_program, set_uniform, use_camera
from humansim_ros.render.device.lens_tessellation import TOLERANCE, VISIBLE, LensView
from humansim_ros.render.device.pixel_geometry import ray_grid
from humansim_ros.render.device.target import RenderTarget, RenderTargets
from humansim_ros.render.frame.rendered_frame import StaticLayer
from humansim_ros.render.frame.shadows import ShadowInputs, SunShadows
from humansim_ros.render.frame.static_scene import UNIT, LightMap, StaticScene, StaticTriangles
from humansim_ros.render.interface.lighting import Lighting
from humansim_ros.render.interface.renderer import Backdrop, Body
from humansim_ros.types import Image

#: Number of shifted images that are averaged for a still camera (a Fibonacci number spreads them best).
#: Number for a moving camera with transparent surfaces or a small image. An image is small if its longer side
#: has at most this many pixels: much of a room is then narrower than a pixel.
_OFFSETS, _MOVING_OFFSETS, _SMALL = 13, 4, 128
#: Largest error of an edge in the shifted images, pixels. It is larger than for depths, which are drawn only
#: once, since it halves the number of triangles. The mean image loses only 0.1 dB.
_SHIFTED = 0.02
#: A moving camera has a single image with two samples of textures per pixel, so it uses textures that are
#: finer by this many mip levels.
_MOVING_MIP_BIAS = -1.5
#: Largest number of cached images.
_MAX_LAYERS = 32
#: Blending of transparent surfaces. Alpha does not change.
_BLENDING = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ZERO, moderngl.ONE)


class _View(NamedTuple):
    """The triangles of the scene for a camera, and a target of the size of its image. ``single``: colours and
    depths come from one image with anti-aliased edges, not from several shifted images."""

    camera: Camera
    moving_camera: bool
    single: bool
    triangles: StaticTriangles
    target: RenderTarget


class StaticLayers:
    """Renders and caches images of the static scene.

    Args:
        ctx: OpenGL context.
        meshes, bodies: Meshes without labels, and labelled bodies that never move.
        lighting: Light.
        ids, lit_bodies: Program for depth and triangle ids; program for bodies with soft shadows.
        targets: Targets to draw into. They can be reused after each call.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        meshes: Sequence[Mesh],
        bodies: Sequence[Body],
        lighting: Lighting,
        ids: moderngl.Program,
        lit_bodies: moderngl.Program,
        targets: RenderTargets,
    ) -> None:
        self._ctx, self._lighting, self._ids, self._targets = ctx, lighting, ids, targets
        self._unlabelled = self._scene = StaticScene(ctx, tuple(meshes))
        if bodies:
            labelled = (replace(body.mesh, vertices=body.vertices.astype(float)) for body in bodies)
            self._scene = StaticScene(ctx, (*meshes, *labelled))
        self._layers: LruCache[tuple[bytes, int], StaticLayer] = LruCache(_MAX_LAYERS)
        self._moving: StaticLayer | None = None
        soft = lighting.shadow == "soft"
        lit = lighting.ambient_occlusion and lighting.mode == "lit"
        self._occluded = lit and self._scene.box is not None
        occlusion = ["AMBIENT_OCCLUSION"] if self._occluded else []
        switches = ["STATIC_SCENE", *occlusion, *self._scene.switches]
        self._lit = self._programs([*switches, *(["STATIC_SHADOWS"] if soft else [])])
        self._without_sun = self._programs(switches, sun=False) if soft else self._lit
        for program in (*self._lit, *self._without_sun):
            set_uniform(program, "light_map", UNIT)
        #: soft shadows; None if the light has none
        self.sun_shadows = SunShadows(ctx, self._scene, lighting, (lit_bodies, *self._lit)) if soft else None
        #: whether bodies cast contact shadows, which need a floor
        self.contact_shadows = lighting.shadow == "contact" and (
            self._scene.has_floor or lighting.shadow_catcher
        )

    def _programs(self, switches: Sequence[str], sun: bool = True) -> tuple[moderngl.Program, ...]:
        """Create the programs that draw the static scene. In this order, they draw: opaque surfaces; only the
        colours of opaque surfaces; only OpenGL's depth; transparent surfaces, if there are any."""
        kinds = (
            () if self._scene.blends else ("SMOOTH_TEXTURES",),
            ("COLOUR",),
            ("COLOUR", "UNSEEN"),
            *((("COLOUR", "TRANSPARENT"),) if self._scene.blends else ()),
        )
        return tuple(lit_program(self._ctx, self._lighting, (*switches, *kind), sun) for kind in kinds)

    @cached_property
    def _light_map(self) -> LightMap | None:
        """The light map, computed when colours are first needed; None without ambient occlusion."""
        light_map = LightMap(self._ctx, self._scene) if self._occluded else None
        self._ctx.gc()  # frees the images from which the map was computed
        return light_map

    def layer(self, camera: Camera, moving_camera: bool, backdrop: Backdrop | None, lit: bool) -> StaticLayer:
        """Return the image for a camera.

        Args:
            camera: The camera.
            moving_camera: Whether the camera moves, so that the image is not cached.
            backdrop: Image behind the scene.
            lit: Whether colours are rendered, not only depths.
        """
        if moving_camera:
            if self._moving is not None:  # cached frames may still have it, and need no images on the device
                self._moving.shadow_inputs = None
            self._moving = self._render(camera, backdrop, True, lit)
            return self._moving
        key = camera_key(camera), id(backdrop)
        layer = self._layers.get(key)
        if layer is not None and (layer.rgba is not None or not lit):
            return layer
        made = self._render(camera, backdrop, False, lit)
        made.kept = self._targets.of(camera.size).keep(made.depth_buffer, made.rgba)
        return self._layers.put(key, made)

    def draw_unlabelled(self, target: RenderTarget, camera: Camera, moving_camera: bool) -> None:
        """Draw depths of the meshes without labels."""
        self._draw_depths(target, _exact(self._unlabelled, camera, moving_camera), camera)

    def _render(
        self, camera: Camera, backdrop: Backdrop | None, moving_camera: bool, lit: bool
    ) -> StaticLayer:
        target = self._targets.of(camera.size)
        if not lit:
            self._draw_depths(target, _exact(self._scene, camera, moving_camera), camera)
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
        if self._light_map is not None:  # before the triangles, since the light map gives them their places
            self._light_map.use()
        triangles = self._scene.tessellated(camera, VISIBLE if moving_camera else _SHIFTED)
        single = moving_camera and not self._scene.blends and max(camera.size) > _SMALL
        view = _View(camera, moving_camera, single, triangles, target)
        rgba = self._colour(self._lit, view, behind)
        soft = self.sun_shadows is not None
        shaded = self._colour(self._without_sun, view, behind_without_sun)[..., :3] if soft else None
        if not view.single:
            if camera.distorted and not moving_camera:
                triangles = _exact(self._scene, camera, moving_camera)
            self._draw_depths(target, triangles, camera)
        if self.sun_shadows is None:
            rgba[..., 3] = 255
        if visibility is not None:
            empty = target.read("depth", lit=True) == 0
            rgba[..., 3][empty] = np.rint(255 * visibility[empty]).astype(np.uint8)
        inputs = None
        if shaded is not None:
            inputs = ShadowInputs(self._ctx, camera, rgba, shaded, target.read("depth", lit=True))
        return StaticLayer(target, rgba, backdrop, inputs)

    def _colour(
        self, programs: Sequence[moderngl.Program], view: _View, behind: Image | None
    ) -> NDArray[np.uint8]:
        """(H, W, 4) colours in front of the image ``behind`` (H, W, 3). Pixels beyond the field of view are
        black. If ``behind`` is None, the background colour is behind."""
        rgba: NDArray[np.uint8]
        if view.single:
            rgba = self._image(programs, view, behind, (0.0, 0.0), _MOVING_MIP_BIAS).copy()
            if self._scene.edges is not None:
                ids, depth = (view.target.read(name, lit=True) for name in ("triangle_id", "depth"))
                self._scene.edges.smooth(rgba, view.camera, view.triangles.triangles(ids), depth)
        else:
            rgba = self._mean(programs, view, behind)
        if view.camera.distorted and LensView(view.camera).partly_dark:
            rgba[..., :3][~np.isfinite(ray_grid(view.camera)[..., 0])] = 0
        return rgba

    def _mean(
        self, programs: Sequence[moderngl.Program], view: _View, behind: Image | None
    ) -> NDArray[np.uint8]:
        """Return the (H, W, 4) mean of images that are shifted by fractions of a pixel."""
        count = _MOVING_OFFSETS if view.moving_camera else _OFFSETS
        # a pixel has several samples of its texture, so the texture may be finer than usual
        mip_bias = -0.75 * float(np.log2(count))
        if self._scene.blends:
            images = (self._image(programs, view, behind, shift, mip_bias) for shift in offsets(count))
            return np.asarray(np.rint(sum(image.astype(np.float32) for image in images) / count), np.uint8)
        _, colours, unseen = programs
        set_uniform(colours, "mip_bias", mip_bias)
        with view.target.sum_of_images("static_map.texel" in colours) as sums:
            for shift in offsets(count):
                sums.start_image()
                use_camera(self._ctx, unseen, view.camera, shift)
                view.triangles.draw(unseen)
                sums.add_visible()
                use_camera(self._ctx, colours, view.camera, shift)
                view.triangles.draw(colours)
            rgba, *sunlight = sums.read()
        mean = np.asarray(cv2.convertScaleAbs(rgba, alpha=255 / count), np.uint8)
        mean[..., 3] = 255
        if sunlight:
            seen = rgba[..., 3:]
            share = sunlight[0] / np.maximum(seen, count) + 1 - np.minimum(seen, count) / count
            mean[..., 3:] = np.rint(255 * share)
        # some of the shifted images are empty there, or coinciding surfaces were added more than once
        row, column = np.nonzero(rgba[..., 3] != count)
        total = rgba[row, column]
        back = np.asarray(self._lighting.background) if behind is None else behind[row, column]
        empty = 1 - np.minimum(total[:, 3:], count) / count
        mean[row, column, :3] = np.rint(255 * total[:, :3] / np.maximum(total[:, 3:], count) + empty * back)
        return mean

    def _image(
        self,
        programs: Sequence[moderngl.Program],
        view: _View,
        behind: Image | None,
        offset: tuple[float, float],
        mip_bias: float,
    ) -> NDArray[np.uint8]:
        """(H, W, 4) colours of one image, shifted by an offset (x, y) in pixels."""
        camera, target = view.camera, view.target
        for program in programs:
            use_camera(self._ctx, program, camera, offset)
            set_uniform(program, "mip_bias", mip_bias)
        self._draw(
            target, view.triangles, programs[0], self._lighting.background if behind is None else (0, 0, 0)
        )
        if behind is not None:
            target.fill(behind)
        if len(programs) > 3:
            target.use_colour()
            self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
            self._ctx.blend_func = _BLENDING  # type: ignore[assignment]  # four factors are allowed
            view.triangles.draw_transparent(programs[3], camera.center)
        return target.read("rgba", lit=True)

    def _ground(self, image: Image, camera: Camera, visibility: NDArray[np.floating]) -> Image:
        """Darken an image (H, W, 3) like ground z = 0 that is in the shade. ``visibility``: (H, W) visible
        share of the sun."""
        down = (ray_grid(camera) @ camera.R)[..., 2] * camera.center[2] < 0
        share = np.where(down[..., None], np.sqrt(self._lighting.on_ground(visibility)), 1.0)
        return np.rint(image * share).astype(np.uint8)

    def _draw(
        self,
        target: RenderTarget,
        triangles: StaticTriangles,
        program: moderngl.Program,
        colour: Sequence[int] = (0, 0, 0),
    ) -> None:
        """Clear a target to a colour and draw the opaque triangles."""
        target.clear(colour)
        target.use(program is not self._ids)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        triangles.draw(program)

    def _draw_depths(self, target: RenderTarget, triangles: StaticTriangles, camera: Camera) -> None:
        """Draw depths. With glTF materials, the lit program draws them, since it applies alpha masks."""
        program = self._lit[0] if self._scene.switches else self._ids
        use_camera(self._ctx, program, camera)
        self._draw(target, triangles, program)


def camera_key(camera: Camera) -> bytes:
    """Return a key that is equal for cameras with the same image."""
    numbers = (np.array(camera.size), camera.K, camera.R, camera.t, np.array(camera.distortion))
    return b"".join((*(n.tobytes() for n in numbers), str(camera.model).encode()))


def _exact(scene: StaticScene, camera: Camera, moving_camera: bool) -> StaticTriangles:
    """Tessellated triangles of the scene, exact enough for depths and labels."""
    return scene.tessellated(camera, VISIBLE if moving_camera else TOLERANCE, checked=not moving_camera)


def offsets(count: int) -> list[tuple[float, float]]:
    """Offsets (x, y) within a pixel: points of a lattice that is spread evenly over rows, columns and
    area."""
    step = max((n for n in range(1, count + 1) if np.gcd(n, count) == 1), key=lambda n: _spread(n, count))
    x = (np.arange(count) + 0.5) / count - 0.5
    y = (np.arange(count) * step % count + 0.5) / count - 0.5
    return list(zip(x.tolist(), y.tolist(), strict=True))


def _spread(step: int, count: int) -> int:
    """Smallest squared distance between two points of the lattice (n, n * step), both modulo ``count``."""
    x = np.arange(1, count)
    y = x * step % count
    return int((np.minimum(x, count - x) ** 2 + np.minimum(y, count - y) ** 2).min(initial=2 * count**2))
