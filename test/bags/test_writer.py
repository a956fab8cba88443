"""Bags as BagWriter writes them, read by rosbags and by the readers of mcap."""

from __future__ import annotations

import pickle
from dataclasses import replace
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any

import pytest
import yaml
from bag_support import PERIOD, TOPICS, append_frame, by_mcap, by_rosbags, chunks_of, content_of
from mcap.reader import SeekingReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader

from humansim_ros.data.bags.chunks import BagMessage, Compression, encode_chunk
from humansim_ros.data.bags.topics import BagTopic, described
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import BagError


def write(
    folder: Path, frames: range, compression: Compression = "none", size: int = 500, **options: Any
) -> None:
    with BagWriter(folder, TOPICS, **options) as writer:
        for frame in frames:
            append_frame(writer, frame, compression, size)


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_all_readers_find_the_messages(compression: Compression, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(20), compression)
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(20))


def test_sqlite3_bags_are_read_by_rosbags(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(160), storage="sqlite3", max_size=1 << 20, size=20_000)
    assert len(list(folder.glob("bag_*.db3"))) > 1
    assert by_rosbags(folder) == content_of(range(160), 20_000)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_metadata_is_that_of_jazzy(storage: str, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(3), storage=storage)
    information = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (information["version"], information["ros_distro"]) == (9, "jazzy")
    with Reader(folder) as reader:
        image, pose = reader.connections
        assert [image.topic, pose.topic] == [topic.name for topic in TOPICS]
        assert image.ext.offered_qos_profiles[0].reliability == QosReliability.BEST_EFFORT
        assert pose.ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL
        assert image.digest == described(TOPICS[0]).type_hash != ""


def test_split_files_hold_whole_groups(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(40), max_size=6000)
    files = sorted(path.name for path in folder.glob("*.mcap"))
    assert len(files) > 2 and files[0] == "bag_0.mcap"
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(40))


def test_an_existing_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="exists"):
        BagWriter(tmp_path, TOPICS)


def test_a_name_that_is_no_topic_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="absolute topic name"):
        BagWriter(tmp_path / "bag", [BagTopic("camera image", "sensor_msgs/msg/Image")])
    assert not (tmp_path / "bag").exists()


def test_topics_can_be_added_while_writing(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    with BagWriter(folder, TOPICS[:1]) as writer:
        writer.append(chunks_of(0)[1])
        index = writer.add_topic(TOPICS[1])
        writer.append(encode_chunk([BagMessage(index, 5, b"\0\1\0\0")]))
    assert by_rosbags(folder) == by_mcap(folder)


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_the_same_messages_give_the_same_bytes(compression: Compression, tmp_path: Path) -> None:
    for name in ("one", "two"):
        write(tmp_path / name / "bag", range(20), compression, max_size=4000)
    files = sorted(path.name for path in (tmp_path / "one" / "bag").iterdir())
    for name in files:
        contents = {(tmp_path / run / "bag" / name).read_bytes() for run in ("one", "two")}
        assert len(contents) == 1, name


def encode(frame: int, slot: memoryview) -> bytes:
    """As a worker does: the chunk goes to shared memory, and its description through a pipe."""
    chunk = chunks_of(frame, size=3000)[1]
    slot[: chunk.size] = chunk.data()
    return pickle.dumps(replace(chunk, buffers=()))


def test_chunks_come_through_shared_memory(tmp_path: Path) -> None:
    memory = SharedMemory(create=True, size=8192)
    try:
        with BagWriter(tmp_path / "bag", TOPICS) as writer:
            for frame in range(5):
                described = encode(frame, memory.buf)
                assert len(described) < 500
                chunk = pickle.loads(described)
                chunk = replace(chunk, buffers=(memory.buf[: chunk.size],))
                writer.append(chunk)
                assert writer.size > 0
                del chunk
                memory.buf[:] = bytes(len(memory.buf))
    finally:
        memory.close()
        memory.unlink()
    expected = [each for each in content_of(range(5), 3000) if each[0] == TOPICS[0].name]
    assert by_rosbags(tmp_path / "bag") == by_mcap(tmp_path / "bag") == expected


def test_publish_times_are_kept(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", TOPICS) as writer:
        published = (5, None, -1)
        writer.append(encode_chunk([BagMessage(0, 7, b"\0\1\0\0", time) for time in published]))
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        times = [(each.log_time, each.publish_time) for _, _, each in SeekingReader(file).iter_messages()]
    assert times == [(7, 5), (7, 7), (7, 0)]


def test_files_are_split_by_their_duration(tmp_path: Path) -> None:
    """As rosbag2 does: a new file begins with the first message that is later than its start by more."""
    write(tmp_path / "bag", range(11), max_duration=4 * PERIOD / 1e9)
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    files = information["rosbag2_bagfile_information"]["files"]
    assert [each["duration"]["nanoseconds"] for each in files] == [4 * PERIOD, 4 * PERIOD, 0]
    assert by_rosbags(tmp_path / "bag") == content_of(range(11))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_size": 1023}, "max_size: .* at least 1024 bytes"),
        ({"max_size": -1}, "max_size"),
        ({"max_size": 2000, "storage": "sqlite3"}, "max_size: .* at least 1048576 bytes"),
        ({"max_duration": -1.0}, "max_duration"),
        ({"max_duration": float("nan")}, "max_duration"),
        ({"storage": "sqlite"}, "'sqlite' is no storage of bags; choose one of mcap, sqlite3"),
        ({"storage": "sqlite3", "compression": "zstd"}, "choose the storage mcap"),
        ({"compression": "zip"}, "'zip' is no compression of chunks; choose one of none, zstd, lz4"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(BagError, match=message):
        BagWriter(tmp_path / "bag", TOPICS, **options)
    assert not (tmp_path / "bag").exists()


def test_metadata_is_renewed_while_chunks_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("humansim_ros.data.bags.writer._RENEWAL", 0.0)
    with BagWriter(tmp_path / "bag", TOPICS) as writer:
        for frame in range(3):
            append_frame(writer, frame)
            text = (tmp_path / "bag" / "metadata.yaml").read_text()
            assert yaml.safe_load(text)["rosbag2_bagfile_information"]["message_count"] == 2 * frame + 2


def test_an_empty_bag_is_read(tmp_path: Path) -> None:
    BagWriter(tmp_path / "bag", TOPICS).close()
    assert by_rosbags(tmp_path / "bag") == by_mcap(tmp_path / "bag") == []
