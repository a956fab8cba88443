"""Panels of the images (a column for each camera, a row for each channel) and of the numbers of a click."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from humansim_ros.drawing.canvas import draw_text
from humansim_ros.types import Image
from humansim_ros.view.panels.page import Page
from humansim_ros.view.source import PixelInfo, ViewFrame

#: Distance of the panel from the edge, and its width, pixels; in narrow pages a share of theirs.
_EDGE, _PANEL_WIDTH, _PANEL_SHARE = 12, 640, 0.9
#: Greatest width of the mosaic in pixels, and the gap between its tiles.
_WIDTH, _GAP = 1280, 4
_BACKGROUND = 32


@dataclass(frozen=True)
class Tile:
    """Place of an image in the mosaic, in pixels, and the scale at which it is drawn."""

    camera: str
    channel: str
    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class Mosaic:
    """Images of cameras and channels as one image."""

    image: Image
    tiles: tuple[Tile, ...]

    def find(self, x: float, y: float) -> tuple[Tile, float, float] | None:
        """Tile at a point of the mosaic, and the point in it as shares of its width and height."""
        for tile in self.tiles:
            across, down = (x - tile.left) / tile.width, (y - tile.top) / tile.height
            if 0 <= across < 1 and 0 <= down < 1:
                return tile, across, down
        return None


def mosaic(images: Mapping[str, Mapping[str, Image]]) -> Mosaic | None:
    """Arrange images (H, W, 3) by camera and channel: a column for each camera, a row for each channel.

    More than four cameras fill several blocks of rows. None without images.
    """
    cameras = [name for name in images if images[name]]
    if not cameras:
        return None
    columns = min(4 if len(cameras) <= 8 else 6, len(cameras))
    across = min(_WIDTH // columns, max(images[name][c].shape[1] for name in cameras for c in images[name]))
    tiles: list[tuple[Tile, Image]] = []
    top = 0
    for start in range(0, len(cameras), columns):
        block = cameras[start : start + columns]
        for channel in images[block[0]]:
            tallest = 0
            for column, camera in enumerate(block):
                image = images[camera].get(channel)
                if image is None:
                    continue
                height = max(1, round(image.shape[0] * across / image.shape[1]))
                tiles.append((Tile(camera, channel, column * (across + _GAP), top, across, height), image))
                tallest = max(tallest, height)
            top += tallest + _GAP
    canvas = np.full((top - _GAP, columns * (across + _GAP) - _GAP, 3), _BACKGROUND, np.uint8)
    several = len({tile.channel for tile, _ in tiles}) > 1
    for tile, image in tiles:
        method = cv2.INTER_AREA if image.shape[1] > tile.width else cv2.INTER_NEAREST
        small = image
        if image.shape[1] != tile.width:
            small = np.asarray(
                cv2.resize(image, (tile.width, tile.height), interpolation=method), dtype=np.uint8
            )
        canvas[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width] = small
        label = f"{tile.camera}  {tile.channel}" if several else tile.camera
        for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            draw_text(canvas, label, (tile.left + 5, tile.top + tile.height - 7), 0.45, color, thickness)
    return Mosaic(canvas, tuple(tile for tile, _ in tiles))


class ImagesPanel:
    """The mosaic of all images that were chosen."""

    def __init__(self, app: Page) -> None:
        self._app = app
        self._panel = app.gui.add_panel()
        self._tab = self._panel.add_tab("Images")
        with self._tab:
            self._handle: Any = None
            first = "The first images are being rendered." if app.source.cameras else "There are no cameras."
            self._hint = app.gui.add_markdown(first)
        self._panel.float(x=_EDGE, y=-_EDGE, width=_PANEL_WIDTH)
        self._placed = False
        self._mosaic: Mosaic | None = None
        self._version: object = None
        app.server.on_request("pick", self._picked)

    def update(self, frame: ViewFrame) -> None:
        """Show the images of a frame."""
        self._fit()
        visible = self._app.through is None  # else the image fills the page
        if self._panel.visible != visible:
            self._panel.visible = visible
        if frame.images is self._version:
            return
        self._version = frame.images
        made = mosaic(frame.images)
        self._mosaic = made
        if made is None:
            return
        if self._handle is None:
            with self._tab:
                self._handle = self._app.gui.add_image(made.image, jpeg_quality=80)
            self._hint.content = "Click an image for the numbers of a pixel."
        else:
            self._handle.image = made.image

    def _fit(self) -> None:
        """Make the panel narrow in the first page that is narrow."""
        if self._placed:
            return
        for client in self._app.server.viser.get_clients().values():
            width = min(_PANEL_WIDTH, round(_PANEL_SHARE * client.camera.image_width))
            self._panel.set_width(max(width, 200))
            self._placed = True
            return

    def remove(self) -> None:
        """Remove the panel."""
        self._panel.remove()

    def _picked(self, query: Mapping[str, str]) -> None:
        """A click in an image of the page, told by its script; in the server's thread."""
        try:
            x, y, width, height = (float(query[key]) for key in ("x", "y", "width", "height"))
        except (KeyError, ValueError):
            return
        made = self._mosaic
        if made is None or (height, width) != made.image.shape[:2]:
            return
        found = made.find(x, y)
        if found is not None:
            tile, across, down = found
            self._app.post(lambda: self._app.pick_pixel(tile.camera, across, down))


# --- numbers of a click

_HINT = "Click a person in 3D, or a pixel of an image."


class NumbersPanel:
    """Table of the numbers of what was clicked last."""

    def __init__(self, app: Page) -> None:
        with app.tabs["Numbers"]:
            self._text = app.gui.add_markdown(_HINT)

    def show(self, info: PixelInfo) -> None:
        """Show numbers."""
        cells = {name: text.replace("|", "\\|").replace("\n", " ") for name, text in info.values.items()}
        rows = "\n".join(f"| {name} | {text} |" for name, text in cells.items())
        self._text.content = f"| | |\n|---|---|\n{rows}"

    def remove(self) -> None:
        """Remove the panel."""
        self._text.remove()
