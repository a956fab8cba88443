"""One MCAP file of a bag: append chunks, finish with summary and footer, find what is whole in a file.

After each chunk stands a small record of our own (opcode 0x80; readers skip it), which says that the chunk is
whole and whether it ends a group. With it a file that was cut anywhere can be finished or continued.
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
from humansim_ros.bags.libraries import needs_libraries
from humansim_ros.bags.mcap_scan import DAMAGES, MAGIC, McapScan, mark, topic_of
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


def _encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def write_all(descriptor: int, buffers: Sequence[Buffer]) -> None:
    """Write buffers one after the other; a single call of the system writes up to 1024 of them."""
    views = [view for view in (memoryview(buffer).cast("B") for buffer in buffers) if view.nbytes]
    while views:
        written = os.writev(descriptor, views[:_MAX_BUFFERS])
        done = 0
        while done < len(views) and written >= views[done].nbytes:
            written -= views[done].nbytes
            done += 1
        views = views[done:]
        if written:
            views[0] = views[0][written:]


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
        position = self.size
        self._write(*chunk.buffers, mark(group, ends_group))
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
