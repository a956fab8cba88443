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
#: Choice of all cameras.
ALL = "all"


class ShowPanel:
    """Checkboxes of channels, cameras and of what is drawn."""

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
