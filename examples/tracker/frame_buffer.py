"""Frames of several cameras: which cameras a frame waits for, and for how long."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, TypeVar

T = TypeVar("T")

#: A camera without these many frames one after the other is not waited for, until it sends again.
_SILENT = 5
#: Stamps that go back by more than this belong to a new run, nanoseconds.
_NEW_RUN = 1_000_000_000


class FrameBuffer(Generic[T]):
    """Collects what cameras send by stamp, and releases frames in the order of their stamps.

    A frame is released when each camera has sent it, or has dropped it, which is known when the camera sends
    a later one. It waits for the others for ``patience`` seconds after its first message. What comes later
    than its frame, or a second time, is ignored.
    """

    def __init__(self, patience: float, cameras: Iterable[str] = ()) -> None:
        self.patience = patience
        self._missed = dict.fromkeys(cameras, 0)
        self._newest: dict[str, int] = {}
        self._frames: dict[int, tuple[float, dict[str, T]]] = {}
        self._last: int | None = None

    def add_camera(self, camera: str) -> None:
        """Wait for a camera from now on."""
        self._missed.setdefault(camera, 0)

    def begins_new_run(self, stamp: int) -> bool:
        """Whether a stamp is that of a new run. :meth:`restart` forgets the old one."""
        return self._last is not None and stamp < self._last - _NEW_RUN

    def restart(self) -> None:
        """Forget all frames, but not the cameras."""
        self._missed = dict.fromkeys(self._missed, 0)
        self._newest.clear()
        self._frames.clear()
        self._last = None

    def is_last(self, stamp: int) -> bool:
        """Whether a stamp is that of the frame that was released last."""
        return stamp == self._last

    def add(self, camera: str, stamp: int, content: T, now: float) -> None:
        """Add what a camera has sent.

        Args:
            camera: Name of the camera.
            stamp: Stamp of the frame, nanoseconds.
            content: What it has sent.
            now: Time on any clock that runs evenly, seconds.
        """
        self._missed[camera] = 0
        self._newest[camera] = max(stamp, self._newest.get(camera, stamp))
        if self._last is None or stamp > self._last:
            self._frames.setdefault(stamp, (now, {}))[1].setdefault(camera, content)

    def next_frame(self, now: float) -> tuple[int, dict[str, T]] | None:
        """Release the next frame: its stamp, and what cameras have sent; None if none is due."""
        if not self._frames:
            return None
        stamp = min(self._frames)
        since, content = self._frames[stamp]
        waited_for = [camera for camera, missed in self._missed.items() if missed < _SILENT]
        complete = all(camera in content or self._newest.get(camera, 0) > stamp for camera in waited_for)
        if not complete and now - since < self.patience:
            return None
        del self._frames[stamp]
        self._last = stamp
        for camera in self._missed.keys() - content.keys():
            self._missed[camera] += 1
        return stamp, content
