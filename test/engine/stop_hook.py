"""Stop a command at one of its file operations: processes are killed, a signal comes, or the disk is full.

An audit hook of Python sees each operation *before* the system does it. All processes of a command count the
operations together, since each operation adds a line of :data:`LINE` bytes to a common log. A child process
that starts Python anew has the hook by the module ``sitecustomize`` that :func:`environment` names.

What the hook does not see: the content that is written to open files, and files that C code opens, such as
those of ``cv2.imwrite``. Therefore a kill can have a delay, so that it comes in the middle of both.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

#: Bytes of a line in the log of operations.
LINE = 256
#: Environment variable with the settings of the hook.
VARIABLE = "HUMANSIM_TEST_STOP"
#: Events of the audit hook that change files. Values: position of the path, and of the descriptor of its
#: folder, in the arguments of the event.
_CHANGES = {
    "os.mkdir": (0, 2),
    "os.rmdir": (0, 1),
    "os.remove": (0, 1),
    "os.rename": (1, 3),
    "os.link": (1, 3),
    "os.symlink": (1, 2),
    "os.truncate": (0, None),
}
#: Operations that need space on the disk.
_NEED_SPACE = ("open", "os.mkdir", "os.link", "os.symlink")
#: Signals for all processes of a command.
_SIGNALS = {"interrupt": signal.SIGINT, "terminate": signal.SIGTERM, "pause": signal.SIGSTOP}
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


@dataclass(frozen=True)
class Stop:
    """What happens at a file operation.

    Attributes:
        at: Number of the operation, from 1, before which it happens. If 0, operations are only counted.
        what: ``group`` kills all processes of the command, ``main`` only the first one, ``self`` the one that
            wants to do the operation. ``full``: this and all later operations that need space fail.
            ``interrupt``, ``terminate`` and ``pause`` send SIGINT, SIGTERM and SIGSTOP to all processes.
        delay: Seconds from the beginning of the operation to the kill.
        counted: Processes whose operations count: ``all``, or only the ``workers``.
        again: Whether it happens before each later operation, too.
        worker_environment: Environment variables that only the workers have.
    """

    at: int = 0
    what: Literal["group", "main", "self", "full", "interrupt", "terminate", "pause"] = "group"
    delay: float = 0.0
    counted: Literal["all", "workers"] = "all"
    again: bool = False
    worker_environment: dict[str, str] = field(default_factory=dict)


def environment(stop: Stop, folder: Path, log: Path) -> dict[str, str]:
    """Environment variables for a command. ``folder``: operations below it count."""
    text = json.dumps(asdict(stop) | {"folder": str(folder), "log": str(log), "main": 0})
    return {VARIABLE: text}


def operations(log: Path) -> list[str]:
    """The operations so far, such as ``1234 os.rename out/index.json``."""
    data = log.read_bytes() if log.exists() else b""
    return [data[k : k + LINE].decode(errors="replace").strip() for k in range(0, len(data), LINE)]


def install(is_main: bool = False) -> None:
    """Install the hook in this process, if the environment has its settings."""
    text = os.environ.get(VARIABLE)
    if not text:
        return
    settings = json.loads(text)
    if is_main:
        settings["main"] = os.getpid()
        os.environ[VARIABLE] = json.dumps(settings)
    else:
        os.environ.update(settings["worker_environment"])
    sys.addaudithook(_Hook(settings))


class _Hook:
    """The audit hook of a process, and of those that it forks."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._folder, self._log, self._main = settings["folder"], settings["log"], settings["main"]
        self._at, self._what, self._delay = settings["at"], settings["what"], settings["delay"]
        self._again = settings["again"]
        self._only_workers = settings["counted"] == "workers"

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" and event not in _CHANGES:
            return
        path = _changed_path(event, arguments)
        if path is None or path == self._log or not path.startswith(f"{self._folder}/"):
            return
        if _changes_nothing(event, path):
            return
        if self._only_workers and os.getpid() == self._main:
            return
        number = self._add(event, path)
        if self._at and self._what == "full":
            if number >= self._at and event in _NEED_SPACE:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)
        elif number == self._at or (self._again and number > self._at > 0):
            self._stop()

    def _add(self, event: str, path: str) -> int:
        """Add an operation to the log. Returns its number."""
        text = f"{os.getpid()} {event} {os.path.relpath(path, self._folder)}".encode()[: LINE - 1]
        log = os.open(self._log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            # another process cannot come between, and the position afterwards is that of this line
            os.write(log, text.ljust(LINE - 1) + b"\n")
            return os.lseek(log, 0, os.SEEK_CUR) // LINE
        finally:
            os.close(log)

    def _stop(self) -> None:
        if self._what in _SIGNALS:
            os.killpg(self._main, _SIGNALS[self._what])
        elif self._delay:
            threading.Thread(target=self._kill, daemon=True).start()
        else:
            self._kill()

    def _kill(self) -> None:
        time.sleep(self._delay)
        if self._what == "group":
            os.killpg(self._main, signal.SIGKILL)
        elif self._what == "main":
            os.kill(self._main, signal.SIGKILL)
        if self._what != "main":
            os.kill(os.getpid(), signal.SIGKILL)


def _changed_path(event: str, arguments: tuple[Any, ...]) -> str | None:
    """Absolute path of the file or folder that an operation changes. None if it changes nothing."""
    position, folder_position = _CHANGES.get(event, (0, None))
    if event == "open" and not (arguments[2] or 0) & _WRITING:
        return None
    path = arguments[position]
    if isinstance(path, int):
        return _opened_path(path) if event == "os.truncate" else None
    text = os.fsdecode(path)
    folder = -1 if folder_position is None else arguments[folder_position]
    if folder not in (-1, None) and not text.startswith("/"):
        text = f"{_opened_path(folder)}/{text}"
    return os.path.abspath(text)  # noqa: PTH100


def _opened_path(descriptor: int) -> str:
    try:
        return os.readlink(f"/proc/self/fd/{descriptor}")  # noqa: PTH115
    except OSError:
        return ""


def _changes_nothing(event: str, path: str) -> bool:
    """Whether an operation fails since there is a folder already, or nothing to remove."""
    exists = os.path.lexists(path)
    return exists if event == "os.mkdir" else not exists if event in ("os.remove", "os.rmdir") else False
