"""Render targets: framebuffers for colour, depth and triangle ids."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.render.device.caches import LruCache
from humansim_ros.render.device.context import OpenGLContext
from humansim_ros.types import Float32Array, ImageSize

#: Images that shaders draw into, by name: location in the shaders, number of components, type.
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
        """Whether the rectangle has no pixels."""
        return self.x1 <= self.x0 or self.y1 <= self.y0

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
        """Index of the pixels of the rectangle in an image (H, W)."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)


class RenderTarget:
    """Framebuffers of one image size: colour, depth in metres, triangle id, and OpenGL's depth buffer.

    Depth and triangle id are 0 where nothing is drawn. If OpenGL runs on the CPU (``on_processor``), images
    are in main memory. A transfer of an image from or to a GPU costs a wait. Therefore the images that frames
    start from stay on a GPU (see :meth:`keep`), and all images of a frame are read with one wait.
    """

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int], on_processor: bool) -> None:
        self._ctx, self.size = ctx, size
        #: colour attachment
        self.colour = ctx.texture(size, 4)
        self._textures = [ctx.texture(size, 1, dtype=dtype) for dtype in ("f4", "u4")] + [self.colour]
        self._depth_buffer = ctx.depth_texture(size)
        self._framebuffers = {
            lit: ctx.framebuffer(self._textures[: 2 + lit], self._depth_buffer) for lit in (False, True)
        }
        self._colour = ctx.framebuffer(self._textures[2:], self._depth_buffer)
        self._colour.depth_mask = False  # shadows change colours, but hide nothing
        #: pixels on their way to main memory, 4 bytes each
        self._to_read = (
            None if on_processor else ctx.buffer(reserve=4 * len(_ATTACHMENTS) * size[0] * size[1])
        )
        #: rectangle that is drawn, and rectangle from which depth and triangle ids are read
        self.coloured = self.identified = Rectangle(0, 0, *size)

    def start(
        self,
        rectangle: Rectangle,
        depth_buffer: Float32Array | None = None,
        rgba: NDArray[np.uint8] | None = None,
        bodies: Rectangle | None = None,
        kept: moderngl.Framebuffer | None = None,
    ) -> None:
        """Limit drawing to a rectangle, and fill it with the images that are behind the new drawing.

        Args:
            rectangle: Pixels to draw.
            depth_buffer: (H, W) OpenGL's depths of the whole image behind. If None, nothing is behind.
            rgba: (H, W, 4) colours of the whole image behind. If None, the colour is undefined.
            bodies: Pixels to read depth and triangle ids from (shadows have neither). If None, all pixels.
            kept: Result of :meth:`keep` for ``depth_buffer`` and ``rgba``.
        """
        self._limit_to(rectangle)
        self.identified = rectangle if bodies is None else bodies
        if kept is None:
            self._write_all(rectangle, depth_buffer, rgba)
        else:
            cleared = self._framebuffers[False]
            cleared.use()
            cleared.clear(viewport=self.identified.xywh)
            self._colour.use()  # the scissor of the framebuffer in use limits the copy
            self._ctx.copy_framebuffer(self._colour, kept)
        self._colour.use()

    def _write_all(
        self, rectangle: Rectangle, depth_buffer: Float32Array | None, rgba: NDArray[np.uint8] | None
    ) -> None:
        # zeros are written, since a clear costs Mesa more, and a copy with a scissor becomes a draw
        zeros = bytes(4 * self.identified.shape[0] * self.identified.shape[1])
        for texture in self._textures[:2]:
            texture.write(zeros, viewport=self.identified.xywh, alignment=1)
        depths = (
            np.ones(rectangle.shape, np.float32) if depth_buffer is None else depth_buffer[rectangle.slices]
        )
        self._depth_buffer.write(depths.tobytes(), viewport=rectangle.xywh, alignment=1)
        if rgba is not None:
            self.colour.write(rgba[rectangle.slices].tobytes(), viewport=rectangle.xywh, alignment=1)

    def keep(self, depth_buffer: Float32Array, rgba: NDArray[np.uint8] | None) -> moderngl.Framebuffer | None:
        """Copy the images that frames start from to the device, and keep them there. Returns None if this
        saves no time (OpenGL runs on the CPU). ``depth_buffer``: (H, W) OpenGL's depths. ``rgba``: (H, W, 4)
        colours; if None, the colours are undefined."""
        if self._to_read is None:
            return None
        colour = self._ctx.texture(self.size, 4, None if rgba is None else rgba.tobytes())
        return self._ctx.framebuffer([colour], self._ctx.depth_texture(self.size, depth_buffer.tobytes()))

    def _limit_to(self, rectangle: Rectangle) -> None:
        self.coloured = self.identified = rectangle
        for framebuffer in (*self._framebuffers.values(), self._colour):
            framebuffer.scissor = rectangle.xywh

    def clear(self, colour: Sequence[int]) -> None:
        """Clear the whole image to a colour (sRGB, 0 to 255) at infinite distance."""
        self._limit_to(Rectangle(0, 0, *self._depth_buffer.size))
        # without this, the scissor of the framebuffer in use would limit the clear
        self._framebuffers[False].use()
        self._framebuffers[False].clear()
        red, green, blue = (c / 255 for c in colour)
        self._colour.clear(red, green, blue, 1.0)

    def fill(self, image: NDArray[np.uint8]) -> None:
        """Show an image (H, W, 3) behind everything that is drawn."""
        rgba, empty = self.read("rgba", lit=True).copy(), self.read_depth_buffer() == 1
        rgba[empty, :3] = image[empty]
        self.colour.write(rgba.tobytes())

    def read_depth_buffer(self) -> Float32Array:
        """Read OpenGL's depth buffer of the whole image, (H, W), 0 to 1."""
        width, height = self._depth_buffer.size
        return np.frombuffer(self._depth_buffer.read(alignment=1), np.float32).reshape(height, width)

    @contextmanager
    def sum_of_images(self, sunlight: bool) -> Iterator[SumOfImages]:
        """Add up the images that are drawn within ``with``. ``sunlight``: also add up shares of the sun."""
        self.clear((0, 0, 0))
        sums = SumOfImages(self._ctx, self._depth_buffer, sunlight)
        try:
            yield sums
        finally:
            self._ctx.depth_func = "<"

    def use_colour(self) -> None:
        """Draw into the colours only."""
        self._colour.use()

    def use(self, lit: bool) -> None:
        """Draw into depth and triangle ids, and into colours if ``lit``."""
        self._framebuffers[lit].use()

    def read(self, name: str, lit: bool) -> NDArray[Any]:
        """Read an attachment within its rectangle, (H, W) or (H, W, C)."""
        attachment, components, dtype = _ATTACHMENTS[name]
        pixels = self._framebuffers[lit].read(
            self._read_of(name).xywh, components=components, attachment=attachment, dtype=dtype, alignment=1
        )
        return _image(name, pixels, self._read_of(name))

    def read_all(self, lit: bool) -> list[NDArray[Any]]:
        """Read triangle ids, depths and, if ``lit``, colours, each as :meth:`read` does."""
        names = ("triangle_id", "depth", "rgba")[: 2 + lit]
        if self._to_read is None:
            return [self.read(name, lit) for name in names]
        areas = [self._read_of(name) for name in names]
        sizes = [4 * area.shape[0] * area.shape[1] for area in areas]
        starts = [sum(sizes[:number]) for number in range(len(names))]
        for name, area, start in zip(names, areas, starts, strict=True):
            attachment, components, dtype = _ATTACHMENTS[name]
            self._framebuffers[lit].read_into(
                *(self._to_read, area.xywh, components, attachment, 1, dtype), write_offset=start
            )
        pixels = memoryview(self._to_read.read(sum(sizes)) if any(sizes) else b"")
        return [
            _image(name, pixels[start : start + size], area)
            for name, area, start, size in zip(names, areas, starts, sizes, strict=True)
        ]

    def _read_of(self, name: str) -> Rectangle:
        """Rectangle of an attachment that is read."""
        return self.coloured if name == "rgba" else self.identified


def _image(name: str, pixels: bytes | memoryview, area: Rectangle) -> NDArray[Any]:
    """Image of an attachment from the pixels that were read."""
    _, components, dtype = _ATTACHMENTS[name]
    image = np.frombuffer(pixels, np.uint8 if dtype == "f1" else dtype)
    return image.reshape(*area.shape, *(() if components == 1 else (components,)))


class SumOfImages:
    """The sum of several images, on the device. All images are drawn into one framebuffer, so that llvmpipe
    draws all of them in one tile of the image before it goes on to the next tile."""

    def __init__(self, ctx: moderngl.Context, depth_buffer: moderngl.Texture, sunlight: bool) -> None:
        self._ctx = ctx
        self._textures = [ctx.texture(depth_buffer.size, n, dtype="f4") for n in (4, 1)[: 1 + sunlight]]
        self._framebuffer = ctx.framebuffer(self._textures, depth_buffer)
        self._framebuffer.use()
        self._framebuffer.clear()

    def start_image(self) -> None:
        """Begin the next image: until :meth:`add_visible`, only OpenGL's depths are drawn."""
        self._write(depths=True)
        self._framebuffer.clear()
        self._ctx.enable_only(moderngl.DEPTH_TEST)

    def add_visible(self) -> None:
        """From now on, add colours to the sum where the depths drawn before show that they are visible."""
        self._write(depths=False)
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        self._ctx.depth_func = "=="
        self._ctx.blend_func = moderngl.ONE, moderngl.ONE

    def _write(self, depths: bool) -> None:
        mask = (not depths,) * 4
        self._framebuffer.color_mask = cast(Any, mask if len(self._textures) == 1 else (mask,) * 2)
        self._framebuffer.depth_mask = depths
        self._framebuffer.use()  # from here on the masks apply
        self._ctx.depth_func = "<"

    def read(self) -> list[Float32Array]:
        """Return (H, W, 4): sums of colours (0 to 1), and number of images that drew the pixel. With
        ``sunlight``, also (H, W, 1): sums of shares of the sun."""
        sums = [np.empty((*one.size[::-1], one.components), np.float32) for one in self._textures]
        for number, one in enumerate(sums):
            self._framebuffer.read_into(one, components=one.shape[2], attachment=number, dtype="f4")
        return sums


#: Most targets in the cache.
_MAX_TARGETS = 64


class RenderTargets(LruCache[ImageSize, RenderTarget]):
    """A cache of targets to draw into, for the most recently used image sizes."""

    def __init__(self, context: OpenGLContext) -> None:
        super().__init__(_MAX_TARGETS)
        self._context = context

    def of(self, size: ImageSize) -> RenderTarget:
        """Return the target of an image size (width and height, pixels). It still has the image drawn
        before."""
        return self.get_or_make(
            size, lambda: RenderTarget(self._context.gl, size, self._context.on_processor)
        )
