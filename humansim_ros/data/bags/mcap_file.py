"""One MCAP file of a bag: append chunks, finish with summary and footer, find whole chunks, read messages.

Each chunk is followed by a mark, a small record of our own (opcode 0x80) that other readers skip. The mark
says that the chunk is complete, and whether the chunk is the last of its group (the chunks of one frame).
With marks, a file that was cut anywhere can be finished or continued.

Large chunks begin and end at block borders of the file. They are written to the disk directly (O_DIRECT),
without a copy in the memory of the system. This takes 0.5 ms of processor time for 2.5 MB instead of 2 to 6
ms. Positions depend only on sizes, so that the bytes of a file are the same on every disk.

The mcap library writes and reads all records but chunks and marks. Its readers stop at the first damage, and
read all bytes of a file without summary. The scan here reads only 80 bytes of each record.
"""

from __future__ import annotations

import errno
import heapq
import mmap
import os
import struct
import tempfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import BinaryIO, ClassVar, NamedTuple

import numpy as np

from humansim_ros import __version__
from humansim_ros.data.bags.chunks import (
    BLOCK,
    CHUNK,
    HEAD_SIZE,
    MESSAGE,
    MESSAGE_INDEX,
    RECORD,
    BagMessage,
    Buffer,
    Chunk,
    chunk_messages,
    chunk_records,
    message_of,
    read_chunk_head,
    read_index_head,
)
from humansim_ros.data.bags.libraries import needs_libraries
from humansim_ros.data.bags.metadata import Content
from humansim_ros.data.bags.topics import BagTopic, qos_of_text, qos_text
from humansim_ros.errors import BagError, warn_about
from humansim_ros.files.reading import ANY_SIZE, open_file

with needs_libraries():
    from mcap.data_stream import ReadDataStream, RecordBuilder
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.reader import SeekingReader
    from mcap.records import (
        Channel,
        ChunkIndex,
        DataEnd,
        Footer,
        Header,
        McapRecord,
        Schema,
        Statistics,
        SummaryOffset,
    )
    from mcap.summary import Summary

MAGIC = b"\x89MCAP0\r\n"
#: Chunks of at least this size, bytes, begin at block borders. The gaps before them are at most 0.2 % of the
#: file on average.
LARGE_CHUNK = 1 << 20
#: Opcode of the record after each chunk. Opcodes from 0x80 on are free for applications.
_MARK = 0x80
#: Opcode of the record that fills the space before a chunk that must be aligned.
_PADDING = 0x81
#: Format of the content of a mark: name, number of the group, whether the chunk is the last of the group.
_MARK_CONTENT = struct.Struct("<8sQB")
_MARK_NAME = b"humansim"
#: The index is kept in memory up to this size, bytes, then in an unnamed temporary file in the folder of the
#: bag.
_INDEX_IN_MEMORY = 1 << 22
#: Error numbers of file systems that do not support direct writing.
_REFUSALS = (errno.EINVAL, errno.EOPNOTSUPP)
#: By opcode: functions that read records about topics. For damaged content they raise ``_DAMAGES``.
_TOPIC_RECORDS: dict[int, Callable[[ReadDataStream], Schema | Channel]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
}
#: Errors of reading damaged records.
_DAMAGES = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError, MemoryError)


def mark(group: int, ends_group: bool, space: int = 0) -> bytes:
    """Encode the mark that follows a chunk. It says that the chunk is complete, names its group (the chunks
    of one frame), and says whether the chunk is the last of the group. ``space``: number of zeros to add."""
    content = _MARK_CONTENT.pack(_MARK_NAME, group, ends_group) + bytes(space)
    return RECORD.pack(_MARK, len(content)) + content


def padding(position: int, block: int) -> bytes:
    """Encode the record that fills the space from a position to the next multiple of ``block``. Empty if the
    position is a multiple of ``block``."""
    space = -position % block
    if space == 0:
        return b""
    if space < RECORD.size:
        space += block
    return RECORD.pack(_PADDING, space - RECORD.size) + bytes(space - RECORD.size)


def _encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def _after(views: Sequence[memoryview], written: int) -> list[memoryview]:
    """Parts of buffers that remain after the first ``written`` bytes. Empty buffers are left out."""
    left = []
    for view in views:
        if written < view.nbytes:
            left.append(view[written:])
        written = max(0, written - view.nbytes)
    return left


def _chunk_index(chunk: Chunk, position: int) -> ChunkIndex:
    """Make the record of the summary that describes a chunk at a position."""
    offsets, offset = {}, position + chunk.chunk_length
    for topic, length in chunk.index_lengths():
        offsets[topic + 1] = offset
        offset += length
    return ChunkIndex(
        chunk_length=chunk.chunk_length,
        chunk_start_offset=position,
        compression=chunk.compression,
        compressed_size=chunk.compressed_size,
        message_end_time=chunk.end,
        message_index_length=chunk.index_length,
        message_index_offsets=offsets,
        message_start_time=chunk.start,
        uncompressed_size=chunk.uncompressed_size,
    )


class DirectFile:
    """Writes an open file directly to the disk (O_DIRECT). ``descriptor``: of the open file."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = -1
        self._staging = mmap.mmap(-1, 2 * BLOCK)
        with suppress(OSError):  # refused, or there is no /proc
            # its own descriptor, since a duplicate would share the flag with the first way
            self._descriptor = os.open(f"/proc/self/fd/{descriptor}", os.O_RDWR | os.O_DIRECT | os.O_CLOEXEC)

    def write(self, views: Sequence[memoryview], position: int) -> int:
        """Write buffers one after the other. Returns how many bytes are written, a multiple of ``BLOCK``.

        The result is 0 if the file system does not support direct writing, and may be less than the total
        size. Aligned bytes at the start of the first buffer are not copied.

        Args:
            views: Buffers. The sum of their sizes must be a multiple of ``BLOCK``.
            position: Place in the file, a multiple of ``BLOCK``.

        Raises:
            OSError: The file cannot be written.
        """
        if self._descriptor < 0:
            return 0
        address: int = np.frombuffer(views[0], np.uint8).__array_interface__["data"][0]
        whole = 0 if address % BLOCK else views[0].nbytes // BLOCK * BLOCK
        buffers = [views[0][:whole], self._staged(_after(views, whole))]
        try:
            return os.pwritev(self._descriptor, buffers, position) // BLOCK * BLOCK
        except OSError as reason:
            if reason.errno not in _REFUSALS:
                raise
            self.close()
            return 0

    def _staged(self, views: Sequence[memoryview]) -> memoryview:
        """Copy buffers to memory that begins at a multiple of ``BLOCK``."""
        size = sum(view.nbytes for view in views)
        if size > len(self._staging):
            self._staging = mmap.mmap(-1, -(-size // BLOCK) * BLOCK)
        staged, position = memoryview(self._staging), 0
        for view in views:
            staged[position : position + view.nbytes] = view
            position += view.nbytes
        return staged[:size]

    def close(self) -> None:
        """End direct writing: :meth:`write` returns 0 from now on."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


class GroupFile:
    """An MCAP file that is being written. Topics have the channel numbers 1, 2 … in their order.

    Raises:
        OSError: Raised by all methods if the file cannot be written.
    """

    smallest: ClassVar[int] = 1024

    def __init__(self, path: Path) -> None:
        self.path = path
        self.content = Content()
        self.topics: list[BagTopic] = []
        self.size = 0
        self._descriptor = -1
        self._direct: DirectFile | None = None
        self._schemas: dict[str, Schema] = {}
        self._channels: list[Channel] = []
        self._chunks = 0
        self._index = tempfile.SpooledTemporaryFile(  # noqa: SIM115 (close closes it)
            max_size=_INDEX_IN_MEMORY, dir=str(path.parent)
        )

    @classmethod
    def create(cls, path: Path, topics: Sequence[BagTopic], profile: str = "ros2") -> GroupFile:
        """Create a file with header and topics. The file appears under its name when these are written.
        ``profile``: MCAP profile; empty for a file that no ROS program reads."""
        file = cls(path)
        temporary = path.with_name(f".{path.name}.new")
        try:
            file._descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
            header = Header(profile=profile, library=f"humansim_ros {__version__}")
            file._write(MAGIC + _encoded(header))
            for topic in topics:
                file.add_topic(topic)
            temporary.rename(path)
        except BaseException:
            file.close()
            temporary.unlink(missing_ok=True)
            raise
        return file

    @classmethod
    def reopen(cls, path: Path, *, spare: int = 0) -> tuple[GroupFile, int | None]:
        """Open a file to continue it after its last complete group (the chunks of one frame).

        Args:
            path: The file, finished or not.
            spare: Cut at least this number of bytes off the end, to free disk space.

        Returns:
            The file, and the number of groups of the bag up to its new end; None if no complete group is
            left.

        Raises:
            BagError: The file is damaged at its start, or was written by another program.
        """
        file = cls(path)
        try:
            file._descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
            if os.fstat(file._descriptor).st_size < len(MAGIC):  # after a loss of power
                return file, None
            with os.fdopen(os.dup(file._descriptor), "rb") as content:
                scan = McapScan(content, path)
            kept = scan.own_units()
            most = kept[-1].end - spare if kept else 0
            while kept and (kept[-1].end > most or not kept[-1].ends_group):
                kept.pop()
            file._cut(kept[-1].end if kept else scan.head_end)
            for end, record in scan.topics:
                if isinstance(record, Schema) and end <= file.size:
                    file._schemas[record.name] = record
                elif isinstance(record, Channel) and end <= file.size:
                    file._channels.append(record)
            schemas = {schema.id: schema for schema in file._schemas.values()}
            file.topics = [_topic_of(channel, schemas) for channel in file._channels]
            for unit in kept:
                file._count(unit.chunk, unit.start)
        except BaseException:
            file.close()
            raise
        return file, kept[-1].group + 1 if kept else None

    @classmethod
    def content_of(cls, path: Path) -> Content:
        """Read numbers and times of messages from the summary of a finished file. BagError if damaged."""
        with open_file(path, BagError, "bag", ANY_SIZE) as file:
            return content_in(file, path)

    def _cut(self, size: int) -> None:
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self.size = size

    def _write(self, *buffers: Buffer, directly: bool = False) -> None:
        """Write all buffers one after the other; if that fails, none. ``directly``: with O_DIRECT, as aligned
        blocks."""
        views = [memoryview(buffer).cast("B") for buffer in buffers]
        size = sum(view.nbytes for view in views)
        try:
            if directly:
                self._direct = self._direct or DirectFile(self._descriptor)
                written = self._direct.write(views, self.size)
                os.lseek(self._descriptor, self.size + written, os.SEEK_SET)
                views = _after(views, written)
            while views:
                views = _after(views, os.writev(self._descriptor, views[:1024]))
        except BaseException:
            self._cut(self.size)
            raise
        self.size += size

    def add_topic(self, topic: BagTopic) -> None:
        """Add a topic. It comes after the existing topics."""
        new: list[McapRecord] = []
        schema = self._schemas.get(topic.type)
        if schema is None:
            schema = Schema(
                id=len(self._schemas) + 1,
                name=topic.type,
                encoding=topic.encoding,
                data=topic.definition.encode(),
            )
            new.append(schema)
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic.name,
            message_encoding=topic.serialization,
            schema_id=schema.id,
            metadata={}
            if topic.serialization == "json"
            else {"offered_qos_profiles": qos_text(topic), "topic_type_hash": topic.type_hash},
        )
        self._write(_encoded(*new, channel))
        self._schemas[topic.type] = schema
        self._channels.append(channel)
        self.topics.append(topic)

    def append(self, chunk: Chunk, group: int, ends_group: bool) -> None:
        """Append a chunk. ``group``: number of the group in the bag."""
        before = self.size
        if chunk.size < LARGE_CHUNK:
            self._write(*chunk.buffers, mark(group, ends_group))
            self._count(chunk, before)
            return
        self._write(padding(before, BLOCK))
        position = self.size
        try:
            space = -(chunk.size + len(mark(group, ends_group))) % BLOCK
            self._write(*chunk.buffers, mark(group, ends_group, space), directly=True)
        except BaseException:
            self._cut(before)
            raise
        self._count(chunk, position)

    def _count(self, chunk: Chunk, position: int) -> None:
        self._index.write(_encoded(_chunk_index(chunk, position)))
        self._chunks += 1
        self.content.add(chunk.counts, chunk.start, chunk.end)

    def finish(self) -> None:
        """Write summary and footer, and close the file."""
        self._write(_encoded(DataEnd(0)))
        start = self.size
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts={
                channel.id: self.content.counts.get(channel.id - 1, 0) for channel in self._channels
            },
            chunk_count=self._chunks,
            message_count=self.content.total,
            message_end_time=self.content.end or 0,
            message_start_time=self.content.start or 0,
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        crc = 0
        offsets = []
        for opcode, parts in (
            (Opcode.SCHEMA, [_encoded(*self._schemas.values())]),
            (Opcode.CHANNEL, [_encoded(*self._channels)]),
            (Opcode.STATISTICS, [_encoded(statistics)]),
            (Opcode.CHUNK_INDEX, self._index_parts()),
        ):
            begin = self.size
            for part in parts:
                self._write(part)
                crc = zlib.crc32(part, crc)
            if self.size > begin:
                offsets.append(
                    SummaryOffset(group_opcode=opcode, group_start=begin, group_length=self.size - begin)
                )
        footer = Footer(summary_start=start, summary_offset_start=self.size, summary_crc=0)
        tail = _encoded(*offsets)
        # the checksum covers the footer up to the checksum itself
        footer.summary_crc = zlib.crc32(_encoded(footer)[:-4], zlib.crc32(tail, crc))
        self._write(tail + _encoded(footer) + MAGIC)
        self.close()

    def _index_parts(self) -> Iterator[bytes]:
        self._index.seek(0)
        while part := self._index.read(_INDEX_IN_MEMORY):
            yield part

    def close(self) -> None:
        """Close the file without finishing it. Further calls do nothing."""
        if self._descriptor >= 0:
            if self._direct is not None:
                self._direct.close()
            os.close(self._descriptor)
            self._descriptor = -1
            self._index.close()


McapFile = GroupFile


def _summary(file: BinaryIO) -> Summary | None:
    """Summary of a finished file; None if missing or damaged."""
    try:
        summary = SeekingReader(file).get_summary()
    except (OSError, AssertionError, StopIteration, *_DAMAGES):
        return None
    return None if summary is None or summary.statistics is None else summary


def content_in(file: BinaryIO, path: str | os.PathLike[str]) -> Content:
    """Read numbers and times of messages from a finished file, which may be on another machine.

    Raises:
        BagError: The summary of the file is damaged. The error names the file ``path``.
    """
    summary = _summary(file)
    if summary is None or summary.statistics is None:
        raise BagError("the summary of this file is damaged; it cannot be continued", path=path)
    found = summary.statistics
    counts = {channel - 1: number for channel, number in found.channel_message_counts.items()}
    return Content(counts, found.message_start_time, found.message_end_time)


class Unit(NamedTuple):
    """Where a chunk and its mark are in the file: from ``start`` to ``end``. ``chunk`` has no bytes.
    ``group`` is -1 without a mark, as in files of other programs. A message outside of chunks is a unit,
    too."""

    chunk: Chunk
    start: int
    end: int
    group: int = -1
    ends_group: bool = True


class McapScan:
    """Finds the complete records of an MCAP file that may have been cut anywhere.

    Attributes:
        topics: Schema and Channel records, each with the position after it.
        units: All chunks.
        head_end: Position after the records before the first unit.
        damaged: Positions of damaged records.

    Raises:
        BagError: The file cannot be read, or is no MCAP file.
    """

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self.topics: list[tuple[int, Schema | Channel]] = []
        self.units: list[Unit] = []
        self.head_end = len(MAGIC)
        self.damaged: list[int] = []
        self._file, self._path = file, path
        self._is_foreign = self._has_end = False
        try:
            self._read()
        except OSError as reason:
            raise BagError(f"cannot be read: {reason.strerror or reason}", path=path) from None

    def own_units(self) -> list[Unit]:
        """The units of a file that this package has written, all with marks. Raises BagError if the file is
        damaged or was written by another program."""
        if self._is_foreign:
            raise BagError("this file was not written by humansim: it cannot be continued", path=self._path)
        if self.damaged:
            text = f"the record at byte {self.damaged[0]} is damaged; the file cannot be continued"
            raise BagError(text, path=self._path)
        return [unit for unit in self.units if unit.group >= 0]

    def _read(self) -> None:
        chunk: Unit | None = None  # its MessageIndex records and its mark follow
        counts: dict[int, int] = {}
        for opcode, position, end, head in self._records():
            try:
                if opcode == MESSAGE_INDEX and chunk is not None:
                    topic, number = read_index_head(head)
                    counts[topic] = number
                    continue
                if chunk is not None:
                    unit = Unit(replace(chunk.chunk, counts=counts), chunk.start, end, *_group(opcode, head))
                    self.units.append(unit)
                    self._is_foreign |= unit.group < 0
                    chunk = None
                    if opcode == _MARK:
                        continue
                if opcode == CHUNK:
                    chunk, counts = Unit(read_chunk_head(head)[0], position, end), {}
                elif opcode == MESSAGE:
                    self._is_foreign = True
                    topic, stamp, _, _ = message_of(memoryview(head)[RECORD.size :])
                    one = Chunk((), end - position, stamp, stamp, "", 0, 0, {topic: 1})
                    self.units.append(Unit(one, position, end))
                elif opcode in _TOPIC_RECORDS:
                    self._file.seek(position + RECORD.size)
                    content = self._file.read(end - position - RECORD.size)
                    self.topics.append((end, _TOPIC_RECORDS[opcode](ReadDataStream(BytesIO(content)))))
                elif opcode not in (Opcode.HEADER, _PADDING):
                    self._is_foreign = True
            except (BagError, *_DAMAGES):
                self.damaged.append(position)
            if not self.units and chunk is None and opcode != _PADDING:
                self.head_end = end
        if chunk is not None:  # its MessageIndex records may be incomplete
            self.units.append(chunk)
            self._is_foreign |= self._has_end

    def _records(self) -> Iterator[tuple[int, int, int, bytes]]:
        """Yield opcode, position, end and first bytes of each complete record, up to the end of the data."""
        size = os.fstat(self._file.fileno()).st_size
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            raise BagError("this is no MCAP file", path=self._path)
        position = len(MAGIC)
        while position + RECORD.size <= size:
            self._file.seek(position)
            head = self._file.read(HEAD_SIZE)
            if len(head) < RECORD.size:  # the file has been cut in the meantime
                return
            opcode, length = RECORD.unpack_from(head)
            end = position + RECORD.size + length
            self._has_end = opcode in (Opcode.DATA_END, Opcode.FOOTER)
            # zero: space without content, as after a loss of power
            if self._has_end or opcode == 0 or end > size:
                return
            yield opcode, position, end, head
            position = end


def _group(opcode: int, head: bytes) -> tuple[int, bool]:
    """Read the record after a chunk. If it is a mark: number of the group, and whether the chunk is the last
    of the group. Otherwise -1."""
    if opcode == _MARK:
        name, group, ends_group = _MARK_CONTENT.unpack_from(head, RECORD.size)
        if name == _MARK_NAME:
            return group, bool(ends_group)
    return -1, True


def _topic_of(channel: Channel, schemas: Mapping[int, Schema]) -> BagTopic:
    schema = schemas.get(channel.schema_id)
    return BagTopic(
        name=channel.topic,
        type="" if schema is None else schema.name,
        qos=qos_of_text(channel.metadata.get("offered_qos_profiles", "")),
        definition="" if schema is None else schema.data.decode("utf-8", "replace"),
        type_hash=channel.metadata.get("topic_type_hash", ""),
    )


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
        self._chunks: list[ChunkIndex] = []
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
        self.topics = [_topic_of(channel, self._schemas) for channel in self._channels.values()]
        counts = self.content.counts.items()
        self.content.counts = {self._indices[n]: number for n, number in counts if n in self._indices}

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read_summary(self) -> bool:
        """Read topics and chunks from the summary. Returns False if the summary is missing or wrong."""
        size = os.fstat(self._file.fileno()).st_size
        summary = _summary(self._file)
        if summary is None or summary.statistics is None:
            return False
        found = summary.statistics
        if found.message_count and not summary.chunk_indexes:
            return False
        for index in summary.chunk_indexes:
            channels = index.message_index_offsets.keys()
            if index.chunk_length < RECORD.size or index.chunk_start_offset + index.chunk_length > size:
                return False
            if not channels or not channels <= summary.channels.keys():
                return False
        self._chunks = summary.chunk_indexes
        self._schemas, self._channels = summary.schemas, summary.channels
        if found.message_count:
            self.content.add(found.channel_message_counts, found.message_start_time, found.message_end_time)
        return True

    def _scan(self) -> None:
        """Find topics and messages without a summary, by a scan from the start of the file."""
        scan = McapScan(self._file, self.path)
        for position in scan.damaged:
            self._warn_about_damage(position)
        for _, record in scan.topics:
            self._add_topic_record(record)
        for unit in scan.units:
            chunk = unit.chunk
            try:
                if not chunk.counts or any(topic + 1 not in self._channels for topic in chunk.counts):
                    chunk = replace(chunk, counts=self._counts_in(_chunk_index(chunk, unit.start)))
            except (BagError, OSError, *_DAMAGES):
                self._warn_about_damage(unit.start)
                continue
            self._chunks.append(_chunk_index(chunk, unit.start))
            counts = {topic + 1: number for topic, number in chunk.counts.items()}
            self.content.add(counts, *((chunk.start, chunk.end) if counts else (None, None)))
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(max(len(MAGIC), size - len(MAGIC)))
        self.whole = self._file.read() == MAGIC

    def _counts_in(self, index: ChunkIndex) -> dict[int, int]:
        """Count messages by topic index, for a chunk without MessageIndex or with topics inside."""
        counts: dict[int, int] = {}
        for opcode, content in chunk_records(self._record(index)):
            if opcode in _TOPIC_RECORDS:
                self._add_topic_record(_TOPIC_RECORDS[opcode](ReadDataStream(BytesIO(content))))
            elif opcode == MESSAGE:
                topic = message_of(content).topic
                counts[topic] = counts.get(topic, 0) + 1
        return counts

    def _add_topic_record(self, record: Schema | Channel) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        else:
            self._channels[record.id] = record

    def _record(self, index: ChunkIndex) -> bytes:
        self._file.seek(index.chunk_start_offset)
        return self._file.read(index.chunk_length)

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
        for chunk in sorted(self._chunks, key=lambda each: each.message_start_time):
            if wanted.isdisjoint(chunk.message_index_offsets):
                continue
            if chunk.message_start_time >= end or chunk.message_end_time < start:
                continue
            while pending and pending[0][0] < chunk.message_start_time:
                yield heapq.heappop(pending)[2]
            for message in self._messages(chunk):
                if message.topic + 1 in wanted and start <= message.stamp < end:
                    found = message._replace(topic=self._indices[message.topic + 1])
                    heapq.heappush(pending, (message.stamp, next(number), found))
        while pending:
            yield heapq.heappop(pending)[2]

    def _messages(self, index: ChunkIndex) -> list[BagMessage]:
        """Read the messages of a chunk, or of a lone Message record. If damaged, warn, and return no
        messages."""
        record = self._record(index)
        try:
            if record[:1] == bytes([MESSAGE]):
                return [message_of(memoryview(record)[RECORD.size :])]
            return chunk_messages(record)
        except BagError:
            self._warn_about_damage(index.chunk_start_offset)
            return []
