"""The process of a tracker: started from a command line, watched, and stopped with all its children."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from humansim_ros.errors import ChallengeError, printable

#: Seconds after SIGINT, and then after SIGTERM, until the next signal.
_AFTER = 2.0
#: Most bytes of the end of its output in an error, and bytes of its output that are kept.
_MAX_TAIL, _MAX_OUTPUT = 600, 1 << 20


def command_words(command: str, values: Mapping[str, str]) -> list[str]:
    """Words of a command line, with ``{cameras}``, ``{topic}`` and ``{scene}`` replaced.

    Raises:
        ChallengeError: Quotes are not closed, or there is no word.
    """
    try:
        words = shlex.split(command)
    except ValueError as reason:
        raise ChallengeError(f"not a command line: {reason}", key="--tracker") from None
    if not words:
        raise ChallengeError("give the command that starts the tracker", key="--tracker")
    for name, value in values.items():
        words = [word.replace(f"{{{name}}}", value) for word in words]
    return words


class TrackerProcess:
    """A running tracker. Use it as a context manager: at its end the process group is stopped.

    Args:
        words: Command line.
        environment: Environment variables that are added to the ones of this process.
        log: File for its output.

    Raises:
        ChallengeError: The command cannot be started.
    """

    def __init__(self, words: list[str], environment: Mapping[str, str], log: Path) -> None:
        self._log = log
        with log.open("wb") as output:
            try:
                self._process = subprocess.Popen(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, **environment},
                    start_new_session=True,
                )
            except OSError as reason:
                raise ChallengeError(
                    f"{printable(words[0], 100)} cannot be started: {reason.strerror or reason}",
                    key="--tracker",
                ) from None

    def __enter__(self) -> TrackerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def death(self) -> str:
        """How the process has ended; empty while it runs."""
        code = self._process.poll()
        if code is None:
            return ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        tail = self.output_tail
        return f"the tracker {how}{f': {tail}' if tail else ''}"

    @property
    def output_tail(self) -> str:
        """Last line of its output."""
        with suppress(OSError), self._log.open("rb") as file:
            file.seek(max(0, self._log.stat().st_size - _MAX_TAIL))
            lines = file.read(_MAX_TAIL).decode(errors="replace").split("\n")
            return printable(next((line.strip() for line in reversed(lines) if line.strip()), ""))
        return ""

    @property
    def is_too_talkative(self) -> bool:
        """Whether its output is longer than a report keeps."""
        with suppress(OSError):
            return self._log.stat().st_size > _MAX_OUTPUT
        return False

    def stop(self) -> None:
        """Stop the process and its children: politely, then by force."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, number)
            end = time.monotonic() + _AFTER
            while self._process.poll() is None and time.monotonic() < end:
                time.sleep(0.02)
            if self._process.poll() is not None and not _has_group(self._process.pid):
                return
        self._process.wait()


def _has_group(number: int) -> bool:
    try:
        os.killpg(number, 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True
