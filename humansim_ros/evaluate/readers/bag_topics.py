"""Poses on the topics of a bag."""

from __future__ import annotations

import os
import re
from typing import Any

from humansim_ros.bags.reader import BagReader
from humansim_ros.bags.topics import BagTopic, message_types
from humansim_ros.errors import EvaluationError, did_you_mean, printable, warn_about
from humansim_ros.evaluate.readers.options import ReadOptions
from humansim_ros.evaluate.stream import EstimateStream
from humansim_ros.messages.people import MESSAGE_TYPES, PoseFrame, read_people

#: Stamp and log time that differ by more, nanoseconds, are of different clocks.
_SAME_CLOCK = 3600 * 10**9
#: Frame of all positions.
_WORLD = "map"


def topic_pattern(topic: str) -> re.Pattern[str]:
    """Pattern of topics in which each ``*`` stands for a part without ``/``, as a group."""
    return re.compile("([^/]+)".join(re.escape(part) for part in topic.split("*")))


def topic_person(match: re.Match[str]) -> str | None:
    """Name of the person that a topic has in place of ``*``; None without ``*``."""
    return "/".join(match.groups()) or None


def read_bag_topic(path: str | os.PathLike[str], topic: str, options: ReadOptions) -> EstimateStream:
    """Read the people on a topic.

    ``*`` in the name of the topic stands for the name of a person, or any other part without ``/``. Several
    messages with one stamp on one topic are several people without names. Latencies are those from stamp to
    log time; unknown if the bag was recorded with a time that stands while a frame is computed.

    Raises:
        EvaluationError: No topic matches, its type holds no poses, or its messages cannot be read.
        BagError: The bag cannot be read.
    """
    pattern = topic_pattern(topic)
    source = f"{os.fspath(path)}:{topic}"
    with BagReader(path) as reader:
        people = {
            index: topic_person(match)
            for index, each in enumerate(reader.topics)
            if (match := pattern.fullmatch(each.name))
        }
        names = [each.name for each in reader.topics]
        if not people:
            listed = did_you_mean(topic, names) or f"; it has {_poses_of(reader.topics)}"
            raise EvaluationError(f"the bag has no topic {topic}{listed}", path=path)
        for index in people:
            _check_type(reader.topics[index], path)
        stream = EstimateStream(source)
        frames = set[str]()
        for message in reader.messages([reader.topics[index].name for index in people]):
            kind = reader.topics[message.topic]
            try:
                content = _read(message.data, kind.type, options)
                latency = _latency(content.stamp, message.stamp)
                stream.add(content, kind.name, message.stamp, people[message.topic], latency)
            except EvaluationError as error:
                raise EvaluationError(error.message, path=path, key=kind.name) from None
            frames.add(content.frame_id)
    if others := sorted(frames - {"", _WORLD}):
        warn_about(source, f"frame_id is {printable(others[0], 80)!r}, and is taken as {_WORLD}")
    return stream


def _read(data: Any, kind: str, options: ReadOptions) -> PoseFrame:
    try:
        content = message_types().deserialize_cdr(bytes(data), kind)
    except Exception as reason:  # rosbags documents no exceptions for damaged messages
        raise EvaluationError(f"a message cannot be read: {type(reason).__name__}: {reason}") from None
    return read_people(kind, content, options.names)


def _latency(stamp: int | None, logged: int) -> float | None:
    """Seconds from stamp to log time; None if they are equal, because simulated time stands in lockstep."""
    if stamp is None or stamp == logged or abs(logged - stamp) > _SAME_CLOCK:
        return None
    return (logged - stamp) * 1e-9


def _poses_of(topics: Any) -> str:
    names = [topic.name for topic in topics if topic.type in MESSAGE_TYPES]
    return f"poses on {', '.join(names[:5])}" if names else "no topic with poses"


def _check_type(topic: BagTopic, path: str | os.PathLike[str]) -> None:
    if topic.type not in MESSAGE_TYPES:
        raise EvaluationError(
            f"{topic.type} holds no poses of people; known are {', '.join(MESSAGE_TYPES)}",
            path=path,
            key=topic.name,
        )
