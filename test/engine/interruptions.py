"""Commands that are interrupted, their processes, and the trees of files that they leave."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from commands import Done
from conftest import ROOT
from stop_hook import Stop, environment, operations
from waiting import has_ended, wait_until

HERE = Path(__file__).parent
#: Number of differences that the message of a failed test shows.
MOST_SHOWN = 12


@dataclass
class Command:
    """A command that runs in a session of its own.

    Attributes:
        pid: Its first process.
        output: Path of its output, without suffix.
        log: Log of its file operations.
    """

    server: CommandServer
    pid: int
    output: Path
    log: Path
    code: int | None = None

    @property
    def has_ended(self) -> bool:
        """Whether its first process has ended."""
        if self.code is None:
            self.code = self.server.ask({"wait": self.pid})
        return self.code is not None

    def wait(self) -> Done:
        """Wait until the first process has ended. Returns exit code and output."""
        assert wait_until(lambda: self.has_ended, step=lambda: time.sleep(0.01)), self.text
        assert self.code is not None
        return Done(self.code, *(Path(f"{self.output}.{suffix}").read_text() for suffix in ("out", "err")))

    @property
    def text(self) -> str:
        """Output so far, for messages."""
        return "".join(Path(f"{self.output}.{suffix}").read_text() for suffix in ("out", "err"))

    @property
    def operations(self) -> list[str]:
        """File operations so far."""
        return operations(self.log)

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the process group, as a terminal does."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    def processes(self) -> list[int]:
        """All processes of the command that have not ended: those of its session, and those with its
        environment."""
        found = []
        for path in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                session = (path / "stat").read_text().rpartition(")")[2].split()[3]
                ours = int(session) == self.pid or str(self.log).encode() in (path / "environ").read_bytes()
                if ours and not has_ended(int(path.name)):
                    found.append(int(path.name))
        return found

    def left_over(self) -> list[str]:
        """Command lines of processes that have not ended although their first process has."""
        if wait_until(lambda: not self.processes()):
            return []
        lines = []
        for pid in self.processes():
            with suppress(OSError):
                lines.append(Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode())
                os.kill(pid, signal.SIGKILL)
        return lines


class CommandServer:
    """Runs commands in copies of a process that has imported the package.

    ``folder``: folder for output and logs of the commands.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._numbers = count(1)
        (folder / "sitecustomize.py").write_text("import stop_hook\n\nstop_hook.install()\n")
        places = [str(folder), str(HERE), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        variables = {
            "PYTHONPATH": os.pathsep.join(places),
            "OPENBLAS_NUM_THREADS": "1",
            "RAY_TMPDIR": "/tmp",  # sockets of Ray must have short names
        }
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / "command_server.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **variables},
        )

    def ask(self, request: Mapping[str, Any]) -> Any:
        """Send a request to the process. Returns its answer."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def start(
        self,
        words: Sequence[object],
        folder: Path,
        stop: Stop | None = None,
        largest_file: int | None = None,
        **variables: str,
    ) -> Command:
        """Start a command.

        Args:
            words: Words after ``humansim``.
            folder: File operations below this folder are counted.
            stop: What happens at one of them.
            largest_file: Most bytes of a file that the command writes.
            variables: Further environment variables.
        """
        output = self.folder / f"{next(self._numbers):05d}"
        log = output.with_suffix(".log")
        request = {
            "words": [str(word) for word in words],
            "environment": variables | environment(stop or Stop(), folder.resolve(), log),
            "output": str(output),
            "largest_file": largest_file,
        }
        return Command(self, self.ask(request), output, log)

    def run(self, words: Sequence[object], folder: Path, *given: Any, **options: Any) -> Done:
        """Run a command to its end. See :meth:`start`."""
        return self.start(words, folder, *given, **options).wait()

    def warm_up(self, words: Sequence[object], folder: Path) -> None:
        """Import the modules that a command imports."""
        listed = self.folder / "modules"
        done = self.run(words, folder, HUMANSIM_TEST_MODULES=str(listed))
        assert done.returncode == 0, done.stderr
        self.ask({"modules": listed.read_text().split()})

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


@contextmanager
def command_server(folder: Path) -> Iterator[CommandServer]:
    """A server of commands, which is closed after the block."""
    server = CommandServer(folder)
    try:
        yield server
    finally:
        server.close()


def tree(folder: Path) -> dict[str, str]:
    """All that is below a folder, by path: ``folder``, target of a link, or hash and size of a file."""
    found = {}
    for place, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(place, name)
            found[str(path.relative_to(folder))] = _described(path)
    return found


def _described(path: Path) -> str:
    mode = path.lstat().st_mode
    if stat.S_ISLNK(mode):
        return f"link to {path.readlink()}"
    if stat.S_ISDIR(mode):
        return "folder"
    if not stat.S_ISREG(mode):
        return "special file"
    data = path.read_bytes()
    return f"{hashlib.sha256(data).hexdigest()[:16]} {len(data)} bytes"


def differences(expected: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Lines of a table of what differs: path, what it should be, what it is."""
    paths = sorted(path for path in expected.keys() | found.keys() if expected.get(path) != found.get(path))
    lines = [f"{path}: {expected.get(path, 'nothing')} -> {found.get(path, 'nothing')}" for path in paths]
    more = [f"and {len(lines) - MOST_SHOWN} more"] if len(lines) > MOST_SHOWN else []
    return lines[:MOST_SHOWN] + more


def is_sentence(done: Done) -> bool:
    """Whether a failed command has said why, and not by a traceback or as a fault of the program."""
    text = done.stdout + done.stderr
    said = "error: " in done.stderr or "stopped" in done.stdout
    return said and "Traceback" not in text and "this is a fault of humansim" not in text
