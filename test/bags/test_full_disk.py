"""A disk that becomes full: the bag ends with whole groups, one clear error, and it can be continued."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from itertools import count
from pathlib import Path

import pytest
from bag_support import TOPICS, append_frame, by_mcap, by_rosbags, content_of
from commands import largest_file
from mcap.reader import SeekingReader
from waiting import PATIENCE

from humansim_ros.data.bags.mcap_file import BLOCK, LARGE_CHUNK, DirectFile
from humansim_ros.data.bags.metadata import Storage
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import BagError

PROGRAM = Path(__file__).with_name("write_until_error.py")


OTHER_DISKS = (("mcap", 3000), ("mcap", 600_000), ("sqlite3", 3000), ("sqlite3", 1_100_000))


def fill(folder: Path, image: int, limit: int) -> tuple[str, int]:
    """Write frames until the limit; the error, and the number of frames that the bag holds."""
    with largest_file(limit), BagWriter(folder, TOPICS) as writer:
        for frame in count():
            try:
                append_frame(writer, frame, size=image)
            except BagError as error:
                return str(error), writer.groups
    raise AssertionError


@pytest.mark.parametrize("limit", [4_000_000, 1000 * BLOCK, 1000 * BLOCK + 100])
@pytest.mark.parametrize("refused", [False, True])
def test_a_full_disk_ends_a_bag_of_large_chunks(
    limit: int, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if refused:
        monkeypatch.setattr(DirectFile, "write", lambda *_: 0)
    folder, image = tmp_path / "bag", LARGE_CHUNK
    error, frames = fill(folder, image, limit)
    assert error.startswith(f"{folder}: cannot be written: ") and f"{frames} whole groups" in error
    assert frames == 3
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(frames), image)
    with BagWriter.resume(folder) as writer:
        append_frame(writer, frames, size=image)
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(frames + 1), image)


def summary_size(path: Path) -> int:
    with path.open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None
    end = max(index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes)
    return path.stat().st_size - end


@pytest.mark.daily("333333-60000")
@pytest.mark.parametrize("image", [10, 3000, 60_000])
@pytest.mark.parametrize("limit", [100_000, 100_100, 333_333])
def test_a_full_disk_ends_a_bag_with_a_whole_group(image: int, limit: int, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    error, frames = fill(folder, image, limit)
    assert error.startswith(f"{folder}: cannot be written: ") and f"{frames} whole groups" in error
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(frames), image)
    file = folder / "bag_0.mcap"
    # little was given away: 16 kB, or twice the space that was missing
    assert limit - file.stat().st_size < max(16384, 2 * summary_size(file)) + 2 * (image + 1200)


def test_a_bag_that_filled_the_disk_is_continued_to_the_same_bytes(tmp_path: Path) -> None:
    _, frames = fill(tmp_path / "bag", 3000, 200_000)
    with BagWriter.resume(tmp_path / "bag") as writer:
        assert writer.groups == frames > 10
        for frame in range(frames, 100):
            append_frame(writer, frame, size=3000)
    with BagWriter(tmp_path / "whole" / "bag", TOPICS) as writer:
        for frame in range(100):
            append_frame(writer, frame, size=3000)
    for name in ("metadata.yaml", "bag_0.mcap"):
        assert (tmp_path / "bag" / name).read_bytes() == (tmp_path / "whole" / "bag" / name).read_bytes()


def test_nothing_is_appended_after_the_end(tmp_path: Path) -> None:
    with largest_file(100_000), BagWriter(tmp_path / "bag", TOPICS) as writer:
        with pytest.raises(BagError):
            append_frame(writer, 0, size=200_000)
        with pytest.raises(BagError, match="closed"):
            append_frame(writer, 1)
    assert by_rosbags(tmp_path / "bag") == []


def may_mount() -> bool:
    """Whether this process may mount a file system of its own."""
    command = ["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]
    return bool(shutil.which("unshare")) and not subprocess.run(command, capture_output=True).returncode


@pytest.mark.slow
@pytest.mark.skipif(not may_mount(), reason="a file system of its own needs the right to mount (root)")
@pytest.mark.parametrize(
    ("storage", "image"),
    [
        ("mcap", 1_100_000),
        ("sqlite3", 600_000),
        *(pytest.param(*each, marks=pytest.mark.nightly) for each in OTHER_DISKS),
    ],
)
def test_a_real_full_disk(image: int, storage: Storage, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    script = f"""
mount -t tmpfs -o size=8m tmpfs {small}
{sys.executable} {PROGRAM} {small}/bag {image} {storage}
cp -r {small}/bag {tmp_path}/bag
"""
    done = subprocess.run(
        ["unshare", "-m", "sh", "-ec", script],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    assert "bag: cannot be written: " in done.stdout and "; the bag ends after" in done.stdout
    found = by_rosbags(tmp_path / "bag")
    frames = len(found) // 2
    assert f"after {frames} whole groups" in done.stdout and frames > 3
    assert found == content_of(range(frames), image)


@pytest.mark.skipif(not may_mount(), reason="a file system of its own needs the right to mount (root)")
def test_a_read_only_target(tmp_path: Path) -> None:
    script = f"mount -t tmpfs -o ro tmpfs {tmp_path} && {sys.executable} {PROGRAM} {tmp_path}/bag 100 mcap"
    done = subprocess.run(
        ["unshare", "-m", "sh", "-ec", script],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.stdout == f"{tmp_path}/bag: cannot be written: Read-only file system\n", done.stderr


def test_a_disk_without_space_for_the_start_leaves_nothing(tmp_path: Path) -> None:
    with largest_file(500), pytest.raises(BagError, match="cannot be written: "):
        BagWriter(tmp_path / "bag", TOPICS)
    assert list(tmp_path.iterdir()) == []


def test_a_target_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="cannot be written: "):
        BagWriter("/proc/bag", TOPICS)
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot be written: Not a directory"):
        BagWriter(tmp_path / "file" / "bag", TOPICS)
    with pytest.raises(BagError, match="exists"):
        BagWriter(tmp_path / "file", TOPICS)
