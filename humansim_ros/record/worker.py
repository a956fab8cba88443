"""Process that encodes frames for a recording, or writes frames of an export.

Its arguments are inherited file descriptors: a socket to the process that writes the bag, and memory for the
chunks of a frame, one for each frame that the process may be ahead. The memory has no name, so that nothing
of it is left, however the processes end.
"""

from __future__ import annotations

import mmap
import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from types import TracebackType
from typing import NamedTuple, Protocol

from humansim_ros.bags.chunks import BLOCK, Chunk
from humansim_ros.errors import HumansimError
from humansim_ros.ros.processes.stop_signals import end_with_parent

#: Step of copying chunks into memory that the writing process has, too.
COPYING = "copying"


class FrameTask(Protocol):
    """What a process does with frames, in a ``with`` block.

    Attributes:
        costs: Seconds of processor time by step.
    """

    costs: dict[str, float]

    def encode(self, index: int) -> list[Chunk]:
        """Do the work of a frame; return the chunks for the process that writes the bag, if there is one."""

    def close(self) -> None:
        """Free the renderer."""

    def __enter__(self) -> FrameTask: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class FrameJob(Protocol):
    """Work on the frames of a scene. It can be copied to another process."""

    def start(self) -> FrameTask:
        """Load what the work needs. Raises HumansimError if this machine cannot do it."""


class EncodedFrame(NamedTuple):
    """A frame in a slot: chunks without their bytes, the size of the slot, processor time by step."""

    number: int
    slot: int
    chunks: list[Chunk]
    size: int
    costs: dict[str, float]


def positions(chunks: Iterable[Chunk]) -> Iterator[int]:
    """Where chunks are in their slot: aligned, so that they can be written directly."""
    position = 0
    for chunk in chunks:
        yield position
        position += -(-chunk.size // BLOCK) * BLOCK


class Slot:
    """Memory for the chunks of one frame; it grows if a frame needs more."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._memory: mmap.mmap | None = None

    def store(self, chunks: list[Chunk]) -> tuple[list[Chunk], int]:
        """Copy chunks one after the other; return them without their bytes, and the size of the slot.

        Without chunks both are empty.

        Raises:
            OSError: There is no memory left.
        """
        if not chunks:
            return [], 0
        starts = list(positions(chunks))
        needed = starts[-1] + chunks[-1].size
        if self._memory is None or len(self._memory) < needed:
            # now: a page that cannot be had later kills the process
            os.posix_fallocate(self._descriptor, 0, needed)
            self._memory = mmap.mmap(self._descriptor, needed)
        with memoryview(self._memory) as memory:
            stored = [chunk.copy_into(memory[start:]) for chunk, start in zip(chunks, starts, strict=True)]
        return stored, len(self._memory)


def main() -> None:
    """Encode the frames that are asked for until the writing process closes the socket, or ends."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)  # the writing process stops its workers
    end_with_parent()
    socket, *slots = map(int, sys.argv[1:])
    connection = Connection(socket)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        try:
            _work(connection, [Slot(slot) for slot in slots])
        except (HumansimError, OSError, MemoryError) as error:
            if isinstance(error, BrokenPipeError | ConnectionResetError):
                raise
            connection.send(error if isinstance(error, HumansimError) else HumansimError(_text(error)))


def _text(error: OSError | MemoryError) -> str:
    if isinstance(error, MemoryError):
        return "out of memory"
    return f"a worker process has no memory or files left: {error.strerror or error}"


def _work(connection: Connection, slots: list[Slot]) -> None:
    import cv2

    if threads := os.environ.get("OPENCV_FOR_THREADS_NUM"):
        cv2.setNumThreads(int(threads))
    job: FrameJob = connection.recv()
    with job.start() as task:
        connection.send(None)
        while True:
            index, slot = connection.recv()
            task.costs = {}
            chunks = task.encode(index)
            start = time.process_time()
            stored, size = slots[slot].store(chunks)
            task.costs[COPYING] = time.process_time() - start
            connection.send(EncodedFrame(index, slot, stored, size, task.costs))
