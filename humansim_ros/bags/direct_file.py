"""Write whole blocks to a disk directly from memory, without a copy of them in the memory of the system.

The copy costs more processor time than everything else that writing does. File systems that cannot write
directly say so; the caller writes through the system's memory then.
"""

from __future__ import annotations

import errno
import mmap
import os
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from humansim_ros.bags.chunks import Buffer

#: Bytes to which direct writing needs places in files and memory aligned.
BLOCK = 4096
_REFUSALS = (errno.EINVAL, errno.EOPNOTSUPP)


class DirectFile:
    """Second way to write a file that is open; ``descriptor``: the first way, with read and write access."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = -1
        self._staging = mmap.mmap(-1, 2 * BLOCK)
        with suppress(OSError):  # refused, or there is no /proc
            # a descriptor of its own: a duplicate would share the flag with the first way
            self._descriptor = os.open(f"/proc/self/fd/{descriptor}", os.O_RDWR | os.O_DIRECT | os.O_CLOEXEC)

    def write(self, buffers: Sequence[Buffer], position: int) -> int:
        """Write buffers one after the other; return how many bytes are written, a multiple of ``BLOCK``.

        It is 0 where direct writing is refused, and less than all if the system ends the write early. Aligned
        bytes at the start of the first buffer are not copied.

        Args:
            buffers: Their sizes add up to a multiple of ``BLOCK``.
            position: Place in the file, a multiple of ``BLOCK``.

        Raises:
            OSError: The file cannot be written.
        """
        if self._descriptor < 0:
            return 0
        first, *others = (memoryview(buffer).cast("B") for buffer in buffers)
        whole = first.nbytes // BLOCK * BLOCK if _is_aligned(first) else 0
        try:
            written = os.pwritev(
                self._descriptor, [first[:whole], self._staged([first[whole:], *others])], position
            )
        except OSError as reason:
            if reason.errno not in _REFUSALS:
                raise
            self.close()
            return 0
        return written // BLOCK * BLOCK

    def _staged(self, buffers: Sequence[memoryview]) -> memoryview:
        """Copy of buffers in aligned memory."""
        size = sum(buffer.nbytes for buffer in buffers)
        if size > len(self._staging):
            self._staging = mmap.mmap(-1, -(-size // BLOCK) * BLOCK)
        staged, position = memoryview(self._staging), 0
        for buffer in buffers:
            staged[position : position + buffer.nbytes] = buffer
            position += buffer.nbytes
        return staged[:size]

    def close(self) -> None:
        """Refuse from now on."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _is_aligned(buffer: memoryview) -> bool:
    address: int = np.frombuffer(buffer, np.uint8).__array_interface__["data"][0]
    return address % BLOCK == 0
