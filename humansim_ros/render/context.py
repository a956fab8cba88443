"""OpenGL contexts: made, made current, found lost."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager

import moderngl

from humansim_ros.errors import RenderError

#: Devices that are tried where one works.
_MAX_DEVICES = 16


def create_context(device: int | None = None) -> moderngl.Context:
    """A standalone OpenGL 3.3 context through EGL, on a device by its number as EGL counts them, GPUs first;
    None: the first that works. RenderError, naming the packages to install or the devices there are, where
    there is none.
    """
    reasons: list[str] = []
    for number in itertools.count() if device is None else [device]:
        try:
            return moderngl.create_context(require=330, standalone=True, backend="egl", device_index=number)  # type: ignore[arg-type]
        except Exception as reason:  # moderngl and glcontext raise bare Exceptions
            reasons.append(str(reason).splitlines()[0])
            if "device index" in reasons[-1] or number >= _MAX_DEVICES:
                break
    if device is not None and (device < 0 or "device index" in reasons[0]):
        raise RenderError(f"there is no OpenGL device {device}: {reasons[0]}")
    raise RenderError(
        f"no OpenGL through EGL ({reasons[0]}). "
        "On Debian or Ubuntu: sudo apt-get install -y libegl1 libgl1-mesa-dri"
    )


@contextmanager
def current(ctx: moderngl.Context) -> Iterator[None]:
    """The context is the current one of this thread, which others may have made theirs, for as long as
    ``with`` lasts. RenderError if it has been released or lost, or OpenGL fails otherwise.
    """
    if isinstance(ctx.mglo, moderngl.InvalidObject):
        raise RenderError("this renderer has been closed")
    with ctx:
        try:
            # without a context OpenGL fails in silence, and what is read is any memory: ask it for something
            ctx.buffer(reserve=4).release()
        except moderngl.Error:
            raise RenderError(
                "the OpenGL context was lost, as when a GPU is reset or taken away: make a new renderer, or "
                "start this node again"
            ) from None
        try:
            yield
        except moderngl.Error as reason:
            raise RenderError(
                f"OpenGL failed, perhaps for want of memory ({str(reason).splitlines()[0]})"
            ) from None
