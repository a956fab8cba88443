"""Shards cover a recording once, and merge to the bytes of a bag that one process has written."""

from __future__ import annotations

from pathlib import Path

import pytest
from recipes import CAMERAS, TOPICS, group

from humansim_ros.bags.writer import BagWriter
from humansim_ros.record.shards import Shard, ShardKind, merged_chunks, shards_of

pytest.importorskip("mcap")

FRAMES = 23


def write_shard(path: Path, shard: Shard) -> Path:
    from humansim_ros.bags.mcap_file import McapFile

    file = McapFile.create(path, TOPICS)
    for index in range(shard.first, shard.end):
        chunks = group(index, shard.cameras, shard.bodies)
        for chunk in chunks:
            file.append(chunk, index, chunk is chunks[-1])
    file.finish()
    return path


@pytest.mark.parametrize("kind", ["frames", "cameras", "scenes"])
def test_shards_cover_every_frame_of_every_camera_once(kind: ShardKind) -> None:
    shards = shards_of(kind, FRAMES, CAMERAS, 5)
    assert [shard.number for shard in shards] == list(range(len(shards)))
    covered = [(i, name) for s in shards for i in range(s.first, s.end) for name in s.cameras]
    assert sorted(covered) == [(i, name) for i in range(FRAMES) for name in CAMERAS]
    bodies = [i for shard in shards if shard.bodies for i in range(shard.first, shard.end)]
    assert bodies == list(range(FRAMES))


def test_a_recording_without_cameras_is_one_shard_of_cameras() -> None:
    assert shards_of("cameras", FRAMES, ()) == [Shard(0, 0, FRAMES, ())]


@pytest.mark.parametrize("kind", ["frames", "cameras", "scenes"])
@pytest.mark.parametrize("max_size", [0, 4000])
def test_merged_shards_are_the_bag_of_one_process(kind: ShardKind, max_size: int, tmp_path: Path) -> None:
    shards = shards_of(kind, FRAMES, CAMERAS, 5)
    paths = [write_shard(tmp_path / f"shard_{shard.number}.mcap", shard) for shard in shards]
    alone, merged = tmp_path / "alone" / "bag", tmp_path / "merged" / "bag"
    with BagWriter(alone, TOPICS, max_size=max_size, compression="zstd") as writer:
        for index in range(FRAMES):
            chunks = group(index)
            for chunk in chunks:
                writer.append(chunk, ends_group=chunk is chunks[-1])
    with BagWriter(merged, TOPICS, max_size=max_size, compression="zstd") as writer:
        for chunk, ends_group in merged_chunks(paths, kind == "cameras"):
            writer.append(chunk, ends_group=ends_group)
    files = {path.name: path.read_bytes() for path in alone.iterdir() if path.suffix in (".mcap", ".yaml")}
    assert (len(files) > 2) == bool(max_size)
    assert files == {p.name: p.read_bytes() for p in merged.iterdir() if p.suffix in (".mcap", ".yaml")}


def test_a_camera_with_less_frames_is_merged_at_their_places(tmp_path: Path) -> None:
    from humansim_ros.bags.mcap_file import McapFile

    paths = []
    for name, frames in {"left": (0, 1, 2), "right": (0,), "top": (0, 2)}.items():
        file = McapFile.create(tmp_path / f"{name}.mcap", TOPICS)
        for index in frames:
            (chunk,) = group(index, (name,), False)
            file.append(chunk, index, True)
        file.finish()
        paths.append(tmp_path / f"{name}.mcap")
    found = [(chunk.start // 100, tuple(chunk.counts), end) for chunk, end in merged_chunks(paths, True)]
    left, right, top = (1,), (2,), (3,)
    first = [(0, left, False), (0, right, False), (0, top, True)]
    assert found == [*first, (1, left, True), (2, left, False), (2, top, True)]
