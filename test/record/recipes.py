"""A recipe for shards that needs no scene and no OpenGL; what happens in its workers is said by files."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from humansim_ros.bags.chunks import BagMessage, Chunk, encode_chunk
from humansim_ros.bags.topics import BagTopic
from humansim_ros.record.shards import Shard

CAMERAS = ("left", "right", "top")
TOPICS = [BagTopic("/joints", "std_msgs/msg/Header")]
TOPICS += [BagTopic(f"/{name}/image", "sensor_msgs/msg/Image") for name in CAMERAS]


def group(index: int, cameras: Sequence[str] = CAMERAS, bodies: bool = True) -> list[Chunk]:
    """A chunk of the bodies and one for each camera."""
    numbers = [0] * bodies + [1 + CAMERAS.index(name) for name in cameras]
    data = [bytes([0, 1, 0, 0, number, index]) * (50 + 7 * number) for number in numbers]
    return [
        encode_chunk([BagMessage(number, 1 + index * 100, each)], "zstd")
        for number, each in zip(numbers, data, strict=True)
    ]


@dataclass(frozen=True)
class Numbers:
    """Numbers as messages.

    Each shard leaves a file with the number of its process in ``folder``. Half-way it looks for files there:
    ``kill_<shard>`` kills its worker once, ``full_<shard>`` is a full disk once, ``broken_<shard>`` an error
    for ever.
    """

    folder: Path
    seed: int = 1

    @property
    def topics(self) -> Sequence[BagTopic]:
        return TOPICS

    @property
    def custom(self) -> Mapping[str, str]:
        return {"numbers": str(self.seed)}

    def groups(self, shard: Shard) -> Iterator[Sequence[Chunk]]:
        with (self.folder / f"pids_{shard.number}").open("a") as file:
            print(os.getpid(), file=file)
        for index in range(shard.first, shard.end):
            if index == (shard.first + shard.end) // 2:
                self._suffer(shard.number)
            yield group(index, shard.cameras, shard.bodies)

    def _suffer(self, number: int) -> None:
        if (mark := self.folder / f"kill_{number}").exists():
            mark.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        if (mark := self.folder / f"full_{number}").exists():
            mark.unlink()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if (self.folder / f"broken_{number}").exists():
            raise ZeroDivisionError("no such number")
