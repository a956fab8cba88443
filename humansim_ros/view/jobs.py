"""Commands of ``humansim`` that the page starts as processes: their last lines and progress, and an end."""

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
from humansim_ros.view.server import check_value

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
        """Ask it to end, as Ctrl-C does; at once."""
        self._stopped = True
        self._signal(signal.SIGINT)

    def close(self) -> None:
        """End it, by force after ten seconds."""
        if self.code is None:
            self.stop()
            try:
                self._process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                self._signal(signal.SIGKILL)
                self._process.wait()
        self._reader.join(1)

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            if self.code is None:
                os.killpg(self._process.pid, number)

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
