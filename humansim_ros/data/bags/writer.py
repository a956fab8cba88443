"""Write a bag of rosbag2: append encoded chunks, split the bag into files, and update ``metadata.yaml``.

An interrupted bag can be finished or continued.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, cast

from humansim_ros import __version__
from humansim_ros.data.bags.chunks import COMPRESSIONS, BagMessage, Chunk, Compression
from humansim_ros.data.bags.libraries import needs_libraries
from humansim_ros.data.bags.metadata import (
    SUFFIXES,
    Content,
    Storage,
    custom_in,
    metadata_text,
    read_metadata,
    topics_in,
    write_metadata,
)
from humansim_ros.data.bags.topics import BagTopic, check_topics, described, qos_text
from humansim_ros.errors import BagError

with needs_libraries():
    from mcap.writer import CompressionType, Writer

if TYPE_CHECKING:
    from humansim_ros.data.bags.mcap_file import GroupFile
    from humansim_ros.data.bags.sqlite_file import SqliteFile

#: Seconds between updates of metadata.yaml.
_RENEWAL = 1.0
#: Exceptions that writing a file of a bag may raise.
_ERRORS = (OSError, sqlite3.Error)
#: Error numbers that mean a full disk.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: When the disk is full, this number of bytes is freed first, for the summary and metadata.yaml.
_SPARE = 1 << 14

#: A chunk ends when it is larger than this, bytes. rosbag2 writes chunks of the same size.
_CHUNK_SIZE = 768 << 10
_COMPRESSION_TYPES: dict[Compression, CompressionType] = {
    "none": CompressionType.NONE,
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
}


class McapFile:
    """An MCAP file that is being written. The same topics and messages give the same bytes.

    Use it in a ``with`` block, or call :meth:`close`. If a ``with`` block ends with an error, the file stays
    unfinished: it has its complete chunks, but no summary.

    Args:
        path: The file. An existing file is replaced.
        topics: Topics, with the definitions of their types. Messages refer to a topic by its index.
        compression: Compression of the chunks.
        profile: MCAP profile; empty for a file that no ROS program reads.

    Attributes:
        topics: All topics, also those of :meth:`add_topic`.
        content: Numbers and times of all messages so far.

    Raises:
        OSError: Raised by all methods if the file cannot be written.
    """

    def __init__(
        self, path: Path, topics: Sequence[BagTopic], compression: Compression = "none", profile: str = "ros2"
    ) -> None:
        self.topics: list[BagTopic] = []
        self.content = Content()
        self._schemas: dict[str, int] = {}
        self._file = path.open("wb")
        self._writer = Writer(self._file, _CHUNK_SIZE, _COMPRESSION_TYPES[compression])
        self._writer.start(profile, f"humansim_ros {__version__}")
        for topic in topics:
            self.add_topic(topic)

    @property
    def size(self) -> int:
        """Size of the complete chunks so far, bytes."""
        return self._file.tell()

    def add_topic(self, topic: BagTopic) -> int:
        """Add a topic. Returns its index for messages."""
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, topic.encoding, topic.definition.encode()
            )
        metadata = {"offered_qos_profiles": qos_text(topic), "topic_type_hash": topic.type_hash}
        self._writer.register_channel(
            topic.name,
            topic.serialization,
            self._schemas[topic.type],
            metadata if topic.serialization == "cdr" else {},
        )
        self.topics.append(topic)
        return len(self.topics) - 1

    def write(self, messages: Sequence[BagMessage]) -> None:
        """Add messages, in the order of their times. They are in the file when their chunk is complete."""
        for topic, stamp, data, published in messages:
            sent = stamp if published is None else max(0, published)  # headers can have times before 1970
            # the library copies any buffer, although it declares bytes
            self._writer.add_message(topic + 1, stamp, cast(bytes, data), sent)
            self.content.add({topic: 1}, stamp, stamp)

    def flush(self) -> None:
        """Complete the chunk, so that all messages are in the file even if the process is killed."""
        self._writer.flush()

    def close(self) -> Content:
        """Write summary and footer, and close the file. Returns numbers and times of all messages. Further
        calls do nothing."""
        if not self._file.closed:
            with self._file:
                self._writer.finish()
        return self.content

    def __enter__(self) -> McapFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        self._file.close()


def _file_class(storage: Storage) -> type[GroupFile] | type[SqliteFile]:
    """Class that writes the files of a storage format.

    Raises:
        BagError: There is no such storage, or the libraries of bags are not installed.
    """
    if storage not in SUFFIXES:
        raise BagError(f"{storage!r} is no storage of bags; choose one of {', '.join(SUFFIXES)}")
    with needs_libraries():
        import rosbags.typesys  # noqa: F401

        from humansim_ros.data.bags.mcap_file import GroupFile
        from humansim_ros.data.bags.sqlite_file import SqliteFile
    return GroupFile if storage == "mcap" else SqliteFile


def _lock_bag(folder: Path) -> int:
    """Lock a bag for this process. Close the returned descriptor to unlock it.

    Raises:
        BagError: Another process writes the bag.
        OSError: The folder cannot be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise BagError("another process is writing this bag", path=folder) from None
    except OSError:  # the file system has no locks
        pass
    return descriptor


def check_unlocked(folder: Path) -> None:
    """Check that no other process writes a bag. Raises BagError."""
    with _unwritable(folder):
        os.close(_lock_bag(folder))


def _files(folder: Path, suffix: str) -> tuple[str, list[Path]]:
    """Find the files of a bag. Returns the common prefix of their names, and the files in order. Raises
    BagError if there are none."""
    found: dict[str, dict[int, Path]] = {}
    for path in folder.glob(f"*{suffix}"):
        if match := re.fullmatch(r"(.+)_(\d+)", path.stem):
            found.setdefault(match[1], {})[int(match[2])] = path
    for prefix, paths in found.items():
        if len(found) == 1 and sorted(paths) == list(range(len(paths))):
            return prefix, [paths[number] for number in range(len(paths))]
    raise BagError("there is no bag to continue here; remove the folder, and record again", path=folder)


@contextmanager
def _unwritable(folder: Path) -> Iterator[None]:
    """Convert errors of writing to BagError."""
    try:
        yield
    except _ERRORS as reason:
        raise BagError(_text(reason), path=folder) from None


def _text(reason: Exception) -> str:
    return f"cannot be written: {getattr(reason, 'strerror', None) or reason}"


class BagWriter:
    """Writer of a bag.

    Use it in a ``with`` block, or call :meth:`close`. A bag keeps the chunks that have been appended,
    whatever happens to the process: if it is killed, BagReader reads the bag, and :meth:`resume` continues or
    finishes it. All methods must be called in one thread. Start other processes by ``spawn`` or
    ``forkserver``, since processes of ``fork`` keep the bag locked.

    Args:
        folder: Folder of the bag. It is created.
        topics: Topics. Messages refer to a topic by its index here. Missing definitions are looked up.
        storage: ``mcap`` or ``sqlite3``.
        compression: Compression of the chunks. sqlite3 files have none.
        max_size: When a file has this size, bytes, the next group begins a new file. If 0, never.
        max_duration: When a file has this duration, seconds, the next group begins a new file. If 0, never.
        custom: Texts for ``custom_data`` of metadata.yaml. ``writer.custom`` can be changed until the end.

    Attributes:
        folder: Absolute path of the folder.
        groups: Number of complete groups in the bag.

    Raises:
        BagError: The folder exists or cannot be created, or an option or a topic is wrong.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        topics: Sequence[BagTopic] = (),
        *,
        storage: Storage = "mcap",
        compression: Compression = "none",
        max_size: int = 0,
        max_duration: float = 0.0,
        custom: Mapping[str, str] | None = None,
    ) -> None:
        self._file_class = _file_class(storage)
        if compression not in COMPRESSIONS:
            raise BagError(
                f"{compression!r} is no compression of chunks; choose one of {', '.join(COMPRESSIONS)}"
            )
        if storage == "sqlite3" and compression != "none":
            raise BagError("files of sqlite3 are not compressed; choose the storage mcap", path=folder)
        check_topics(topics)
        topics = [described(topic) for topic in topics]
        self._set_limits(max_size, max_duration)
        self.folder, self._storage = Path(folder).resolve(), storage
        self._prefix, self.groups, self.custom = self.folder.name, 0, dict(custom or {})
        with _unwritable(self.folder):
            try:
                self.folder.mkdir(parents=True)
            except FileExistsError:
                raise BagError("this path exists; choose another name for the bag", path=folder) from None
            try:
                self._lock = _lock_bag(self.folder)
                self._done: list[tuple[str, Content]] = []
                self._file = self._file_class.create(self._path(0), topics)
                self._begin()
            except BaseException:
                shutil.rmtree(self.folder, ignore_errors=True)
                raise

    @classmethod
    def resume(
        cls, folder: str | os.PathLike[str], *, max_size: int = 0, max_duration: float = 0.0
    ) -> BagWriter:
        """Continue an interrupted or a finished bag after its last complete group.

        ``groups``, ``topics``, ``end`` and ``custom`` of the writer describe the existing content of the bag.
        With the same limits and the same chunks as before, the bag becomes the same as without interruption.

        Args:
            folder: Folder of the bag.
            max_size: The same as for a new bag.
            max_duration: The same as for a new bag.

        Raises:
            BagError: There is no bag of humansim, another process writes it, or the bag is damaged.
        """
        writer = cls.__new__(cls)
        writer.folder = Path(folder).resolve()
        if not writer.folder.is_dir():
            raise BagError("there is no bag to continue here", path=folder)
        with _unwritable(writer.folder):
            writer._lock = _lock_bag(writer.folder)
            try:
                writer._reopen()
                writer._set_limits(max_size, max_duration)
                writer._begin()
            except BaseException:
                os.close(writer._lock)
                raise
        return writer

    def _set_limits(self, max_size: int, max_duration: float) -> None:
        smallest = self._file_class.smallest
        if max_size != 0 and max_size < smallest:
            raise BagError(f"must be 0 (never split) or at least {smallest} bytes", key="max_size")
        if not max_duration >= 0:
            raise BagError("must be 0 (never split) or a number of seconds", key="max_duration")
        self._max_size, self._max_duration = max_size, round(max_duration * 1e9)

    def _begin(self) -> None:
        self._in_group = self._closed = self._torn = False
        self._renewed = time.monotonic()
        self._write_metadata()

    def _reopen(self, spare: int = 0) -> None:
        """Open the files to continue them after their last complete group.

        ``spare``: to free disk space, remove groups with at least this number of bytes from the end.

        Raises:
            BagError: The folder holds no bag of humansim, or the bag is damaged.
            OSError: A file cannot be written.
        """
        information = read_metadata(self.folder)
        self.custom = custom_in(information)
        self._storage = "sqlite3" if information.get("storage_identifier") == "sqlite3" else "mcap"
        self._prefix, paths = _files(self.folder, SUFFIXES[self._storage])
        self._file_class = _file_class(self._storage)
        for path in self.folder.glob(".*.new"):
            path.unlink()
        while True:
            self._file, groups = self._file_class.reopen(paths[-1], spare=spare)
            if groups is not None:
                break
            # without messages; perhaps not even the topics are complete
            self._file.close()
            paths[-1].unlink()
            if len(paths) == 1:
                topics = max(self._file.topics, topics_in(information), key=len)
                self._file = self._file_class.create(paths[0], [described(topic) for topic in topics])
                break
            paths.pop()
            spare = 0
        self.groups = groups or 0
        try:
            self._done = [(path.name, self._file_class.content_of(path)) for path in paths[:-1]]
        except BaseException:
            self._file.close()
            raise

    def _path(self, number: int) -> Path:
        return self.folder / f"{self._prefix}_{number}{SUFFIXES[self._storage]}"

    def _write_metadata(self) -> None:
        files = [*self._done, (self._file.path.name, self._file.content)]
        write_metadata(self.folder, metadata_text(self._storage, self._file.topics, files, self.custom))

    @property
    def topics(self) -> Sequence[BagTopic]:
        """Topics of the bag."""
        return tuple(self._file.topics)

    @property
    def end(self) -> int | None:
        """Newest log time in nanoseconds; None in an empty bag."""
        contents = [*(content for _, content in self._done), self._file.content]
        return max((content.end for content in contents if content.end is not None), default=None)

    @property
    def size(self) -> int:
        """Size in bytes of the file that is being written."""
        return self._file.size

    def add_topic(self, topic: BagTopic) -> int:
        """Add a topic. Returns its index for messages.

        Raises:
            BagError: The name or type is wrong, the bag has the topic, or the disk is full.
        """
        check_topics([*self.topics, topic])
        topic = described(topic)
        with self._writing():
            self._file.add_topic(topic)
        self.sync()
        return len(self.topics) - 1

    def append(self, chunk: Chunk, *, ends_group: bool = True) -> None:
        """Append a chunk. Its bytes are passed to the system at once, so they may change after the call.

        Args:
            chunk: Encoded messages. Chunks must come in the order of their times.
            ends_group: Whether the chunk is the last of its group. If False, the next chunk belongs to the
                same group, for example with another camera of the frame. Files are split, and bags are
                continued, only between groups.

        Raises:
            BagError: The disk is full. The bag is finished with the previous groups.
        """
        with self._writing():
            if not self._in_group and self._is_full(chunk.end):
                self._split()
            self._file.append(chunk, self.groups, ends_group)
            self._in_group = not ends_group
            self.groups += ends_group
        if time.monotonic() - self._renewed > _RENEWAL:
            self.sync()

    def _is_full(self, end: int) -> bool:
        start = self._file.content.start
        if start is None:
            return False
        return 0 < self._max_duration < end - start or 0 < self._max_size <= self._file.size

    def _split(self) -> None:
        """Finish the file, and begin the next one."""
        self._file.finish()
        following = self._file_class.create(self._path(len(self._done) + 1), self._file.topics)
        self._done.append((self._file.path.name, self._file.content))
        self._file = following
        self._write_metadata()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Context for writing to the files. If that fails, finish the bag after its last complete group."""
        if self._closed:
            raise BagError("the bag is closed", path=self.folder)
        try:
            yield
        except _ERRORS as reason:
            self._torn = True
            with suppress(BagError):
                self.close()
            text = f"{_text(reason)}; the bag ends after {self.groups} whole groups of messages"
            raise BagError(text, path=self.folder) from None
        except BaseException:  # such as KeyboardInterrupt
            self._torn = True
            raise

    def sync(self) -> None:
        """Update metadata.yaml. This also happens every second while chunks are appended.

        Raises:
            BagError: The disk is full. The bag is finished with the previous groups.
        """
        self._renewed = time.monotonic()
        with self._writing():
            self._write_metadata()

    def close(self) -> None:
        """Finish the bag. Further calls do nothing. If the call is interrupted, :meth:`resume` can finish the
        bag.

        Raises:
            BagError: The disk is full. The bag has only the groups that fit.
        """
        if self._closed:
            return
        self._closed = True
        try:
            with _unwritable(self.folder):
                if self._torn:
                    self._finish_again()
                    return
                try:
                    self._finish()
                except _ERRORS:
                    self._finish_again()
                    raise
        finally:
            os.close(self._lock)

    def _finish(self) -> None:
        self._file.finish()
        self._write_metadata()

    def _finish_again(self) -> None:
        """Finish the bag after an error: open its files again, and finish them. If the disk is full, groups
        are removed until there is space."""
        custom, spare = self.custom, 0
        while True:
            self._file.close()
            self._reopen(spare)
            self.custom = custom
            try:
                self._finish()
                return
            except OSError as reason:
                if reason.errno not in _FULL or self.groups == 0:
                    raise
                spare = max(_SPARE, 2 * spare)
            finally:
                with suppress(OSError):
                    self._file.close()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
