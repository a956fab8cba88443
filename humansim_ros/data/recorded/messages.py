"""The messages of a bag by topic, for export, evaluation and the page."""

from __future__ import annotations

import os
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, TypeVar

from humansim_ros.data.bags import BagReader, BagTopic
from humansim_ros.errors import HumansimError, located

Value = TypeVar("Value")

#: Messages are read together if their log times differ by less than this, nanoseconds.
_TOGETHER = 250_000_000


class Place(NamedTuple):
    """Where a message of a topic is in a bag. ``log``: log time, nanoseconds. ``number``: number of the
    message among those of the topic with this log time."""

    log: int
    number: int = 0


class RecordedMessages:
    """Reads the messages of a bag by topic.

    Use it in a ``with`` block, or call :meth:`close`.

    Args:
        path: The bag.
        most: Largest size of the messages that :meth:`read` keeps in memory, bytes.

    Attributes:
        path: The bag.
        reader: Reader of the bag.
        topics: Topics that have messages, by name, in the order of the bag.
        kept: The messages that are in memory, by topic and place.
        size: Size of these messages, bytes.

    Raises:
        BagError: The bag cannot be read.
    """

    def __init__(self, path: str | os.PathLike[str], most: int = 0) -> None:
        self.path, self._most = Path(path), most
        self.reader = BagReader(path)
        self._all, counts = self.reader.topics, self.reader.info.counts
        self.topics = {topic.name: topic for index, topic in enumerate(self._all) if counts.get(index)}
        self.kept: OrderedDict[tuple[str, Place], bytes] = OrderedDict()
        self.size = 0

    def places(self, topics: Collection[str]) -> Iterator[tuple[str, Place, bytes]]:
        """Yield topic, place and content of all messages of some topics, in the order of their log times."""
        log, numbers = -1, Counter[str]()
        for message in self.reader.messages(topics) if topics else ():
            if message.stamp != log:
                log, numbers = message.stamp, Counter()
            name = self._all[message.topic].name
            yield name, Place(log, numbers[name]), bytes(message.data)
            numbers[name] += 1

    def each(
        self,
        topics: Collection[str],
        read: Callable[[bytes, BagTopic], Value],
        error: type[HumansimError] | None = None,
    ) -> Iterator[tuple[BagTopic, int, Value]]:
        """Read all messages of some topics. Yields topic, log time in nanoseconds, and what ``read`` returns.

        Args:
            topics: Names of the topics.
            read: Function of the serialised message and its topic.
            error: Class of the errors. If None, each keeps its class.

        Raises:
            HumansimError: A message is damaged. The error names the bag and the topic.
        """
        for message in self.reader.messages(topics) if topics else ():
            topic = self._all[message.topic]
            with located(error, self.path, key=topic.name):
                value = read(bytes(message.data), topic)
            yield topic, message.stamp, value

    def read(self, places: Mapping[str, Place]) -> dict[str, bytes]:
        """Read the messages at some places, by topic. Damaged messages are left out."""
        found: dict[str, bytes] = {}
        lacking: list[tuple[Place, str]] = []
        for topic, place in places.items():
            if (content := self.kept.get((topic, place))) is None:
                lacking.append((place, topic))
            else:
                self.kept.move_to_end((topic, place))
                found[topic] = content
        groups: list[dict[str, Place]] = []
        last = 0
        for place, topic in sorted(lacking):
            if not groups or place.log - last > _TOGETHER:
                groups.append({})
            groups[-1][topic] = place
            last = place.log
        for group in groups:
            found |= self._read_group(group)
        return found

    def _read_group(self, places: Mapping[str, Place]) -> dict[str, bytes]:
        logs = [place.log for place in places.values()]
        numbers, found = Counter[str](), {}
        for message in self.reader.messages(list(places), start=min(logs), end=max(logs) + 1):
            topic = self._all[message.topic].name
            place = places[topic]
            if message.stamp == place.log:
                if numbers[topic] == place.number:
                    found[topic] = bytes(message.data)
                    self._keep((topic, place), found[topic])
                numbers[topic] += 1
        return found

    def _keep(self, key: tuple[str, Place], content: bytes) -> None:
        self.kept[key] = content
        self.size += len(content)
        while self.kept and self.size > self._most:
            self.size -= len(self.kept.popitem(last=False)[1])

    def close(self) -> None:
        """Close the bag."""
        self.reader.close()

    def __enter__(self) -> RecordedMessages:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
