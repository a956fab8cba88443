"""Panel that starts ``humansim`` commands on the scene, such as record, and their processes."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
from collections import deque
from pathlib import Path

from humansim_ros.errors import HumansimError, printable
from humansim_ros.view.document import SceneDocument
from humansim_ros.view.panels.page import Page
from humansim_ros.view.server import check_value

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


# --- processes of commands

#: Commands that the page starts.
COMMANDS = ("run", "record", "export", "evaluate")
#: Lines that are kept, characters of a line, and seconds for an end in order.
_LINES, _WIDTH, _PATIENCE = 12, 200, 10.0
#: Lines of progress: ``120 of 300 frames, …``.
_PROGRESS = re.compile(r"(\d+) of (\d+) ")


def command_words(text: str, folder: Path) -> list[str]:
    """Words of a command line such as ``humansim record scene.yaml -o bag``.

    ``folder``: files that it names must be below it.

    Raises:
        HumansimError: It is not one of the commands that the page starts, or names another file.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise HumansimError(f"the command line cannot be read: {error}") from None
    if words[:1] != ["humansim"] or len(words) < 2 or words[1] not in COMMANDS or "\0" in text:
        known = ", ".join(COMMANDS)
        raise HumansimError(f"give 'humansim' with one of {known}; found {printable(text, 60)!r}")
    for word in words[2:]:
        for value in {word, *word.split(",")}:  # a list has commas
            check_value(folder, re.sub(r"^--?[\w-]*=?", "", value))
    return words


class Job:
    """A command that runs in a process of its own.

    Args:
        text: Command line; it begins with ``humansim``.
        folder: Folder that it runs in.

    Raises:
        HumansimError: The command line is wrong, or the process cannot start.
    """

    def __init__(self, text: str, folder: Path) -> None:
        words = command_words(text, folder)
        self.text = text
        self._lines: deque[str] = deque(maxlen=_LINES)
        self._progress = 0.0
        self._stopped = False
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "humansim_ros", *words[1:]],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=os.environ | {"PYTHONUNBUFFERED": "1"},
                start_new_session=True,  # Ctrl-C of the page's terminal is for the page
            )
        except (OSError, ValueError) as error:
            raise HumansimError(f"the command cannot start: {error}") from None
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def lines(self) -> list[str]:
        """The last lines that it has printed."""
        return list(self._lines)

    @property
    def progress(self) -> float:
        """Share that is done, 0 to 1, as its last line says."""
        return 1.0 if self.code == 0 else self._progress

    @property
    def code(self) -> int | None:
        """Exit code; None while it runs."""
        return self._process.poll()

    @property
    def state(self) -> str:
        """State in words."""
        if self.code is None:
            return "is stopping" if self._stopped else "runs"
        if self._stopped:
            return "was stopped"
        return "has finished" if self.code == 0 else f"has failed with exit code {self.code}"

    def stop(self) -> None:
        """Ask the process to end. Not by SIGINT, which background jobs of a shell ignore."""
        self._stopped = True
        if self.code is None:
            self._process.terminate()

    def close(self) -> None:
        """End it, by force after ten seconds."""
        if self.code is None:
            self.stop()
            try:
                self._process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
        self._reader.join(1)

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as output:
            for line in iter(lambda: output.readline(1 << 16), b""):
                self.take_line(line.decode(errors="replace"))

    def take_line(self, line: str) -> None:
        """Keep a line of its output, and the progress in it."""
        text = line.rstrip()
        if text:
            self._lines.append(printable(text, _WIDTH))
        if found := _PROGRESS.search(text):
            self._progress = min(1.0, int(found[1]) / max(1, int(found[2])))
