"""Render targets: framebuffers for colour, depth and triangle ids."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.render.caches import LruCache
from humansim_ros.types import Float32Array, ImageSize

#: Name -> location in the shaders, components to read, their type.
_ATTACHMENTS = {"depth": (0, 1, "f4"), "triangle_id": (1, 1, "u4"), "rgba": (2, 4, "f1")}


@dataclass(frozen=True)
class Rectangle:
    """Pixels x0 <= x < x1, y0 <= y < y1."""

    x0: int
    y0: int
    x1: int
    y1: int
    #: a surface is so near that the camera may be inside it
    near: bool = False

    @property
    def empty(self) -> bool:
        """Whether it has no pixels."""
        return self.x1 <= self.x0 or self.y1 <= self.y0

    @property
    def low(self) -> tuple[int, int]:
        """(x, y) of the first pixel."""
        return self.x0, self.y0

    @property
    def high(self) -> tuple[int, int]:
        """(x, y) after the last pixel."""
        return self.x1, self.y1

    @property
    def xywh(self) -> tuple[int, int, int, int]:
        """x, y, width and height."""
        return self.x0, self.y0, self.x1 - self.x0, self.y1 - self.y0

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of its pixels in an image (H, W)."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)


class RenderTarget:
    """Framebuffers of one image size: colour, depth in metres, triangle id, and OpenGL's depth buffer.

    Depth and triangle id are 0 where nothing is drawn.
    """

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int]) -> None:
        self._ctx, self.size = ctx, size
        self._textures = [
            ctx.texture(size, 1, dtype="f4"),
            ctx.texture(size, 1, dtype="u4"),
            ctx.texture(size, 4),
        ]
        self._depth_buffer = ctx.depth_texture(size)
        self._framebuffers = {
            lit: ctx.framebuffer(self._textures[: 2 + lit], self._depth_buffer) for lit in (False, True)
        }
        self._colour = ctx.framebuffer(self._textures[2:], self._depth_buffer)
        self._colour.depth_mask = False  # shadows change colours and hide nothing
        #: pixels of colours, and of depth and triangle ids
        self._coloured = self._identified = Rectangle(0, 0, *size)

    def start(
        self,
        rectangle: Rectangle,
        depth_buffer: Float32Array | None = None,
        rgba: NDArray[np.uint8] | None = None,
        bodies: Rectangle | None = None,
    ) -> None:
        """Limit drawing to a rectangle, and initialise it.

        Args:
            rectangle: Pixels to draw.
            depth_buffer: (H, W) of the whole image behind; if None, nothing is behind.
            rgba: (H, W, 4) of the whole image behind; if None, the colour is undefined.
            bodies: Pixels whose depth and triangle ids will be read; all if None. Shadows have neither.
        """
        self._limit_to(rectangle)
        self._identified = rectangle if bodies is None else bodies
        # writing: a clear costs Mesa more, and so does a copy, which with a scissor becomes a draw
        zeros = bytes(4 * self._identified.shape[0] * self._identified.shape[1])
        for texture in self._textures[:2]:
            texture.write(zeros, viewport=self._identified.xywh, alignment=1)
        if depth_buffer is None:
            self._write(self._depth_buffer, np.ones(rectangle.shape, np.float32).tobytes())
        else:
            self._write(self._depth_buffer, depth_buffer[rectangle.slices].tobytes())
        if rgba is not None:
            self._write(self.colour, rgba[rectangle.slices].tobytes())
        self._colour.use()

    def _write(self, image: moderngl.Texture, pixels: bytes) -> None:
        image.write(pixels, viewport=self._coloured.xywh, alignment=1)

    def _limit_to(self, rectangle: Rectangle) -> None:
        self._coloured = self._identified = rectangle
        for framebuffer in (*self._framebuffers.values(), self._colour):
            framebuffer.scissor = rectangle.xywh

    @property
    def identified(self) -> Rectangle:
        """Pixels whose depths and triangle ids are read."""
        return self._identified

    def clear(self, colour: Sequence[int]) -> None:
        """Clear the whole image to a colour (sRGB, 0 to 255) at infinite distance."""
        self._limit_to(Rectangle(0, 0, *self._depth_buffer.size))
        self._framebuffers[False].use()  # or the scissor of the framebuffer in use would count
        self._framebuffers[False].clear()
        red, green, blue = (c / 255 for c in colour)
        self._colour.clear(red, green, blue, 1.0)

    def fill(self, image: NDArray[np.uint8]) -> None:
        """Show an image (H, W, 3) where nothing is drawn."""
        rgba, empty = self.read("rgba", lit=True).copy(), self.read_depth_buffer() == 1
        rgba[empty, :3] = image[empty]
        self._textures[2].write(rgba.tobytes())

    @property
    def colour(self) -> moderngl.Texture:
        """Colour attachment."""
        return self._textures[2]

    def read_depth_buffer(self) -> Float32Array:
        """Read OpenGL's depth buffer of the whole image, (H, W), 0 to 1."""
        width, height = self._depth_buffer.size
        return np.frombuffer(self._depth_buffer.read(alignment=1), np.float32).reshape(height, width)

    @contextmanager
    def sum_of_images(self, sunlight: bool) -> Iterator[SumOfImages]:
        """Add up images, for the duration of ``with``. ``sunlight``: of shares of the sun, too."""
        self.clear((0, 0, 0))
        sums = SumOfImages(self._ctx, self._depth_buffer, sunlight)
        try:
            yield sums
        finally:
            sums.release()

    def use_colour(self) -> None:
        """Draw into the colours only."""
        self._colour.use()

    def use(self, lit: bool) -> None:
        """Draw into depth and triangle ids, and into colours if ``lit``."""
        self._framebuffers[lit].use()

    def read(self, name: str, lit: bool) -> NDArray[Any]:
        """Read an attachment within its rectangle, (H, W) or (H, W, C)."""
        attachment, components, dtype = _ATTACHMENTS[name]
        rectangle = self._coloured if name == "rgba" else self._identified
        pixels = self._framebuffers[lit].read(
            rectangle.xywh, components=components, attachment=attachment, dtype=dtype, alignment=1
        )
        image = np.frombuffer(pixels, np.uint8 if dtype == "f1" else dtype)
        return image.reshape(*rectangle.shape, *(() if components == 1 else (components,)))

    def release(self) -> None:
        """Free the memory on the device."""
        for framebuffer in (*self._framebuffers.values(), self._colour):
            framebuffer.release()
        for attachment in self._textures:
            attachment.release()
        self._depth_buffer.release()


class SumOfImages:
    """The sum of images, on the device.

    Drawing into one framebuffer lets llvmpipe draw all images in one tile before it goes on to the next.
    """

    def __init__(self, ctx: moderngl.Context, depth_buffer: moderngl.Texture, sunlight: bool) -> None:
        self._ctx = ctx
        self._textures = [ctx.texture(depth_buffer.size, n, dtype="f4") for n in (4, 1)[: 1 + sunlight]]
        self._framebuffer = ctx.framebuffer(self._textures, depth_buffer)
        self._framebuffer.use()
        self._framebuffer.clear()

    def start_image(self) -> None:
        """Draw only OpenGL's depths of the next image."""
        self._write(depths=True)
        self._framebuffer.clear()
        self._ctx.enable_only(moderngl.DEPTH_TEST)

    def add_visible(self) -> None:
        """Draw colours at the depths that have been drawn, and add them."""
        self._write(depths=False)
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        self._ctx.depth_func = "=="
        self._ctx.blend_func = moderngl.ONE, moderngl.ONE

    def _write(self, depths: bool) -> None:
        mask = (not depths,) * 4
        self._framebuffer.color_mask = cast(Any, mask if len(self._textures) == 1 else (mask,) * 2)
        self._framebuffer.depth_mask = depths
        self._framebuffer.use()  # the masks count from here on
        self._ctx.depth_func = "<"

    def read(self) -> list[Float32Array]:
        """(H, W, 4) sums of colours from 0 to 1 and number of images; (H, W, 1) sums of shares of the sun."""
        sums = [np.empty((*one.size[::-1], one.components), np.float32) for one in self._textures]
        for number, one in enumerate(sums):
            self._framebuffer.read_into(one, components=one.shape[2], attachment=number, dtype="f4")
        return sums

    def release(self) -> None:
        """Free the memory on the device."""
        self._ctx.depth_func = "<"
        self._framebuffer.release()
        for one in self._textures:
            one.release()


#: Image sizes whose render targets are cached.
_MAX_SIZES = 32


class RenderTargets(LruCache[ImageSize, RenderTarget]):
    """Targets to draw into, one for each of the most recently used image sizes."""

    def __init__(self, ctx: moderngl.Context) -> None:
        super().__init__(_MAX_SIZES, release=lambda target: target.release())
        self._ctx = ctx

    def of(self, size: ImageSize) -> RenderTarget:
        """Return the target of an image size, with what was drawn last."""
        return self.get_or_make(size, lambda: RenderTarget(self._ctx, size))
