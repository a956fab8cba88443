"""Read an MCAP file, also one that was cut anywhere or that has damaged chunks.

The mcap library reads all records. Its own readers of messages stop at the first damage, and keep all
messages of a file without chunks in memory.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator
from itertools import count
from pathlib import Path
from typing import BinaryIO, NamedTuple

from humansim_ros.data.bags.libraries import needs_libraries
from humansim_ros.data.bags.metadata import Content
from humansim_ros.data.bags.topics import BagMessage, BagTopic, qos_of_text
from humansim_ros.errors import BagError, warn_about
from humansim_ros.files.reading import ANY_SIZE, open_file

with needs_libraries():
    from mcap.exceptions import McapError
    from mcap.reader import SeekingReader
    from mcap.records import Channel, Chunk, McapRecord, Message, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk
    from mcap.writer import MCAP0_MAGIC

#: Sizes of a Chunk and a Message record, without the data and the name of the compression, bytes.
_CHUNK_HEAD, _MESSAGE_HEAD = 49, 31


class _Place(NamedTuple):
    """Where a file has a chunk, or a message outside of chunks.

    ``start`` and ``end`` are the first and last log time, ns. ``channels`` are the numbers of the channels
    with messages in the chunk; empty if unknown.
    """

    position: int
    start: int
    end: int
    channels: Collection[int]


class McapInput:
    """Reads an MCAP file.

    Attributes:
        topics: Topics of the channels in the order of the file.
        content: Numbers and times of the messages.
        whole: Whether the file was finished. If false, its complete chunks are read.

    Raises:
        BagError: The file cannot be read, or is no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content = Content()
        self.whole = True
        self._places: list[_Place] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._file: BinaryIO = open_file(path, BagError, "bag", ANY_SIZE)
        try:
            if not self._read_summary():
                self._scan()
        except BaseException:
            self.close()
            raise
        #: Index of the topic of each channel.
        self._indices = {number: index for index, number in enumerate(self._channels)}
        self.topics = [self._topic(channel) for channel in self._channels.values()]
        counts = self.content.counts.items()
        self.content.counts = {self._indices[n]: number for n, number in counts if n in self._indices}

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read_summary(self) -> bool:
        """Read topics and places of chunks from the summary. Returns False if the summary is missing or
        damaged, or has no chunks."""
        try:
            summary = SeekingReader(self._file).get_summary()
        except Exception:  # the library documents no exceptions for damaged files
            return False
        if summary is None or (found := summary.statistics) is None:
            return False
        if found.message_count and not summary.chunk_indexes:
            return False
        for index in summary.chunk_indexes:
            place = index.chunk_start_offset, index.message_start_time, index.message_end_time
            self._places.append(_Place(*place, index.message_index_offsets.keys()))
        self._schemas, self._channels = summary.schemas, summary.channels
        if found.message_count:
            self.content.add(found.channel_message_counts, found.message_start_time, found.message_end_time)
        return True

    def _scan(self) -> None:
        """Find topics and messages without a summary, by reading the file from its start."""
        self._file.seek(0)
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise BagError("this is no MCAP file", path=self.path)
        records = StreamReader(self._file, skip_magic=True, emit_chunks=True).records
        while True:
            try:
                record = next(records)
            except StopIteration:  # after the footer
                return
            except Exception:  # the end of a file that was cut, or damage that hides what follows
                self.whole = False
                return
            if isinstance(record, Chunk):
                size = _CHUNK_HEAD + len(record.compression) + len(record.data)
            elif isinstance(record, Message):
                size = _MESSAGE_HEAD + len(record.data)
            else:
                self._add_topic_record(record)
                continue
            position = self._file.tell() - size
            contained = self._contained(record, position)
            for each in contained:
                self._add_topic_record(each)
            messages = [each for each in contained if isinstance(each, Message)]
            for message in messages:
                self.content.add({message.channel_id: 1}, message.log_time, message.log_time)
            if messages:
                times = [message.log_time for message in messages]
                channels = {message.channel_id for message in messages}
                self._places.append(_Place(position, min(times), max(times), channels))

    def _add_topic_record(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record

    def _topic(self, channel: Channel) -> BagTopic:
        schema = self._schemas.get(channel.schema_id)
        return BagTopic(
            name=channel.topic,
            type="" if schema is None else schema.name,
            qos=qos_of_text(channel.metadata.get("offered_qos_profiles", "")),
            definition="" if schema is None else schema.data.decode("utf-8", "replace"),
            type_hash=channel.metadata.get("topic_type_hash", ""),
        )

    def _contained(self, record: McapRecord, position: int) -> list[McapRecord]:
        """Records in a chunk at a position, or the record itself. If damaged, warn, and return nothing."""
        try:
            return breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
        except Exception:  # the libraries of compressions have exceptions of their own
            self._warn_about_damage(position)
            return []

    def _warn_about_damage(self, position: int) -> None:
        warn_about(self.path, f"the record at byte {position} is damaged; its messages are left out")

    def messages(self, topics: Collection[int], start: int, end: int) -> Iterator[BagMessage]:
        """Messages in the order of their times. Damaged messages are left out, with a HumansimWarning.

        Args:
            topics: Indices of the topics.
            start: Smallest log time, nanoseconds.
            end: Only messages before this log time, nanoseconds.
        """
        wanted = {number for number, index in self._indices.items() if index in topics}
        pending: list[tuple[int, int, BagMessage]] = []
        number = count()
        for place in sorted(self._places, key=lambda each: each.start):
            if place.channels and wanted.isdisjoint(place.channels):
                continue
            if place.start >= end or place.end < start:
                continue
            while pending and pending[0][0] < place.start:
                yield heapq.heappop(pending)[2]
            for each in self._messages(place.position):
                if each.channel_id in wanted and start <= each.log_time < end:
                    topic = self._indices[each.channel_id]
                    message = BagMessage(topic, each.log_time, each.data, each.publish_time)
                    heapq.heappush(pending, (message.stamp, next(number), message))
        while pending:
            yield heapq.heappop(pending)[2]

    def _messages(self, position: int) -> list[Message]:
        """Read the messages of a chunk, or a message outside of chunks. If damaged, warn, and return no
        messages."""
        self._file.seek(position)
        try:
            record = next(StreamReader(self._file, skip_magic=True, emit_chunks=True).records)
            if not isinstance(record, (Chunk, Message)):
                raise McapError("neither a chunk nor a message")
        except Exception:
            self._warn_about_damage(position)
            return []
        return [each for each in self._contained(record, position) if isinstance(each, Message)]
