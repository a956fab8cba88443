"""Read an MCAP file of a bag, also one that was not finished, was cut, or was written by another program."""

from __future__ import annotations

import heapq
import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import BinaryIO

from humansim_ros.bags.chunks import (
    HEAD_SIZE,
    INDEX_HEAD_SIZE,
    RECORD,
    BagMessage,
    Chunk,
    ChunkHead,
    chunk_messages,
    chunk_records,
    index_count,
    message_of,
)
from humansim_ros.bags.libraries import needs_libraries
from humansim_ros.bags.mcap_scan import DAMAGES, MAGIC, McapScan, Place, places, topic_of, topic_record
from humansim_ros.bags.metadata import Content
from humansim_ros.errors import BagError, warn_about
from humansim_ros.io.files import ANY_SIZE, open_file

with needs_libraries():
    from mcap.opcode import Opcode
    from mcap.reader import SeekingReader
    from mcap.records import Channel, Schema


@dataclass(frozen=True)
class _Source:
    """A Chunk record or a Message record in the file; ``channels``: those of its messages."""

    place: Place
    start: int
    end: int
    channels: frozenset[int]


class McapInput:
    """An MCAP file that is read.

    ``topics`` are those of the channels in the order of the file. ``whole`` is False if the end of the file
    is missing: it was interrupted or cut; what is whole is read then.

    Raises:
        BagError: The file cannot be read, or is no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content = Content()
        self.whole = False
        self._sources: list[_Source] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._file: BinaryIO = open_file(path, BagError, "bag", ANY_SIZE)
        try:
            if not self._read_summary():
                self._scan()
        except OSError as reason:
            self.close()
            raise BagError(f"cannot be read: {reason.strerror or reason}", path=path) from None
        except BaseException:
            self.close()
            raise
        #: Index of the topic of each channel.
        self._indices = {number: index for index, number in enumerate(self._channels)}
        self.topics = [topic_of(channel, self._schemas) for channel in self._channels.values()]
        self.content.counts = {
            self._indices[number]: count
            for number, count in self.content.counts.items()
            if number in self._indices
        }

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read_summary(self) -> bool:
        """Take topics and chunks from the summary; False if there is none that can be trusted."""
        size = os.fstat(self._file.fileno()).st_size
        try:
            summary = SeekingReader(self._file).get_summary()
        except (OSError, AssertionError, StopIteration, *DAMAGES):
            return False
        if summary is None or summary.statistics is None:
            return False
        found = summary.statistics
        if found.message_count and not summary.chunk_indexes:
            return False
        sources = []
        for index in summary.chunk_indexes:
            place = Place(Opcode.CHUNK, index.chunk_start_offset, index.chunk_length - RECORD.size)
            if place.length < 0 or place.end > size or not index.message_index_offsets:
                return False
            channels = frozenset(index.message_index_offsets)
            if not channels <= summary.channels.keys():
                return False
            sources.append(_Source(place, index.message_start_time, index.message_end_time, channels))
        self._sources, self._schemas, self._channels = sources, summary.schemas, summary.channels
        if found.message_count:
            self.content.add(found.channel_message_counts, found.message_start_time, found.message_end_time)
        self.whole = True
        return True

    def _scan(self) -> None:
        """Find topics and messages from the start of the file."""
        chunk: Place | None = None
        counts: dict[int, int] = {}
        for place in places(self._file, self.path):
            if place.opcode == Opcode.MESSAGE_INDEX:
                topic, number = index_count(self._record(place, INDEX_HEAD_SIZE))
                counts[topic + 1] = number
                continue
            if chunk is not None:
                self._add_chunk(chunk, counts)
            chunk, counts = None, {}
            try:
                if place.opcode == Opcode.CHUNK:
                    chunk = place
                elif place.opcode == Opcode.MESSAGE:
                    message = message_of(self._content(place))
                    self._add(place, message.stamp, message.stamp, {message.topic + 1: 1})
                elif place.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._add_topic_record(place.opcode, bytes(self._content(place)))
            except (BagError, *DAMAGES):
                self._warn_about_damage(place)
        if chunk is not None:  # its index may not be whole
            self._add_chunk(chunk, {})
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(max(0, size - len(MAGIC)))
        self.whole = self._file.read() == MAGIC and size > 2 * len(MAGIC)

    def _add_chunk(self, place: Place, counts: dict[int, int]) -> None:
        """Add a chunk; one without index, or with topics in it, is read."""
        try:
            head = ChunkHead.read(self._record(place, HEAD_SIZE))
            if not counts or not counts.keys() <= self._channels.keys():
                counts = {}
                for opcode, content in chunk_records(self._record(place)):
                    if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                        self._add_topic_record(opcode, bytes(content))
                    elif opcode == Opcode.MESSAGE:
                        channel = message_of(content).topic + 1
                        counts[channel] = counts.get(channel, 0) + 1
            self._add(place, head.start, head.end, counts)
        except (BagError, *DAMAGES):
            self._warn_about_damage(place)

    def _add(self, place: Place, start: int, end: int, counts: dict[int, int]) -> None:
        self._sources.append(_Source(place, start, end, frozenset(counts)))
        self.content.add(counts, start if counts else None, end if counts else None)

    def _add_topic_record(self, opcode: int, content: bytes) -> None:
        record = topic_record(opcode, content)
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        else:
            self._channels[record.id] = record

    def _record(self, place: Place, size: int | None = None) -> bytes:
        """A record with opcode and length, or the first bytes of it."""
        self._file.seek(place.position)
        return self._file.read(place.end - place.position if size is None else size)

    def _content(self, place: Place) -> memoryview:
        return memoryview(self._record(place))[RECORD.size :]

    def _warn_about_damage(self, place: Place) -> None:
        warn_about(self.path, f"the record at byte {place.position} is damaged; its messages are left out")

    def messages(self, topics: Collection[int], start: int, end: int) -> Iterator[BagMessage]:
        """Messages in the order of their times.

        Args:
            topics: Indices of the topics.
            start: First log time in nanoseconds.
            end: Log time after the last one.
        """
        wanted = {number for number, index in self._indices.items() if index in topics}
        sources = [each for each in self._sources if each.channels & wanted]
        pending: list[tuple[int, int, BagMessage]] = []
        number = count()
        for source in sorted(sources, key=lambda each: each.start):
            if source.start >= end or source.end < start:
                continue
            while pending and pending[0][0] < source.start:
                yield heapq.heappop(pending)[2]
            for message in self._messages(source.place):
                if message.topic + 1 in wanted and start <= message.stamp < end:
                    found = message._replace(topic=self._indices[message.topic + 1])
                    heapq.heappush(pending, (message.stamp, next(number), found))
        while pending:
            yield heapq.heappop(pending)[2]

    def _messages(self, place: Place) -> list[BagMessage]:
        """Messages of a chunk, or the one of a Message record; none with a warning if it is damaged."""
        try:
            if place.opcode == Opcode.MESSAGE:
                return [message_of(self._content(place))]
            return chunk_messages(self._record(place))
        except BagError:
            self._warn_about_damage(place)
            return []

    def groups(self) -> Iterator[list[Chunk]]:
        """The chunks of each whole group, with their bytes.

        Raises:
            BagError: Another program has written the file.
        """
        group: list[Chunk] = []
        for unit in McapScan(self._file, self.path).units:
            self._file.seek(unit.start)
            group.append(unit.chunk.with_data(self._file.read(unit.chunk.size)))
            if unit.ends_group:
                yield group
                group = []
