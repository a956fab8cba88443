"""A plan that needs no scene and no OpenGL: each item is a small file, and marks make workers fail."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from humansim_ros.data.engine import Costs, Done, OutputFolder, WorkPlan, WorkShard, Written, shards_of
from humansim_ros.errors import BagError, HumansimError


@dataclass(frozen=True)
class Numbers(WorkPlan):
    """Files of numbers.

    Each item leaves a file with the number of its process in ``marks``. Before an item is made, files there
    make it fail: ``kill_<item>`` kills the worker once, ``kills_<item>`` each time, ``full_<item>`` is a full
    disk once, ``wrong_<item>`` an error of the item, and ``broken_<item>`` a fault of the program.
    """

    marks: Path
    count: int = 12
    seed: int = 1
    size: int = 4
    device: str = ""
    what = "table"
    items = "numbers"
    error = BagError

    @property
    def key(self) -> Mapping[str, Any]:
        return {"count": self.count, "seed": self.seed, "size": self.size, "device": self.device}

    @property
    def shards(self) -> Sequence[WorkShard]:
        return shards_of(range(self.count), self.size)

    def open(self) -> NumbersWorker:
        with (self.marks / "workers").open("a") as file:
            print(os.getpid(), file=file)
        return NumbersWorker(self)

    def finished(self, folder: OutputFolder) -> tuple[Mapping[str, Any], Collection[int]] | None:
        if folder.size("index") is None:
            return None
        return self.key, [shard.number for shard in self.shards]

    def finish(self, done: Collection[Done], folder: OutputFolder) -> None:
        folder.write("index", f"{sum(each.rows for each in done)}\n")


class NumbersWorker:
    """Writes the files of :class:`Numbers`."""

    def __init__(self, plan: Numbers) -> None:
        self._plan = plan
        self.device = "Numbers device"
        self.costs = Costs()

    def write(self, shard: WorkShard, folder: Path, tick: Callable[[], None]) -> Written:
        marks = self._plan.marks
        for index in shard.items:
            with (marks / f"pids_{index:02}").open("a") as file:
                print(os.getpid(), file=file)
            if (mark := marks / f"kill_{index}").exists():
                mark.unlink()
                os.kill(os.getpid(), signal.SIGKILL)
            if (marks / f"kills_{index}").exists():
                os.kill(os.getpid(), signal.SIGKILL)
            if (mark := marks / f"full_{index}").exists():
                mark.unlink()
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if (marks / f"wrong_{index}").exists():
                raise HumansimError(f"number {index} is wrong")
            if (marks / f"broken_{index}").exists():
                raise ZeroDivisionError("no such number")
            place = folder / f"tens_{index // 10}"
            place.mkdir(exist_ok=True)
            (place / f"{index:02}").write_text(f"{index * self._plan.seed}\n")
            tick()
        return Written(sum(shard.items))

    def close(self) -> None:
        pass
