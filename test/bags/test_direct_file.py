"""Large chunks are written directly, and the bytes of a file do not depend on whether the disk allows it."""

from __future__ import annotations

import errno
import mmap
import os
import random
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from bag_support import TOPICS, append_frame, by_mcap, by_rosbags, chunks_of, content_of
from mcap.reader import SeekingReader

from humansim_ros.data.bags.mcap_file import BLOCK, LARGE_CHUNK, RECORD, DirectFile, padding
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import BagError

#: Sizes of the images of successive frames: small and large chunks in turn.
SIZES = (LARGE_CHUNK + 1, 2 * LARGE_CHUNK, 500, LARGE_CHUNK - 2000, LARGE_CHUNK + 5000, 700, LARGE_CHUNK + 9)


def write(folder: Path, sizes: Sequence[int] = SIZES) -> bytes:
    """Write a frame of each size; the bytes of the file."""
    with BagWriter(folder, TOPICS) as writer:
        for frame, size in enumerate(sizes):
            append_frame(writer, frame, size=size)
    return (folder / "bag_0.mcap").read_bytes()


def content() -> list[tuple[str, int, bytes]]:
    return sorted(message for frame, size in enumerate(SIZES) for message in content_of([frame], size))


def refuse(monkeypatch: pytest.MonkeyPatch, error: int = errno.EINVAL) -> None:
    """Let the system refuse to write directly."""

    def pwritev(*_: Any) -> int:
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(os, "pwritev", pwritev)


def allows_direct_writing(folder: Path) -> bool:
    descriptor = os.open(folder / "probe", os.O_RDWR | os.O_CREAT)
    try:
        return DirectFile(descriptor).write([memoryview(bytes(BLOCK))], 0) == BLOCK
    finally:
        os.close(descriptor)


def test_large_chunks_begin_at_whole_blocks(tmp_path: Path) -> None:
    write(tmp_path / "bag")
    assert by_rosbags(tmp_path / "bag") == by_mcap(tmp_path / "bag") == content()
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None
    lengths = {index.chunk_start_offset: index.chunk_length for index in summary.chunk_indexes}
    large = [start % BLOCK for start, length in lengths.items() if length >= LARGE_CHUNK]
    assert large == [0] * 4


def test_large_chunks_are_written_directly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not allows_direct_writing(tmp_path):
        pytest.skip("this file system refuses direct writing")
    written: list[int] = []
    pwritev = os.pwritev

    def counted(descriptor: int, buffers: Sequence[memoryview], position: int) -> int:
        written.append(pwritev(descriptor, buffers, position))
        return written[-1]

    monkeypatch.setattr(os, "pwritev", counted)
    write(tmp_path / "bag")
    assert len(written) == 4 and min(written) > LARGE_CHUNK


@pytest.mark.parametrize("error", [errno.EINVAL, errno.EOPNOTSUPP, None])
def test_a_disk_that_refuses_or_a_file_that_cannot_be_opened_again_gets_the_same_bytes(
    error: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = write(tmp_path / "direct" / "bag")
    if error is None:
        monkeypatch.setattr(os, "O_DIRECT", os.O_DIRECTORY)  # no file opens with it
    else:
        refuse(monkeypatch, error)
    assert write(tmp_path / "refused" / "bag") == expected


@pytest.mark.parametrize("most", [0, 100, BLOCK, 10_000, LARGE_CHUNK])
def test_short_writes_are_completed(most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = write(tmp_path / "whole" / "bag")

    def pwritev(descriptor: int, buffers: Sequence[memoryview], position: int) -> int:
        return os.pwrite(descriptor_of["plain"], b"".join(buffers)[:most], position)

    descriptor_of = {}
    monkeypatch.setattr(os, "pwritev", pwritev)
    with BagWriter(tmp_path / "short" / "bag", TOPICS) as writer:
        descriptor_of["plain"] = writer._file._descriptor  # type: ignore[attr-defined]
        for frame, size in enumerate(SIZES):
            append_frame(writer, frame, size=size)
    assert (tmp_path / "short" / "bag" / "bag_0.mcap").read_bytes() == expected


def test_chunks_in_aligned_memory_give_the_same_bytes(tmp_path: Path) -> None:
    expected = write(tmp_path / "parts" / "bag")
    with BagWriter(tmp_path / "slots" / "bag", TOPICS) as writer:
        for frame, size in enumerate(SIZES):
            for number, chunk in enumerate(chunks_of(frame, size=size)):
                memory = mmap.mmap(-1, chunk.size)
                memory[:] = chunk.data()
                whole = replace(chunk, buffers=(memoryview(memory),))
                writer.append(whole, ends_group=number == 1)
    assert (tmp_path / "slots" / "bag" / "bag_0.mcap").read_bytes() == expected


@pytest.mark.daily("True")
@pytest.mark.parametrize("refused", [False, True])
def test_a_bag_that_was_cut_anywhere_is_continued_to_the_same_bytes(
    refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = tmp_path / "whole" / "bag"
    expected = write(whole)
    with (whole / "bag_0.mcap").open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None
    starts = [index.chunk_start_offset for index in summary.chunk_indexes]
    # in the space before a chunk, at both of its ends, in the chunk
    cuts = [start + step for start in starts for step in (-2000, -5, -1, 0, 1, 5000)]
    if refused:
        refuse(monkeypatch)
    for cut in random.Random(1).sample(cuts, 30):
        folder = tmp_path / "cut" / "bag"
        shutil.copytree(whole, folder)
        os.truncate(folder / "bag_0.mcap", cut)
        with BagWriter.resume(folder) as writer:
            for frame in range(writer.groups, len(SIZES)):
                append_frame(writer, frame, size=SIZES[frame])
        assert (folder / "bag_0.mcap").read_bytes() == expected, cut
        shutil.rmtree(folder)


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO])
def test_an_error_of_direct_writing_ends_the_bag(
    error: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with BagWriter(tmp_path / "bag", TOPICS) as writer:
        append_frame(writer, 0, size=LARGE_CHUNK)
        refuse(monkeypatch, error)
        with pytest.raises(BagError, match=r"cannot be written: .* after 1 whole groups"):
            append_frame(writer, 1, size=LARGE_CHUNK)
    assert by_rosbags(tmp_path / "bag") == content_of([0], LARGE_CHUNK)


def test_padding_fills_any_space() -> None:
    for position in range(1, 100):
        record = padding(position, 32)
        assert (position + len(record)) % 32 == 0
        assert not record or RECORD.unpack_from(record)[1] == len(record) - RECORD.size
