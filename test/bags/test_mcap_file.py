"""Files of McapFile, read by the libraries mcap and rosbags."""

from __future__ import annotations

from pathlib import Path

import pytest
from bag_support import PERIOD, TOPICS
from mcap.reader import SeekingReader
from rosbags.rosbag2 import Reader

from humansim_ros.data.bags.chunks import BagMessage, Compression
from humansim_ros.data.bags.topics import described
from humansim_ros.data.bags.writer import McapFile


def write(path: Path, compression: Compression = "none") -> list[BagMessage]:
    """Write two topics with five messages each, and return the messages."""
    messages = [
        BagMessage(topic, frame * PERIOD, bytes([0, 1, 0, 0, topic, frame]) * size, frame * PERIOD - 1)
        for frame in range(5)
        for topic, size in ((0, 200_000), (1, 5))
    ]
    with McapFile(path, [described(topic) for topic in TOPICS], compression) as file:
        file.write(messages[:3])
        file.write([message._replace(data=memoryview(message.data)) for message in messages[3:]])
    assert file.content.counts == {0: 5, 1: 5} and (file.content.start, file.content.end) == (0, 4 * PERIOD)
    return messages


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_libraries_read_the_same_messages_times_and_topics(tmp_path: Path, compression: Compression) -> None:
    messages = write(path := tmp_path / "a.mcap", compression)
    with path.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        read = [(each[1].topic, each[2]) for each in reader.iter_messages()]
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert [(topic, each.log_time, each.publish_time, each.data) for topic, each in read] == [
        (TOPICS[each.topic].name, each.stamp, max(0, each.published or 0), each.data) for each in messages
    ]
    assert {index.compression for index in summary.chunk_indexes} == {compression.replace("none", "")}
    with Reader(path) as bag:
        assert [(connection.topic, stamp, data) for connection, stamp, data in bag.messages()] == [
            (TOPICS[each.topic].name, each.stamp, each.data) for each in messages
        ]
        assert [each.topic for each in bag.connections] == [topic.name for topic in TOPICS]


def test_equal_messages_give_equal_bytes(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap")
    write(tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_after_an_error_whole_chunks_are_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with (
        pytest.raises(ValueError, match="full"),
        McapFile(path, [described(each) for each in TOPICS]) as file,
    ):
        file.write([BagMessage(0, PERIOD, bytes(1 << 20)), BagMessage(1, PERIOD, bytes(8))])
        assert file.size > 1 << 20
        raise ValueError("full")
    assert 1 << 20 < path.stat().st_size < (1 << 20) + 10_000
