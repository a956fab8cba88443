"""Shows photographs of a person in the page, with the fitted person and the cameras in 3D."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import HumansimError
from humansim_ros.files.mesh import Mesh
from humansim_ros.people.humans import Human
from humansim_ros.photographs import PersonFit, PhotoSet, fit_person
from humansim_ros.types import Image
from humansim_ros.view.edit.photo_document import PhotoDocument, PhotoState
from humansim_ros.view.sources.source import POSES, FrameRequest, PixelInfo, ViewFrame, ViewSource, fitted

#: Name of the only channel, and name of the person.
PHOTOGRAPH, PERSON = "photograph", "person"
#: Photographs that are wider are scaled down to this width, pixels.
_WIDTH = 2048


class PhotoSource(ViewSource):
    """Photographs that are edited by hand, with the person who was fitted to them.

    Attributes:
        document: The photographs.
        solver: Fits the person to the photographs again.
    """

    objects: Mapping[str, Mesh] = {}
    static: Mapping[str, Mesh] = {}
    channels: tuple[str, ...] = (PHOTOGRAPH,)

    def __init__(self, document: PhotoDocument) -> None:
        self.document, self.solver = document, PhotoSolver()
        self._problems: dict[str, str] = {}
        self._images: tuple[int, dict[str, dict[str, Image]]] | None = None

    @property
    def title(self) -> str:
        """Name of the views file."""
        return self.document.photos.path.stem

    @property
    def people(self) -> Mapping[str, Human]:
        """The fitted person; empty before the first solution."""
        fit = self.document.state.fit
        return {} if fit is None else {PERSON: fit.body}

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return dict(zip(self.document.photos.names, self.document.photos.cameras, strict=True))

    @property
    def period(self) -> int:
        return self.document.photos.period

    @property
    def frames(self) -> int:
        return len(self.document.photos.frames)

    @property
    def messages(self) -> Sequence[str]:
        """Messages about photographs that cannot be shown."""
        return list(self._problems.values())

    def frame(self, index: int, wanted: FrameRequest = POSES) -> ViewFrame:
        fit = self.document.state.fit
        joints = {}
        if fit is not None:
            joints[PERSON] = np.array(fit.body.skeleton.joint_transforms(fit.posed(index)))
        return ViewFrame(
            index=index,
            stamp=index * self.period,
            scene_time=index * self.period,
            joints=joints,
            cameras=self.cameras,
            images=self.photographs(index),
            image_index=index,
        )

    def photographs(self, index: int) -> Mapping[str, Mapping[str, Image]]:
        """Images (H, W, 3) of a frame by view and channel; images that cannot be read are left out."""
        if self._images is None or self._images[0] != index:
            self._problems = {}
            self._images = (index, {name: self._read(index, name) for name in self.document.photos.names})
        return self._images[1]

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Camera and place of a pixel."""
        values = {"camera": camera, "pixel": f"{x}, {y}"}
        return PixelInfo(values)

    def close(self) -> None:
        """Stop the solver, and wait for its end."""
        self.solver.close()

    def _read(self, index: int, view: str) -> dict[str, Image]:
        photo = self.document.photo(index, view)
        if photo.image_path is None:
            return {}
        try:
            return {PHOTOGRAPH: fitted(photo.image(), _WIDTH, "rgb")}
        except HumansimError as error:
            self._problems[view] = str(error)
            return {}


# --- the solver: a thread, so that the page lives meanwhile

#: Seconds between two reports of progress.
_REPORT = 0.2


class _StoppedError(Exception):
    """Raised in the thread of the solver when the user has stopped it."""


class PhotoSolver:
    """Fits the person to the photographs in a thread; one fit (solution) at a time.

    Attributes:
        progress: The running step, such as ``first guess: 3 of 20 frames``.
        changed: Function that is called in the thread of the solver when there is progress or a result.
    """

    def __init__(self) -> None:
        self.progress = ""
        self.changed: Callable[[], None] = lambda: None
        self._thread: threading.Thread | None = None
        self._stopped = threading.Event()
        self._ended: tuple[PersonFit | None, PhotoState, list[str], str | None] | None = None

    @property
    def runs(self) -> bool:
        """Whether a solution is being computed, or is ready but not yet fetched with :meth:`take`."""
        return self._thread is not None

    def start(self, document: PhotoDocument, silhouettes: bool) -> None:
        """Start to fit the person to the present points. Raises HumansimError if the solver is running."""
        if self._thread is not None:
            raise HumansimError("a solution is being computed: wait for it, or stop it")
        self._stopped.clear()
        self.progress = "begins"
        given = (document.state, document.edited, silhouettes)
        self._thread = threading.Thread(target=self._solve, args=given, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the solver to stop before its next step. Its solution is discarded."""
        self._stopped.set()
        self.progress = "stops"

    def take(self) -> tuple[PersonFit | None, PhotoState, list[str], str | None] | None:
        """Return the result once: the solution (None if the user stopped it), the state that was solved,
        warnings, and the reason of a failure. Returns None while the solution is being computed."""
        ended = self._ended
        if ended is None or self._thread is None:
            return None
        self._thread.join()
        self._thread = self._ended = None
        return ended

    def close(self) -> None:
        """Stop the solver, and wait until its present step has ended."""
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
            except Exception as error:  # the page must survive any error of a solution
                problem = f"the solution has failed: {type(error).__name__}: {error}"
        told = list(dict.fromkeys(str(each.message) for each in caught))
        self._ended = (None if self._stopped.is_set() else fit, state, told, problem)
        self.changed()
