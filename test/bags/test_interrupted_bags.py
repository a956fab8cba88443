"""Bags whose writing ends early: by kill -9, by errors, by a full disk. They are readable, and continued."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from bag_support import TOPICS, by_mcap, by_rosbags, content_of, messages_of
from commands import largest_file
from waiting import PATIENCE

from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import BagError, HumansimWarning

PROGRAM = Path(__file__).with_name("write_endlessly.py")
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


def by_reader(folder: Path) -> list[tuple[str, int, bytes]]:
    with BagReader(folder) as reader:
        return sorted((reader.topics[m.topic].name, m.stamp, bytes(m.data)) for m in reader.messages())


def killed(folder: Path, lines: int, delay: float, options: Sequence[object]) -> list[int]:
    """Kill a process that writes frames. Returns the frames that it has reported."""
    command = [sys.executable, str(PROGRAM), str(folder), *map(str, options)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT) as process:
        assert process.stdout is not None
        reported = [process.stdout.readline() for _ in range(lines)]
        time.sleep(delay)
        process.kill()
        return [int(line) for line in (*reported, *process.stdout)]


@pytest.mark.slow
@pytest.mark.parametrize("size", [500, 400_000])
def test_a_killed_writer_loses_nothing_that_it_has_flushed(size: int, tmp_path: Path) -> None:
    folder, dice = tmp_path / "bag", random.Random(size)
    first = killed(folder, 5, dice.random() / 10, (size, 2_000_000, False))
    with pytest.warns(HumansimWarning, match="was not finished"):
        found = by_reader(folder)
    assert len(found) - len(content_of(first, size)) in (0, 1, 2)  # of the frame when it was killed
    second = killed(folder, 5, dice.random() / 10, (size, 2_000_000, True))
    with BagWriter.resume(folder) as writer:
        assert [topic.name for topic in writer.topics] == [topic.name for topic in TOPICS]
        assert writer.custom == {"plan": "p"}
        writer.write(messages_of(second[-1] + 2, size))
    found = by_rosbags(folder)
    assert found == by_mcap(folder) == by_reader(folder)
    expected = content_of([*first, *second, second[-1] + 2], size)
    assert set(expected) <= set(found) and len(found) - len(expected) <= 4


def test_a_finished_bag_is_continued_in_a_new_file(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    with BagWriter(folder, TOPICS) as writer:
        writer.write(messages_of(0))
    with BagWriter.resume(folder) as writer:
        assert writer.end == messages_of(0)[0].stamp
        writer.write(messages_of(1))
    assert sorted(path.name for path in folder.glob("*.mcap")) == ["bag_0.mcap", "bag_1.mcap"]
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(2))


def test_what_is_no_bag_is_not_continued(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="No such file"):
        BagWriter.resume(tmp_path / "bag")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(BagError, match="no MCAP bag to continue"):
        BagWriter.resume(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_writer_that_was_killed_at_its_start_is_continued(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "bag_0.mcap").write_bytes(b"")
    with BagWriter.resume(tmp_path / "bag") as writer:
        for topic in TOPICS:
            writer.add_topic(topic)
        writer.write(messages_of(0))
    assert by_rosbags(tmp_path / "bag") == content_of([0])


def test_one_process_writes_a_bag(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", TOPICS), pytest.raises(BagError, match="another process is writing"):
        BagWriter.resume(tmp_path / "bag")


def test_an_error_of_the_caller_leaves_a_finished_bag(tmp_path: Path) -> None:
    def fail() -> None:
        with BagWriter(tmp_path / "bag", TOPICS) as writer:
            writer.write(messages_of(0))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert by_rosbags(tmp_path / "bag") == by_mcap(tmp_path / "bag") == content_of([0])


@pytest.mark.parametrize("size", [10, 3000, 60_000])
@pytest.mark.parametrize("limit", [100_000, 333_333])
def test_a_full_disk_leaves_a_readable_bag_that_can_be_continued(
    size: int, limit: int, tmp_path: Path
) -> None:
    folder, frames = tmp_path / "bag", 0
    with largest_file(limit), BagWriter(folder, TOPICS) as writer:
        error = ""
        while not error:
            try:
                writer.write(messages_of(frames, size))
                writer.flush()
                frames += 1
            except BagError as reason:
                error = str(reason)
        with pytest.raises(BagError, match="closed"):
            writer.write(messages_of(0))
    assert "cannot be written: File too large; its messages are readable" in error
    with pytest.warns(HumansimWarning, match="was not finished"):
        found = by_reader(folder)
    assert content_of(range(frames), size) == found != []
    with BagWriter.resume(folder) as writer:
        writer.write(messages_of(frames, size))
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(frames + 1), size)


def may_mount() -> bool:
    """Whether this process may mount a file system of its own."""
    command = ["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]
    return bool(shutil.which("unshare")) and not subprocess.run(command, capture_output=True).returncode


def on_another_disk(script: str) -> str:
    """Output of shell commands that may mount."""
    done = subprocess.run(
        ["unshare", "-m", "sh", "-ec", script],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.skipif(not may_mount(), reason="a file system of its own needs the right to mount (root)")
def test_a_real_full_disk(tmp_path: Path) -> None:
    (tmp_path / "small").mkdir()
    output = on_another_disk(
        f"mount -t tmpfs -o size=8m tmpfs {tmp_path}/small\n"
        f"{sys.executable} {PROGRAM} {tmp_path}/small/bag 600000 0 False\n"
        f"cp -r {tmp_path}/small/bag {tmp_path}/bag"
    )
    *frames, error = output.splitlines()
    assert "bag: cannot be written: No space left on device; its messages are readable" in error
    with pytest.warns(HumansimWarning, match="was not finished"):
        assert by_reader(tmp_path / "bag") == content_of(range(len(frames)), 600_000) != []


@pytest.mark.skipif(not may_mount(), reason="a file system of its own needs the right to mount (root)")
def test_a_read_only_target(tmp_path: Path) -> None:
    script = f"mount -t tmpfs -o ro tmpfs {tmp_path} && {sys.executable} {PROGRAM} {tmp_path}/bag 100 0 False"
    assert on_another_disk(script) == f"{tmp_path}/bag: cannot be written: Read-only file system\n"


def test_a_disk_without_space_for_the_start_leaves_nothing(tmp_path: Path) -> None:
    with largest_file(10), pytest.raises(BagError, match="cannot be written: "):
        BagWriter(tmp_path / "bag", TOPICS)
    assert list(tmp_path.iterdir()) == []
