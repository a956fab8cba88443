"""What the engine works on: a plan, divided into shards, which workers write.

A :class:`WorkPlan` determines all bytes of a product, such as a bag or an export. A :class:`WorkShard` is the
unit of work, of failure and of ``--resume``. The shards follow from the plan alone, never from the number of
workers.
"""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol

from humansim_ros.data.engine.folder import OutputFolder
from humansim_ros.errors import HumansimError

#: Number of shards that a long plan is divided into, and the limits of the number of frames of a shard.
_SHARDS, LEAST, _MOST = 32, 5, 100
#: Most entries that an error about different lists names.
_MAX_LISTED = 6


@dataclass(frozen=True)
class WorkShard:
    """A part of a plan.

    Attributes:
        number: Number of the shard, from 0.
        items: Numbers of the items of the shard, such as frames.
    """

    number: int
    items: range

    @property
    def name(self) -> str:
        """Name of the files about the shard, without suffix."""
        return f"{self.number:06d}"

    def __str__(self) -> str:
        last = self.items[-1]
        return str(last) if len(self.items) == 1 else f"{self.items[0]} to {last}"


def shards_of(items: range, size: int | None = None) -> list[WorkShard]:
    """Divide consecutive items into shards.

    Args:
        items: Numbers of the items.
        size: Number of items of a shard. If None, a 32nd of all items, but at least 5 and at most 100.
    """
    if size is None:
        size = min(max(-(-len(items) // _SHARDS), LEAST), _MOST)
    return [
        WorkShard(number, items[first : first + size])
        for number, first in enumerate(range(0, len(items), size))
    ]


def count_items(shards: Iterable[WorkShard]) -> int:
    """Number of items of some shards."""
    return sum(len(shard.items) for shard in shards)


class Costs(dict[str, float]):
    """Seconds of processor time by step."""

    def add(self, step: str, start: float) -> float:
        """Add the processor time since ``start`` to a step. Returns the present processor time."""
        now = time.process_time()
        self[step] = self.get(step, 0.0) + now - start
        return now


@dataclass(frozen=True)
class Written:
    """What a worker returns for a shard.

    Attributes:
        rows: Data for :meth:`WorkPlan.finish`, as JSON values.
        failure: Why the shard has no files. Empty if the shard is written.
    """

    rows: Any = None
    failure: str = ""


@dataclass(frozen=True)
class Done:
    """A finished shard, as its file in the folder of the work states it.

    Attributes:
        number: Number of the shard.
        files: Size of each file in bytes, by path relative to the folder of the product.
        rows: See :class:`Written`.
        failure: See :class:`Written`.
        costs: Seconds of processor time by step.
    """

    number: int
    files: Mapping[str, int] = field(default_factory=dict)
    rows: Any = None
    failure: str = ""
    costs: Mapping[str, float] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Size of all files, bytes."""
        return sum(self.files.values())


class Worker(Protocol):
    """Writes shards, one after the other, in one process. A worker has one OpenGL context at most.

    Attributes:
        device: Device that renders. Empty if nothing is rendered.
        costs: Seconds of processor time by step, of the shards that were written so far.
    """

    device: str
    costs: Costs

    def write(self, shard: WorkShard, folder: Path, tick: Callable[[], None]) -> Written:
        """Write the files of a shard. Equal shards give equal files.

        Args:
            shard: The shard.
            folder: Empty folder on this machine. Its files become files of the product.
            tick: Function to call after each item. It raises an exception if the work has been cancelled.

        Raises:
            HumansimError: An item cannot be made, or a file cannot be written.
        """

    def close(self) -> None:
        """Free the renderer, and close open files."""


class WorkPlan(ABC):
    """Everything that determines the content of a product. A plan can be copied to another process.

    Attributes:
        what: What is made, such as ``recording``, for messages.
        items: What a shard consists of, such as ``frames``, for messages.
        saving: What to do if the disk is too small, for the end of a message.
        error: Class of the errors about the folder of the product.
        device: Device that renders. Empty if nothing is rendered.
    """

    what: ClassVar[str]
    items: ClassVar[str] = "frames"
    saving: ClassVar[str] = ""
    error: ClassVar[type[HumansimError]] = HumansimError
    device: str

    @property
    def views(self) -> int:
        """Number of images of an item. 0 if this is not known."""
        return 0

    @property
    @abstractmethod
    def key(self) -> Mapping[str, Any]:
        """JSON values that are equal for plans with the same product."""

    @property
    @abstractmethod
    def shards(self) -> Sequence[WorkShard]:
        """The shards, in order."""

    @abstractmethod
    def open(self) -> Worker:
        """Start a worker. Raises HumansimError if this machine cannot do the work."""

    @abstractmethod
    def finished(self, folder: OutputFolder) -> tuple[Mapping[str, Any], Collection[int]] | None:
        """Key and numbers of the shards of a finished product.

        Returns:
            None if the folder has no finished product.

        Raises:
            HumansimError: The folder has a product of another program or version.
        """

    @abstractmethod
    def finish(self, done: Collection[Done], folder: OutputFolder) -> None:
        """Write the files of the whole product, the index last. If this is interrupted, it is repeated.

        Args:
            done: All shards, in order. Each iteration reads them from the disk.
            folder: Folder of the product.

        Raises:
            HumansimError: A file cannot be written.
        """

    def failure(self, done: Collection[Done]) -> str:
        """Why the work is given up, or is incomplete at its end. Empty if it is neither.

        ``done``: the shards that are finished.
        """
        return ""


@dataclass
class WorkProgress:
    """State of the work on a plan.

    Attributes:
        first: Number of items that were done before this run.
        total: Number of items.
        done: Number of items that are done so far.
        kept: Number of items in finished shards. These survive an interruption.
        size: Bytes that this run has written.
        seconds: Wall-clock seconds of this run.
        costs: Seconds of processor time of all workers by step.
    """

    first: int
    total: int
    done: int
    kept: int
    size: int = 0
    seconds: float = 0.0
    costs: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, total: int, missing: int) -> WorkProgress:
        """WorkProgress at the start of a run with ``missing`` items left."""
        done = total - missing
        return cls(done, total, done, done)

    @property
    def new(self) -> int:
        """Number of items that this run has done."""
        return self.done - self.first

    @property
    def rate(self) -> float:
        """Items per second."""
        return self.new / self.seconds if self.seconds else 0.0


class RetryError(HumansimError):
    """A worker process has died, or a host did not answer. The same command with ``--resume`` may succeed."""

    exit_code = 3


class PartialError(HumansimError):
    """A disk is full. Finished shards stay, and ``--resume`` continues when there is space."""

    exit_code = 4


def key_text(plan: WorkPlan) -> str:
    """Text of the key of a plan. Equal keys have equal texts."""
    return json.dumps(plan.key, sort_keys=True)


def check_key(plan: WorkPlan, there: Mapping[str, Any], folder: str) -> None:
    """Check that a folder has the product of a plan.

    Args:
        plan: The plan.
        there: Key of the product in the folder.
        folder: Path or URL of the folder.

    Raises:
        HumansimError: ``plan.error``, which names the differences.
    """
    if text := differences(there, json.loads(key_text(plan))):
        raise plan.error(f"this folder has another {plan.what}: {text}", path=folder)


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """Describe in words how the key of a product in a folder differs from the wanted key. Empty if they are
    equal."""
    return "; ".join(
        _difference(name, there.get(name), here.get(name))
        for name in {**there, **here}
        if there.get(name) != here.get(name)
    )


def _difference(name: str, there: Any, here: Any) -> str:
    """Describe in words how a value of a key differs."""
    if name == "scene":
        return "the scene, a file of it, or the bag has changed"
    if name == "hash":
        return "the recipe has changed"
    word = name.replace("_", " ")
    if isinstance(there, list) and isinstance(here, list):
        parts = [
            f"{', '.join(map(str, only[:_MAX_LISTED]))}{', …' * (len(only) > _MAX_LISTED)} only {where}"
            for only, where in (
                ([each for each in there if each not in here], "there"),
                ([each for each in here if each not in there], "now"),
            )
            if only
        ]
        return f"{word}: {'; '.join(parts) or 'in another order'}"
    return f"{word}: {there} there, {here} now"
