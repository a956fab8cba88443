"""Cached images of the static scene, one per camera and backdrop."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.ambient_occlusion import UNIT, AmbientOcclusion
from humansim_ros.render.caches import LruCache
from humansim_ros.render.lens_tessellation import TOLERANCE, VISIBLE, LensView
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.pixel_geometry import ray_grid
from humansim_ros.render.programs import lit_program, use_camera
from humansim_ros.render.rendered_frame import StaticLayer
from humansim_ros.render.renderer import Backdrop, Body
from humansim_ros.render.static_scene import StaticScene, StaticTriangles
from humansim_ros.render.sun_shadows import ShadowInputs, SunShadows
from humansim_ros.render.target import RenderTarget
from humansim_ros.render.uniforms import set_uniform
from humansim_ros.types import Image

#: Supersampling factor of cached images: they are rendered once.
_SUPERSAMPLING, _MAX_SIDE = 4, 8192
#: A moving camera renders the static scene with multisampling, in half the time; or supersampled if there is
#: a backdrop, because the pixels that show it have to be known.
_SAMPLES, _MOVING_SUPERSAMPLING = 4, 2
#: Pixels per texel of ambient occlusion, by whether the camera moves; and the fewest texels along a side.
_AO_SCALE, _MIN_AO_SIDE = {False: 2, True: 4}, 120
#: Largest number of cached images, and memory of the targets that they are rendered into.
_MAX_LAYERS, _MAX_TARGET_BYTES = 32, 1 << 30
#: Blending of transparent surfaces; alpha stays.
_BLENDING = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ZERO, moderngl.ONE)


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
        self._unlabelled = self._scene = StaticScene(ctx, tuple(meshes))
        if bodies:
            labelled = (replace(body.mesh, vertices=body.vertices.astype(float)) for body in bodies)
            self._scene = StaticScene(ctx, (*meshes, *labelled))
        self._layers: LruCache[tuple[bytes, int], StaticLayer] = LruCache(
            _MAX_LAYERS, release=lambda layer: layer.release()
        )
        self._targets: LruCache[tuple[tuple[int, int], int], RenderTarget] = LruCache(
            _MAX_LAYERS,
            _MAX_TARGET_BYTES,
            nbytes=lambda target: target.nbytes,
            release=lambda target: target.release(),
        )
        self._moving: StaticLayer | None = None
        soft = lighting.shadow == "soft"
        occlusion = lighting.ambient_occlusion and lighting.mode == "lit" and self._scene.box is not None
        switches = ["STATIC_SCENE", *(["AMBIENT_OCCLUSION"] if occlusion else []), *self._scene.switches]
        self._lit = self._programs([*switches, *(["STATIC_SHADOWS"] if soft else [])])
        self._without_sun = self._programs(switches, sun=False) if soft else self._lit
        self._occlusion = AmbientOcclusion(ctx, self._scene) if occlusion else None
        #: soft shadows, if the light has them
        self.sun_shadows = SunShadows(ctx, self._scene, lighting, (lit_bodies, *self._lit)) if soft else None
        #: whether bodies cast contact shadows: there is a floor for them
        self.contact_shadows = lighting.shadow == "contact" and (
            self._scene.has_floor or lighting.shadow_catcher
        )

    def _programs(self, switches: Sequence[str], sun: bool = True) -> tuple[moderngl.Program, ...]:
        """A program for opaque surfaces, and one for transparent surfaces if there are any."""
        transparent = [[*switches, "TRANSPARENT"]] if self._scene.blends else []
        return tuple(lit_program(self._ctx, self._lighting, names, sun) for names in (switches, *transparent))

    def layer(self, camera: Camera, moving_camera: bool, backdrop: Backdrop | None) -> StaticLayer:
        """Return the image for a camera. That of a moving camera is not cached: the next one replaces it."""
        if moving_camera:
            if self._moving is not None:
                self._moving.release()
            self._moving = self._render(camera, True, backdrop)
            return self._moving
        key = camera_key(camera), id(backdrop)
        return self._layers.get_or_make(key, lambda: self._render(camera, False, backdrop))

    def draw_unlabelled(self, target: RenderTarget, camera: Camera, moving_camera: bool) -> None:
        """Draw depths of the meshes without labels."""
        with self._unlabelled.tessellated(camera, _tolerance(moving_camera)) as triangles:
            self._draw(target, triangles, self._depth_program, camera)

    def _render(self, camera: Camera, moving_camera: bool, backdrop: Backdrop | None) -> StaticLayer:
        behind = None if backdrop is None else backdrop.picture(camera)
        behind_without_sun, visibility = behind, None
        if self.sun_shadows is not None and self._lighting.shadow_catcher:
            if behind is None:
                behind = np.full((*camera.size[::-1], 3), self._lighting.background, np.uint8)
            visibility = self.sun_shadows.on_ground(camera)
            behind, behind_without_sun = (
                self._ground(behind, camera, sun) for sun in (visibility, np.zeros_like(visibility))
            )
        target = RenderTarget(self._ctx, camera.size)
        # clip coordinates do not depend on the resolution: the same view, only finer
        fine = self._fine_target(camera.size, moving_camera, behind is not None)
        with (
            self._scene.tessellated(camera, _tolerance(moving_camera)) as triangles,
            ExitStack() as stack,
        ):
            if self._occlusion is not None:
                scale = min(_AO_SCALE[moving_camera], max(1, min(camera.size) // _MIN_AO_SIDE))
                occlusion = self._occlusion.image(camera, triangles, scale)
                stack.callback(occlusion.release)
                occlusion.use(UNIT)
                for program in (*self._lit, *self._without_sun):
                    set_uniform(program, "ao_map", UNIT)
                    ratio = (occlusion.width / fine.size[0], occlusion.height / fine.size[1])
                    set_uniform(program, "ao_scale", ratio)
            rgba = self._colour(self._lit, triangles, camera, fine, target, behind)
            shadow_inputs = None
            if self.sun_shadows is not None:
                shaded = self._colour(self._without_sun, triangles, camera, fine, target, behind_without_sun)
                shadow_inputs = ShadowInputs(self._ctx, camera, shaded[..., :3])
            self._draw(target, triangles, self._depth_program, camera)
        if self.sun_shadows is None:
            rgba[..., 3] = 255
        if visibility is not None:
            empty = target.read("depth", lit=True) == 0
            rgba[..., 3][empty] = np.rint(255 * visibility[empty]).astype(np.uint8)
        target.write(rgba)
        return StaticLayer(target, backdrop, shadow_inputs)

    def _colour(
        self,
        programs: Sequence[moderngl.Program],
        triangles: StaticTriangles,
        camera: Camera,
        fine: RenderTarget,
        target: RenderTarget,
        behind: Image | None,
    ) -> NDArray[np.uint8]:
        """(H, W, 4) colours of the static scene before an image.

        Args:
            programs: See :meth:`_programs`.
            triangles: The static scene for the camera.
            camera: The camera.
            fine: Target of a higher resolution, or with samples.
            target: Target of the resolution of the image.
            behind: (H, W, 3) image behind the scene, the background colour if None.
        """
        colour = self._lighting.background if behind is None else (0, 0, 0)
        self._draw(fine, triangles, programs[0], camera, colour)
        if len(programs) == 1:
            return _composed(self._averaged(fine, target), fine, camera, behind)
        if behind is not None:
            fine.fill(behind)
        fine.use_colour()
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        self._ctx.blend_func = _BLENDING  # type: ignore[assignment]  # four factors are allowed
        use_camera(self._ctx, programs[1], camera)
        triangles.draw_transparent(programs[1], camera.center)
        return _composed(self._averaged(fine, target), fine, camera, None)

    def _ground(self, image: Image, camera: Camera, visibility: NDArray[np.floating]) -> Image:
        """Image (H, W, 3) of sunny ground z = 0, darkened to a visible share (H, W) of the sun."""
        down = (ray_grid(camera) @ camera.R)[..., 2] * camera.center[2] < 0
        share = np.where(down[..., None], np.sqrt(self._lighting.on_ground(visibility)), 1.0)
        return np.rint(image * share).astype(np.uint8)

    @property
    def _depth_program(self) -> moderngl.Program:
        """Program for depths: with glTF materials the lit one, which applies alpha masks."""
        return self._lit[0] if self._scene.switches else self._ids

    def _draw(
        self,
        target: RenderTarget,
        triangles: StaticTriangles,
        program: moderngl.Program,
        camera: Camera,
        colour: Sequence[int] = (0, 0, 0),
    ) -> None:
        """Clear a target to a colour and draw the opaque triangles."""
        target.clear(colour)
        target.use(program is not self._ids)
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        use_camera(self._ctx, program, camera)
        # the samples of a pixel share one texel: select it as if each had its own
        set_uniform(program, "mip_bias", -0.5 * np.log2(max(target.samples, 1)))
        triangles.draw(program)

    def _fine_target(self, size: tuple[int, int], moving_camera: bool, has_backdrop: bool) -> RenderTarget:
        """Target of a higher resolution than the image, or with samples."""
        samples, factor = (_SAMPLES, 1) if moving_camera and not has_backdrop else (0, 0)
        if not samples:
            limit = _MOVING_SUPERSAMPLING if moving_camera else _SUPERSAMPLING
            factor = max(1, min(limit, _MAX_SIDE // max(size)))
        fine = size[0] * factor, size[1] * factor
        return self._targets.get_or_make((fine, samples), lambda: RenderTarget(self._ctx, fine, samples))

    def _averaged(self, fine: RenderTarget, target: RenderTarget) -> NDArray[np.uint8]:
        """(H, W, 4) colours of a finer target at the resolution of ``target``."""
        if fine.samples:
            target.average(fine)
            return target.read("rgba", lit=True).copy()
        image = fine.read("rgba", lit=True)
        return np.asarray(cv2.resize(image, target.size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def camera_key(camera: Camera) -> bytes:
    """Return the same bytes for cameras with the same image."""
    numbers = (np.array(camera.size), camera.K, camera.R, camera.t, np.array(camera.distortion))
    return b"".join((*(n.tobytes() for n in numbers), str(camera.model).encode()))


def _tolerance(moving_camera: bool) -> float:
    return VISIBLE if moving_camera else TOLERANCE


def _composed(
    rgba: NDArray[np.uint8], fine: RenderTarget, camera: Camera, behind: Image | None
) -> NDArray[np.uint8]:
    """Colours (H, W, 4) before an image, black beyond the field of view of the lens."""
    if behind is not None:
        empty = np.where(fine.read("depth", lit=True) > 0, np.uint8(0), np.uint8(255))
        share = cv2.resize(empty, camera.size, interpolation=cv2.INTER_AREA)[..., None] / 255
        rgba[..., :3] = np.rint(rgba[..., :3] + share * behind)
    if camera.distorted and LensView(camera).partly_dark:
        rgba[..., :3][~np.isfinite(ray_grid(camera)[..., 0])] = 0
    return rgba
