"""Slow work in a thread, while a node goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

from humansim_ros.errors import RosError

T = TypeVar("T")


class BackgroundWork:
    """Runs one piece of work at a time in a thread, and waits for it for a limited time.

    A thread cannot be stopped: after work that takes longer, new work is refused until it has ended.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._thread: threading.Thread | None = None

    @property
    def is_busy(self) -> bool:
        """Whether earlier work has not ended."""
        return self._thread is not None and self._thread.is_alive()

    def run(self, work: Callable[[], T], meanwhile: Callable[[], object], pause: float) -> T:
        """Return the result of ``work``; until then call ``meanwhile`` every ``pause`` seconds.

        Raises:
            RosError: The work takes too long, or earlier work has not ended.
        """
        if self.is_busy:
            raise RosError("an earlier request that took too long has not ended yet: try again later")
        result: Future[T] = Future()
        self._thread = threading.Thread(target=_fulfil, args=(result, work), daemon=True)
        self._thread.start()
        end = time.monotonic() + self._seconds
        while not wait([result], timeout=pause).done:
            if time.monotonic() > end:
                raise RosError(f"it takes more than {self._seconds:g} s: nothing is changed")
            meanwhile()
        return result.result()


def _fulfil(result: Future[T], work: Callable[[], T]) -> None:
    try:
        result.set_result(work())
    except BaseException as error:
        result.set_exception(error)
