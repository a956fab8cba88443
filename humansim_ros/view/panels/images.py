"""Images of the cameras next to the 3D scene, and the numbers of a click."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from humansim_ros.types import Image
from humansim_ros.view.panels.page import Page
from humansim_ros.view.sources.source import PixelInfo, ViewFrame, jpeg_of

#: First number of a message with images. A message with poses begins with a frame number instead.
_IMAGES = 0xFFFFFFFF


def images_message(images: Mapping[str, Mapping[str, Image]]) -> bytes:
    """Encode images (H, W, 3), by camera and channel, as a message for the page's script (``page/tiles.js``).

    The message has uint32 0xFFFFFFFF; uint32 length of the table in bytes; the table, a JSON list of
    ``camera``, ``channel``, ``width``, ``height`` (pixels) and ``bytes``. Then the JPEG files, in the order
    of the table.
    """
    table: list[dict[str, Any]] = []
    files = []
    for camera, channels in images.items():
        for channel, image in channels.items():
            file = jpeg_of(image)
            height, width = image.shape[:2]
            table.append(
                {"camera": camera, "channel": channel, "width": width, "height": height, "bytes": len(file)}
            )
            files.append(file)
    head = json.dumps(table).encode()
    return b"".join([np.array([_IMAGES, len(head)], np.uint32).tobytes(), head, *files])


class ImagesPanel:
    """The chosen images, as tiles next to the 3D scene, which the script ``page/tiles.js`` draws."""

    def __init__(self, app: Page) -> None:
        self._app = app
        self._version: object = None
        app.server.on_request("pick", self._picked)
        app.server.on_request("enlarge", self._enlarged)

    def update(self, frame: ViewFrame) -> None:
        """Show the images of a frame."""
        app = self._app
        # the image of a camera that is looked through fills the page
        shown = bool(app.shown_cameras and app.shown_channels) and app.through is None
        # images that come soon after the start: the page shows them first
        soon = len(app.shown_cameras) * len(app.shown_channels) if app.source.renders and shown else 0
        app.send_state(tiles=shown, large=app.enlarged, expected=soon)
        if not shown or frame.images is self._version:
            return
        self._version = frame.images
        app.server.stream(images_message(frame.images), "images")

    def remove(self) -> None:
        """Remove the panel."""
        self._app.send_state(tiles=False)
        self._app.server.stream(images_message({}), "images")

    def _picked(self, query: Mapping[str, str]) -> None:
        """Handle a click in an image, which the script of the page reports. Runs in the thread of the
        server."""
        try:
            across, down = float(query["across"]), float(query["down"])
            camera = query["camera"]
        except (KeyError, ValueError):
            return
        if 0 <= across < 1 and 0 <= down < 1:
            self._app.post(lambda: self._app.pick_pixel(camera, across, down))

    def _enlarged(self, query: Mapping[str, str]) -> None:
        """Handle that the user enlarged an image, or made it small again (query without camera). Runs in the
        thread of the server."""
        tile = query.get("camera", ""), query.get("channel", "")

        def enlarge() -> None:
            self._app.enlarged = tile if tile[0] in self._app.source.cameras else None
            self._app.refresh()

        self._app.post(enlarge)


# --- numbers of a click

_HINT = "Click a person in 3D, or a pixel of an image."


class NumbersPanel:
    """Tab ``Numbers``: table of the values at the point that was clicked last."""

    def __init__(self, app: Page) -> None:
        with app.tabs["Numbers"]:
            self._text = app.gui.add_markdown(_HINT)

    def show(self, info: PixelInfo) -> None:
        """Show the values of a pixel or point as a table."""
        cells = {name: text.replace("|", "\\|").replace("\n", " ") for name, text in info.values.items()}
        rows = "\n".join(f"| {name} | {text} |" for name, text in cells.items())
        self._text.content = f"| | |\n|---|---|\n{rows}"

    def remove(self) -> None:
        """Remove the panel."""
        self._text.remove()
