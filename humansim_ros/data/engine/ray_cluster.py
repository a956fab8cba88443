"""Run a job on a Ray cluster. Each task does a part of the job: some consecutive frames."""

from __future__ import annotations

import os
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from humansim_ros import __version__
from humansim_ros.data.engine.frame_job import FrameJob, FrameProgress, FrameWorker
from humansim_ros.errors import BagError, HumansimError, RenderError, some_of

#: Number of frames of a part. With four cameras they are some seconds of work for one core, and 1 GB of raw
#: images.
PART_FRAMES = 100
#: Number of further attempts after a worker has died, or after an error that may not occur on another
#: machine.
_RETRIES = 3
_RETRIED = [OSError, BagError, RenderError, MemoryError]
#: Number of tasks for each core, so that one task waits while another runs.
_TASKS_PER_CORE = 2
#: Longest wait for the answer of a host, seconds.
_CONNECT_LIMIT = 5.0
#: Size of the object store, bytes, of a Ray that is started here. The store holds the scenes.
_OBJECT_STORE = 2**29
#: Environment variables of a task, which limit the task to one core.
_ONE_CORE = {"LP_NUM_THREADS": "0", "OPENCV_FOR_THREADS_NUM": "1"}
#: Most parts that an error lists.
_MAX_LISTED = 5


@dataclass(frozen=True)
class ClusterPart:
    """A part of a job: the frames that one task makes.

    Attributes:
        name: Short name, for the list of missing parts.
        text: Name for messages about failures.
        frames: Numbers of the frames.
        size: Number of frames that the part adds to the progress.
        target: Path of the file of the part, if the job writes one file for each part.
        version: Version of the package.
    """

    name: str
    text: str
    frames: Sequence[int]
    size: int
    target: Any = None
    version: str = __version__


class PartResult(Protocol):
    """What a task returns."""

    @property
    def size(self) -> int:
        """Bytes that the task has written."""


class ClusterJob(FrameJob, Protocol):
    """Work on frames that tasks of a cluster do in parts."""

    @property
    def key(self) -> str:
        """Key that is equal for jobs that can use the same worker."""

    def write_part(self, worker: FrameWorker, part: ClusterPart) -> PartResult:
        """Write the files of a part; this runs in a task. Raises HumansimError, OSError."""


@dataclass(frozen=True)
class _Work:
    key: str
    job: ClusterJob = field(compare=False)


@lru_cache(maxsize=1)
def _worker(work: _Work) -> FrameWorker:
    """Start a worker. Cached for the next part, since a new renderer needs seconds for the static scene."""
    return work.job.start()


def write_part(job: ClusterJob, part: ClusterPart) -> PartResult:
    """Write a part of a job. Runs in a task. Raises HumansimError if the command has another version."""
    if part.version != __version__:
        message = (
            f"has humansim_ros {__version__}, and the driver {part.version}: install the same everywhere"
        )
        raise HumansimError(f"{socket.gethostname()} {message}")
    for name, value in _ONE_CORE.items():
        os.environ.setdefault(name, value)
    try:
        return job.write_part(_worker(_Work(job.key, job)), part)
    except BaseException:
        _worker.cache_clear()  # the worker may be broken, so the next attempt starts from the beginning
        raise


def run_parts(
    ray: Any,
    work: Sequence[tuple[ClusterJob, Sequence[ClusterPart]]],
    progress: FrameProgress,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> tuple[dict[ClusterPart, PartResult], list[str]]:
    """Run parts of jobs on a cluster. After a failure, no further parts start.

    Args:
        ray: The module ``ray``, connected to a cluster.
        work: Jobs, each with its parts.
        progress: State before the first part. This function updates it.
        on_progress: Called with ``progress`` after each part.

    Returns:
        Results of the parts that have been written, and the reasons of failures.
    """
    options = {"max_retries": _RETRIES, "retry_exceptions": _RETRIED, "scheduling_strategy": "SPREAD"}
    task = ray.remote(num_cpus=1, **options)(write_part)
    # a job is sent once for all its parts
    waiting = deque(
        (job, part) for job, parts in ((ray.put(job), parts) for job, parts in work) for part in parts
    )
    running: dict[Any, ClusterPart] = {}
    results: dict[ClusterPart, PartResult] = {}
    failures: list[str] = []
    start = time.monotonic()
    try:
        while running or (waiting and not failures):
            limit = _TASKS_PER_CORE * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while waiting and not failures and len(running) < limit:
                job, part = waiting.popleft()
                running[task.remote(job, part)] = part
            ray.wait(list(running), num_returns=1)
            for done in ray.wait(list(running), num_returns=len(running), timeout=0)[0]:
                part = running.pop(done)
                try:
                    result: PartResult = ray.get(done)
                except ray.exceptions.RayError as error:
                    failures.append(f"{part.text}: {_reason(error)}")
                    continue
                results[part] = result
                progress.done += part.size
                progress.size += result.size
                progress.seconds = time.monotonic() - start
                on_progress(progress)
    finally:
        for reference in running:  # after Ctrl-C
            ray.cancel(reference, force=True)
    return results, failures


def _reason(error: Any) -> str:
    """Reason of a failed task as text for the user."""
    if type(error).__name__ == "WorkerCrashedError":
        return "its worker was killed, or crashed"
    cause = getattr(error, "cause", None) or error
    text = next(iter(str(cause).strip().splitlines()), "")
    return text if isinstance(cause, HumansimError) else f"{type(cause).__name__}: {text}"


def missing_text(
    work: Sequence[tuple[ClusterJob, Sequence[ClusterPart]]],
    results: Mapping[ClusterPart, PartResult],
    failures: Sequence[str],
    what: str,
    does: str,
) -> str:
    """Error text about parts that could not be written. Empty if all were written.

    Args:
        work: Jobs, each with its parts.
        results: Results of the parts that are written.
        failures: Reasons of failures.
        what: Noun for the parts, such as ``shards``.
        does: Verb for what ``--resume`` does with missing parts, such as ``records``.
    """
    missing = [part.name for _, parts in work for part in parts if part not in results]
    if not missing:
        return ""
    reasons = "; ".join(failures[:_MAX_LISTED])
    return (
        f"{len(missing)} {what} are missing ({some_of(missing, _MAX_LISTED)}), after {1 + _RETRIES} "
        f"attempts: {reasons}. --resume {does} them, and keeps the others"
    )


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
