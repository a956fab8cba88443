"""Shards of recordings: parts that different machines record, and how they become one bag.

Which shards there are depends on the recording alone, never on the number of machines. A shard is one MCAP
file, with the groups of chunks that the bag of the whole recording has. Shards of frames follow each other in
time; shards of cameras have the same times.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Literal, TypeAlias

from humansim_ros.bags.chunks import Chunk

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
    shards = map(_groups, paths)
    groups: Iterable[Iterable[Chunk]]
    if interleaved:
        groups = map(chain.from_iterable, zip(*shards, strict=True))
    else:
        groups = chain.from_iterable(shards)
    for chunks in groups:
        group = list(chunks)
        for position, chunk in enumerate(group, 1):
            yield chunk, position == len(group)


def _groups(path: Path) -> Iterator[list[Chunk]]:
    from humansim_ros.bags.mcap_reading import McapInput

    with closing(McapInput(path)) as shard:
        yield from shard.groups()
