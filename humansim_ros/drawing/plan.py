"""Plan views, from above: metres to pixels, the grid, labels, cameras, and the colours of coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.drawing.canvas import GRID, INK, PAPER, draw_disc, draw_line, draw_text, text_size
from humansim_ros.types import Array, Color, Image

#: Grid lines through the origin, and lines from cameras down to the floor.
SHADE: Color = (168, 172, 180)
#: Colour of places that no camera sees.
_UNSEEN: Color = (214, 216, 220)
#: Most steps of a legend.
_LEVELS = 10
#: Points along each side of a distorted image.
_BORDER_POINTS = 16


@dataclass(frozen=True)
class Plan:
    """Plan view, x to the right and y up.

    Attributes:
        corner: x, y of its top left corner in ``map``, metres.
        scale: Pixels per metre.
        size: Width and height of the image in pixels.
        margin: Pixels at the left and the lower edge, for the numbers along the axes.
    """

    corner: Array
    scale: float
    size: tuple[int, int]
    margin: int

    @classmethod
    def fitting(cls, low: Array, high: Array, size: tuple[int, int], margin: int) -> Plan:
        """Plan of an area with a border around it.

        Args:
            low: Least x and y of the area, (2,) metres.
            high: Greatest x and y, (2,) metres.
            size: Width and height of the image in pixels.
            margin: Pixels at the left and the lower edge.
        """
        room = np.array(size, dtype=float) - margin
        scale = float((room / np.maximum((high - low) * 1.2, 1e-9)).min())
        return cls((low + high) / 2 + room / scale / 2 * np.array([-1, 1]), scale, size, margin)

    @property
    def extent(self) -> Array:
        """Width and height (2,) of what it shows, metres."""
        return np.asarray((np.array(self.size, dtype=float) - self.margin) / self.scale)

    def pixels(self, points: Array) -> Array:
        """Pixels (N, 2) of points (N, 2) or (N, 3)."""
        return np.asarray((points[..., :2] - self.corner) * self.scale * [1, -1] + [self.margin, 0])

    def has(self, pixel: Array) -> bool:
        """Whether a pixel (2,) is inside the margins."""
        width, height = self.size
        return bool(((pixel >= [self.margin, 0]) & (pixel < [width, height - self.margin])).all())

    def positions(self, step: int) -> tuple[Array, Array]:
        """x (W,) and y (H,) of positions every ``step`` pixels."""
        width, height = ((np.arange((n - self.margin) // step) + 0.5) * step / self.scale for n in self.size)
        return self.corner[0] + width, self.corner[1] - height

    def draw_field(self, image: Image, x: Array, y: Array, colors: NDArray[np.uint8], step: int) -> None:
        """Draw a square for each position.

        Args:
            image: Image that is drawn on.
            x: Positions along x, (W,), of :meth:`positions`.
            y: Positions along y, (H,).
            colors: Colours of the squares, (H, W, 3).
            step: Side of a square in pixels.
        """
        field = np.repeat(np.repeat(colors, step, axis=0), step, axis=1)
        left, top = np.rint(self.pixels(np.array([x[0], y[0]])) - step / 2).astype(int)
        image[top : top + field.shape[0], left : left + field.shape[1]] = field

    def draw_axes(self, image: Image) -> None:
        """Draw grid lines, with metres along the left and the lower edge."""
        cell = round_cell(float(self.extent.max()))
        last = self.corner + self.extent * [1, -1]
        for axis, start, stop in ((0, self.corner[0], last[0]), (1, last[1], self.corner[1])):
            for step in range(int(np.ceil(start / cell)), int(np.floor(stop / cell)) + 1):
                ends = np.array([self.corner, last])
                ends[:, axis] = step * cell
                pixels = self.pixels(ends)
                draw_line(image, pixels, SHADE if step == 0 else GRID)
                label = f"{step * cell:g}"
                position = pixels[1] + np.array([0, 16]) if axis == 0 else pixels[0] + np.array([-6, 4])
                draw_label(image, label, position, 0.36, anchor="middle" if axis == 0 else "right")


def draw_view(image: Image, center: Array, border: Array, color: Color) -> None:
    """Draw a camera and its field of view.

    Args:
        image: Image that is drawn on.
        center: Pixel of the camera, (2,).
        border: Pixels of the border of its view, (B, 2).
        color: Colour of the lines.
    """
    for corner in border[:: max(1, len(border) // 4)]:
        draw_line(image, [center, corner], color)
    draw_line(image, np.vstack([border, border[:1]]), color)
    draw_disc(image, center, 4, color)


def draw_name(image: Image, text: str, center: Array, backward: Array, margin: int) -> None:
    """Draw a camera's name behind it, or above it where there is no room.

    Args:
        image: Image that is drawn on.
        text: The name.
        center: Pixel of the camera, (2,).
        backward: Direction away from its view, (2,) pixels.
        margin: Pixels at the left edge that stay free.
    """
    width, _ = text_size(text, 0.4)
    x, y = backward / max(float(np.linalg.norm(backward)), 1e-9)
    position = center + 12 * np.array([x, y]) + np.array([0, 4 + 4 * np.sign(y) * (abs(x) <= 0.5)])
    side = 0.0 if abs(x) <= 0.5 else np.sign(x)
    left = position[0] + width * (side - 1) / 2
    if not margin < left < image.shape[1] - width - 2:
        position, left = center - np.array([0, 9]), center[0] - width / 2
    draw_label(image, text, (max(left, margin + 2), position[1]), 0.4, boxed=True)


def draw_label(
    image: Image,
    text: str,
    position: Sequence[float] | Array,
    scale: float,
    color: Color = INK,
    anchor: Literal["left", "middle", "right"] = "left",
    boxed: bool = False,
) -> None:
    """Draw text inside the image.

    Args:
        image: Image that is drawn on.
        text: The text.
        position: x, y of its lower edge in pixels.
        scale: Size of the font, as in :func:`~humansim_ros.drawing.canvas.draw_text`.
        color: Colour of the text.
        anchor: The part of its lower edge that is at ``position``.
        boxed: Draw it on a translucent box.
    """
    width, _ = text_size(text, scale)
    x, y = position
    x -= width * {"left": 0, "middle": 1 / 2, "right": 1}[anchor]
    x = min(max(x, 2), image.shape[1] - width - 2)
    left, bottom = round(float(x)), round(float(np.clip(y, 12, image.shape[0] - 4)))
    if boxed:
        box = image[bottom - 10 : bottom + 4, max(left - 2, 0) : left + width + 2]
        box[:] = np.rint(0.35 * box + 0.65 * np.array(PAPER))
    draw_text(image, text, (left, bottom), scale, color)


def view_border(camera: Camera, reach: float) -> Array:
    """Border (B, 3) of a camera's view at a distance of ``reach`` metres, without pixels that see no ray."""
    width, height = (n - 0.5 for n in camera.size)
    along = np.linspace(0, 1, _BORDER_POINTS if camera.distorted else 1, endpoint=False)
    corners = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    following = np.roll(corners, -1, axis=0)
    pixels = corners[:, None] + along[:, None] * (following - corners)[:, None]
    rays = camera.rays(pixels.reshape(-1, 2))
    rays = rays[np.isfinite(rays).all(axis=1)]
    if len(rays) < 3:  # a fisheye whose image is a disc
        angles = np.linspace(0, 2 * np.pi, 4 * _BORDER_POINTS, endpoint=False)
        rim = camera.lens.valid_radius * np.column_stack([np.cos(angles), np.sin(angles)])
        rays = np.column_stack([rim, np.ones(len(rim))])
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(camera.center + reach * rays @ camera.R, dtype=float)


def round_cell(extent: float) -> float:
    """Size of a grid cell in metres, 1, 2 or 5 times a power of ten: 5 to 12 cells fit into the extent."""
    power = 10.0 ** np.floor(np.log10(extent / 5))
    return float(power * max(step for step in (1, 2, 5) if step * power <= extent / 5 * (1 + 1e-9)))


def coverage_colors(most: int) -> tuple[list[tuple[int, int]], list[Color], NDArray[np.uint8]]:
    """Colours of the number of cameras that see a place.

    ``most``: the greatest number, at least 1.

    Returns:
        Least and greatest number of each step of the legend; its colour; colour of each number (most + 1, 3).
    """
    step = -(-most // _LEVELS)
    levels = [(0, 0), *((least, min(least + step - 1, most)) for least in range(1, most + 1, step))]
    colors = [_UNSEEN, *_ramp(len(levels) - 1)]
    of_count = np.zeros((most + 1, 3), np.uint8)
    for (least, last), color in zip(levels, colors, strict=True):
        of_count[least : last + 1] = color
    return levels, colors, of_count


def _ramp(count: int) -> list[Color]:
    """Colours from dark blue to yellow."""
    values = np.rint(np.linspace(40, 255, count) if count > 1 else np.array([255.0])).astype(np.uint8)
    mapped = cv2.applyColorMap(values[None], cv2.COLORMAP_VIRIDIS)[0]
    return [(int(r), int(g), int(b)) for b, g, r in mapped]
