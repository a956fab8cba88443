"""Do the work of a job in this process or in others, frame by frame.

A worker process inherits file descriptors: a socket to the process that started it, and slots. A slot is
shared memory for the data of one result. A worker can be ahead by as many frames as it has slots. The memory
has no name, so nothing is left if the processes are killed. A worker ends when its socket is closed.
"""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import humansim_ros
from humansim_ros.data.engine.frame_job import Buffer, FrameJob, FrameProgress, FrameResult, FrameWorker
from humansim_ros.errors import HumansimError
from humansim_ros.files.reading import thread_limits

#: Name of a step in costs: copying data into the shared memory.
COPYING = "copying"
#: Number of slots: a worker makes the next frame while the last one is being written.
_SLOTS = 2
#: Program of a worker. Run with ``-m``, objects of this module could not be sent to another process.
_PROGRAM = "from humansim_ros.data.engine.workers import main; main()"
#: A worker that has not ended this time after its socket is closed, seconds, is killed.
_ENDING = 2.0
#: File descriptors of a copy are below this number; seconds between checks whether a copy has ended.
_MOST_DESCRIPTORS, _LOOK_EVERY = 1 << 16, 0.02


def children_of(parent: int) -> set[int]:
    """Ids of the children of a process, including dead ones."""
    found = set[int]()
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):  # the process has ended meanwhile
            # the name in brackets may contain anything
            if int((folder / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                found.add(int(folder.name))
    return found


class WorkerDiedError(HumansimError):
    """A worker process has died."""


class _Load(NamedTuple):
    """Request to start a job, which is pickled in slot ``slot``. ``size``: bytes; 0 means the job that a
    copied process has already."""

    slot: int
    size: int


class _Answer(NamedTuple):
    """Answer of a worker: value of the result, sizes of the groups of data in the slot, size of the slot, and
    processor time by step."""

    value: Any
    sizes: list[int]
    memory: int
    costs: dict[str, float]


def _positions(sizes: Sequence[int]) -> list[int]:
    """Positions of groups of data in their slot. Groups begin at memory pages, so that they can be written to
    a disk directly."""
    places = [0]
    for size in sizes:
        places.append(places[-1] + -(-size // mmap.PAGESIZE) * mmap.PAGESIZE)
    return places


class CopiedProcess:
    """A forked copy of this process, which runs a function. It has the methods of ``subprocess.Popen`` that
    are used here.

    Args:
        function: Function that the copy runs before it ends.
        environment: Environment variables of the copy.
        descriptors: File descriptors that the copy keeps, in addition to standard output and standard error.
    """

    def __init__(
        self, function: Callable[[], None], environment: dict[str, str], descriptors: Sequence[int]
    ) -> None:
        self._code: int | None = None
        with warnings.catch_warnings():
            # threads of BLAS cause a warning, but BLAS handles copies
            warnings.simplefilter("ignore", DeprecationWarning)
            self.pid = os.fork()
        if self.pid:
            return
        code = 1
        try:
            os.setsid()
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            # other sockets are closed too, since workers end when their sockets are closed
            kept = sorted({2, *descriptors})
            for low, high in zip(kept, [*kept[1:], _MOST_DESCRIPTORS], strict=True):
                os.closerange(low + 1, high)
            os.environ |= environment
            function()
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)

    def poll(self) -> int | None:
        """Exit code, or the negative number of the signal that ended the copy; None while the copy runs."""
        if self._code is None:
            try:
                pid, status = os.waitpid(self.pid, os.WNOHANG)
            except ChildProcessError:
                pid, status = self.pid, 0
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code

    def wait(self, timeout: float | None = None) -> int:
        """Wait until the copy has ended. Returns its exit code. Raises ``subprocess.TimeoutExpired``."""
        end = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if end is not None and time.monotonic() > end:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            time.sleep(_LOOK_EVERY)
        return code

    def kill(self) -> None:
        """Kill the copy, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)


WorkerProcess: TypeAlias = subprocess.Popen[bytes] | CopiedProcess


class _Worker:
    """One worker process, as seen by the process that has started it.

    Args:
        number: Number of the worker.
        environment: Environment variables of the worker.
        nice: Number that is added to its niceness.
        copied: Job for a worker that is a copy of this process. If None, a new process is started.

    Attributes:
        connection: Socket to the process.
        job: The last job that the worker was given.
        asked: Frames that were requested and have not arrived, with their slots. None stands for the start of
            a job.
    """

    def __init__(
        self, number: int, environment: dict[str, str], nice: int, copied: FrameJob | None = None
    ) -> None:
        self.number = number
        self._is_copy = copied is not None
        self.connection, other = Pipe()
        self.job: bytes | None = None
        self.asked: deque[tuple[Any, int]] = deque()
        self._slots = [os.memfd_create(f"humansim-{number}-{slot}") for slot in range(_SLOTS)]
        self._memory: list[mmap.mmap | None] = [None] * _SLOTS
        self._free = deque(range(_SLOTS))
        descriptors = [other.fileno(), *self._slots]
        self.process: WorkerProcess
        try:
            if copied is not None:
                work = partial(_work, nice, descriptors, copied)
                self.process = CopiedProcess(work, environment, descriptors)
            else:
                self.process = subprocess.Popen(
                    [sys.executable, "-c", _PROGRAM, str(nice), *map(str, descriptors)],
                    pass_fds=descriptors,
                    stdin=subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C is meant for the process that started this one
                    env=environment,
                )
        finally:
            other.close()

    def load(self, job: bytes) -> None:
        """Start a job. All slots must be free. The pickled job is passed in a slot, since writing it to the
        socket could block. A copy has its first job already."""
        slot = self._free.popleft()
        position = 0
        size = 0 if self._is_copy and self.job is None else len(job)
        while position < size:
            position += os.pwrite(self._slots[slot], memoryview(job)[position:], position)
        self.job = job
        self._send(None, slot, _Load(slot, size))

    def ask(self, frame: Any) -> None:
        """Request a frame from the worker. A slot must be free."""
        slot = self._free.popleft()
        self._send(frame, slot, (frame, slot))

    def _send(self, frame: Any, slot: int, request: Any) -> None:
        self.asked.append((frame, slot))
        try:
            self.connection.send(request)
        except OSError:
            raise self._died() from None

    def receive(self) -> tuple[Any, int, FrameResult | HumansimError]:
        """Wait for the next answer. Returns its frame, slot and result. Raises WorkerDiedError."""
        try:
            answer: _Answer | HumansimError = self.connection.recv()
        except (EOFError, OSError):
            raise self._died() from None
        frame, slot = self.asked.popleft()
        if isinstance(answer, HumansimError):
            self.release(slot)
            return frame, slot, answer
        self.costs = answer.costs
        return frame, slot, FrameResult(answer.value, self._data(slot, answer))

    def release(self, slot: int) -> None:
        """Free a slot for the next result."""
        self._free.append(slot)

    def _data(self, slot: int, answer: _Answer) -> list[tuple[Buffer]]:
        if not answer.sizes:
            return []
        memory = self._memory[slot]
        if memory is None or len(memory) != answer.memory:
            memory = mmap.mmap(self._slots[slot], answer.memory, prot=mmap.PROT_READ)
            self._memory[slot] = memory
        view = memoryview(memory)
        places = zip(_positions(answer.sizes), answer.sizes, strict=False)
        return [(view[place : place + size],) for place, size in places]

    def _died(self) -> WorkerDiedError:
        code = self.process.wait()
        reason = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        frame = self.asked[0][0] if self.asked else None
        doing = "before its first frame" if frame is None else f"while it encoded frame {frame}"
        return WorkerDiedError(f"worker process {self.number + 1} {reason} {doing}")

    def close(self) -> None:
        """Wait until the process has ended, and kill it if that takes too long. The caller must close the
        connection first, which tells the process to end."""
        try:
            self.process.wait(_ENDING)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for slot in self._slots:
            os.close(slot)


class Workers:
    """Worker processes of a job. Use it in a ``with`` block, or call :meth:`close`.

    Args:
        job: The work.
        count: Number of processes.
        nice: Number that is added to the niceness of this process for the workers.
        copies: Whether workers are copies of this process, so that they have its modules and the job at once.
            This process must have no other threads, and must not have used OpenGL or threads of OpenCV.

    Attributes:
        costs: Seconds of processor time of all workers by step.
    """

    def __init__(self, job: FrameJob, count: int, nice: int = 0, copies: bool = False) -> None:
        self.costs: dict[str, float] = {}
        self._workers: list[_Worker] = []
        sources = [str(Path(humansim_ros.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        environment = {
            **os.environ,
            **thread_limits(count),
            "PYTHONPATH": os.pathsep.join(filter(None, sources)),
        }
        try:
            for number in range(count):
                self._workers.append(_Worker(number, environment, nice, job if copies else None))
            self.use(job)
            for worker in self._workers:
                worker.load(self._job)
        except BaseException:
            self.close()
            raise

    @property
    def processes(self) -> list[WorkerProcess]:
        """The worker processes."""
        return [worker.process for worker in self._workers]

    def use(self, job: FrameJob) -> None:
        """Change the job. The new job is used from the next :meth:`ask` on."""
        self._job = pickle.dumps(job)

    def wait_until_ready(self) -> None:
        """Wait until all processes have started the job. Raises HumansimError if a process cannot."""
        for worker in self._workers:
            _, slot, answer = worker.receive()
            if isinstance(answer, HumansimError):
                raise answer
            worker.release(slot)

    def idle(self) -> list[int]:
        """Numbers of the processes without a frame to work on. They may still be starting the job."""
        return [
            worker.number
            for worker in self._workers
            if not worker.asked
            or (worker.job is self._job and [frame for frame, _ in worker.asked] == [None])
        ]

    def ask(self, frame: Any, number: int | None = None) -> bool:
        """Request a frame from an idle process. Returns False if no process is idle. ``number``: number of a
        process from :meth:`idle`. If None, any process."""
        idle = self.idle()
        if not idle:
            return False
        worker = self._workers[idle[0] if number is None else number]
        if worker.job is not self._job:
            worker.load(self._job)
        worker.ask(frame)
        return True

    def arrived(self, timeout: float | None = None) -> Iterator[tuple[Any, FrameResult | HumansimError]]:
        """Yield frames that have arrived, each with its result or error. None means the start of a job.

        The data of a result are valid until the next iteration. ``timeout``: seconds to wait for a frame.

        Raises:
            WorkerDiedError: A process has died.
        """
        for worker, frame, slot, answer in self._received(timeout):
            try:
                yield frame, answer
            finally:  # also if the loop of the caller ends here
                if isinstance(answer, FrameResult):
                    worker.release(slot)

    def _received(
        self, timeout: float | None = None
    ) -> Iterator[tuple[_Worker, Any, int, FrameResult | HumansimError]]:
        asked: dict[Any, _Worker] = {w.connection: w for w in self._workers if w.asked}
        for connection in wait(list(asked), timeout):
            yield asked[connection], *asked[connection].receive()

    def results(self, frames: Sequence[int]) -> Iterator[FrameResult]:
        """Yield the results of frames in the order of ``frames`` (numbers without repetitions).

        Raises:
            WorkerDiedError: A process has died.
            HumansimError: A frame cannot be made.
        """
        following = iter(frames)
        for _ in range(_SLOTS):
            for worker, frame in zip(self._workers, following, strict=False):
                worker.ask(frame)
        waiting: dict[int, tuple[_Worker, int, FrameResult]] = {}
        for frame in frames:
            while frame not in waiting:
                for worker, number, slot, answer in self._received():
                    if isinstance(answer, HumansimError):
                        raise type(answer)(f"frame {number}: {answer}")
                    waiting[number] = worker, slot, answer
                    for step, seconds in worker.costs.items():
                        self.costs[step] = self.costs.get(step, 0.0) + seconds
            worker, slot, result = waiting.pop(frame)
            yield result
            worker.release(slot)
            for another in islice(following, 1):
                worker.ask(another)

    def close(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.connection.close()
        for worker in self._workers:
            worker.close()

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def run_frames(
    job: FrameJob,
    frames: Sequence[int],
    jobs: int,
    progress: FrameProgress,
    take: Callable[[int, FrameResult], int],
    *,
    begin: Callable[[], None] = lambda: None,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> None:
    """Do the work of some frames.

    Args:
        job: The work.
        frames: Numbers of the frames without repetitions; at least one.
        jobs: Number of processes. If 1, this process does the work.
        progress: State before the first frame. This function updates it.
        take: Called with each number and result, in the order of ``frames``. Returns the number of bytes
            written.
        begin: Called after the workers have started, so not if their start fails, for example without OpenGL.
        on_progress: Called with ``progress`` after each frame.

    Raises:
        WorkerDiedError: A worker process has died.
        HumansimError: A frame cannot be made.
    """
    jobs = min(jobs, len(frames))
    source = job.start() if jobs == 1 else Workers(job, jobs)
    try:
        if isinstance(source, Workers):
            source.wait_until_ready()
        begin()
        start = time.monotonic()
        results = source.results(frames) if isinstance(source, Workers) else map(source.work, frames)
        for frame, result in zip(frames, results, strict=True):
            progress.costs.update(source.costs)
            progress.size += take(frame, result)
            progress.done += 1
            progress.seconds = time.monotonic() - start
            on_progress(progress)
    finally:
        source.close()


class _Slot:
    """Memory for the data of one result. The slot grows if a result needs more."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._memory: mmap.mmap | None = None

    def read(self, size: int) -> bytes:
        return os.pread(self._descriptor, size, 0)

    def store(self, groups: Sequence[Sequence[Buffer]]) -> tuple[list[int], int]:
        """Copy groups of buffers one after the other. Returns their sizes, and the size of the slot.

        Raises:
            OSError: There is no memory left.
        """
        if not groups:
            return [], 0
        sizes = [sum(memoryview(buffer).nbytes for buffer in group) for group in groups]
        places = _positions(sizes)
        if self._memory is None or len(self._memory) < places[-1]:
            # allocated now, since a page that cannot be had later would kill the process
            os.posix_fallocate(self._descriptor, 0, places[-1])
            self._memory = mmap.mmap(self._descriptor, places[-1])
        with memoryview(self._memory) as memory:
            for position, group in zip(places, groups, strict=False):
                for view in (memoryview(buffer).cast("B") for buffer in group):
                    memory[position : position + view.nbytes] = view
                    position += view.nbytes
        return sizes, len(self._memory)


def main() -> None:
    """Run a worker process: answer requests until the other process closes the socket or ends."""
    nice, *descriptors = map(int, sys.argv[1:])
    _work(nice, descriptors)


def _work(nice: int, descriptors: Sequence[int], job: FrameJob | None = None) -> None:
    """Answer the requests of the other process. ``descriptors``: the socket and the slots. ``job``: job of a
    copied process."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)  # the other process stops its workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a copy has the handler of the other process
    os.nice(nice)
    if threads := os.environ.get("OPENCV_FOR_THREADS_NUM"):
        import cv2

        cv2.setNumThreads(int(threads))
    socket, *slots = descriptors
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        _serve(Connection(socket), [_Slot(slot) for slot in slots], job)


def _serve(connection: Connection, slots: list[_Slot], job: FrameJob | None) -> None:
    worker: FrameWorker | None = None
    try:
        while True:
            request: _Load | tuple[Any, int] = connection.recv()
            try:
                if isinstance(request, _Load):
                    if worker is not None:
                        worker.close()
                    worker = None
                    if request.size:
                        job = pickle.loads(slots[request.slot].read(request.size))
                if worker is None:
                    assert job is not None
                    worker = job.start()
                answer: Any = _Answer(None, [], 0, {})
                if not isinstance(request, _Load):
                    frame, slot = request
                    answer = _answer(worker, frame, slots[slot])
            except HumansimError as error:
                answer = error
            except MemoryError:
                answer = HumansimError("out of memory")
            except OSError as error:
                text = f"a worker process has no memory or files left: {error.strerror or error}"
                answer = HumansimError(text)
            connection.send(answer)
    finally:
        if worker is not None:
            worker.close()


def _answer(worker: FrameWorker, frame: Any, slot: _Slot) -> _Answer:
    worker.costs.clear()
    result = worker.work(frame)
    start = time.process_time()
    sizes, memory = slot.store(result.data)
    if sizes or worker.costs:
        worker.costs[COPYING] = time.process_time() - start
    return _Answer(result.value, sizes, memory, dict(worker.costs))
