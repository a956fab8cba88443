"""Shards of recordings: parts that different machines record, and how they become one bag.

Which shards there are depends on the recording alone, never on the number of machines. A shard is one MCAP
file, with the groups of chunks that the bag of the whole recording has. Shards of frames follow each other in
time; shards of cameras have the same times.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import Literal, TypeAlias

from humansim_ros.bags.chunks import Chunk
from humansim_ros.errors import BagError
from humansim_ros.io.files import ANY_SIZE, open_file

#: Division of a recording; ``scenes`` divides none.
ShardKind: TypeAlias = Literal["frames", "cameras", "scenes"]
#: Frames of a shard: with four cameras some seconds of work for one core, and 1 GB of raw images.
SHARD_FRAMES = 100


@dataclass(frozen=True)
class Shard:
    """A part of a recording.

    Attributes:
        number: Number among the shards of the recording.
        first: First frame.
        end: Frame after the last one.
        cameras: Names of the cameras.
        bodies: It has the topics that belong to no camera.
    """

    number: int
    first: int
    end: int
    cameras: tuple[str, ...]
    bodies: bool = True

    @property
    def size(self) -> int:
        """Number of camera-frames; of frames if there is no camera."""
        return (self.end - self.first) * max(1, len(self.cameras))


def shards_of(
    kind: ShardKind, frames: int, cameras: Sequence[str], shard_frames: int = SHARD_FRAMES
) -> list[Shard]:
    """Divide a recording.

    Args:
        kind: ``frames``: ranges of frames with all cameras; ``cameras``: single cameras with all frames, the
            first one with the topics that belong to no camera; ``scenes``: nothing is divided.
        frames: Number of frames.
        cameras: Names of the cameras.
        shard_frames: Frames of a shard of frames; the last one may have less.
    """
    if kind == "frames":
        ranges = [(first, min(first + shard_frames, frames)) for first in range(0, frames, shard_frames)]
        return [Shard(i, first, end, tuple(cameras)) for i, (first, end) in enumerate(ranges)]
    if kind == "cameras" and cameras:
        return [Shard(i, 0, frames, (name,), i == 0) for i, name in enumerate(cameras)]
    return [Shard(0, 0, frames, tuple(cameras))]


def merged_chunks(paths: Sequence[Path], interleaved: bool) -> Iterator[tuple[Chunk, bool]]:
    """Chunks of the bag of a whole recording, and whether each ends its group.

    Args:
        paths: Files of all shards in their order.
        interleaved: They are shards of cameras.

    Raises:
        BagError: A file is damaged.
    """
    shards = [_chunks(path) for path in paths]
    # frames are not equally many in all shards: one of a camera may have only legends, in frame 0
    chunks = heapq.merge(*shards, key=itemgetter(0)) if interleaved else chain.from_iterable(shards)
    for _, group in groupby(chunks, key=itemgetter(0)):
        of_frame = [chunk for _, chunk in group]
        for position, chunk in enumerate(of_frame, 1):
            yield chunk, position == len(of_frame)


def _chunks(path: Path) -> Iterator[tuple[int, Chunk]]:
    """Number of the frame, and chunk."""
    from humansim_ros.bags.mcap_file import McapScan

    with open_file(path, BagError, "bag", ANY_SIZE) as file:
        for unit in McapScan(file, path).own_units():
            file.seek(unit.start)
            yield unit.group, unit.chunk.with_data(file.read(unit.chunk.size))
