"""Fits photographs of a page in a thread, so that the page lives meanwhile."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable

from humansim_ros.errors import HumansimError
from humansim_ros.photographs.fitting import fit_person
from humansim_ros.photographs.person_fit import PersonFit
from humansim_ros.photographs.views import PhotoSet
from humansim_ros.view.photo_document import PhotoDocument, PhotoState

#: Seconds between two reports of progress.
_REPORT = 0.2


class _StoppedError(Exception):
    """The user has stopped the solution."""


class PhotoSolver:
    """One solution after the other.

    Attributes:
        progress: Step that runs, such as ``first guess: 3 of 20 frames``.
        changed: Called in the thread of the solution when there is progress or a result.
    """

    def __init__(self) -> None:
        self.progress = ""
        self.changed: Callable[[], None] = lambda: None
        self._thread: threading.Thread | None = None
        self._stopped = threading.Event()
        self._ended: tuple[PersonFit | None, PhotoState, list[str], str | None] | None = None

    @property
    def runs(self) -> bool:
        """Whether a solution is being computed, or waits for :meth:`take`."""
        return self._thread is not None

    def start(self, document: PhotoDocument, silhouettes: bool) -> None:
        """Solve for the points as they are. Raises HumansimError if another solution runs."""
        if self._thread is not None:
            raise HumansimError("a solution is being computed: wait for it, or stop it")
        self._stopped.clear()
        self.progress = "begins"
        given = (document.state, document.edited, silhouettes)
        self._thread = threading.Thread(target=self._solve, args=given, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask for an end before the next step; the solution is dropped."""
        self._stopped.set()
        self.progress = "stops"

    def take(self) -> tuple[PersonFit | None, PhotoState, list[str], str | None] | None:
        """The solution (None if it was stopped), what it is of, warnings, and why it failed; once.

        None while it is being computed.
        """
        ended = self._ended
        if ended is None or self._thread is None:
            return None
        self._thread.join()
        self._thread = self._ended = None
        return ended

    def close(self) -> None:
        """Stop, and wait until the step that runs has ended."""
        self.changed = lambda: None
        if self._thread is not None:
            self.stop()
            self._thread.join(10)

    def _solve(self, state: PhotoState, photos: PhotoSet, silhouettes: bool) -> None:
        last = 0.0

        def report(step: str, done: int, count: int) -> None:
            nonlocal last
            if self._stopped.is_set():
                raise _StoppedError
            self.progress = f"{step}: {done} of {count} frames"
            if time.monotonic() - last > _REPORT:
                last = time.monotonic()
                self.changed()

        fit, problem = None, None
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            try:
                fit = fit_person(photos, start=state.fit, silhouettes=silhouettes, progress=report)
            except _StoppedError:
                pass
            except HumansimError as error:
                problem = str(error)
            except Exception as error:  # the page lives, whatever happens in a solution
                problem = f"the solution has failed: {type(error).__name__}: {error}"
        told = list(dict.fromkeys(str(each.message) for each in caught))
        self._ended = (None if self._stopped.is_set() else fit, state, told, problem)
        self.changed()
