"""OpenGL contexts through EGL: creation, use, and detection of lost contexts."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager

import moderngl

from humansim_ros.errors import RenderError

#: Largest number of devices that are tried.
_MAX_DEVICES = 16


def create_context(device: int | None = None) -> moderngl.Context:
    """Create an OpenGL 3.3 context through EGL.

    ``device``: number of the device in the order of EGL, GPUs first; the first one that works if None.

    Raises:
        RenderError: There is no such device, or OpenGL is missing. The message names the packages to install.
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
    """Make a context current in this thread for the duration of ``with``.

    Raises:
        RenderError: The context has been released or lost, or OpenGL failed.
    """
    if isinstance(ctx.mglo, moderngl.InvalidObject):
        raise RenderError("this renderer has been closed")
    with ctx:
        try:
            # without a context OpenGL fails silently and reads arbitrary memory: test it with an allocation
            ctx.buffer(reserve=4).release()
        except moderngl.Error:
            raise RenderError(
                "the OpenGL context was lost, for example because the GPU was reset or removed: create a new "
                "renderer, or restart this node"
            ) from None
        try:
            yield
        except moderngl.Error as reason:
            raise RenderError(
                f"OpenGL failed, possibly out of memory ({str(reason).splitlines()[0]})"
            ) from None
