"""BagReader: whole bags, bags of other programs, bags that were cut anywhere or damaged."""

from __future__ import annotations

import random
import warnings
from pathlib import Path

import pytest
from bag_support import PERIOD, STORE, TOPICS, content_of, messages_of
from mcap.writer import MCAP0_MAGIC, CompressionType
from mcap.writer import Writer as McapLibraryWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from humansim_ros.data.bags.metadata import Storage
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.topics import described
from humansim_ros.data.bags.writer import BagWriter, Compression
from humansim_ros.errors import BagError, HumansimWarning

FRAMES = range(30)


def make_bag(
    folder: Path, storage: Storage = "mcap", compression: Compression = "none", max_duration: float = 0.0
) -> Path:
    """A bag of 30 frames with a chunk for each frame."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        writer = BagWriter(
            folder,
            TOPICS,
            storage=storage,
            compression=compression,
            max_duration=max_duration,
            custom={"plan": "p: [1]"},
        )
    with writer:
        for frame in FRAMES:
            writer.write(messages_of(frame))
            writer.flush()
    return folder


def by_reader(path: Path) -> list[tuple[str, int, bytes]]:
    """All messages, as of the other readers of bag_support; they come in the order of their times."""
    with BagReader(path) as reader:
        found = [(reader.topics[each.topic].name, each.stamp, bytes(each.data)) for each in reader.messages()]
        assert len(found) == reader.info.messages
    assert [stamp for _, stamp, _ in found] == sorted(stamp for _, stamp, _ in found)
    return sorted(found)


@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
def test_mcap_bags_are_read(compression: Compression, tmp_path: Path) -> None:
    folder = make_bag(tmp_path / "bag", compression=compression)
    assert by_reader(folder) == by_reader(folder / "bag_0.mcap") == content_of(FRAMES)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_topics_and_facts_of_a_bag(storage: Storage, tmp_path: Path) -> None:
    folder = make_bag(tmp_path / "bag", storage, max_duration=5 * PERIOD / 1e9)
    with BagReader(folder) as reader:
        assert reader.topics == tuple(described(topic) for topic in TOPICS)
        info = reader.info
    assert (info.storage, info.whole, info.custom) == (storage, True, {"plan": "p: [1]"})
    assert info.counts == {0: 30, 1: 30} and (info.start, info.end) == (1, 1 + 29 * PERIOD)
    assert info.size == sum(path.stat().st_size for path in info.files)
    assert by_reader(folder) == content_of(FRAMES)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_messages_of_a_time_and_of_topics(storage: Storage, tmp_path: Path) -> None:
    with BagReader(make_bag(tmp_path / "bag", storage)) as reader:
        found = list(reader.messages(["/human/pose"], start=1 + 5 * PERIOD, end=1 + 8 * PERIOD))
        assert [(each.topic, each.stamp) for each in found] == [(1, 1 + k * PERIOD) for k in (5, 6, 7)]
        with pytest.raises(BagError, match="did you mean '/human/pose'"):
            list(reader.messages(["/human/posee"]))


def in_temporal_disorder(path: Path, **options: object) -> None:
    """A file of mcap's own writer, with topics in chunks or without chunks, and frames in another order."""
    with path.open("wb") as file:
        writer = McapLibraryWriter(file, **options)  # type: ignore[arg-type]
        writer.start("ros2")
        channels = {}
        for index, topic in enumerate(TOPICS):
            definition = described(topic).definition.encode()
            schema = writer.register_schema(topic.type, "ros2msg", definition)
            channels[index] = writer.register_channel(topic.name, "cdr", schema)
        frames = list(FRAMES)
        random.Random(3).shuffle(frames)
        for frame in frames:
            for message in messages_of(frame):
                writer.add_message(channels[message.topic], message.stamp, bytes(message.data), message.stamp)
        writer.finish()


@pytest.mark.parametrize("chunking", [True, False])
@pytest.mark.parametrize("statistics", [True, False])
def test_mcap_files_of_others_are_read(chunking: bool, statistics: bool, tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    in_temporal_disorder(
        path,
        chunk_size=2000,
        compression=CompressionType.LZ4,
        use_chunking=chunking,
        use_statistics=statistics,
    )
    assert by_reader(path) == content_of(FRAMES)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bags_of_rosbags_are_read(plugin: StoragePlugin, tmp_path: Path) -> None:
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        connections = [writer.add_connection(each.name, each.type, typestore=STORE) for each in TOPICS]
        for frame in FRAMES:
            for message in messages_of(frame):
                writer.write(connections[message.topic], message.stamp, message.data)
    assert by_reader(tmp_path / "bag") == content_of(FRAMES)


def test_compressed_files_of_rosbag2_are_refused(tmp_path: Path) -> None:
    writer = RosbagsWriter(tmp_path / "bag", version=9)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        writer.add_connection(TOPICS[0].name, TOPICS[0].type, typestore=STORE)
    with pytest.raises(BagError, match="ros2 bag convert"):
        BagReader(tmp_path / "bag")


def test_what_is_no_bag_is_refused(tmp_path: Path) -> None:
    for name, text in (("a.mcap", "no bag"), ("a.db3", "no database, but long enough" * 9), ("a.txt", "")):
        (tmp_path / name).write_text(text)
        with pytest.raises(BagError, match=name):
            BagReader(tmp_path / name)
    (tmp_path / "empty").mkdir()
    for name in ("empty", "gone", "gone.mcap"):
        with pytest.raises(BagError, match=r"no such bag|no bag in this folder"):
            BagReader(tmp_path / name)
    (tmp_path / "empty" / "metadata.yaml").write_text("a: [")
    with pytest.raises(BagError, match="not valid YAML"):
        BagReader(tmp_path / "empty")


@pytest.mark.daily("True-zstd")
@pytest.mark.slow
@pytest.mark.parametrize("compression", ["none", "zstd", "lz4"])
@pytest.mark.parametrize("of_others", [False, True])
def test_a_bag_that_was_cut_gives_what_is_whole(
    compression: Compression, of_others: bool, tmp_path: Path
) -> None:
    path = tmp_path / "cut.mcap"
    if of_others:
        in_temporal_disorder(path, chunk_size=2000, compression=CompressionType[compression.upper()])
    else:
        path = make_bag(tmp_path / "cut", compression=compression) / "cut_0.mcap"
    whole, expected = path.read_bytes(), content_of(FRAMES)
    dice, most = random.Random(4), 0
    for size in sorted({*(dice.randrange(len(whole)) for _ in range(60)), *range(20)}):
        path.write_bytes(whole[:size])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HumansimWarning)
            if size < len(MCAP0_MAGIC):
                with pytest.raises(BagError, match=r"no MCAP file|is empty"):
                    BagReader(path)
                continue
            found = by_reader(path if of_others else path.parent)
        assert set(found) <= set(expected) and len(found) >= most
        most = len(found)
    assert most == len(expected)


def test_a_cut_bag_is_announced(tmp_path: Path) -> None:
    folder = make_bag(tmp_path / "bag", max_duration=5 * PERIOD / 1e9)
    last = sorted(folder.glob("*.mcap"))[-1]
    last.write_bytes(last.read_bytes()[:-50])
    with pytest.warns(HumansimWarning, match="was not finished, or was cut"):
        assert by_reader(folder) == content_of(FRAMES)
    last.unlink()
    with pytest.warns(HumansimWarning, match="is missing"):
        assert set(by_reader(folder)) < set(content_of(FRAMES))


@pytest.mark.daily("sqlite3")
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_damaged_bytes_give_no_invented_messages(storage: Storage, tmp_path: Path) -> None:
    folder = make_bag(tmp_path / "bag", storage)
    (path,) = (path for path in folder.iterdir() if path.suffix != ".yaml")
    whole, expected = path.read_bytes(), content_of(FRAMES)
    dice = random.Random(5)
    for _ in range(150):
        data = bytearray(whole)
        place = dice.randrange(len(data))
        data[place : place + dice.choice((1, 8, 300))] = b""
        path.write_bytes(data if dice.random() < 0.5 else data[:place] + b"\0" * 500 + data[place:])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HumansimWarning)
            try:
                with BagReader(folder) as reader:
                    found = [
                        (reader.topics[each.topic].name, each.stamp, bytes(each.data))
                        for each in reader.messages()
                    ]
            except BagError:
                continue
        if storage == "mcap":  # sqlite3 has no checksums
            assert set(found) <= set(expected)


def test_a_sqlite3_bag_that_was_cut_is_refused(tmp_path: Path) -> None:
    folder = make_bag(tmp_path / "bag", "sqlite3")
    path = folder / "bag_0.db3"
    whole = path.read_bytes()
    for size in range(0, len(whole), 9973):
        path.write_bytes(whole[:size])
        with pytest.raises(BagError, match=r"bag_0\.db3: (cannot be read|the bag file is empty)"):
            BagReader(folder)


def test_a_bag_is_read_while_it_is_written(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", TOPICS) as writer:
        for frame in range(3):
            writer.write(messages_of(frame))
            writer.flush()
            with pytest.warns(HumansimWarning, match="was not finished"):
                assert by_reader(tmp_path / "bag") == content_of(range(frame + 1))
