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
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from urllib.parse import quote

from humansim_ros.errors import HumansimError, printable
from humansim_ros.files.reading import size_text
from humansim_ros.view.edit.document import SceneDocument
from humansim_ros.view.panels.files import FileChoice
from humansim_ros.view.panels.page import Page, by_user, plain_markdown
from humansim_ros.view.server.server import PREFIX, check_value, inside

_START, _STOP = "Start", "Stop"
#: Command lines that the panel offers, with the options that each command needs.
_BEGINNINGS = {
    "run": "humansim run {scene}",
    "record": "humansim record {scene} -o {stem}_bag --frames {frames}",
    "export": "humansim export {scene} -o {stem}_export --format {formats} --frames {frames}",
    "evaluate": "humansim evaluate --truth {scene} --estimate {estimate} --report {stem}_report.html",
    "check": "humansim check {scene}",
    "snapshot": "humansim snapshot {scene} -o {stem}_snapshot.png",
    "open the photographs": "humansim view {views} --no-browser --port 0",
    "fit the photographs": "humansim human fit {views} -o fit.yaml --picture fit.png",
    "texture": "humansim human texture {views} --fit fit.yaml -o {person}.npz --picture {person}.png",
}
#: Entry of the list of other commands that means that none is chosen.
_NO_OTHER = "(another command)"
#: Most links to the files of a result; and most files of a folder that are listed.
_MOST_LINKS, _MOST_LOOKED = 30, 5000
#: Options of commands that name an output file or folder.
_WRITTEN = ("-o", "--output", "--report", "--picture")
#: Address of a page that a command serves.
_ADDRESS = re.compile(r"http://127\.0\.0\.1:\d{2,5}\b")


class CommandsPanel:
    """The tab ``Run`` of a page: the command line, a button that starts the command, and its progress.

    Args:
        app: The page. All methods run in its thread.
        document: The scene that the commands use.
    """

    def __init__(self, app: Page, document: SceneDocument) -> None:
        self._app, self._document = app, document
        self._shown = ""
        self._command = COMMANDS[0]
        self._outputs: list[str] = []
        self.job: Job | None = None
        gui = app.gui
        with app.tabs["Run"]:
            self._choice = gui.add_button_group("Command", COMMANDS)
            self._other = gui.add_dropdown("Other", (_NO_OTHER, *list(_BEGINNINGS)[len(COMMANDS) :]))
            self._frames = gui.add_number("Frames", 100, min=1, max=1_000_000, step=1)
            self._formats = gui.add_text(
                "Formats", "coco", hint="of export: coco, openpose, c3d, bvh … (docs/export.md)"
            )
            self.estimate = FileChoice(app, document, "Estimate", "estimate", self._use_estimate)
            with gui.add_folder("Photographs", expand_by_default=False):
                self.views = FileChoice(
                    app, document, "Views file", "views", lambda _: self.choose("open the photographs")
                )
                self._photo = FileChoice(app, document, "Photographs", "image", lambda _: None)
            self._text = gui.add_text(
                "Line", "", hint="the command that the button starts; copy it to a terminal for the same"
            )
            self._button = gui.add_button(_START)
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._results = gui.add_markdown("")
            self._output = gui.add_markdown("")
        self._choice.on_click(lambda event: app.post(lambda: self.choose(event.target.value)))
        self._button.on_click(lambda _: app.post(self.toggle))
        self._other.on_update(by_user(app.post, lambda: self.choose(str(self._other.value))))
        for handle in (self._frames, self._formats):
            handle.on_update(by_user(app.post, lambda: self.choose(self._command)))
        app.server.result = self.result
        self.choose(COMMANDS[0])

    def choose(self, command: str) -> None:
        """Put the command line of a command for this scene into the text field."""
        if command not in _BEGINNINGS:
            return
        self._command = command
        path = self._document.path or Path("scene.yaml")
        views = self.views.value or "views.yaml"
        values = {
            "scene": path.name if path.resolve().parent == self._document.folder else str(path.resolve()),
            "stem": path.stem,
            "frames": str(int(self._frames.value)),
            "formats": str(self._formats.value).strip(),
            "estimate": self.estimate.value or "estimate.csv",
            "views": views,
            "person": f"{Path(views).stem}_person",
        }
        quoted = {key: shlex.quote(value) for key, value in values.items()}
        self._text.value = _BEGINNINGS[command].format(**quoted)

    def _use_estimate(self, name: str) -> None:
        """Show the command line of an evaluation, and the estimate next to the truth. An empty name means no
        estimate."""
        self.choose("evaluate")
        self._app.compare(self._document.folder / name if name else None)

    def toggle(self) -> None:
        """Start the command, or stop the running one."""
        if self.job is not None and self.job.code is None:
            self.job.stop()
        else:
            self.start(self._text.value)
        self.update()

    def start(self, text: str) -> None:
        """Start a command line in the folder of the scene. If this fails, the error is shown."""
        try:
            words = command_words(text, self._document.folder)
            of_scene = words[1] in (*COMMANDS, "check", "snapshot")
            if of_scene and (self._document.path is None or self._document.changed):
                raise HumansimError("commands read the file of the scene: save it first")
            if self.job is not None and self.job.code is None:
                raise HumansimError("a command runs: stop it first")
            self.job = Job(text, self._document.folder)
            self._outputs += outputs_of(words)
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
        self._results.content = self._links()
        self._button.label = _STOP if running else _START
        self._bar.visible, self._bar.value = running, 100 * self.job.progress
        self._bar.animated = running

    def result(self, name: str) -> Path | None:
        """Path of a file that a command of this page has written, else None. ``name``: path in the folder."""
        folder = self._document.folder
        try:
            path = inside(folder, name)
            written = [inside(folder, output) for output in self._outputs]
        except HumansimError:
            return None
        mine = any(path == output or path.is_relative_to(output) for output in written if output != folder)
        return path if mine and path.is_file() else None

    def _links(self) -> str:
        """Markdown links to the files that a command has written, or to the page that a command serves."""
        if self.job is None:
            return ""
        if self.job.code is None:
            found = next((match[0] for line in self.job.lines if (match := _ADDRESS.search(line))), None)
            return f"[Open the photographs]({found})" if found and self.job.text.split()[1] == "view" else ""
        folder, lines = self._document.folder, []
        for output in outputs_of(shlex.split(self.job.text)):
            try:
                path = inside(folder, output)
            except HumansimError:
                continue
            files = [path] if path.is_file() else files_below(path)
            lines += [
                f"- [{plain_markdown(str(file.relative_to(folder)))}]({PREFIX}results/"
                f"{quote(str(file.relative_to(folder)))}) ({size_text(file.stat().st_size)})"
                for file in files[:_MOST_LINKS]
            ]
            if len(files) > _MOST_LINKS:
                lines.append(f"- and {len(files) - _MOST_LINKS} more in {plain_markdown(str(path))}")
        return "\n".join(["**Results**", "", *lines]) if lines else ""

    def close(self) -> None:
        """End the command that runs."""
        if self.job is not None:
            self.job.close()


# --- processes of commands

#: Commands that the page starts.
COMMANDS = ("run", "record", "export", "evaluate")
#: Other commands that the page starts, with the options that it allows. None of these options starts a
#: program.
_OPTIONS: dict[str, tuple[str, ...]] = {
    "check": ("--quick", "--frames"),
    "snapshot": ("-o", "--output", "--time", "--frame"),
    "view": ("--no-browser", "--port"),
    "human fit": (
        "-o",
        "--output",
        "--picture",
        "--body",
        "--npz",
        "--bvh",
        "--no-silhouettes",
        "--silhouettes",
    ),
    "human texture": ("-o", "--output", "--fit", "--picture", "--method", "--texture-size", "--frame"),
}
#: Number of last lines of output to show; most characters of a line; seconds to wait for the end of a
#: process.
_LINES, _WIDTH, _PATIENCE = 12, 200, 10.0
#: Lines of progress: ``120 of 300 frames, …``.
_PROGRESS = re.compile(r"(\d+) of (\d+) ")


def command_words(text: str, folder: Path) -> list[str]:
    """Split a command line such as ``humansim record scene.yaml -o bag`` into words, and check it.

    ``folder``: files that the command line names must be below this folder.

    Raises:
        HumansimError: The page does not start this command, or the command line names a file outside of the
            folder.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise HumansimError(f"the command line cannot be read: {error}") from None
    known = (*COMMANDS, *_OPTIONS)
    command = next((name for name in known if words[1 : 1 + len(name.split())] == name.split()), None)
    if words[:1] != ["humansim"] or command is None or "\0" in text:
        raise HumansimError(f"give 'humansim' with one of {', '.join(known)}; found '{printable(text, 60)}'")
    for word in words[2:]:
        option = word.partition("=")[0]
        if command in _OPTIONS and option.startswith("-") and option not in _OPTIONS[command]:
            raise HumansimError(
                f"{printable(option, 60)}: the page starts 'humansim {command}' without this option"
            )
        for value in {word, *word.split(",")}:  # a list has commas
            check_value(folder, re.sub(r"^--?[\w-]*=?", "", value))
    return words


def outputs_of(words: Sequence[str]) -> list[str]:
    """Names of the files and folders that a command writes, from the words of its command line."""
    found = []
    for word, value in zip(words, [*words[1:], ""], strict=True):
        option, equals, own = word.partition("=")
        if option in _WRITTEN:
            found.append(own if equals else value)
        elif word.startswith("-o") and len(word) > 2:
            found.append(word[2:])
    return [name for name in found if name and not name.startswith("-")]


def files_below(folder: Path) -> list[Path]:
    """Sorted paths of the files below a folder, without symbolic links."""
    paths = islice(
        (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()), _MOST_LOOKED
    )
    return sorted(paths)


class Job:
    """A command that runs in its own process.

    Args:
        text: Command line. It begins with ``humansim``.
        folder: Working folder of the command.

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
        """The last lines that the command has printed."""
        return list(self._lines)

    @property
    def progress(self) -> float:
        """Share of the work that is done, 0 to 1, from the last printed line that tells the progress."""
        return 1.0 if self.code == 0 else self._progress

    @property
    def code(self) -> int | None:
        """Exit code of the command; None while the command runs."""
        return self._process.poll()

    @property
    def state(self) -> str:
        """State of the command in words, such as ``runs``."""
        if self.code is None:
            return "is stopping" if self._stopped else "runs"
        if self._stopped:
            return "was stopped"
        return "has finished" if self.code == 0 else f"has failed with exit code {self.code}"

    def stop(self) -> None:
        """Ask the process to end. SIGINT is not used, because background jobs of a shell ignore it."""
        self._stopped = True
        if self.code is None:
            self._process.terminate()

    def close(self) -> None:
        """End the process, by force after ten seconds."""
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
        """Store a line that the command has printed, and read the progress from it."""
        text = line.rstrip()
        if text:
            self._lines.append(printable(text, _WIDTH))
        if found := _PROGRESS.search(text):
            self._progress = min(1.0, int(found[1]) / max(1, int(found[2])))
