"""Pixels that each triangle of a body covers, also where another triangle hides it.

OpenGL decides which pixel centres a triangle covers, as in the face image, so that both counts of a triangle
that nothing hides are equal. All triangles are drawn together: each draw finds up to four more triangles at
each pixel, so that the number of draws follows from the number of surfaces behind a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import moderngl
import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.render.body_buffers import PosedBody
from humansim_ros.render.lens_tessellation import TessellatedMesh
from humansim_ros.render.mesh_buffers import TriangleBuffers
from humansim_ros.render.programs import link, use_camera
from humansim_ros.render.target import Rectangle
from humansim_ros.render.uniforms import set_uniform
from humansim_ros.types import Indices

#: Beyond all ids of triangles; single precision is exact up to here.
_NONE = float(1 << 24)
#: Texture unit of the triangles that were found; materials use others.
_UNIT = 8


class CoveragePass:
    """Counts covered pixels on the device."""

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
            (N,) pixels of each triangle of the mesh of the body.
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
        """Lowest and highest ids (M,) at pixels, of one draw after the other until all are found."""
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
