"""How processes of this package end: on Ctrl-C, ``kill``, a closed terminal, and with their parent."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

#: Exit code of a recorder that cannot write any more.
CANNOT_WRITE = 1
#: Exit code of a node that has reported wrong input. It is not started again, since it would report the input
#: again.
WRONG_INPUT = 2
#: Exit code of a motion player that has stopped because nodes did not finish a frame in time.
TIMED_OUT = 3
#: Exit code of a motion player that was asked to quit. All other nodes end with it.
QUIT = 4
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
#: A signal that is repeated within this time, seconds, counts as one, since a terminal that closes sends
#: SIGHUP twice.
_SAME_REQUEST = 0.5


class Stopped(SystemExit):
    """A stop signal has arrived. If nothing catches it, the process ends with exit code 128 + number, as in
    shells.

    Attributes:
        number: Number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.number = number


def raise_stopped(number: int) -> NoReturn:
    """Raise :class:`Stopped`."""
    raise Stopped(number)


def end_process(number: int) -> NoReturn:
    """End this process at once, with exit code 128 + number."""
    os._exit(128 + number)


class StopRequest:
    """Handlers for a process that stops in order. The first stop signal raises :class:`Stopped`.

    Libraries may swallow the exception, but ``number`` stays set.

    Args:
        again: Called with the number of each later signal. Users send it when they do not want to wait.

    Attributes:
        number: Number of the first signal; None before a signal has arrived.
        raises: Whether the first signal raises. If not, the process must check ``number``.
    """

    def __init__(self, again: Callable[[int], object] = raise_stopped) -> None:
        self.number: int | None = None
        self.raises = True
        self._again = again
        self._last = 0.0
        _install(self._on_signal)

    def _on_signal(self, number: int, _: Any) -> None:
        last, self._last = self._last, time.monotonic()
        if self.number is None:
            self.number = number
            if self.raises:
                raise Stopped(number)
        elif self._last - last >= _SAME_REQUEST:
            self._again(number)


def end_process_on_stop(code: int | None = None) -> None:
    """Let a stop signal end this process at once and quietly, as long as there is nothing to clean up.
    ``code``: exit code. If None, 128 + number of the signal."""
    _install(lambda number, _: end_process(number) if code is None else os._exit(code))


def _install(handler: Callable[[int, Any], object]) -> None:
    for number in STOP_SIGNALS:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


#: Environment variable with the process id of the parent.
PARENT_PID = "HUMANSIM_PARENT_PID"
_PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Make this process get SIGTERM when its parent (see ``PARENT_PID``) dies. If the parent is already dead,
    end now. The kernel sends the signal when that thread of the parent ends that has started this process."""
    parent = os.environ.get(PARENT_PID)
    if parent is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM))
    if os.getppid() != int(parent):  # it died before the request
        os._exit(0)


def children_of(parent: int) -> set[int]:
    """Ids of the children of a process, including dead ones."""
    found = set[int]()
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):  # the process has ended meanwhile
            # the name in brackets may contain anything
            if int((folder / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                found.add(int(folder.name))
    return found
