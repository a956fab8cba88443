"""Panel that starts ``humansim`` commands on the scene: run, record, export, evaluate."""

from __future__ import annotations

import shlex
from pathlib import Path

from humansim_ros.errors import HumansimError
from humansim_ros.view.document import SceneDocument
from humansim_ros.view.jobs import COMMANDS, Job
from humansim_ros.view.page_interface import Page

_START, _STOP = "Start", "Stop"
#: Options that a command needs, as a beginning.
_BEGINNINGS = {
    "run": "humansim run {scene}",
    "record": "humansim record {scene} -o {stem}_bag --frames 100",
    "export": "humansim export {scene} -o {stem}_export --format coco --frames 100",
    "evaluate": "humansim evaluate --truth {scene} --estimate estimate.csv",
}


class CommandsPanel:
    """The tab ``Run`` of a page: the command line, a button, and the progress.

    Args:
        app: The page. All methods run in its thread.
        document: The scene that the commands get.
    """

    def __init__(self, app: Page, document: SceneDocument) -> None:
        self._app, self._document = app, document
        self._shown = ""
        self.job: Job | None = None
        gui = app.gui
        with app.tabs["Run"]:
            self._choice = gui.add_button_group("Command", COMMANDS)
            self._text = gui.add_text(
                "Line", "", hint="the command that the button starts; copy it to a terminal for the same"
            )
            self._button = gui.add_button(_START)
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._output = gui.add_markdown("")
        self._choice.on_click(lambda event: app.post(lambda: self.choose(event.target.value)))
        self._button.on_click(lambda _: app.post(self.toggle))
        self.choose(COMMANDS[0])

    def choose(self, command: str) -> None:
        """Show the line of a command for this scene."""
        path = self._document.path or Path("scene.yaml")
        scene, stem = shlex.quote(str(path.resolve())), shlex.quote(path.stem)
        self._text.value = _BEGINNINGS[command].format(scene=scene, stem=stem)

    def toggle(self) -> None:
        """Start the command, or stop the one that runs."""
        if self.job is not None and self.job.code is None:
            self.job.stop()
        else:
            self.start(self._text.value)
        self.update()

    def start(self, text: str) -> None:
        """Start a command line in the folder of the scene; an error is shown."""
        try:
            if self._document.path is None or self._document.changed:
                raise HumansimError("commands read the file of the scene: save it first")
            self.job = Job(text, self._document.folder)
        except HumansimError as error:
            self._app.notify("Not started", str(error))

    def update(self) -> None:
        """Show the state of the command; the page calls this again and again."""
        if self.job is None:
            return
        running = self.job.code is None
        shown = "\n".join([f"`humansim` {self.job.state}", "", "```text", *self.job.lines, "```"])
        if shown == self._shown:
            return
        self._shown = shown
        self._output.content = shown
        self._button.label = _STOP if running else _START
        self._bar.visible, self._bar.value = running, 100 * self.job.progress
        self._bar.animated = running

    def close(self) -> None:
        """End the command that runs."""
        if self.job is not None:
            self.job.close()
