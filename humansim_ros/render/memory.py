"""How the C library keeps memory."""

from __future__ import annotations

import ctypes
from contextlib import suppress

#: glibc's mallopt parameters: trim threshold, top pad, mmap threshold.
_MALLOPT = ((-3, 32 << 20), (-1, 512 << 20), (-2, 64 << 20))


def keep_image_blocks() -> None:
    """Let image-sized blocks stay in the heap instead of being mapped and unmapped for every picture, page by
    page. Nothing happens where the C library is not glibc.
    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        for parameter, value in _MALLOPT:
            libc.mallopt(parameter, value)
