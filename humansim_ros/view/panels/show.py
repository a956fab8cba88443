"""Panels of the view: cameras, channels and 3D options, the view through a camera, and the time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from humansim_ros.cameras.camera import Camera
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.scene.pictures import person_color
from humansim_ros.view.panels.page import SPEEDS, Page, plain_markdown
from humansim_ros.view.panels.stage import Options
from humansim_ros.view.server.server import PREFIX
from humansim_ros.view.sources.source import ViewFrame, jpeg_of
from humansim_ros.view.sources.tracks import TrackReader, Tracks

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
    "scans": "Laser scans",
    "room": "Room and objects",
}
#: Choice of all cameras.
ALL = "all"


class ShowPanel:
    """Tab ``Show``: choice of the cameras, image channels and 3D drawings."""

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
                box.visible = option.name != "scans" or bool(source.scanners)
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
    """Choice of a camera to look through. The script ``page/through.js`` shows either the image of this
    camera or the 3D scene with the projection of this camera. Both fill the same rectangle of the page, and
    clicks and names refer to that rectangle."""

    def __init__(self, app: Page) -> None:
        self._app = app
        self._camera: str | None = None
        self._number = 0
        self._version: object = None
        app.server.on_request("through", self._picked)
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
        """Move the view to the pose of the chosen camera, and show its image or the 3D scene from there."""
        camera = frame.cameras.get(self._camera or "")
        if camera is None or self._camera is None:
            self._app.send_state(through=None)
            return
        for client in self._app.server.viser.get_clients().values():
            with client.atomic():
                client.camera.wxyz = matrix_to_quaternion(camera.R.T[None])[0][[3, 0, 1, 2]]
                client.camera.position = camera.center
        with_lens = self._kind.value == _WITH_LENS
        if with_lens:
            self._serve_image(frame)
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        self._app.send_state(
            through={
                "camera": self._camera,
                "size": list(camera.size),
                "K": [fx, fy, cx, cy],
                "image": f"{PREFIX}through.jpg?{self._number}" if with_lens and self._number else None,
                "lens": with_lens,
                "names": _names_in(camera, frame) if with_lens and self._app.options.names else [],
            }
        )

    def remove(self) -> None:
        """Remove the panel."""
        self._app.through = None
        self._app.send_state(through=None)
        self._folder.remove()

    def _serve_image(self, frame: ViewFrame) -> None:
        """Serve the image of the camera if the frame has a new image."""
        images = frame.images.get(self._camera or "", {})
        if images and frame.images is not self._version:
            self._version = frame.images
            self._number += 1
            self._app.server.add_file("through.jpg", "image/jpeg", jpeg_of(next(iter(images.values()))))

    def _choose(self) -> None:
        chosen = self._choice.value
        self._camera = chosen if chosen in self._app.source.cameras else None
        self._number, self._version = 0, None
        self._app.through = self._camera if self._kind.value == _WITH_LENS else None
        self._app.hide_camera(self._camera)
        self._app.refresh()

    def _picked(self, query: Mapping[str, str]) -> None:
        """Handle a click in the image of the camera, which the script reports. Runs in the thread of the
        server."""
        camera = self._camera
        try:
            across, down = float(query["across"]), float(query["down"])
        except (KeyError, ValueError):
            return
        if camera is not None and 0 <= across < 1 and 0 <= down < 1:
            self._app.post(lambda: self._app.pick_pixel(camera, across, down))


def _names_in(camera: Camera, frame: ViewFrame) -> list[tuple[str, float, float]]:
    """Names of the people in view, with x and y of a point above the head as shares of the image size."""
    width, height = camera.size
    found = []
    for name, joints in frame.joints.items():
        positions = joints[:, :3, 3]
        over = [*positions[:, :2].mean(axis=0), positions[:, 2].max() + 0.2]
        (x, y), depth = camera.project([over])[0][0], camera.project([over])[1][0]
        if depth > 0 and -0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5:
            found.append((name, (float(x) + 0.5) / width, (float(y) + 0.5) / height))
    return found


# --- the time

#: A timeline needs at least this number of frames. Most digits of a frame number that a page sends.
_FEWEST, _DIGITS = 2, 12
#: Longest waits before the tracks are read, seconds: for the first images (which may never come), and then
#: until the browser has drawn these images.
_PATIENCE, _DRAWING = 20.0, 3.0
#: Seconds between two updates of the timeline of a running graph.
_LIVE_EVERY = 0.8
#: Seconds between two updates of the text of the time while the page plays.
_TELL = 0.2
_PLAY, _PAUSE = "Play", "Pause"
_BACK, _ON = "◀ frame", "frame ▶"


class TimelinePanel:
    """The controls of the time: play, step, speed, loop, and a slider of the frames."""

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
        self._shown, self._told = "", 0.0

        # a coroutine: it runs before anything else can set the slider
        async def seek(event: Any) -> None:
            if event.client_id is not None:
                index = int(self._slider.value)
                app.post(lambda: app.seek(index))

        self._slider.on_update(seek)
        app.server.on_request("key", lambda query: app.post(lambda: self.use(query.get("action", ""))))
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
        if timing := self._app.source.timing:
            text += f"\n\n{plain_markdown(timing)}"
        now = time.monotonic()
        if text != self._shown and (not player.playing or now - self._told > _TELL):
            self._text.content = text
            self._shown, self._told = text, now

    def remove(self) -> None:
        """Remove the panel."""
        for handle in (self._slider, self._play, self._steps, self._speed, self._loop, self._text):
            handle.remove()

    def use(self, action: str) -> None:
        """Do the action of a key that the user pressed, such as ``play`` or ``undo`` (``page/keys.js``)."""
        frames = self._app.player.frames
        if action == "play" and frames != 1:
            self._toggle()
        elif action in ("undo", "redo"):
            self._app.step_back(redo=action == "redo")
        elif frames is not None and action in ("back", "on"):
            self._step(_ON if action == "on" else _BACK)
        elif frames is not None and action in ("first", "last"):
            self._app.seek(0 if action == "first" else frames - 1)

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


# --- the timeline along the bottom of the page


class TracksPanel:
    """The timeline at the bottom of the page: tracks and joint curves of the source, drawn by
    ``page/timeline.js``.

    Attributes:
        notes: Messages for the user about the tracks.
    """

    def __init__(self, app: Page) -> None:
        self._app = app
        self.notes: list[str] = []
        self._reader = TrackReader(lambda *found: app.post(lambda: self._take(*found)))
        self._tracks: Tracks | None = None
        self._curve: tuple[str, str] = ("", "")
        self._source = self._version = 0
        self._patient_until = self._due = 0.0
        app.server.on_request("seek", self._sought)
        app.server.on_request("curve", self._chosen)

    def show(self) -> None:
        """Begin the timeline anew for the present source of the page."""
        self._tracks, self.notes = None, []
        self._source = self._reader.show(self._app.source.tracks())
        self._patient_until = time.monotonic() + _PATIENCE
        frames = self._app.player.frames
        if frames is None or frames < _FEWEST:
            self._publish(None)
            return
        self._publish({"frames": frames, "period": self._app.source.period * 1e-9})

    def update(self, frame: ViewFrame) -> None:
        """Start to read the tracks once the page has shown its first images, which have priority."""
        app = self._app
        now = time.monotonic()
        if frame.image_index is not None:  # the browser begins to draw now
            self._patient_until = min(self._patient_until, now + _DRAWING)
        if now > self._patient_until or not (app.shown_cameras and app.shown_channels):
            self._reader.begin()

    def follow(self) -> None:
        """Update the timeline of a running graph with new messages, even while the page is paused."""
        if self._app.player.frames is not None or time.monotonic() < self._due:
            return
        self._due = time.monotonic() + _LIVE_EVERY
        found = self._app.source.live_tracks()
        if found is not None:
            self._tracks = found
            self._publish(self._table(found))

    def close(self) -> None:
        """End the process that reads tracks."""
        self._reader.close()

    def _take(self, source: int, found: Tracks | str) -> None:
        if source != self._source:
            return
        if isinstance(found, str):
            frames = {"frames": self._app.player.frames, "period": self._app.source.period * 1e-9}
            self._publish(frames | {"problem": found})
            return
        self._tracks = found
        self._publish(self._table(found))
        if found.errors.note:
            self.notes = [f"Estimate: {found.errors.note}."]
            self._app.refresh()

    def _table(self, tracks: Tracks) -> dict[str, Any]:
        numbers = {name: number for number, name in enumerate(self._app.source.people)}
        table = tracks.table()
        for person in table["people"]:
            person["color"] = "#{:02x}{:02x}{:02x}".format(*person_color(numbers.get(person["name"], 0)))
        live = self._app.player.frames is None
        return table | {"curve": tracks.curve(*self._curve), "live": live}

    def _publish(self, table: Mapping[str, Any] | None) -> None:
        """Serve a table of tracks, and notify the script. If ``table`` is None, the page has no timeline."""
        self._version += 1
        if table is not None:
            self._app.server.add_json("tracks.json", table)
        self._app.send_state(tracks=None if table is None else self._version)

    def _sought(self, query: Mapping[str, str]) -> None:
        """Handle a click or drag on the timeline, which the script reports. Runs in the thread of the
        server."""
        text = query.get("frame", "")
        if text.isdecimal() and len(text) < _DIGITS:
            index = int(text)
            seek = self._app.scrub if query.get("drag") else self._app.seek
            self._app.post(lambda: seek(index))

    def _chosen(self, query: Mapping[str, str]) -> None:
        """Handle the choice of the joint that the curves show. Runs in the thread of the server."""
        chosen = query.get("person", ""), query.get("joint", "")

        def choose() -> None:
            self._curve = chosen
            if self._tracks is not None:
                self._publish(self._table(self._tracks))

        self._app.post(choose)
