"""Panel to look through a camera: its image with its lens fills the page."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from humansim_ros.rotations import matrix_to_quaternion
from humansim_ros.types import Image
from humansim_ros.view.page_interface import Page
from humansim_ros.view.source import ViewFrame

_FREE = "free view"
_WITH_LENS, _WITHOUT = "its image, with its lens", "3D from its position"


class ThroughPanel:
    """Choice of a camera to look through, for each browser."""

    def __init__(self, app: Page) -> None:
        self._app = app
        self._camera: str | None = None
        self._covered: set[int] = set()
        self._image: Image | None = None
        self._version: object = None
        names = tuple(app.source.cameras)
        with (
            app.tabs["Show"],
            app.gui.add_folder("Look through", visible=bool(names), order=2) as self._folder,
        ):
            self._choice = app.gui.add_dropdown("Camera", (_FREE, *names), initial_value=_FREE)
            self._kind = app.gui.add_dropdown("Show", (_WITH_LENS, _WITHOUT), initial_value=_WITH_LENS)
        self._choice.on_update(lambda _: app.post(self._choose))
        self._kind.on_update(lambda _: app.post(self._choose))

    def update(self, frame: ViewFrame) -> None:
        """Move the view with the camera, and show its image."""
        camera = frame.cameras.get(self._camera or "")
        if camera is None or self._camera is None:
            return
        image = self._new_image(frame)
        for client in self._app.server.viser.get_clients().values():
            with client.atomic():
                client.camera.wxyz = matrix_to_quaternion(camera.R.T[None])[0][[3, 0, 1, 2]]
                client.camera.position = camera.center
                client.camera.fov = 2 * math.atan2(camera.size[1] / 2, camera.K[1, 1])
            if image is not None or client.client_id not in self._covered:
                self._cover(client, image if image is not None else self._image)

    def remove(self) -> None:
        """Remove the panel."""
        self._uncover()
        self._app.through = None
        self._folder.remove()

    def _new_image(self, frame: ViewFrame) -> Image | None:
        """The image of the camera, if there is a new one."""
        images = frame.images.get(self._camera or "", {})
        if self._kind.value != _WITH_LENS or not images or frame.images is self._version:
            return None
        self._version = frame.images
        self._image = next(iter(images.values()))
        return self._image

    def _cover(self, client: Any, image: Image | None) -> None:
        """Show an image over all of a page, with bars where it has another shape."""
        if image is not None:
            padded = with_bars(image, client.camera.image_width / max(client.camera.image_height, 1))
            # a depth of zero: the image is in front of everything
            client.scene.set_background_image(padded, format="jpeg", depth=np.zeros((2, 2), np.float32))
            self._covered.add(client.client_id)

    def _uncover(self) -> None:
        for client in self._app.server.viser.get_clients().values():
            if client.client_id in self._covered:
                client.scene.set_background_image(None)
        self._covered.clear()
        self._image = self._version = None

    def _choose(self) -> None:
        chosen = self._choice.value
        self._camera = chosen if chosen in self._app.source.cameras else None
        self._uncover()
        self._app.through = self._camera if self._kind.value == _WITH_LENS else None
        self._app.refresh()


def with_bars(image: Image, aspect: float) -> Image:
    """Image with black bars, so that its width is ``aspect`` times its height."""
    height, width = image.shape[:2]
    wide, high = max(width, round(height * aspect)), max(height, round(width / aspect))
    out = np.zeros((high, wide, 3), np.uint8)
    top, left = (high - height) // 2, (wide - width) // 2
    out[top : top + height, left : left + width] = image
    return out
