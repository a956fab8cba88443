"""Files of McapFile and bags of BagWriter, read by rosbags and by the readers of mcap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from bag_support import PERIOD, TOPICS, by_mcap, by_rosbags, content_of, messages_of
from mcap.reader import SeekingReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader

from humansim_ros.data import encode_chunk
from humansim_ros.data.bags.topics import BagMessage, BagTopic, described
from humansim_ros.data.bags.writer import BagWriter, Compression, McapFile
from humansim_ros.errors import BagError


def write(folder: Path, frames: range, size: int = 500, **options: Any) -> None:
    with BagWriter(folder, TOPICS, **options) as writer:
        for frame in frames:
            writer.write(messages_of(frame, size))


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_all_readers_find_the_messages(compression: Compression, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(6), 500_000, compression=compression)
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(6), 500_000)
    with (folder / "bag_0.mcap").open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary is not None and len(summary.chunk_indexes) == 3
    assert {index.compression for index in summary.chunk_indexes} == {compression.replace("none", "")}


def test_metadata_is_that_of_jazzy(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(3), custom={"plan": "p"})
    information = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (information["version"], information["ros_distro"]) == (9, "jazzy")
    assert information["custom_data"] == {"plan": "p"} and information["message_count"] == 6
    for path in (folder, folder / "bag_0.mcap"):
        with Reader(path) as reader:
            image, pose = reader.connections
            assert [image.topic, pose.topic] == [topic.name for topic in TOPICS]
            assert image.ext.offered_qos_profiles[0].reliability == QosReliability.BEST_EFFORT
            assert pose.ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL
            assert "string frame_id" in image.msgdef.data
    with Reader(folder) as reader:
        assert reader.connections[0].digest == described(TOPICS[0]).type_hash != ""


def test_publish_times_are_kept(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", TOPICS) as writer:
        writer.write([BagMessage(0, 7, b"\0\1\0\0", time) for time in (5, None, -1)])
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        times = [(each.log_time, each.publish_time) for _, _, each in SeekingReader(file).iter_messages()]
    assert times == [(7, 5), (7, 7), (7, 0)]


def test_equal_messages_give_equal_bytes(tmp_path: Path) -> None:
    for name, kind in (("a", bytes), ("b", memoryview)):
        with McapFile(tmp_path / name, [described(topic) for topic in TOPICS], "zstd") as file:
            for frame in range(20):
                file.write([each._replace(data=kind(each.data)) for each in messages_of(frame)])
        assert file.content.counts == {0: 20, 1: 20} and file.content.start == 1
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_files_are_split_by_their_size(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(8), 600_000, max_size=1_000_000)
    assert len(list(folder.glob("bag_*.mcap"))) == 4
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(8), 600_000)


def test_files_are_split_by_their_duration(tmp_path: Path) -> None:
    """As rosbag2 does: a new file begins with the first message that is later than its start by more."""
    write(tmp_path / "bag", range(11), max_duration=4 * PERIOD / 1e9)
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    files = information["rosbag2_bagfile_information"]["files"]
    assert [each["duration"]["nanoseconds"] for each in files] == [4 * PERIOD, 4 * PERIOD, 0]
    assert by_rosbags(tmp_path / "bag") == content_of(range(11))


def test_topics_can_be_added_while_writing(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    with BagWriter(folder, TOPICS[:1], max_duration=PERIOD / 1e9) as writer:
        for frame in range(4):
            writer.write(messages_of(frame)[1:])
        index = writer.add_topic(TOPICS[1])
        for frame in range(4, 8):
            writer.write([each._replace(topic=index) for each in messages_of(frame)[:1]])
    assert by_rosbags(folder) == by_mcap(folder)
    assert [topic for topic, _, _ in by_rosbags(folder)] == [TOPICS[0].name] * 4 + [TOPICS[1].name] * 4


def test_an_empty_bag_is_read(tmp_path: Path) -> None:
    BagWriter(tmp_path / "bag", TOPICS).close()
    assert by_rosbags(tmp_path / "bag") == by_mcap(tmp_path / "bag") == []


def test_metadata_is_renewed_while_messages_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("humansim_ros.data.bags.writer._RENEWAL", 0.0)
    with BagWriter(tmp_path / "bag", TOPICS) as writer:
        for frame in range(3):
            writer.write(messages_of(frame))
            text = (tmp_path / "bag" / "metadata.yaml").read_text()
            assert yaml.safe_load(text)["rosbag2_bagfile_information"]["message_count"] == 2 * frame + 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_size": 1023}, "max_size: .* at least 1024 bytes"),
        ({"max_size": -1}, "max_size"),
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


def test_wrong_names_and_paths_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file"):
        with pytest.raises(BagError, match="exists"):
            BagWriter(path, TOPICS)
    with pytest.raises(BagError, match="absolute topic name"):
        BagWriter(tmp_path / "bag", [BagTopic("camera image", "sensor_msgs/msg/Image")])
    assert not (tmp_path / "bag").exists()
    with pytest.raises(BagError, match="cannot be written: "):
        BagWriter("/proc/bag", TOPICS)
    with pytest.raises(BagError, match="cannot be written: Not a directory"):
        BagWriter(tmp_path / "file" / "bag", TOPICS)


def test_sqlite3_bags_are_deprecated_and_read_by_rosbags(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    with pytest.warns(DeprecationWarning, match="ros2 bag convert"):
        write(folder, range(9), storage="sqlite3", max_duration=PERIOD / 1e9, custom={"plan": "p"})
    assert sorted(path.name for path in folder.iterdir()) == ["bag_0.db3", "metadata.yaml"]
    assert by_rosbags(folder) == content_of(range(9))
    with Reader(folder) as reader:
        image, pose = reader.connections
        assert image.ext.offered_qos_profiles[0].reliability == QosReliability.BEST_EFFORT
        assert pose.ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL


def test_chunks_of_the_caller_are_deprecated(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", TOPICS) as writer:
        for frame in range(3):
            with pytest.warns(DeprecationWarning, match=r"BagWriter\.write"):
                chunk = encode_chunk(messages_of(frame), "zstd")
            with pytest.warns(DeprecationWarning, match="use write"):
                writer.append(chunk)
    assert by_rosbags(tmp_path / "bag") == content_of(range(3))
