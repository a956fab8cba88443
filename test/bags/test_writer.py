"""Bags as BagWriter writes them, read by rosbags and by the readers of mcap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from bag_support import TOPICS, append_frame, by_mcap, by_rosbags, chunks_of, content_of
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader

from humansim_ros.bags.chunks import BagMessage, Compression, encode_chunk
from humansim_ros.bags.topics import BagTopic, described
from humansim_ros.bags.writer import BagWriter
from humansim_ros.errors import BagError


def write(folder: Path, frames: range, compression: Compression = "none", **options: Any) -> None:
    with BagWriter(folder, TOPICS, **options) as writer:
        for frame in frames:
            append_frame(writer, frame, compression)


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_all_readers_find_the_messages(compression: Compression, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(20), compression)
    assert by_rosbags(folder) == by_mcap(folder) == content_of(range(20))


def test_sqlite3_bags_are_read_by_rosbags(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    write(folder, range(160), storage="sqlite3", max_size=90_000)
    assert len(list(folder.glob("bag_*.db3"))) > 1
    assert by_rosbags(folder) == content_of(range(160))


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
