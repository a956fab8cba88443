"""Panel to look through a camera: its image with its lens fills the page."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from humansim_ros.rotations import matrix_to_quaternion
from humansim_ros.view.page_interface import Page
from humansim_ros.view.source import ViewFrame

_FREE = "free view"
_WITH_LENS, _WITHOUT = "its image, with its lens", "3D from its position"


class ThroughPanel:
    """Choice of a camera to look through, for each browser."""

    def __init__(self, app: Page) -> None:
        self._app = app
        self._camera: str | None = None
        self._shows_image = False
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
        if self._kind.value == _WITH_LENS:
            images = frame.images.get(self._camera, {})
            if images and frame.images is not self._version:
                self._version = frame.images
                image = next(iter(images.values()))
                # a depth of zero: the image is in front of everything
                self._set_background(image, np.zeros((2, 2), np.float32))
                self._shows_image = True
        elif self._shows_image:
            self._set_background(None, None)
            self._shows_image = False
        for client in self._app.server.viser.get_clients().values():
            with client.atomic():
                client.camera.wxyz = matrix_to_quaternion(camera.R.T[None])[0][[3, 0, 1, 2]]
                client.camera.position = camera.center
                client.camera.fov = 2 * math.atan2(camera.size[1] / 2, camera.K[1, 1])

    def remove(self) -> None:
        """Remove the panel."""
        if self._shows_image:
            self._set_background(None, None)
        self._folder.remove()

    def _set_background(self, image: Any, depth: Any) -> None:
        self._app.server.viser.scene.set_background_image(image, format="jpeg", depth=depth)

    def _choose(self) -> None:
        chosen = self._choice.value
        self._camera = chosen if chosen in self._app.source.cameras else None
        self._version = None
        if self._camera is None and self._shows_image:
            self._set_background(None, None)
            self._shows_image = False
        self._app.refresh()
