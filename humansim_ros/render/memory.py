"""Settings of the C library's memory allocation."""

from __future__ import annotations

import ctypes
from contextlib import suppress

#: glibc's mallopt parameters: trim threshold, top pad, mmap threshold.
_MALLOPT = ((-3, 32 << 20), (-1, 512 << 20), (-2, 64 << 20))


def keep_image_blocks() -> None:
    """Allocate image-sized blocks on the heap, instead of mapping and unmapping their pages for every image.

    Without glibc the function has no effect.
    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        for parameter, value in _MALLOPT:
            libc.mallopt(parameter, value)
