"""Panels of the view: cameras, channels and 3D options, the view through a camera, and the time."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np

from humansim_ros.rotations import matrix_to_quaternion
from humansim_ros.types import Image
from humansim_ros.view.panels.page import SPEEDS, Page
from humansim_ros.view.source import ViewFrame
from humansim_ros.view.stage import Options

_LABELS = {
    "cameras": "Cameras",
    "images": "Images in cameras",
    "names": "Names",
    "axes": "Axes of map",
    "joints": "Joints",
    "joint_names": "Joint names",
    "trails": "Trails",
    "boxes": "Boxes",
    "coverage": "Coverage of the floor",
    "room": "Room and objects",
}
#: Choice of all cameras.
ALL = "all"


class ShowPanel:
    """Boxes and lists to choose cameras, channels and 3D options."""

    def __init__(self, app: Page) -> None:
        gui, source = app.gui, app.source
        self._app = app
        names = list(source.cameras)
        if app.chosen_camera not in names:
            app.chosen_camera = ALL
        self._channels = {}
        self._options = {}
        with app.tabs["Show"], gui.add_folder("Images", visible=bool(names), order=1) as self._images:
            self._camera = gui.add_dropdown("Cameras", (ALL, *names), initial_value=app.chosen_camera)
            for channel in source.channels:
                box = gui.add_checkbox(channel, channel in app.shown_channels)
                box.on_update(lambda _: app.post(self._choose))
                self._channels[channel] = box
            self._camera.on_update(lambda _: app.post(self._choose))
        with app.tabs["Show"], gui.add_folder("3D", order=3) as self._drawn:
            for option in fields(Options):
                box = gui.add_checkbox(_LABELS[option.name], bool(getattr(app.options, option.name)))
                box.on_update(lambda _: app.post(self._draw))
                self._options[option.name] = box
            self._dark = gui.add_checkbox("Dark page", app.dark)
            self._dark.on_update(lambda _: app.post(lambda: app.set_dark(bool(self._dark.value))))
        self._choose()
        if app.options != Options():
            self._draw()

    def remove(self) -> None:
        """Remove the panel."""
        self._images.remove()
        self._drawn.remove()

    def _choose(self) -> None:
        names = list(self._app.source.cameras)
        chosen = self._app.chosen_camera = str(self._camera.value)
        self._app.shown_cameras = tuple(name for name in names if chosen in (ALL, name))
        self._app.shown_channels = tuple(name for name, box in self._channels.items() if box.value)
        self._app.refresh()

    def _draw(self) -> None:
        self._app.set_options(Options(**{name: bool(box.value) for name, box in self._options.items()}))


# --- the view through a camera

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


# --- the time

_PLAY, _PAUSE = "Play", "Pause"
_BACK, _ON = "◀ frame", "frame ▶"


class TimelinePanel:
    """The controls of the player of a page."""

    def __init__(self, app: Page) -> None:
        gui, player = app.gui, app.player
        self._app = app
        self._live = player.frames is None
        self._last = last = max((player.frames or 2) - 1, 1)
        still = player.frames == 1
        recorded = not (self._live or still)
        with app.head:
            self._slider: Any = gui.add_slider(
                "Frame", min=0, max=last, step=1, initial_value=0, visible=recorded
            )
            self._play = gui.add_button(_PAUSE if player.playing else _PLAY, visible=not still)
            self._steps = gui.add_button_group("Step", (_BACK, _ON), visible=recorded)
            self._speed = gui.add_dropdown(
                "Speed", SPEEDS, initial_value=f"{player.speed:g}", visible=recorded
            )
            self._loop = gui.add_checkbox("Loop", player.loop, visible=recorded)
            self._text = gui.add_markdown("")
        self._shown = ""

        # a coroutine: it runs before anything else can set the slider
        async def seek(event: Any) -> None:
            if event.client_id is not None:
                index = int(self._slider.value)
                app.post(lambda: app.seek(index))

        self._slider.on_update(seek)
        self._play.on_click(lambda _: app.post(self._toggle))
        self._steps.on_click(lambda _: app.post(lambda: self._step(self._steps.value)))
        self._speed.on_update(lambda _: app.post(self._set_speed))
        self._loop.on_update(lambda _: app.post(lambda: setattr(player, "loop", bool(self._loop.value))))

    def update(self, frame: ViewFrame) -> None:
        """Show the time of a frame."""
        player = self._app.player
        index = frame.index
        if not self._live and self._slider.value != index:
            self._slider.value = min(index, self._last)
        label = _PAUSE if player.playing else _PLAY
        if self._play.label != label:
            self._play.label = label
        late = ""
        if frame.image_index is not None and frame.image_index != index:
            late = f", images of frame {frame.image_index}"
        text = f"{frame.scene_time * 1e-9:.3f} s, stamp {frame.stamp} ns{late}"
        if text != self._shown and (not player.playing or index % 5 == 0):
            self._text.content = text
            self._shown = text

    def remove(self) -> None:
        """Remove the panel."""
        for handle in (self._slider, self._play, self._steps, self._speed, self._loop, self._text):
            handle.remove()

    def _toggle(self) -> None:
        player = self._app.player
        if not player.playing and player.frames is not None and player.index == player.frames - 1:
            player.seek(0)
        player.playing = not player.playing
        self._app.refresh()

    def _step(self, which: str) -> None:
        self._app.player.step(1 if which == _ON else -1)
        self._app.refresh()

    def _set_speed(self) -> None:
        if self._speed.value in SPEEDS:
            self._app.player.speed = float(self._speed.value)
