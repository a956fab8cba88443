"""Cached images of the static scene, one per camera and backdrop, with their ambient occlusion.

Ambient occlusion is the visible share of sky and ground at a point. Depth maps of the scene are rendered
once from many directions, side by side in one texture. Each pixel of a camera tests one ninth of the
directions, its neighbours test the others, at a lower resolution than the image. Like the sun, ambient light
passes through the back faces of surfaces.
"""

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
from humansim_ros.render.caches import LruCache
from humansim_ros.render.lens_tessellation import TOLERANCE, VISIBLE, LensView
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.pixel_geometry import ray_grid
from humansim_ros.render.programs import columns, depth_program, lit_program, set_uniform, shader, use_camera
from humansim_ros.render.rendered_frame import StaticLayer
from humansim_ros.render.renderer import Backdrop, Body
from humansim_ros.render.static_scene import StaticScene, StaticTriangles
from humansim_ros.render.sun_shadows import ShadowInputs, SunShadows
from humansim_ros.render.target import RenderTarget
from humansim_ros.types import Array, Float32Array, Image

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
        """Return the image for a camera. Images of a moving camera are not cached."""
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

        ``fine``: target of a higher resolution, or with samples. ``target``: of the resolution of the image.
        ``behind``: (H, W, 3), the background colour if None.
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


#: Maps along a side of the common texture, and texels along a side of each map.
_SIDE, _TEXELS = 12, 208
#: Relative difference of depth below which two points belong to one surface.
_SAME_SURFACE = 0.03
#: Metres that the maps cover around the scene.
_MARGIN = 0.1
#: Texture unit; 0 has the texture of the surface, 1 to 4 have shadow maps.
UNIT = 5


class AmbientOcclusion:
    """Depth maps of a static scene from many directions."""

    def __init__(self, ctx: moderngl.Context, static: StaticScene) -> None:
        self._ctx = ctx
        box = static.box
        assert box is not None
        low, high = box.min(axis=1).astype(float), box.max(axis=1).astype(float)
        self._centre, self._extent = (low + high) / 2, (high - low) / 2 + _MARGIN
        self._directions = directions(_SIDE * _SIDE)
        side = _SIDE * _TEXELS
        self._map = ctx.depth_texture((side, side))
        self._sampler = ctx.sampler(
            False, False, filter=(moderngl.LINEAR, moderngl.LINEAR), compare_func="<=", texture=self._map
        )
        self._program = ctx.program(
            vertex_shader=shader(["lens.glsl", "ambient_occlusion.vert"]),
            fragment_shader=shader(
                ["ambient_occlusion.frag"], [f"COUNT {_SIDE**2}", f"SIDE {_SIDE}", f"INSET {1 / _TEXELS}"]
            ),
        )
        set_uniform(self._program, "directions", self._directions.astype("f4").tobytes())
        set_uniform(self._program, "centre", tuple(self._centre))
        set_uniform(self._program, "extent", tuple(self._extent))
        set_uniform(self._program, "texel", 2 * float(self._extent.max()) / _TEXELS)
        set_uniform(self._program, "maps", UNIT)
        self._draw_maps(static)

    def _draw_maps(self, static: StaticScene) -> None:
        depths = depth_program(self._ctx, static.switches)
        framebuffer = self._ctx.framebuffer(depth_attachment=self._map)
        framebuffer.use()
        framebuffer.clear(depth=1.0)
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        self._ctx.cull_face = "front"  # images are mirrored, and with them the winding of front faces
        for number, direction in enumerate(self._directions):
            row, column = divmod(number, _SIDE)
            framebuffer.viewport = column * _TEXELS, row * _TEXELS, _TEXELS, _TEXELS
            set_uniform(depths, "clip", columns(self._clip(direction)))
            static.whole.draw(depths)
        self._ctx.cull_face = "back"
        framebuffer.release()

    def _clip(self, direction: Array) -> Array:
        """(4, 4) from the world to a map's clip coordinates (the same as in ambient_occlusion.frag)."""
        u = np.array([-direction[1], direction[0], 0.0])
        u /= np.linalg.norm(u)
        axes = np.stack([u, np.cross(direction, u), -direction])
        axes /= (np.abs(axes) @ self._extent)[:, None]
        clip = np.eye(4)
        clip[:3, :3], clip[:3, 3] = axes, -axes @ self._centre
        return clip

    def image(self, camera: Camera, static: StaticTriangles, scale: int) -> moderngl.Texture:
        """Render the ambient occlusion for a camera, see :func:`packed`. ``scale``: pixels per texel."""
        size = -(-camera.size[0] // scale), -(-camera.size[1] // scale)
        sums_image, depth = self._ctx.texture(size, 4, dtype="f4"), self._ctx.texture(size, 1, dtype="f4")
        buffer = self._ctx.depth_renderbuffer(size)
        framebuffer = self._ctx.framebuffer([sums_image, depth], buffer)
        framebuffer.use()
        framebuffer.clear()
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        use_camera(self._ctx, self._program, camera)
        self._sampler.use(UNIT)
        static.draw(self._program)
        self._sampler.clear(UNIT)
        sums = np.frombuffer(framebuffer.read(components=4, dtype="f4"), np.float32).reshape(*size[::-1], 4)
        far = np.frombuffer(framebuffer.read(components=1, attachment=1, dtype="f4"), np.float32)
        for one in (framebuffer, sums_image, depth, buffer):
            one.release()
        made = self._ctx.texture(size, 1, packed(sums, far.reshape(size[::-1])).tobytes(), dtype="u4")
        made.filter = moderngl.NEAREST, moderngl.NEAREST
        return made


def directions(count: int) -> Array:
    """(N, 3) unit vectors evenly over the sphere, on a spiral; none is vertical."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def packed(sums: Float32Array, depth: Float32Array) -> NDArray[np.uint32]:
    """Combine each pixel with its neighbours on the same surface, and pack the result.

    ``sums``: (H, W, 4) sky visible and total, ground visible and total, of one ninth of the directions each.
    ``depth``: (H, W) metres.

    Returns:
        (H, W): visible share of sky in the low 8 bits, of ground in the next 8, 1 / (1 + depth) in 16.
    """
    padded, far = np.pad(sums, ((1, 1), (1, 1), (0, 0))), np.pad(depth, 1)
    height, width = depth.shape
    total = np.zeros_like(sums)
    for y in range(3):
        for x in range(3):
            near = np.abs(far[y : y + height, x : x + width] - depth) < _SAME_SURFACE * depth
            total += np.where(near[..., None], padded[y : y + height, x : x + width], 0)
    shares = np.where(total[..., 1::2] > 1e-3, total[..., ::2] / np.maximum(total[..., 1::2], 1e-3), 1)
    sky, ground = np.moveaxis(np.rint(255 * shares).astype(np.uint32), -1, 0)
    return np.asarray(
        sky | ground << 8 | np.rint(65535 / (1 + depth)).astype(np.uint32) << 16, dtype=np.uint32
    )
