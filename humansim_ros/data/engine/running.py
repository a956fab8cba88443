"""Do the work of a plan: in this process, in several, or on a Ray cluster; and continue interrupted work.

While work goes on, the folder of the product has a folder ``.work``: the plan (``plan.json``), a file for
each finished shard (``000012.json``), and staging folders, which a worker fills with the files of a shard.
When a shard is complete, its files are moved to the product, then its own file appears. At the end
``plan.json`` is removed first. So a folder ``.work`` without a plan has just begun or has just ended.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress

from humansim_ros.data.engine.folder import WORK, OutputFolder
from humansim_ros.data.engine.work import (
    Done,
    PartialError,
    WorkPlan,
    WorkProgress,
    WorkShard,
    check_key,
    count_items,
    key_text,
)
from humansim_ros.data.engine.writing import (
    CONTINUES,
    PLAN_FILE,
    ShardJob,
    digest,
    full_disk,
    ignore,
    open_worker,
    write_done,
    write_here,
)
from humansim_ros.errors import HumansimError, warn_about
from humansim_ros.files.reading import parse_json, size_text

#: Names in the folder of the work.
_OURS = re.compile(r"plan\.json|\d{6,}\.json|staging-.*|files|converted")
#: Shares of the free space: an estimated size above the first causes a warning, above the second an error.
#: (Shards differ in size.)
_MUCH, _TOO_MUCH = 0.9, 1.5
#: Error about a folder that exists.
_EXISTS = "this path exists; choose another one, or continue with --resume"


def run(
    plan: WorkPlan,
    output: str | os.PathLike[str],
    *,
    workers: int = 1,
    ray: str | None = None,
    resume: bool = False,
    on_progress: Callable[[WorkProgress], None] = ignore,
) -> WorkProgress:
    """Do the work of a plan. The files do not depend on the workers, nor on interruptions.

    Args:
        plan: What is made.
        output: Folder of the product, or its URL. It must not exist, unless ``resume`` is set.
        workers: Number of processes. If 1 and without Ray, this process does the work.
        ray: Address of a Ray cluster, such as ``local`` or ``auto``. If None, this machine does the work.
        resume: Whether to continue interrupted work. If there is nothing yet, the work begins.
        on_progress: Called from time to time with the progress.

    Returns:
        The progress at the end.

    Raises:
        RetryError: A worker process has died twice, or hosts of a cluster have failed.
        PartialError: The disk is full.
        HumansimError: The folder exists or has another product; this machine cannot do the work; or an item
            cannot be made.
    """
    with WorkFolder(plan, OutputFolder.at(output)) as work:
        try:
            with full_disk():
                todo = work.begin(resume)
            progress = WorkProgress.of(count_items(plan.shards), count_items(todo))
            if work.is_finished:
                return progress
            if todo:
                _write_all(work, todo, workers, ray, progress, on_progress)
            with full_disk():
                plan.finish(done := FinishedShards(work), work.output)
            failure = plan.failure(done)
        except BaseException:
            work.give_up()
            raise
        work.end()
    if failure:
        raise plan.error(failure)
    return progress


def _write_all(
    work: WorkFolder,
    todo: Sequence[WorkShard],
    workers: int,
    ray: str | None,
    progress: WorkProgress,
    on_progress: Callable[[WorkProgress], None],
) -> None:
    """Write the shards ``todo``, and follow the progress."""
    tried = list[Done]()
    job, start = ShardJob.of(work.plan, work.output), time.monotonic()
    left = count_items(todo)

    def show(done: int) -> None:
        progress.done, progress.seconds = done, time.monotonic() - start
        on_progress(progress)

    def take(done: Done) -> None:
        nonlocal left
        items = len(work.plan.shards[done.number].items)
        left -= items
        progress.kept += items
        progress.size += done.size
        for step, seconds in done.costs.items():
            progress.costs[step] = progress.costs.get(step, 0.0) + seconds
        work.is_begun = True
        tried.append(done)
        if left and (failure := work.plan.failure(tried)):
            raise work.plan.error(f"{failure}, and the rest is given up")
        work.check_space(progress.size / (progress.kept - progress.first), left)

    if ray is None and min(workers, len(todo)) == 1:
        _write_here(job, todo, show, take, progress.first)
    else:
        from humansim_ros.data.engine.pool import write_in_pool

        write_in_pool(job, todo, workers, ray, show, take, progress.first)
    progress.done, progress.seconds = progress.kept, time.monotonic() - start


def _write_here(
    job: ShardJob,
    todo: Sequence[WorkShard],
    show: Callable[[int], None],
    take: Callable[[Done], None],
    count: int,
) -> None:
    """Write shards in this process. ``count``: number of items that are done."""

    def tick() -> None:
        nonlocal count
        count += 1
        show(count)

    worker = open_worker(job)
    try:
        for shard in todo:
            take(write_here(job, worker, shard, tick))
    finally:
        worker.close()


class WorkFolder:
    """Folder of a product, with the state of the work.

    Attributes:
        output: Folder of the product.
        is_begun: Whether there are finished shards.
        is_finished: Whether the product is complete.
    """

    def __init__(self, plan: WorkPlan, output: OutputFolder) -> None:
        self.plan, self.output = plan, output
        self.is_begun = self.is_finished = False
        self._is_new = self._is_warned = False
        self._descriptor: int | None = None

    def begin(self, resume: bool) -> list[WorkShard]:
        """Create the folder, or continue the work in it.

        Returns:
            The shards that are not finished.

        Raises:
            HumansimError: The folder exists, has another product, or cannot be written.
        """
        plan, output = self.plan, self.output
        is_new = not output.exists()
        if output.local is not None and not (is_new or output.local.is_dir()):
            raise plan.error("this is not a folder" if resume else _EXISTS, path=output.url)
        if is_new:
            output.create()
        elif not resume:
            begun = output.size(PLAN_FILE) is not None
            text = f"a {plan.what} has begun here; {CONTINUES} it" if begun else _EXISTS
            raise plan.error(text, path=output.url)
        self._lock()
        self._is_new = is_new
        self._check_names()
        if output.size(PLAN_FILE) is not None:
            where = output.path(PLAN_FILE)
            there = parse_json(output.read(PLAN_FILE).decode(errors="replace"), plan.error, where)
            check_key(plan, there if isinstance(there, dict) else {}, output.url)
            return self._open_shards()
        complete = None
        if output.names() - {WORK}:
            complete = plan.finished(output)
            if complete is None:
                raise plan.error(f"no {plan.what} that can be continued has begun here", path=output.url)
            check_key(plan, complete[0], output.url)
        output.delete(WORK)  # from a kill at the start or at the end
        if complete is not None and set(complete[1]) >= {shard.number for shard in plan.shards}:
            self.is_finished = True
            return []
        for number in complete[1] if complete else ():
            write_done(output, Done(number))
        output.write(PLAN_FILE, key_text(plan))
        return self._open_shards()

    def _check_names(self) -> None:
        """Raise the error of the plan if the folder of the work has files of somebody else."""
        local = self.output.local
        if local is not None and ((local / WORK).is_symlink() or (local / WORK).is_file()):
            raise self.plan.error("this is not a folder of ours", path=local / WORK)
        for name in self.output.names(WORK):
            if not _OURS.fullmatch(name):
                raise self.plan.error(
                    "this file is not ours: move it away", path=f"{self.output.url}/{WORK}/{name}"
                )

    def _open_shards(self) -> list[WorkShard]:
        """Shards that are not finished. Removes staging folders of processes that have died."""
        finished = set[int]()
        for name in sorted(self.output.names(WORK)):
            if name.endswith(".json") and name != "plan.json":
                done = self.read(name)
                if done is not None and all(
                    self.output.size(file) == size for file, size in done.files.items()
                ):
                    finished.add(done.number)
            elif name.startswith("staging-"):
                self.output.delete(f"{WORK}/{name}")
        self.is_begun = bool(finished)
        return [shard for shard in self.plan.shards if shard.number not in finished]

    def read(self, name: str) -> Done | None:
        """Read the file of a finished shard. None if the file is damaged, as after a power cut."""
        text = self.output.read(f"{WORK}/{name}").decode(errors="replace")
        try:
            content = parse_json(text, HumansimError)
            done = Done(**content["done"])
            is_whole = content["sha256"] == digest(done) and name == f"{done.number:06d}.json"
            return done if is_whole else None
        except (HumansimError, LookupError, TypeError, ValueError):
            return None

    def check_space(self, each: float, left: int) -> None:
        """Warn once if the remaining items may not fit on the disk.

        Args:
            each: Size of an item, bytes.
            left: Number of remaining items.

        Raises:
            PartialError: The items need more than 1.5 times the free space.
        """
        local, needed = self.output.local, int(each * left)
        if local is None or self._is_warned:
            return
        free = shutil.disk_usage(local).free
        text = (
            f"the other {left} {self.plan.items} need about {size_text(needed)}, and {size_text(free)} are "
            f"free on the disk{self.plan.saving}"
        )
        if needed > _TOO_MUCH * free:
            raise PartialError(f"{text}. With more space, {CONTINUES}", path=self.output.url)
        if needed > _MUCH * free:
            self._is_warned = True
            warn_about(self.output.url, text)

    def _lock(self) -> None:
        """Make sure that no other process of this machine works on the folder. Raises HumansimError."""
        if self.output.local is None:
            return
        try:
            self._descriptor = os.open(self.output.local, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise self.plan.error("another process works on this folder", path=self.output.url) from None
        except OSError:  # the file system has no locks; or this is no folder, which the caller finds out
            pass

    def __enter__(self) -> WorkFolder:
        return self

    def __exit__(self, *_: object) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)

    def give_up(self) -> None:
        """Remove the folder if this run has created it and no shard is finished."""
        if self._is_new and not self.is_begun:
            with suppress(HumansimError):
                self.output.delete()

    def end(self) -> None:
        """Remove the state of the work."""
        self.output.remove(PLAN_FILE)
        self.output.delete(WORK)


class FinishedShards(Collection[Done]):
    """All shards of finished work, in order.

    Each iteration reads them from the disk, since the rows of a long export may not fit into the memory. It
    raises the error of the plan if a file is damaged.
    """

    def __init__(self, work: WorkFolder) -> None:
        self._work = work

    def __len__(self) -> int:
        return len(self._work.plan.shards)

    def __iter__(self) -> Iterator[Done]:
        plan = self._work.plan
        for shard in plan.shards:
            if (done := self._work.read(f"{shard.name}.json")) is None:
                where = self._work.output.url
                raise plan.error("a file of a finished shard is damaged; begin again", path=where)
            yield done

    def __contains__(self, done: object) -> bool:
        return any(each == done for each in self)
