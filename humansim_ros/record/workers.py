"""Worker processes that encode the frames of a recording or an export; the frames come out in order."""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import islice
from multiprocessing import Pipe
from multiprocessing.connection import wait
from pathlib import Path
from types import TracebackType
from typing import Any

import humansim_ros
from humansim_ros.bags.chunks import Chunk
from humansim_ros.errors import HumansimError
from humansim_ros.record.worker import EncodedFrame, FrameJob, positions
from humansim_ros.ros.processes.node_processes import thread_limits
from humansim_ros.ros.processes.stop_signals import PARENT_PID

#: Frames that a worker may be ahead: it encodes the next one while one is being written.
_SLOTS = 2
#: Not ``-m``: objects of a module that is run so cannot be sent to another process.
_PROGRAM = "from humansim_ros.record.worker import main; main()"
#: Seconds in which a worker ends whose socket is closed.
_ENDING = 2.0


class WorkerDiedError(HumansimError):
    """A worker process has died."""


class _Worker:
    """One worker process, as the process sees it that writes the bag.

    Attributes:
        connection: Socket to the process.
        free: Slots that hold no frame.
        frames: Frames that it has been asked for and that have not arrived, in their order.
    """

    def __init__(self, number: int, environment: dict[str, str]) -> None:
        self.number = number
        self.connection, other = Pipe()
        self._slots = [os.memfd_create(f"humansim-{number}-{slot}") for slot in range(_SLOTS)]
        self._memory: list[mmap.mmap | None] = [None] * _SLOTS
        self.free = deque(range(_SLOTS))
        self.frames: deque[int] = deque()
        descriptors = [other.fileno(), *self._slots]
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM, *map(str, descriptors)],
                pass_fds=descriptors,
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the writing process
                env=environment,
            )
        finally:
            other.close()

    def ask(self, index: int) -> None:
        """Ask for a frame; there must be a free slot."""
        slot = self.free.popleft()
        self.frames.append(index)
        self._send((index, slot))

    def start(self, job: bytes) -> None:
        """Send the job, pickled."""
        try:
            self.connection.send_bytes(job)
        except OSError:
            raise self._died() from None

    def _send(self, request: Any) -> None:
        try:
            self.connection.send(request)
        except OSError:
            raise self._died() from None

    def receive(self) -> EncodedFrame | None:
        """Next frame, or None when the process is ready. Raises HumansimError if it has failed or died."""
        try:
            answer: EncodedFrame | HumansimError | None = self.connection.recv()
        except (EOFError, OSError):
            raise self._died() from None
        if isinstance(answer, HumansimError):
            raise type(answer)(f"frame {self.frames[0]}: {answer}" if self.frames else str(answer))
        if answer is not None:
            self.frames.popleft()
        return answer

    def _died(self) -> WorkerDiedError:
        code = self._process.wait()
        reason = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        doing = f"while it encoded frame {self.frames[0]}" if self.frames else "before its first frame"
        return WorkerDiedError(f"worker process {self.number + 1} {reason} {doing}")

    def chunks(self, frame: EncodedFrame) -> list[Chunk]:
        """Chunks of a frame with their bytes, which are in its slot."""
        if not frame.chunks:
            return []
        memory = self._memory[frame.slot]
        if memory is None or len(memory) != frame.size:
            memory = mmap.mmap(self._slots[frame.slot], frame.size, prot=mmap.PROT_READ)
            self._memory[frame.slot] = memory
        view, starts = memoryview(memory), positions(frame.chunks)
        return [chunk.with_data(view[start:]) for chunk, start in zip(frame.chunks, starts, strict=True)]

    def close_socket(self) -> None:
        """Let the process end."""
        self.connection.close()

    def close(self) -> None:
        """Wait for the end of the process, or end it."""
        self.connection.close()
        try:
            self._process.wait(_ENDING)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for slot in self._slots:
            os.close(slot)


class Workers:
    """Worker processes of a recording or an export; use it in a ``with`` block. They end with it, however it
    ends.

    ``job``: the work. ``jobs``: number of processes. Raises HumansimError if one cannot start.

    Attributes:
        costs: Seconds of processor time of all workers by step.
    """

    def __init__(self, job: FrameJob, jobs: int) -> None:
        self.costs: dict[str, float] = {}
        self._workers: list[_Worker] = []
        sources = [str(Path(humansim_ros.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        environment = {
            **os.environ,
            **thread_limits(jobs),
            PARENT_PID: str(os.getpid()),
            "PYTHONPATH": os.pathsep.join(filter(None, sources)),
        }
        try:
            for number in range(jobs):
                self._workers.append(_Worker(number, environment))
            copied = pickle.dumps(job)
            for worker in self._workers:
                worker.start(copied)
            for worker in self._workers:
                worker.receive()
        except BaseException:
            self.close()
            raise

    def frames(self, indices: Sequence[int]) -> Iterator[list[Chunk]]:
        """Chunks of some frames, in their order. ``indices``: their numbers, each once.

        The bytes of a frame are valid until the next one is asked for.

        Raises:
            WorkerDiedError: A process has died.
            HumansimError: A frame cannot be encoded.
        """
        following = iter(indices)
        for _ in range(_SLOTS):
            for worker, index in zip(self._workers, following, strict=False):
                worker.ask(index)
        encoded: dict[int, tuple[_Worker, EncodedFrame]] = {}
        by_connection: dict[Any, _Worker] = {worker.connection: worker for worker in self._workers}
        for index in indices:
            while index not in encoded:
                for connection in wait([w.connection for w in self._workers if w.frames]):
                    worker = by_connection[connection]
                    frame = worker.receive()
                    assert frame is not None
                    encoded[frame.number] = worker, frame
                    for step, seconds in frame.costs.items():
                        self.costs[step] = self.costs.get(step, 0.0) + seconds
            worker, frame = encoded.pop(index)
            yield worker.chunks(frame)
            worker.free.append(frame.slot)
            for another in islice(following, 1):
                worker.ask(another)

    def close(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.close_socket()
        for worker in self._workers:
            worker.close()

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class FrameEncoding:
    """Encodes frames in this process, or in several others; use it in a ``with`` block.

    ``job``: the work. ``jobs``: number of processes; with 1, this process does it.
    """

    def __init__(self, job: FrameJob, jobs: int) -> None:
        self._source = job.start() if jobs == 1 else Workers(job, jobs)

    def __enter__(self) -> FrameEncoding:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._source.close()

    @property
    def costs(self) -> dict[str, float]:
        """Seconds of processor time by step."""
        return self._source.costs

    def frames(self, indices: Sequence[int]) -> Iterator[Sequence[Chunk]]:
        """Chunks of some frames, in their order; each is valid until the next. Raises as :class:`Workers`."""
        if isinstance(self._source, Workers):
            return self._source.frames(indices)
        return map(self._source.encode, indices)
