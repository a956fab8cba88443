"""Cached frames: with optical flow, a frame is rendered once and used up to three times."""

from __future__ import annotations

import weakref
from collections.abc import Sequence

from humansim_ros.render.caches import LruCache
from humansim_ros.render.rendered_frame import RenderedFrame
from humansim_ros.render.renderer import Body

#: Largest number of frames, their memory, and the number that is cached even if it needs more.
_MAX_FRAMES, _MAX_BYTES, _MIN_FRAMES = 48, 256 << 20, 3

_Entry = tuple[RenderedFrame, tuple["weakref.ref[Body]", ...]]


class FrameCache:
    """The most recently used frames. A frame is dropped when one of its bodies is gone."""

    def __init__(self) -> None:
        self._frames: LruCache[tuple[object, ...], _Entry] = LruCache(
            _MAX_FRAMES, _MAX_BYTES, _MIN_FRAMES, lambda entry: entry[0].nbytes
        )

    def get(self, bodies: Sequence[Body], view: tuple[object, ...]) -> RenderedFrame | None:
        """Return the frame of bodies. ``view``: key of camera and static scene."""
        entry = self._frames.get(_key(bodies, view))
        if entry is None or any(ref() is not body for ref, body in zip(entry[1], bodies, strict=True)):
            return None
        return entry[0]

    def put(self, bodies: Sequence[Body], view: tuple[object, ...], frame: RenderedFrame) -> RenderedFrame:
        """Cache a frame, see :meth:`get`."""
        key, frames = _key(bodies, view), self._frames
        frames.put(key, (frame, tuple(weakref.ref(body, lambda _: frames.discard(key)) for body in bodies)))
        return frame


def _key(bodies: Sequence[Body], view: tuple[object, ...]) -> tuple[object, ...]:
    return (*(id(body) for body in bodies), *view)
