"""What pictures are drawn into, and the still scene as one camera sees it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render.channels import CHANNEL_TABLE
from humansim_ros.render.pixel_geometry import ray_grid
from humansim_ros.render.renderer import Backdrop
from humansim_ros.types import Float32Array

if TYPE_CHECKING:
    from humansim_ros.render.rendered_frame import RenderedFrame

#: What a target is made of: the shaders' location, components read back, their type.
_ATTACHMENTS = {"depth": (0, 1, "f4"), "label": (1, 1, "u4"), "rgb": (2, 3, "f1"), "rgba": (2, 4, "f1")}


@dataclass(frozen=True)
class Rectangle:
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


class RenderTarget:
    """What one picture is drawn into: colour, depth in metres, triangle number; and OpenGL's depth buffer.

    Without ``lit`` the colour is left out. Where nothing was drawn depth and number are 0. With ``samples`` a
    pixel has so many, to be averaged into another target.
    """

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int], samples: int = 0) -> None:
        self._ctx, self.size, self.samples = ctx, size, samples
        self._textures = [
            ctx.texture(size, 1, dtype="f4", samples=samples),
            ctx.texture(size, 1, dtype="u4", samples=samples),
            ctx.texture(size, 4, samples=samples),
        ]
        self._buffer = ctx.depth_texture(size, samples=samples)
        self._framebuffers = {
            lit: ctx.framebuffer(self._textures[: 2 + lit], self._buffer) for lit in (False, True)
        }
        self._colour = ctx.framebuffer(self._textures[2:], self._buffer)
        self._colour.depth_mask = False  # shadows colour what is there, they hide nothing
        self._rectangle = Rectangle(0, 0, *size)

    def start(self, rectangle: Rectangle, background: StaticLayer | None = None) -> None:
        """Keep to a rectangle, and fill it with the colour of a background that hides what is behind it."""
        self._keep_to(rectangle)
        # written: to clear costs Mesa more, and so does to copy, which with a scissor it does by drawing
        nothing = bytes(4 * rectangle.shape[0] * rectangle.shape[1])
        self._write(self._textures[0], nothing)
        self._write(self._textures[1], nothing)
        if background is None:
            self._write(self._buffer, np.ones(rectangle.shape, np.float32).tobytes())
        else:
            self._write(self._buffer, background.hides[rectangle.slices].tobytes())
            self._write(self.colour, background.rgba[rectangle.slices].tobytes())
        self._colour.use()

    def _write(self, image: moderngl.Texture, pixels: bytes) -> None:
        image.write(pixels, viewport=self._rectangle.xywh, alignment=1)

    def _keep_to(self, rectangle: Rectangle) -> None:
        self._rectangle = rectangle
        for framebuffer in (*self._framebuffers.values(), self._colour):
            framebuffer.scissor = rectangle.xywh

    def clear(self, colour: Sequence[int]) -> None:
        """Start anew with the whole picture: nothing there but a colour, endlessly far away."""
        self._keep_to(Rectangle(0, 0, *self._buffer.size))
        self._framebuffers[False].use()  # or the scissor of what was in use would count
        self._framebuffers[False].clear()
        red, green, blue = (c / 255 for c in colour)
        self._colour.clear(red, green, blue, 1.0)

    def average(self, fine: RenderTarget) -> None:
        """Take over the means of another target's samples as colour."""
        self._ctx.copy_framebuffer(self._colour, fine._colour)

    def take(self, rgba: NDArray[np.uint8]) -> None:
        """Take over a picture (H, W, 4)."""
        self._textures[2].write(rgba.tobytes())

    def fill(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture, of which this one is some times as large, where nothing is drawn."""
        times = self.size[0] // picture.shape[1]
        larger = picture.repeat(times, axis=0).repeat(times, axis=1)
        rgba, empty = self.read("rgba", lit=True).copy(), self.read("depth", lit=True) == 0
        rgba[empty, :3] = larger[empty]
        self.take(rgba)

    @property
    def depth(self) -> moderngl.Texture:
        return self._textures[0]

    @property
    def hides(self) -> Float32Array:
        """(H, W) the whole of OpenGL's depth buffer, 0 to 1."""
        width, height = self._buffer.size
        return np.frombuffer(self._buffer.read(alignment=1), np.float32).reshape(height, width)

    @property
    def colour(self) -> moderngl.Texture:
        return self._textures[2]

    def use_colour(self) -> None:
        """Draw colour alone."""
        self._colour.use()

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


class StaticLayer:
    """The static scene as one camera sees it, kept on the device and as arrays."""

    def __init__(self, target: RenderTarget, backdrop: Backdrop | None, shades: ShadowTarget | None) -> None:
        self.target, self.shades = target, shades
        self._backdrop = backdrop  # kept, so that its id stays its own
        #: what in it has labels, once that is drawn
        self.standing: RenderedFrame | None = None
        self._rgb, self.rgba, depth = (target.read(name, lit=True) for name in ("rgb", "rgba", "depth"))
        self.hides = target.hides
        self._depth = np.where(depth > 0, depth, np.float32(np.inf))

    def view(self, channels: Collection[str]) -> dict[str, NDArray[Any]]:
        """The channels of a picture without bodies, to be drawn into."""
        cached = {"rgb": self._rgb, "depth": self._depth}
        shared = [c for c in map(CHANNEL_TABLE.__getitem__, channels) if not (c.per_body or c.adjacent_frame)]
        return {
            c.name: cached[c.name].copy() if c.name in cached else c.empty_image(self._depth.shape)
            for c in shared
        }

    def release(self) -> None:
        self.standing = None  # which has this layer
        self.target.release()
        if self.shades is not None:
            self.shades.release()


class ShadowTarget:
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
