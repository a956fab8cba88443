"""Bags whose writing is interrupted: by kill -9, by signals, by errors."""

from __future__ import annotations

import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from unittest.mock import Mock

import pytest
from bag_support import TOPICS, append_frame, by_mcap, by_rosbags, content_of
from waiting import PATIENCE

from humansim_ros.data.bags.chunks import Compression
from humansim_ros.data.bags.mcap_file import DirectFile
from humansim_ros.data.bags.metadata import Storage
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import BagError, HumansimWarning

PROGRAM = Path(__file__).with_name("write_endlessly.py")
#: Sizes of images, and whether direct writing is refused.
LARGE_IMAGES = ((200_000, False), (1_500_000, False), (1_500_000, True))
#: Bytes of an image that take long enough to write that a random kill hits it.
LARGE = 2_000_000


class WritingProcess:
    """A process that appends frames to a bag."""

    def __init__(
        self,
        folder: Path,
        storage: Storage = "mcap",
        size: int = LARGE,
        max_size: int = 0,
        refused: bool = False,
    ) -> None:
        self.process = subprocess.Popen(
            [sys.executable, PROGRAM, folder, storage, str(size), str(max_size), str(refused)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )

    def wait_for_frame(self, frame: int) -> None:
        assert self.process.stdout is not None
        while int(self.process.stdout.readline()) < frame:
            pass

    def end(self, number: int = signal.SIGKILL) -> int:
        """Send a signal to the process, and return the last frame that it reported."""
        self.process.send_signal(number)
        lines = self.process.communicate(timeout=PATIENCE)[0].split()
        return int(lines[-1]) if lines else -1


def frames_in(found: list[tuple[str, int, bytes]], size: int) -> int:
    """Number of frames whose messages are all in a bag; the messages must be the first that were written."""
    number = sum(topic == TOPICS[0].name for topic, _, _ in found)
    rest = sorted(set(found) - set(content_of(range(number), size)))
    assert len(rest) in (0, 1) and len(found) == 2 * number + len(rest)
    assert set(rest) <= set(content_of([number], size))
    return number


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_killed_bag_is_read_and_finished(storage: Storage, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    writing = WritingProcess(folder, storage, size=200_000)
    writing.wait_for_frame(3)
    last = writing.end()
    with pytest.warns(HumansimWarning, match="was not finished"), BagReader(folder) as reader:
        found = sorted((reader.topics[m.topic].name, m.stamp, bytes(m.data)) for m in reader.messages())
    assert frames_in(found, 200_000) > last
    with BagWriter.resume(folder):
        pass
    assert 0 <= len(found) - len(by_rosbags(folder)) <= 1
    assert not list(folder.glob(".*")) and not list(folder.glob("*-journal"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "refused", "attempts"),
    [
        (200_000, False, 2),
        *(pytest.param(*each, 6, marks=pytest.mark.nightly) for each in LARGE_IMAGES),
    ],
)
def test_a_bag_is_continued_to_the_same_bytes_after_any_kill(
    size: int, refused: bool, attempts: int, tmp_path: Path
) -> None:
    dice = random.Random(2)
    folder, whole = tmp_path / "bag", tmp_path / "whole" / "bag"
    for _ in range(attempts):
        writing = WritingProcess(folder, size=size, max_size=10 * size, refused=refused)
        writing.wait_for_frame(dice.randrange(1, 40))
        time.sleep(dice.uniform(0, 0.02))  # the kill comes anywhere within the writing of a frame
        last = writing.end()
        with BagWriter.resume(folder, max_size=10 * size) as writer:
            assert last < writer.groups and writer.custom == {"plan": "p"}
            frames = max(60, writer.groups)  # more on a busy machine, where the kill is late
            for frame in range(writer.groups, frames):
                append_frame(writer, frame, size=size)
        with BagWriter(whole, TOPICS, max_size=10 * size, custom={"plan": "p"}) as writer:
            for frame in range(frames):
                append_frame(writer, frame, size=size)
        names = sorted(path.name for path in whole.iterdir())
        assert sorted(path.name for path in folder.iterdir()) == names
        for name in names:
            assert (folder / name).read_bytes() == (whole / name).read_bytes(), name
        shutil.rmtree(folder)
        shutil.rmtree(whole)


@pytest.mark.daily("zstd")
@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_bag_that_was_cut_is_continued_to_the_same_bytes(compression: Compression, tmp_path: Path) -> None:
    folder, frames = tmp_path / "bag", 30
    with BagWriter(folder, TOPICS, custom={"plan": "p"}) as writer:
        for frame in range(frames):
            append_frame(writer, frame, compression)
    path, dice = folder / "bag_0.mcap", random.Random(7)
    whole, metadata = path.read_bytes(), (folder / "metadata.yaml").read_text()
    for size in (0, 5, 20, 50, 300, 3000, *(dice.randrange(len(whole)) for _ in range(30))):
        path.write_bytes(whole[:size])
        with BagWriter.resume(folder) as writer:
            assert writer.groups <= frames and len(writer.topics) == 2
            for frame in range(writer.groups, frames):
                append_frame(writer, frame, compression)
        assert path.read_bytes() == whole
        assert (folder / "metadata.yaml").read_text() == metadata


@pytest.mark.nightly
def test_sqlite3_bags_are_continued_after_any_kill(tmp_path: Path) -> None:
    dice, size = random.Random(6), 200_000
    for attempt in range(6):
        folder = tmp_path / f"bag{attempt}"
        writing = WritingProcess(folder, "sqlite3", size=size, max_size=10 * size)
        writing.wait_for_frame(dice.randrange(1, 25))
        time.sleep(dice.uniform(0, 0.01))
        last = writing.end()
        with BagWriter.resume(folder, max_size=10 * size) as writer:
            assert last < writer.groups and writer.custom == {"plan": "p"}
            frames = writer.groups + 5
            for frame in range(writer.groups, frames):
                append_frame(writer, frame, size=size)
        assert by_rosbags(folder) == content_of(range(frames), size)
        assert not list(folder.glob("*-journal"))
        shutil.rmtree(folder)


def test_the_journal_of_a_full_sqlite3_file_goes_when_the_bag_is_continued(tmp_path: Path) -> None:
    """It is empty, because the process was killed between two groups; the next group is in the next file."""
    size, limit, killed = 200_000, 1 << 20, tmp_path / "killed"
    with BagWriter(tmp_path / "bag", TOPICS, storage="sqlite3", max_size=limit) as writer:
        while writer.size < limit:
            append_frame(writer, writer.groups, size=size)
        frames = writer.groups
        assert [path.name for path in writer.folder.glob("*-journal")] == ["bag_0.db3-journal"]
        shutil.copytree(writer.folder, killed)
    with BagWriter.resume(killed, max_size=limit) as writer:
        append_frame(writer, frames, size=size)
    assert sorted(path.name for path in killed.iterdir()) == ["bag_0.db3", "bag_1.db3", "metadata.yaml"]
    assert by_rosbags(killed) == content_of(range(frames + 1), size)


@pytest.mark.slow
def test_ctrl_c_leaves_a_bag_that_is_whole(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    writing = WritingProcess(folder)
    writing.wait_for_frame(2)
    last = writing.end(signal.SIGINT)
    found = by_rosbags(folder)
    assert found == by_mcap(folder)
    assert frames_in(found, LARGE) > max(last, 2)


def test_an_error_while_writing_leaves_a_bag_that_is_whole(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    with suppress(KeyboardInterrupt), BagWriter(folder, TOPICS) as writer:
        append_frame(writer, 0)
        raise KeyboardInterrupt
    assert by_rosbags(folder) == content_of([0])


def test_an_interrupted_write_does_not_reach_the_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C between the two halves of a chunk."""
    folder, real = tmp_path / "bag", os.writev
    interrupted = []

    def half(descriptor: int, buffers: list[memoryview]) -> int:
        if interrupted:
            raise KeyboardInterrupt
        interrupted.append(True)
        return real(descriptor, [buffers[0][:7]])

    with BagWriter(folder, TOPICS) as writer:
        append_frame(writer, 0)
        monkeypatch.setattr(os, "writev", half)
        with pytest.raises(KeyboardInterrupt):
            append_frame(writer, 1)
        monkeypatch.undo()
    assert by_rosbags(folder) == by_mcap(folder) == content_of([0])


def test_an_interrupted_direct_write_does_not_reach_the_bag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the middle of a large chunk."""
    folder = tmp_path / "bag"

    def half(file: DirectFile, buffers: list[memoryview], position: int) -> int:
        os.pwrite(writer._file._descriptor, buffers[0][:100], position)  # type: ignore[attr-defined]
        raise KeyboardInterrupt

    with BagWriter(folder, TOPICS) as writer:
        append_frame(writer, 0, size=LARGE)
        monkeypatch.setattr(DirectFile, "write", half)
        with pytest.raises(KeyboardInterrupt):
            append_frame(writer, 1, size=LARGE)
        monkeypatch.undo()
    assert by_rosbags(folder) == by_mcap(folder) == content_of([0], LARGE)


def test_readers_do_not_stop_the_writing_of_a_sqlite3_bag(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", TOPICS, storage="sqlite3") as writer:
        append_frame(writer, 0)
        reader = sqlite3.connect(tmp_path / "bag" / "bag_0.db3", timeout=0.0)
        with pytest.raises(sqlite3.OperationalError, match="locked"):
            reader.execute("SELECT COUNT(*) FROM messages").fetchall()
        append_frame(writer, 1)
    assert reader.execute("SELECT COUNT(*) FROM messages").fetchall() == [(4,)]
    reader.close()


def test_a_bag_whose_end_was_interrupted_is_finished_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while the summary is written."""
    folder = tmp_path / "bag"
    writer = BagWriter(folder, TOPICS)
    append_frame(writer, 0)
    monkeypatch.setattr("humansim_ros.data.bags.mcap_file.Statistics", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        writer.close()
    monkeypatch.undo()
    BagWriter.resume(folder).close()
    assert by_rosbags(folder) == by_mcap(folder) == content_of([0])


def test_a_moved_bag_is_continued(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", TOPICS, max_size=2000) as writer:
        append_frame(writer, 0)
    (tmp_path / "bag").rename(tmp_path / "moved")
    with BagWriter.resume(tmp_path / "moved", max_size=2000) as writer:
        for frame in range(1, 5):
            append_frame(writer, frame)
    assert (tmp_path / "moved" / "bag_1.mcap").exists()
    assert by_rosbags(tmp_path / "moved") == content_of(range(5))


def test_a_bag_that_is_being_written_is_not_continued(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", TOPICS), pytest.raises(BagError, match="another process"):
        BagWriter.resume(tmp_path / "bag")


def test_folders_without_a_bag_are_not_continued(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="no bag to continue"):
        BagWriter.resume(tmp_path / "gone")
    with pytest.raises(BagError, match="no bag to continue"):
        BagWriter.resume(tmp_path)


def test_a_bag_of_another_program_is_not_continued(tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = TOPICS[1]
        connection = writer.add_connection(topic.name, topic.type, msgdef="x", rihs01="y")
        writer.write(connection, 1, b"\0\1\0\0")
    (tmp_path / "bag" / "bag.mcap").rename(tmp_path / "bag" / "bag_0.mcap")
    before = (tmp_path / "bag" / "bag_0.mcap").read_bytes()
    with pytest.raises(BagError, match="not written by humansim"):
        BagWriter.resume(tmp_path / "bag")
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes() == before


def test_finishing_twice_changes_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    with BagWriter(folder, TOPICS, max_size=3000) as writer:
        for frame in range(10):
            append_frame(writer, frame)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    BagWriter.resume(folder).close()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
