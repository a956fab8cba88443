"""One MCAP file of a bag: append chunks, finish with summary and footer, find what is whole in a file.

After each chunk stands a small record of our own (opcode 0x80; readers skip it), which says that the chunk is
whole and whether it ends a group. With it a file that was cut anywhere can be finished or continued.

Large chunks begin and end at whole blocks of the file, so that they can be written directly. This depends on
their sizes alone: the bytes of a file are the same wherever it is written.
"""

from __future__ import annotations

import os
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, ClassVar

from humansim_ros import __version__
from humansim_ros.bags.chunks import Buffer, Chunk
from humansim_ros.bags.direct_file import BLOCK, DirectFile
from humansim_ros.bags.libraries import needs_libraries
from humansim_ros.bags.mcap_scan import DAMAGES, MAGIC, MARK_SIZE, McapScan, mark, padding, topic_of
from humansim_ros.bags.metadata import Content
from humansim_ros.bags.topics import BagTopic, qos_text
from humansim_ros.errors import BagError
from humansim_ros.io.files import ANY_SIZE, open_file

with needs_libraries():
    from mcap.data_stream import RecordBuilder
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

#: Bytes of the index that are kept in memory; the rest goes to a file without name in the folder of the bag.
_INDEX_IN_MEMORY = 1 << 22
_MAX_BUFFERS = 1024
#: Bytes from which a chunk is aligned: the space between such chunks is 0.2 % of them on average at most.
LARGE_CHUNK = 1 << 20


def _encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def write_all(descriptor: int, buffers: Sequence[Buffer]) -> None:
    """Write buffers one after the other; a single call of the system writes up to 1024 of them."""
    views = _after([memoryview(buffer).cast("B") for buffer in buffers], 0)
    while views:
        views = _after(views, os.writev(descriptor, views[:_MAX_BUFFERS]))


def _after(views: Sequence[memoryview], written: int) -> list[memoryview]:
    """What is left of buffers when so many bytes of them are written; none is empty."""
    left = []
    for view in views:
        skipped = min(written, view.nbytes)
        written -= skipped
        if skipped < view.nbytes:
            left.append(view[skipped:])
    return left


class McapFile:
    """An MCAP file that is being written. Topics have the channel numbers 1, 2 … in their order.

    Raises:
        OSError: By all methods, if the file cannot be written.
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
    def create(cls, path: Path, topics: Sequence[BagTopic]) -> McapFile:
        """Create a file with its header and topics; it gets its name when these are whole."""
        file = cls(path)
        temporary = path.with_name(f".{path.name}.new")
        try:
            file._descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
            header = Header(profile="ros2", library=f"humansim_ros {__version__}")
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
    def reopen(cls, path: Path, *, whole_groups: bool, spare: int = 0) -> tuple[McapFile, int | None]:
        """Open a file to continue it; see :class:`BagFile`."""
        file = cls(path)
        try:
            file._descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
            if os.fstat(file._descriptor).st_size < len(MAGIC):  # after a loss of power
                return file, None
            with os.fdopen(os.dup(file._descriptor), "rb") as content:
                scan = McapScan(content, path)
            kept = scan.units
            most = kept[-1].end - spare if kept else 0
            while kept and (kept[-1].end > most or (whole_groups and not kept[-1].ends_group)):
                kept.pop()
            file._cut(kept[-1].end if kept else scan.head_end)
            file._schemas, file._channels = scan.topic_records(file.size)
            by_id = {schema.id: schema for schema in file._schemas.values()}
            file.topics = [topic_of(channel, by_id) for channel in file._channels]
            for unit in kept:
                file._count(unit.chunk, unit.start)
        except BaseException:
            file.close()
            raise
        return file, kept[-1].group + kept[-1].ends_group if kept else None

    def _cut(self, size: int) -> None:
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self.size = size

    def _write(self, *buffers: Buffer) -> None:
        try:
            write_all(self._descriptor, buffers)
        except BaseException:
            self._cut(self.size)
            raise
        self.size += sum(memoryview(buffer).nbytes for buffer in buffers)

    def _write_directly(self, buffers: Sequence[Buffer]) -> None:
        """Write whole blocks to a place that is aligned."""
        if self._direct is None:
            self._direct = DirectFile(self._descriptor)
        views = [memoryview(buffer).cast("B") for buffer in buffers]
        size = sum(view.nbytes for view in views)
        try:
            written = self._direct.write(views, self.size)
            os.lseek(self._descriptor, self.size + written, os.SEEK_SET)
            if written < size:
                write_all(self._descriptor, _after(views, written))
        except BaseException:
            self._cut(self.size)
            raise
        self.size += size

    @classmethod
    def content_of(cls, path: Path) -> Content:
        """Content of a finished file, from its summary; see :class:`BagFile`."""
        try:
            with open_file(path, BagError, "bag", ANY_SIZE) as file:
                return content_in(file, path)
        except OSError:
            raise _damaged(path) from None

    def add_topic(self, topic: BagTopic) -> None:
        """Add a topic after those that exist."""
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
            message_encoding="cdr",
            schema_id=schema.id,
            metadata={"offered_qos_profiles": qos_text(topic), "topic_type_hash": topic.type_hash},
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
            space = -(chunk.size + MARK_SIZE) % BLOCK
            self._write_directly([*chunk.buffers, mark(group, ends_group, space)])
        except BaseException:
            self._cut(before)
            raise
        self._count(chunk, position)

    def _count(self, chunk: Chunk, position: int) -> None:
        offsets, offset = {}, position + chunk.chunk_length
        for topic, length in chunk.index_lengths():
            offsets[topic + 1] = offset
            offset += length
        index = ChunkIndex(
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
        self._index.write(_encoded(index))
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
        offset_start = self.size
        tail = _encoded(*offsets)
        footer = Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=0)
        # the checksum covers the footer up to its own place
        crc = zlib.crc32(_encoded(footer)[:-4], zlib.crc32(tail, crc))
        footer.summary_crc = crc
        self._write(tail + _encoded(footer) + MAGIC)
        self.close()

    def _index_parts(self) -> Iterator[bytes]:
        self._index.seek(0)
        while part := self._index.read(_INDEX_IN_MEMORY):
            yield part

    def close(self) -> None:
        """Close the file as it is."""
        if self._descriptor >= 0:
            if self._direct is not None:
                self._direct.close()
            os.close(self._descriptor)
            self._descriptor = -1
            self._index.close()


def content_in(file: BinaryIO, path: str | os.PathLike[str]) -> Content:
    """Content of a finished file of ours, which need not be on a disk of this machine.

    Raises:
        BagError: The summary of the file, which the error calls ``path``, is damaged.
    """
    try:
        summary = SeekingReader(file).get_summary()
    except (OSError, *DAMAGES):
        summary = None
    if summary is None or summary.statistics is None:
        raise _damaged(path)
    found = summary.statistics
    counts = {channel - 1: count for channel, count in found.channel_message_counts.items()}
    return Content(counts, found.message_start_time, found.message_end_time)


def _damaged(path: str | os.PathLike[str]) -> BagError:
    return BagError("the summary of this file is damaged; it cannot be continued", path=path)
