"""Panel of the time: play, pause, step, scrub, speed, loop."""

from __future__ import annotations

from typing import Any

from humansim_ros.view.page_interface import Page
from humansim_ros.view.player import SPEEDS
from humansim_ros.view.source import ViewFrame

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
        self._loop.on_update(lambda _: app.post(self._set_loop))

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

    def _set_loop(self) -> None:
        self._app.player.loop = bool(self._loop.value)
