"""Write a shard: in this process, in a worker process, or in a task of Ray."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from humansim_ros.data.engine.folder import WORK, OutputFolder
from humansim_ros.data.engine.work import Done, PartialError, Worker, WorkPlan, WorkShard, key_text
from humansim_ros.errors import HumansimError, RenderError
from humansim_ros.files.reading import package_version, temporary_folder

#: The plan, in the folder of the work.
PLAN_FILE = f"{WORK}/plan.json"
#: Folder there for files of the product that only :meth:`WorkPlan.finish` needs.
TEMPORARY = f"{WORK}/files"
#: Error numbers of a full disk.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Words about what to do after an interruption.
CONTINUES = "the same command with --resume continues"


def ignore(*_: Any) -> None:
    """Do nothing. The default of callbacks."""


@dataclass(frozen=True)
class ShardJob:
    """A plan and the folder of its product. It is sent to each worker once.

    Attributes:
        plan: The plan.
        output: Folder of the product.
        key: Key that is equal for jobs that can use the same worker. It is made once, since the key of a plan
            may be a hash of files, which other hosts do not have.
        version: Version of this package.
    """

    plan: WorkPlan = field(compare=False)
    output: OutputFolder = field(compare=False)
    key: str
    version: str = field(default_factory=package_version)

    @classmethod
    def of(cls, plan: WorkPlan, output: OutputFolder) -> ShardJob:
        """The work of a plan in a folder."""
        return cls(plan, output, f"{output.url} {key_text(plan)}")


def digest(done: Done) -> str:
    """Hash of the data of a finished shard, which tells a damaged file."""
    return hashlib.sha256(json.dumps(asdict(done), sort_keys=True).encode()).hexdigest()


def write_done(output: OutputFolder, done: Done) -> None:
    """Write the file that says that a shard is finished."""
    content = {"sha256": digest(done), "done": asdict(done)}
    output.write(f"{WORK}/{done.number:06d}.json", json.dumps(content))


def open_worker(job: ShardJob) -> Worker:
    """Start a worker.

    Raises:
        HumansimError: This machine cannot do the work; or renders on another device than that of the plan,
            so that pixels would differ.
    """
    worker, device = job.plan.open(), job.plan.device
    if device in worker.device:
        return worker
    worker.close()
    raise RenderError(
        f"{socket.gethostname()} renders on {worker.device}, and the {job.plan.what} is planned for "
        f"{device}: pixels would differ. Use machines that are alike, also for the command"
    )


@lru_cache(maxsize=1)
def _opened(job: ShardJob) -> Worker:
    """Start a worker. Cached for the next shard, since a new renderer needs seconds for the static scene."""
    return open_worker(job)


def write_shard(job: ShardJob, shard: WorkShard, tick: Callable[[], None] = ignore) -> Done:
    """Write a shard in a worker process or in a task of Ray.

    Raises:
        HumansimError: This machine cannot do the work, or the shard cannot be written.
    """
    if job.version != package_version():
        text = (
            f"has humansim_ros {package_version()}, and the driver {job.version}: install the same everywhere"
        )
        raise HumansimError(f"{socket.gethostname()} {text}")
    if job.output.size(PLAN_FILE) is None:
        text = f"host {socket.gethostname()} does not have this folder: use one that all hosts share"
        raise job.plan.error(text, path=job.output.url)
    try:
        return write_here(job, _opened(job), shard, tick)
    except BaseException:
        _opened.cache_clear()  # the worker may be broken, so the next attempt starts from the beginning
        raise


def write_here(job: ShardJob, worker: Worker, shard: WorkShard, tick: Callable[[], None]) -> Done:
    """Write a shard, and move its files to the product.

    Args:
        job: Plan and folder.
        worker: Worker of the plan.
        shard: The shard.
        tick: Called after each item.

    Raises:
        PartialError: The disk is full.
        HumansimError: An item cannot be made, or a file cannot be written.
    """
    output = job.output
    worker.costs.clear()
    with full_disk(), _staging(output, shard) as folder:
        written = worker.write(shard, folder, tick)
        files = {}
        for name in _files(folder) if not written.failure else ():
            files[name] = (folder / name).lstat().st_size
            output.put(folder / name, name)
        done = Done(shard.number, files, written.rows, written.failure, dict(worker.costs))
        write_done(output, done)
        return done


@contextmanager
def full_disk() -> Iterator[None]:
    """Convert errors of a full disk to PartialError, and other system errors to HumansimError."""
    try:
        yield
    except HumansimError as error:
        if not isinstance(error, PartialError) and _is_full(error):
            raise PartialError(f"{error}; finished shards stay, and {CONTINUES}") from None
        raise
    except OSError as reason:
        text, path = f"cannot be written: {reason.strerror or reason}", reason.filename
        if reason.errno in _FULL:
            raise PartialError(f"{text}; finished shards stay, and {CONTINUES}", path=path) from None
        raise HumansimError(text, path=path) from None


def _is_full(error: BaseException) -> bool:
    """Whether the error of a full disk has led to an error."""
    reason: BaseException | None = error
    while reason is not None and not isinstance(reason, OSError):
        reason = reason.__cause__ or reason.__context__
    return reason is not None and reason.errno in _FULL


@contextmanager
def _staging(output: OutputFolder, shard: WorkShard) -> Iterator[Path]:
    """An empty folder for the files of a shard. It is removed at the end."""
    if output.local is None:
        with temporary_folder() as folder:
            yield folder
        return
    folder = Path(mkdtemp(prefix=f"staging-{shard.name}-", dir=output.local / WORK))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _files(folder: Path) -> list[str]:
    """Paths of all files and links below a folder, relative to it, in order."""
    found = []
    for place, folders, names in os.walk(folder):
        links = [name for name in folders if Path(place, name).is_symlink()]
        found += [Path(place, name).relative_to(folder).as_posix() for name in [*names, *links]]
    return sorted(found)
