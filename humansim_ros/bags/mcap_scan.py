"""Find what is whole in an MCAP file that may end anywhere: topics, chunks, marks after our chunks."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from humansim_ros.bags.chunks import (
    HEAD_SIZE,
    INDEX_HEAD_SIZE,
    RECORD,
    Chunk,
    ChunkHead,
    index_count,
)
from humansim_ros.bags.libraries import needs_libraries
from humansim_ros.bags.topics import BagTopic, qos_of_text
from humansim_ros.errors import BagError

with needs_libraries():
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.records import Channel, Schema

MAGIC = b"\x89MCAP0\r\n"
#: Opcode of the record after each chunk; from 0x80 on, opcodes are free for applications.
MARK = 0x80
#: Opcode of the record that fills the space before a chunk that must be aligned.
PADDING = 0x81
#: Name, number of the group, whether the chunk is the last of the group.
_MARK = struct.Struct("<8sQB")
_MARK_NAME = b"humansim"
#: Errors of reading damaged records.
DAMAGES = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError, MemoryError)


#: Bytes of the record after a chunk.
MARK_SIZE = RECORD.size + _MARK.size


def mark(group: int, ends_group: bool, space: int = 0) -> bytes:
    """The record after a chunk: the chunk is whole, and belongs to a group; ``space``: zeros at its end."""
    return RECORD.pack(MARK, _MARK.size + space) + _MARK.pack(_MARK_NAME, group, ends_group) + bytes(space)


def padding(position: int, block: int) -> bytes:
    """The record that fills the space from a position to a multiple of ``block``; nothing is in place."""
    space = -position % block
    if space == 0:
        return b""
    if space < RECORD.size:
        space += block
    return RECORD.pack(PADDING, space - RECORD.size) + bytes(space - RECORD.size)


class Place(NamedTuple):
    """A record in a file: ``position`` of its opcode, and ``length`` of its content."""

    opcode: int
    position: int
    length: int

    @property
    def end(self) -> int:
        """Position after the record."""
        return self.position + RECORD.size + self.length


def places(file: BinaryIO, path: Path) -> Iterator[Place]:
    """Places of the records that are whole, from the start of a file to the end of its data.

    Raises:
        BagError: The file is no MCAP file.
    """
    size = os.fstat(file.fileno()).st_size
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise BagError("this is no MCAP file", path=path)
    position = len(MAGIC)
    while position + RECORD.size <= size:
        file.seek(position)
        head = file.read(RECORD.size)
        if len(head) < RECORD.size:  # the file has been cut meanwhile
            return
        place = Place(*_fields(head, position))
        # zero: space without content, as after a loss of power
        if place.opcode in (0, Opcode.DATA_END, Opcode.FOOTER) or place.end > size:
            return
        yield place
        position = place.end


def _fields(head: bytes, position: int) -> tuple[int, int, int]:
    opcode, length = RECORD.unpack(head)
    return opcode, position, length


class Unit(NamedTuple):
    """A whole chunk with its mark, from ``start`` to ``end`` in the file; ``chunk`` has no bytes."""

    chunk: Chunk
    group: int
    ends_group: bool
    start: int
    end: int


class McapScan:
    """What is whole in an MCAP file that BagWriter has begun.

    Raises:
        BagError: The file cannot be read, is no MCAP file, or was written by another program.
    """

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._topics: list[tuple[Place, Schema | Channel]] = []
        self.units: list[Unit] = []
        #: Position after the records before the first unit.
        self.head_end = len(MAGIC)
        try:
            self._read(file, path)
        except OSError as reason:
            raise BagError(f"cannot be read: {reason.strerror or reason}", path=path) from None
        except DAMAGES:
            raise BagError("the topics of this file are damaged", path=path) from None

    def _read(self, file: BinaryIO, path: Path) -> None:
        chunk: tuple[Place, ChunkHead] | None = None
        counts: dict[int, int] = {}
        for place in places(file, path):
            file.seek(place.position)
            if place.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                content = file.read(RECORD.size + place.length)[RECORD.size :]
                self._topics.append((place, topic_record(place.opcode, content)))
            elif place.opcode == Opcode.CHUNK:
                chunk, counts = (place, ChunkHead.read(file.read(HEAD_SIZE))), {}
            elif place.opcode == Opcode.MESSAGE_INDEX:
                topic, count = index_count(file.read(INDEX_HEAD_SIZE))
                counts[topic] = count
            elif place.opcode == MARK and chunk is not None:
                file.seek(RECORD.size, os.SEEK_CUR)
                name, group, ends_group = _MARK.unpack(file.read(_MARK.size))
                if name == _MARK_NAME:
                    described = _chunk(*chunk, counts)
                    self.units.append(Unit(described, group, bool(ends_group), chunk[0].position, place.end))
                chunk = None
            elif place.opcode == PADDING:
                continue  # it belongs to the chunk that follows
            elif place.opcode == Opcode.HEADER:
                pass
            else:
                raise BagError("this file was not written by humansim: it cannot be continued", path=path)
            if not self.units and chunk is None:
                self.head_end = place.end

    def topic_records(self, end: int) -> tuple[dict[str, Schema], list[Channel]]:
        """Schemas by the name of the type, and channels, up to a position in the file."""
        records = [record for place, record in self._topics if place.end <= end]
        schemas = {record.name: record for record in records if isinstance(record, Schema)}
        return schemas, [record for record in records if isinstance(record, Channel)]


def _chunk(place: Place, head: ChunkHead, counts: dict[int, int]) -> Chunk:
    return Chunk(
        buffers=(),
        chunk_length=place.end - place.position,
        start=head.start,
        end=head.end,
        compression=head.compression,
        compressed_size=head.compressed_size,
        uncompressed_size=head.uncompressed_size,
        counts=counts,
    )


def topic_record(opcode: int, content: bytes) -> Schema | Channel:
    """Read the content of a Schema or Channel record. Raises one of ``DAMAGES`` if it is damaged."""
    stream = ReadDataStream(BytesIO(content))
    record: Schema | Channel
    record = Schema.read(stream) if opcode == Opcode.SCHEMA else Channel.read(stream)
    return record


def topic_of(channel: Channel, schemas: dict[int, Schema]) -> BagTopic:
    """The topic of a channel."""
    schema = schemas.get(channel.schema_id)
    return BagTopic(
        name=channel.topic,
        type="" if schema is None else schema.name,
        qos=qos_of_text(channel.metadata.get("offered_qos_profiles", "")),
        definition="" if schema is None else schema.data.decode("utf-8", "replace"),
        type_hash=channel.metadata.get("topic_type_hash", ""),
    )
