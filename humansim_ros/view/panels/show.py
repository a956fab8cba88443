"""Panel of what is shown: cameras and channels of the images, and what is drawn in 3D."""

from __future__ import annotations

from dataclasses import fields

from humansim_ros.view.page_interface import Page
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
_ALL = "all"


class ShowPanel:
    """Checkboxes of channels, cameras and of what is drawn."""

    def __init__(self, app: Page) -> None:
        gui, source = app.gui, app.source
        self._app = app
        names = list(source.cameras)
        self._channels = {}
        self._options = {}
        with app.tabs["Show"], gui.add_folder("Images", visible=bool(names), order=1) as self._images:
            self._camera = gui.add_dropdown("Cameras", (_ALL, *names), initial_value=_ALL)
            for channel in source.channels:
                box = gui.add_checkbox(channel, channel == source.channels[0])
                box.on_update(lambda _: app.post(self._choose))
                self._channels[channel] = box
            self._camera.on_update(lambda _: app.post(self._choose))
        with app.tabs["Show"], gui.add_folder("3D", order=3) as self._drawn:
            for option in fields(Options):
                box = gui.add_checkbox(_LABELS[option.name], bool(option.default))
                box.on_update(lambda _: app.post(self._draw))
                self._options[option.name] = box
            self._dark = gui.add_checkbox("Dark page", app.dark)
            self._dark.on_update(lambda _: app.post(lambda: app.set_dark(bool(self._dark.value))))
        self._choose()

    def remove(self) -> None:
        """Remove the panel."""
        self._images.remove()
        self._drawn.remove()

    def _choose(self) -> None:
        names = list(self._app.source.cameras)
        chosen = self._camera.value
        self._app.shown_cameras = tuple(name for name in names if chosen in (_ALL, name))
        self._app.shown_channels = tuple(name for name, box in self._channels.items() if box.value)
        self._app.refresh()

    def _draw(self) -> None:
        self._app.set_options(Options(**{name: bool(box.value) for name, box in self._options.items()}))
