"""Chunks of messages. A bag is encoded, compressed and appended chunk by chunk, and searched by chunks.

A chunk is an MCAP Chunk record with its MessageIndex records. Its bytes do not depend on its place in the
file, so that workers can encode chunks and one process appends them. The mcap library would copy the messages
four times (2.5 MB of images: 3.9 ms instead of 0.4 ms to encode, 2.7 ms instead of 0.4 ms to decode). So this
module encodes and decodes Chunk, Message and MessageIndex records itself.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias, get_args

from humansim_ros.data.bags.libraries import needs_libraries
from humansim_ros.errors import BagError

if TYPE_CHECKING:
    from zstandard import ZstdCompressor

#: Bytes in memory. A NumPy array or shared memory is passed as ``memoryview``.
Buffer: TypeAlias = bytes | bytearray | memoryview
Compression: TypeAlias = Literal["none", "zstd", "lz4"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)

#: To write directly to a disk, positions in files and memory must be aligned to this number of bytes.
BLOCK = 4096
MESSAGE, CHUNK, MESSAGE_INDEX = 0x05, 0x06, 0x07
#: Format of the start of every record: opcode and length.
RECORD = struct.Struct("<BQ")
#: Format of the head of a Chunk record: opcode, length, first and last time, size before compression,
#: checksum, length of the name of the compression.
_CHUNK_HEAD = struct.Struct("<BQQQQII")
_SIZE = struct.Struct("<Q")
#: Format of the head of a Message record: opcode, length, channel, sequence, log time, publish time.
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
#: ``_MESSAGE_HEAD`` without opcode and length.
_MESSAGE_CONTENT = struct.Struct("<HIQQ")
#: Format of the head of a MessageIndex record: opcode, length, channel, size of the entries. An entry is log
#: time and offset in the chunk, 8 bytes each.
_INDEX_HEAD = struct.Struct("<BQHI")
_INDEX_ENTRY = 16
#: Compression level of zstd. Level 3 would make rendered frames 12 % smaller, but take twice the time.
_ZSTD_LEVEL = 1
#: A chunk with a larger size in its head counts as damaged, since no program writes such chunks.
_MAX_CHUNK = 1 << 32


class BagMessage(NamedTuple):
    """A message of a bag. ``topic`` is the index in the topics of the bag, ``stamp`` the log time in
    nanoseconds, ``data`` the message in CDR with its header of 4 bytes, ``published`` the publish time (None
    if equal to the log time)."""

    topic: int
    stamp: int
    data: Buffer
    published: int | None = None


@dataclass(frozen=True)
class Chunk:
    """An encoded chunk.

    ``buffers`` are the bytes in their order: the Chunk record (``chunk_length`` bytes), then the MessageIndex
    records. ``start`` and ``end`` are the first and last log time, nanoseconds. ``counts`` has the number of
    messages by topic index.
    """

    buffers: tuple[Buffer, ...]
    chunk_length: int
    start: int
    end: int
    compression: str
    compressed_size: int
    uncompressed_size: int
    counts: Mapping[int, int]

    @property
    def size(self) -> int:
        """Size of the chunk, bytes."""
        return self.chunk_length + self.index_length

    @property
    def index_length(self) -> int:
        """Total size of the MessageIndex records, bytes."""
        return sum(length for _, length in self.index_lengths())

    def index_lengths(self) -> Iterator[tuple[int, int]]:
        """Yield topic index and size in bytes of each MessageIndex record, in their order."""
        for topic, count in self.counts.items():
            yield topic, _INDEX_HEAD.size + count * _INDEX_ENTRY

    def data(self) -> Buffer:
        """All bytes of the chunk in one buffer."""
        return self.buffers[0] if len(self.buffers) == 1 else b"".join(self.buffers)


def encode_chunk(messages: Sequence[BagMessage], compression: Compression = "none") -> Chunk:
    """Encode messages as one chunk.

    Without compression the data are not copied, so they must not change until the chunk has been appended.

    Args:
        messages: At least one message, in the order of their times.
        compression: ``none``, ``zstd`` or ``lz4``.

    Raises:
        HumansimError: The library of the compression is not installed.
    """
    parts: list[Buffer] = []
    entries: dict[int, list[tuple[int, int]]] = {}
    offset = crc = 0
    for topic, stamp, data, published in messages:
        view = memoryview(data).cast("B")
        length = _MESSAGE_HEAD.size + view.nbytes
        sent = stamp if published is None else max(0, published)  # headers can have times before 1970
        head = _MESSAGE_HEAD.pack(MESSAGE, length - RECORD.size, topic + 1, 0, stamp, sent)
        crc = zlib.crc32(view, zlib.crc32(head, crc))
        parts += (head, view)
        entries.setdefault(topic, []).append((stamp, offset))
        offset += length
    compressed_size = offset
    if compression != "none":
        compressed = _compress(parts, compression)
        parts, compressed_size = [compressed], len(compressed)
    name = b"" if compression == "none" else compression.encode()
    start, end = min(m.stamp for m in messages), max(m.stamp for m in messages)
    length = _CHUNK_HEAD.size + len(name) + _SIZE.size + compressed_size
    head = _CHUNK_HEAD.pack(CHUNK, length - RECORD.size, start, end, offset, crc, len(name))
    return Chunk(
        buffers=(head + name + _SIZE.pack(compressed_size), *parts, _index_records(entries)),
        chunk_length=length,
        start=start,
        end=end,
        compression=name.decode(),
        compressed_size=compressed_size,
        uncompressed_size=offset,
        counts={topic: len(entries[topic]) for topic in sorted(entries)},
    )


def _index_records(entries: Mapping[int, Sequence[tuple[int, int]]]) -> bytes:
    """Encode the MessageIndex records: one for each topic, with log time and offset of each message."""
    records = []
    for topic in sorted(entries):
        size = len(entries[topic]) * _INDEX_ENTRY
        records.append(
            _INDEX_HEAD.pack(MESSAGE_INDEX, _INDEX_HEAD.size - RECORD.size + size, topic + 1, size)
        )
        records.append(struct.pack(f"<{size // 8}Q", *chain.from_iterable(entries[topic])))
    return b"".join(records)


def _compress(parts: Sequence[Buffer], compression: Compression) -> bytes:
    data = b"".join(parts)
    if compression == "zstd":
        return _zstd_compressor(threading.get_ident()).compress(data)
    with needs_libraries():
        import lz4.frame

    compressed: bytes = lz4.frame.compress(data)
    return compressed


@lru_cache(maxsize=16)
def _zstd_compressor(thread: int) -> ZstdCompressor:
    """Compressor of a thread. Cached: threads must not share a compressor, and making one takes a fifth of
    the time of a chunk."""
    with needs_libraries():
        import zstandard

    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL)


def chunk_records(record: Buffer) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of the records in a Chunk record, after a check of sizes and checksum.

    ``record``: all bytes of the Chunk record. Without compression, contents are views of ``record``.

    Raises:
        BagError: The chunk is damaged, or its compression is not known.
    """
    whole = memoryview(record).cast("B")
    chunk, crc, position = read_chunk_head(whole)
    if whole.nbytes != chunk.chunk_length:
        raise BagError("a damaged chunk: it is not whole")
    data = _decompressed(whole[position:], chunk.compression, chunk.uncompressed_size)
    if data.nbytes != chunk.uncompressed_size or (crc and zlib.crc32(data) != crc):
        raise BagError("a damaged chunk: its size or its checksum is wrong")
    position = 0
    while position < data.nbytes:
        start = position + RECORD.size
        if start <= data.nbytes:
            opcode, length = RECORD.unpack_from(data, position)
            position = start + length
        if max(start, position) > data.nbytes:
            raise BagError("a damaged chunk: it ends within a record")
        yield opcode, data[start:position]


def message_of(content: memoryview) -> BagMessage:
    """Read a Message record. ``topic`` of the message is the number of the channel minus 1.

    Raises:
        BagError: The record is damaged.
    """
    if content.nbytes < _MESSAGE_CONTENT.size:
        raise BagError("a damaged message: its header is not whole")
    channel, _, stamp, published = _MESSAGE_CONTENT.unpack_from(content)
    return BagMessage(channel - 1, stamp, content[_MESSAGE_CONTENT.size :], published)


def chunk_messages(record: Buffer) -> list[BagMessage]:
    """Read the messages of a Chunk record, in the order of the record.

    Raises:
        BagError: The chunk is damaged, or its compression is not known.
    """
    return [message_of(content) for opcode, content in chunk_records(record) if opcode == MESSAGE]


#: This number of bytes contains the head of a Chunk record: names of compressions are shorter than 23 bytes.
HEAD_SIZE = 80


def read_chunk_head(record: Buffer) -> tuple[Chunk, int, int]:
    """Read the first ``HEAD_SIZE`` bytes of a Chunk record, or more.

    Returns:
        The chunk without bytes and counts, its checksum, and the position of its records.

    Raises:
        BagError: The head is damaged.
    """
    try:
        _, length, start, end, size, crc, name_length = _CHUNK_HEAD.unpack_from(record)
        name = bytes(record[_CHUNK_HEAD.size : _CHUNK_HEAD.size + name_length]).decode()
        (compressed_size,) = _SIZE.unpack_from(record, _CHUNK_HEAD.size + name_length)
    except (struct.error, UnicodeDecodeError):
        raise BagError("a damaged chunk: its header is not whole") from None
    position = _CHUNK_HEAD.size + name_length + _SIZE.size
    if start > end or size > _MAX_CHUNK or position + compressed_size != RECORD.size + length:
        raise BagError("a damaged chunk: its header is wrong")
    return Chunk((), RECORD.size + length, start, end, name, compressed_size, size, {}), crc, position


def read_index_head(record: Buffer) -> tuple[int, int]:
    """Read topic index and number of messages from the first bytes of a MessageIndex record."""
    _, _, channel, size = _INDEX_HEAD.unpack_from(record)
    return channel - 1, size // _INDEX_ENTRY


def _decompressed(data: memoryview, compression: str, size: int) -> memoryview:
    if not compression:
        return data
    with needs_libraries():
        import lz4.frame
        import zstandard
    try:
        if compression == "zstd":
            if zstandard.frame_content_size(data) > size:
                raise BagError("a damaged chunk: its size is wrong")
            return memoryview(zstandard.ZstdDecompressor().decompress(data, max_output_size=size))
        if compression == "lz4":
            return memoryview(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError):
        raise BagError("a damaged chunk: it cannot be decompressed") from None
    raise BagError(f"chunks are compressed with {compression!r}; only zstd and lz4 are known")
