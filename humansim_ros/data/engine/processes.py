"""Processes that answer requests about a job, for images and tracks of the page and of reports.

Each process has one job, such as a scene with its renderer, and answers one request at a time.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

from humansim_ros.data.engine.pool import (
    begin_process,
    end,
    process_context,
    process_environment,
    starting,
)
from humansim_ros.errors import HumansimError
from humansim_ros.files.reading import cores

#: Fewer requests than this are answered in this process, since another one needs seconds for its start.
_FEW = 60


class JobWorker(Protocol):
    """Answers requests in a process."""

    def work(self, request: Any, /) -> Any:
        """Answer a request. Request and answer can be pickled. Raises HumansimError if that fails."""

    def close(self) -> None:
        """Free the renderer and open files."""


class ProcessJob(Protocol):
    """A job for other processes, to which it can be copied."""

    def start(self) -> JobWorker:
        """Create a worker. Raises HumansimError if this machine cannot do the work."""


class ProcessDiedError(HumansimError):
    """A process that answers requests has died."""


class JobProcesses:
    """Processes of a job. Use it in a ``with`` block, or call :meth:`close`.

    Args:
        job: The job.
        count: Number of processes.
        nice: Number that is added to the niceness of this process for the others.
        copies: Whether the processes are forked from this one, so that they have its modules and the job at
            once. This process must have no other threads, and must not have used OpenGL or threads of OpenCV.

    Attributes:
        processes: The processes that have been started.
    """

    def __init__(self, job: ProcessJob, count: int, nice: int = 0, copies: bool = False) -> None:
        context = multiprocessing.get_context("fork") if copies else process_context()
        self.use(job)
        arguments = nice, process_environment(count), job if copies else None
        # a pool of one process each, since a process keeps the static images of its cameras
        self._pools = [ProcessPoolExecutor(1, context, _begin, arguments) for _ in range(count)]
        self.processes: list[BaseProcess] = []
        self._asked: dict[Future[Any], tuple[int, Any]] = {}
        #: The job that each process has, as a pickled job.
        self._jobs: list[bytes | None] = [self._job if copies else None] * count
        if copies:
            with warnings.catch_warnings():
                # of Python, about the threads of the other pools, which hold no locks of a new process
                warnings.simplefilter("ignore", DeprecationWarning)
                for pool in self._pools:
                    with starting(self.processes):
                        pool.submit(_load, None)

    def use(self, job: ProcessJob) -> None:
        """Change the job. The new job is used from the next :meth:`ask` on."""
        self._job = pickle.dumps(job)

    def idle(self) -> list[int]:
        """Numbers of the processes without a request."""
        busy = {number for number, _ in self._asked.values()}
        return [number for number in range(len(self._pools)) if number not in busy]

    def ask(self, request: Any, number: int | None = None) -> bool:
        """Send a request to an idle process. Returns False if no process is idle. ``number``: number of a
        process from :meth:`idle`. If None, any process.

        Raises:
            ProcessDiedError: The process has died.
        """
        idle = self.idle()
        if not idle:
            return False
        chosen = idle[0] if number is None else number
        try:
            with starting(self.processes):
                if self._jobs[chosen] is not self._job:
                    self._pools[chosen].submit(_load, self._job)
                    self._jobs[chosen] = self._job
                self._asked[self._pools[chosen].submit(_answer, request)] = chosen, request
        except BrokenProcessPool:
            raise ProcessDiedError("a worker process has died") from None
        return True

    def arrived(self, timeout: float | None = None) -> Iterator[tuple[Any, Any]]:
        """Yield requests that are answered, each with its answer, or with a HumansimError.

        ``timeout``: seconds to wait for an answer. If None, until there is one.

        Raises:
            ProcessDiedError: A process has died.
        """
        for future in wait(self._asked, timeout, FIRST_COMPLETED).done:
            _, request = self._asked.pop(future)
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                raise ProcessDiedError("a worker process has died")
            if isinstance(error, MemoryError):
                error = HumansimError("a worker process has no memory left")
            if error is not None and not isinstance(error, HumansimError):
                raise error
            yield request, error or future.result()

    def close(self) -> None:
        """End the processes, after the requests that they work on."""
        end(self._pools, self.processes)

    def __enter__(self) -> JobProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def answers(job: ProcessJob, requests: Sequence[int], count: int | None = None) -> Iterator[Any]:
    """Answer requests in their order, with several processes if there are many.

    Args:
        job: The job.
        requests: Different numbers, such as those of frames.
        count: Number of processes. If None, one for each core, or this process for a few requests.

    Raises:
        ProcessDiedError: A process has died.
        HumansimError: A request cannot be answered.
    """
    if count is None:
        count = cores() if len(requests) >= _FEW else 1
    if count == 1:
        worker = job.start()
        try:
            yield from map(worker.work, requests)
        finally:
            worker.close()
        return
    found: dict[int, Any] = {}
    with JobProcesses(job, count) as processes:
        left = deque(requests)
        for request in requests:
            while request not in found:
                while left and processes.ask(left[0]):
                    left.popleft()
                for answered, answer in processes.arrived():
                    if isinstance(answer, HumansimError):
                        raise answer
                    found[answered] = answer
            yield found.pop(request)


class _State:
    """The job of a process, and its worker."""

    job: ProcessJob | None = None
    worker: JobWorker | None = None


def _begin(nice: int, environment: dict[str, str], job: ProcessJob | None) -> None:
    begin_process(environment)
    os.nice(nice)
    _State.job = job


def _load(job: bytes | None) -> None:
    """Change the job. ``job``: pickled; None keeps the job of a forked process."""
    if _State.worker is not None:
        _State.worker.close()
    _State.worker = None
    if job is not None:
        _State.job = pickle.loads(job)


def _answer(request: Any) -> Any:
    if _State.worker is None:
        assert _State.job is not None
        _State.worker = _State.job.start()
    return _State.worker.work(request)
