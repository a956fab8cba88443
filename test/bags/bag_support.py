"""Bags of the tests: small messages of two topics, and what independent readers find in a bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import NonSeekingReader, SeekingReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from humansim_ros.data.bags.topics import BagMessage, BagTopic, Qos

STORE = get_typestore(Stores.ROS2_JAZZY)
TOPICS = (
    BagTopic("/camera/image", "sensor_msgs/msg/CompressedImage", (Qos(reliable=False, depth=3),)),
    BagTopic("/human/pose", "geometry_msgs/msg/PoseStamped", (Qos(transient_local=True, depth=1),)),
)
PERIOD = 40_000_000


def header(stamp: int) -> Any:
    time = STORE.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return STORE.types["std_msgs/msg/Header"](time, "map")


def messages_of(frame: int, size: int = 500) -> list[BagMessage]:
    """Messages of a frame: a pose, and an image of ``size`` bytes that depend on the frame. They were
    published 1 ns before they were logged."""
    stamp = 1 + frame * PERIOD
    image = STORE.types["sensor_msgs/msg/CompressedImage"](
        header(stamp), "jpeg", np.resize(np.random.default_rng(frame).integers(0, 8, 997, np.uint8), size)
    )
    point = STORE.types["geometry_msgs/msg/Point"](float(frame), 2.0, 3.0)
    turn = STORE.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose = STORE.types["geometry_msgs/msg/Pose"](point, turn)
    stamped = STORE.types["geometry_msgs/msg/PoseStamped"](header(stamp), pose)
    return [
        BagMessage(1, stamp, STORE.serialize_cdr(stamped, TOPICS[1].type), stamp - 1),
        BagMessage(0, stamp, STORE.serialize_cdr(image, TOPICS[0].type), stamp - 1),
    ]


def content_of(frames: Sequence[int], size: int = 500) -> list[tuple[str, int, bytes]]:
    """Topic, stamp and bytes of all messages of frames, in the order of stamp and topic."""
    return sorted(
        (TOPICS[message.topic].name, message.stamp, bytes(message.data))
        for frame in frames
        for message in messages_of(frame, size)
    )


def by_rosbags(folder: Path) -> list[tuple[str, int, bytes]]:
    with Reader(folder) as reader:
        found = [(connection.topic, stamp, bytes(data)) for connection, stamp, data in reader.messages()]
        assert len(found) == reader.message_count
    return sorted(found)


def by_mcap(folder: Path) -> list[tuple[str, int, bytes]]:
    """By mcap's reader with the index and by the one for streams, which check all checksums."""
    found: list[tuple[str, int, bytes]] = []
    for path in sorted(folder.glob("*.mcap")):
        contents = []
        for kind in (SeekingReader, NonSeekingReader):
            with path.open("rb") as file:
                contents.append(
                    [
                        (channel.topic, message.log_time, message.data)
                        for _, channel, message in kind(file, validate_crcs=True).iter_messages()
                    ]
                )
        assert contents[0] == contents[1]
        found += contents[0]
    return sorted(found)
