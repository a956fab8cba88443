"""Workers of a plan in other processes: processes of this machine, or tasks of a Ray cluster."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from multiprocessing import forkserver
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol
from urllib.parse import urlsplit

from humansim_ros.data.engine.work import LEAST, Done, RetryError, WorkShard, count_items
from humansim_ros.data.engine.writing import CONTINUES, ShardJob, write_shard
from humansim_ros.errors import BagError, HumansimError, some_of
from humansim_ros.files.reading import cores, thread_limits

#: Seconds between looks at the progress, and longest wait for a worker to end.
_LOOK, _ENDING = 0.1, 10.0
#: Number of shards for each worker that are given out, so that one waits while another is written.
_AHEAD = 2
#: Signals of a terminal. The process that has started the workers gets them, too, and ends the workers.
_TERMINAL = (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
#: Number of further attempts of Ray after a worker has died, or after an error that may not occur on another
#: machine.
_RETRIES = 3
_RETRIED = [OSError, HumansimError, MemoryError]
#: Longest wait for the answer of a host, seconds.
_CONNECT_LIMIT = 5.0
#: Size of the object store, bytes, of a Ray that is started here. The store holds the scenes.
_OBJECT_STORE = 2**29
#: Environment variables of a task, which limit the task to one core.
_ONE_CORE = {"LP_NUM_THREADS": "0", "OPENCV_FOR_THREADS_NUM": "1"}
#: Most shards that an error lists.
_MAX_LISTED = 5


class _Pool(Protocol):
    """Workers in other processes.

    Attributes:
        is_patient: Whether shards in work are finished after a failure of another shard.
    """

    is_patient: bool

    @property
    def workers(self) -> int:
        """Number of workers."""

    def submit(self, shard: WorkShard) -> Future[Done]:
        """Give a shard to a worker."""

    def ticks(self, shards: Iterable[WorkShard]) -> int:
        """Number of items that are done of shards that are not finished. 0 if it is not known."""

    def reason(self, error: BaseException, left: Collection[WorkShard]) -> BaseException:
        """The error of a shard as an error for the user. ``left``: shards that are not finished."""

    def close(self, is_whole: bool) -> None:
        """End the workers. ``is_whole``: whether all shards are finished. If not, the others are given up."""


def write_in_pool(
    job: ShardJob,
    todo: Sequence[WorkShard],
    workers: int,
    ray: str | None,
    show: Callable[[int], None],
    take: Callable[[Done], None],
    count: int,
) -> None:
    """Write shards in other processes.

    Args:
        job: Plan and folder.
        todo: The shards.
        workers: Number of processes of this machine, or of a local Ray.
        ray: Address of a Ray cluster. If None, processes of this machine do the work.
        show: Called from time to time with the number of items that are done.
        take: Called with each finished shard.
        count: Number of items that are done.

    Raises:
        RetryError: A worker process has died twice, or shards failed on a cluster.
        HumansimError: A shard cannot be written.
    """
    left = dict.fromkeys(todo)
    with ExitStack() as stack:
        if ray is not None:
            module = stack.enter_context(connected(ray, workers))
            _run(_RayTasks(module, job), left, show, take, count)
            return
        for is_last in (False, True):
            pool = _Processes(job, min(workers, len(left)))
            try:
                _run(pool, left, show, take, count + count_items(todo) - count_items(left))
                return
            except BrokenProcessPool as death:
                if is_last:
                    text = f"{pool.death(death)}; finished shards stay, and {CONTINUES}"
                    raise RetryError(text) from None


def _run(
    pool: _Pool,
    left: dict[WorkShard, None],
    show: Callable[[int], None],
    take: Callable[[Done], None],
    count: int,
) -> None:
    """Write the shards ``left``. Finished ones are removed from it.

    Raises:
        BrokenProcessPool: A worker process has died.
    """
    running: dict[Future[Done], WorkShard] = {}
    waiting = deque(left)
    failure: BaseException | None = None
    try:
        while running or waiting:
            while waiting and len(running) < _AHEAD * pool.workers:
                shard = waiting.popleft()
                running[pool.submit(shard)] = shard
            for future in wait(running, _LOOK, FIRST_COMPLETED).done:
                shard = running.pop(future)
                if (error := future.exception()) is None:
                    del left[shard]
                    count += len(shard.items)
                    take(future.result())
                elif failure is None:
                    failure = error
            if failure is not None:
                waiting.clear()
                if not pool.is_patient:
                    break
            show(count + pool.ticks(running.values()))
    finally:
        pool.close(not left)
    if failure is not None:
        raise pool.reason(failure, left)


# --- processes of this machine


class _Processes:
    """Processes that write shards. The pool of Python starts them when the first shards are given out."""

    is_patient = False

    def __init__(self, job: ShardJob, workers: int) -> None:
        self.workers = workers
        context = process_context()
        #: Number of finished items by shard. The last number tells the workers to give up. (Without a lock,
        #: which a killed process could hold for ever.)
        self._ticks = context.RawArray("q", max(shard.number for shard in job.plan.shards) + 2)
        arguments = pickle.dumps(job), self._ticks, process_environment(workers)
        self._pool = ProcessPoolExecutor(workers, context, _begin, arguments)
        self._processes: list[BaseProcess] = []

    def submit(self, shard: WorkShard) -> Future[Done]:
        """Give a shard to a process, which is started now if none is idle."""
        self._ticks[shard.number] = 0
        with starting(self._processes):
            return self._pool.submit(_in_process, shard)

    def ticks(self, shards: Iterable[WorkShard]) -> int:
        return sum(self._ticks[shard.number] for shard in shards)

    def reason(self, error: BaseException, left: Collection[WorkShard]) -> BaseException:
        if isinstance(error, MemoryError):
            return HumansimError("a worker process has no memory left")
        if isinstance(error, OSError):
            return HumansimError(f"a worker process has failed: {error.strerror or error}")
        return error

    def death(self, error: BaseException) -> str:
        """Text about the death of a process."""
        codes = [process.exitcode for process in self._processes]
        # the pool ends the other processes with SIGTERM
        code = next((code for code in codes if code not in (None, 0, -signal.SIGTERM)), None)
        if code is None:
            return "a worker process has died"
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"a worker process {how}"

    def close(self, is_whole: bool) -> None:
        """End the processes, after the present item if the work is given up."""
        self._ticks[-1] = not is_whole
        end([self._pool], self._processes)


_STARTING = threading.Lock()
#: Environment variable of Python 3.11 and later: do not search the current folder for modules.
_SAFE_PATH = "PYTHONSAFEPATH"


def prepare_processes(modules: Sequence[str], workers: int | None, items: int | range | None = None) -> None:
    """Let another process import modules while this process prepares a plan. Worker processes are forked from
    that process, so that their start takes less time.

    Args:
        modules: Names of modules of this package.
        workers: Number of worker processes. If None, one for each core.
        items: Items of the plan, or their number. If None, they are not known.
    """
    count = len(items) if isinstance(items, range) else items
    if (workers or cores()) > 1 and (count is None or count > LEAST):
        with _STARTING, _terminal_signals_blocked(), _safe_path() as is_safe:
            if is_safe:
                forkserver.set_forkserver_preload(list(modules))
                forkserver.ensure_running()


def process_context() -> BaseContext:
    """Context of :mod:`multiprocessing` for worker processes. They are not forked from this process, since a
    fork after threads of OpenCV would wait for ever."""
    return multiprocessing.get_context("forkserver")


def process_environment(workers: int) -> dict[str, str]:
    """Environment variables of worker processes. ``workers``: their number."""
    return {**os.environ, **thread_limits(workers)}


@contextmanager
def _terminal_signals_blocked() -> Iterator[None]:
    """Context for the start of processes, which ignore the signals of a terminal."""
    signals = signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, signals)


@contextmanager
def _safe_path() -> Iterator[bool]:
    """Context for the start of a process that does not import files of the current folder, which a user may
    have named like a module. Gives whether this version of Python can do so."""
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield sys.version_info >= (3, 11)
    finally:
        del os.environ[_SAFE_PATH]
        if before is not None:
            os.environ[_SAFE_PATH] = before


@contextmanager
def starting(processes: list[BaseProcess]) -> Iterator[None]:
    """Start processes in the block. They ignore signals of the terminal, and do not run the main module,
    which a user may have written without ``if __name__ == "__main__"``.

    ``processes``: list that gets the new processes.
    """
    with _STARTING, _terminal_signals_blocked():
        others = set(multiprocessing.active_children())
        main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main
            processes += [each for each in multiprocessing.active_children() if each not in others]


def end(pools: Sequence[ProcessPoolExecutor], processes: Iterable[BaseProcess]) -> None:
    """End the processes of pools: after their present work, or by force after some seconds."""

    def kill() -> None:
        for process in processes:
            process.kill()

    timer = threading.Timer(_ENDING, kill)
    timer.start()
    try:
        for pool in pools:
            pool.shutdown(cancel_futures=True)
    except BaseException:  # another Ctrl-C
        kill()
        raise
    finally:
        timer.cancel()


class _Cancelled(Exception):
    """The work is given up."""


class _State:
    """What a worker process gets at its start: its job (pickled), and the numbers of finished items."""

    job: bytes
    ticks: Any


def _begin(job: bytes, ticks: Any, environment: dict[str, str]) -> None:
    """Prepare a process that writes shards. The job is unpickled later, since an error here would be lost."""
    _State.job, _State.ticks = job, ticks
    begin_process(environment)


def begin_process(environment: dict[str, str]) -> None:
    """Prepare a worker process: limit its threads, and end it if the process that has started it is killed.

    ``environment``: environment variables, see :func:`process_environment`.
    """
    os.environ.pop(_SAFE_PATH, None)
    os.environ.update(environment)  # the present one may be that of an earlier time
    signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINAL)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a forked process has the handler of the other process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if threads := environment.get("OPENCV_FOR_THREADS_NUM"):
        import cv2

        cv2.setNumThreads(int(threads))


def _end_with_parent() -> None:
    """End this process if the process that has started it is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@lru_cache(maxsize=1)
def _job() -> ShardJob:
    job: ShardJob = pickle.loads(_State.job)
    return job


def _in_process(shard: WorkShard) -> Done:
    """Write a shard in a worker process."""
    ticks = _State.ticks

    def tick() -> None:
        if ticks[-1]:
            raise _Cancelled
        ticks[shard.number] += 1

    return write_shard(_job(), shard, tick)


# --- tasks of Ray


class _RayTasks:
    """Tasks of a Ray cluster, which write shards."""

    is_patient = True

    def __init__(self, ray: Any, job: ShardJob) -> None:
        self._ray = ray
        options = {"max_retries": _RETRIES, "retry_exceptions": _RETRIED, "scheduling_strategy": "SPREAD"}
        self._task = ray.remote(num_cpus=1, **options)(_in_task)
        self._job = ray.put(job)  # sent once for all shards
        self._references: dict[Future[Done], Any] = {}

    @property
    def workers(self) -> int:
        """Number of cores of the cluster."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def submit(self, shard: WorkShard) -> Future[Done]:
        """Start a task."""
        reference = self._task.remote(self._job, shard)
        future: Future[Done] = reference.future()
        self._references[future] = reference
        return future

    def ticks(self, shards: Iterable[WorkShard]) -> int:
        return 0

    def reason(self, error: BaseException, left: Collection[WorkShard]) -> BaseException:
        if type(error).__name__ == "WorkerCrashedError":
            text = "its worker was killed, or crashed"
        else:
            cause = getattr(error, "cause", None) or error
            text = next(iter(str(cause).strip().splitlines()), "")
            text = text if isinstance(cause, HumansimError) else f"{type(cause).__name__}: {text}"
        listed = some_of(map(str, left), _MAX_LISTED)
        return RetryError(
            f"{len(left)} shards are missing ({listed}), after {1 + _RETRIES} attempts: {text}; {CONTINUES}"
        )

    def close(self, is_whole: bool) -> None:
        """Cancel the tasks that have not ended."""
        for future, reference in self._references.items():
            if not future.done():
                self._ray.cancel(reference, force=True)


def _in_task(job: ShardJob, shard: WorkShard) -> Done:
    """Write a shard in a task."""
    for name, value in _ONE_CORE.items():
        os.environ.setdefault(name, value)
    return write_shard(job, shard)


@contextmanager
def connected(address: str, workers: int | None) -> Iterator[Any]:
    """Connect Ray to a cluster, and give the module ``ray``. An existing connection of this process is used.

    Raises:
        BagError: Ray is not installed, or the address does not answer.
    """
    # otherwise Ray warns of a change to come
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
        import ray.exceptions
    except ImportError as reason:
        raise BagError(f"--ray needs Ray ({reason}); install it: pip install 'humansim_ros[ray]'") from None
    if ray.is_initialized():
        yield ray
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address == "local":
        options |= {"num_cpus": workers, "include_dashboard": False, "object_store_memory": _OBJECT_STORE}
        # workers import the package from the same place as this process
        places = [str(Path(__file__).parents[3]), *filter(None, [os.environ.get("PYTHONPATH")])]
        options["runtime_env"] = {"env_vars": {"PYTHONPATH": os.pathsep.join(places)}}
    else:
        _check_address(address)
    try:
        ray.init(address=address, **options)
    except (ConnectionError, ValueError, RuntimeError, OSError, ray.exceptions.RayError) as reason:
        text = str(reason).strip().splitlines()[0] if str(reason).strip() else type(reason).__name__
        raise BagError(f"Ray cannot be reached at this address: {text}", key=f"--ray {address}") from None
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_address(address: str) -> None:
    """Check that a host answers, since Ray itself would try for half a minute. Raises BagError."""
    parts = urlsplit(address if "://" in address else f"//{address}")
    if address == "auto":
        return
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None or parts.scheme not in ("", "ray"):
        raise BagError("give local, auto, HOST:PORT or ray://HOST:PORT", key=f"--ray {address}")
    try:
        socket.create_connection((host, port), _CONNECT_LIMIT).close()
    except OSError as reason:
        raise BagError(
            f"Ray cannot be reached at this address: {reason.strerror or reason}", key=f"--ray {address}"
        ) from None
