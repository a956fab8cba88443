"""Write MCAP files and bags of rosbag2 by the mcap library."""

from __future__ import annotations

import fcntl
import os
import shutil
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TypeAlias, cast, get_args

from humansim_ros.data.bags.libraries import needs_libraries
from humansim_ros.data.bags.metadata import (
    SUFFIXES,
    Content,
    Storage,
    custom_in,
    metadata_text,
    read_metadata,
    write_metadata,
)
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.sqlite_file import write_sqlite
from humansim_ros.data.bags.topics import BagMessage, BagTopic, check_topics, described, qos_text
from humansim_ros.errors import BagError, HumansimWarning
from humansim_ros.files.reading import package_version

Compression: TypeAlias = Literal["none", "zstd", "lz4"]
#: Warning about the storage sqlite3.
SQLITE_DEPRECATED = (
    "writing of sqlite3 bags is deprecated, and 0.4.0 removes it; `ros2 bag convert` converts MCAP bags"
)
#: A chunk ends when it is larger than this, bytes. rosbag2 writes chunks of the same size.
_CHUNK_SIZE = 768 << 10
#: Smallest size at which a bag can be split, bytes.
_SMALLEST = 1024
#: Seconds between updates of metadata.yaml.
_RENEWAL = 1.0


class McapFile:
    """An MCAP file that is being written. The same topics and messages give the same bytes.

    Use it in a ``with`` block, or call :meth:`close`. A ``with`` block that ends with an error leaves the
    complete chunks, but no summary.

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
        with needs_libraries():
            from mcap.writer import CompressionType, Writer

        self.topics: list[BagTopic] = []
        self.content = Content()
        self._schemas: dict[str, int] = {}
        self._file = path.open("wb")
        self._writer = Writer(self._file, _CHUNK_SIZE, CompressionType[compression.upper()])
        self._writer.start(profile, f"humansim_ros {package_version()}")
        self._writer.flush()  # from now on it is an MCAP file
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

    def abandon(self) -> None:
        """Close the file after an error. It keeps its complete chunks, but has no summary."""
        with suppress(OSError):
            self._file.close()

    def __enter__(self) -> McapFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        self.abandon()


def encode_chunk(messages: Sequence[BagMessage], compression: Compression = "none") -> list[BagMessage]:
    """Deprecated: BagWriter makes chunks of messages itself. Returns the messages."""
    text = "encode_chunk is deprecated: give messages to BagWriter.write; 0.4.0 removes it"
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return list(messages)


class BagWriter:
    """Writer of a bag of rosbag2.

    Use it in a ``with`` block, or call :meth:`close`. Whatever happens to the process, BagReader reads the
    bag up to its last complete chunk, and :meth:`resume` continues it. All methods must be called in one
    thread. Start other processes by ``spawn`` or ``forkserver``, since processes of ``fork`` keep the bag
    locked.

    Args:
        folder: Folder of the bag. It is created.
        topics: Topics. Messages refer to a topic by its index here. Missing definitions are looked up.
        storage: ``mcap``; or ``sqlite3`` (deprecated): :meth:`close` converts the bag to one sqlite3 file.
        compression: Compression of the chunks. sqlite3 files have none.
        max_size: When a file has this size, bytes, a new file begins. If 0, never.
        max_duration: When a file has this duration, seconds, a new file begins. If 0, never.
        custom: Texts for ``custom_data`` of metadata.yaml. ``writer.custom`` can be changed until the end.
        resume: Whether to continue an existing bag, as :meth:`resume` does.

    Attributes:
        folder: Absolute path of the folder.

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
        resume: bool = False,
    ) -> None:
        _check_options(storage, compression, max_size, max_duration)
        check_topics(topics)
        self.folder, self._storage, self._compression = Path(folder).resolve(), storage, compression
        self._max_size, self._max_duration = max_size, round(max_duration * 1e9)
        self.custom, self._closed = dict(custom or {}), False
        topics = [described(topic) for topic in topics]
        #: Name and content of the files before the last one.
        self._done: list[tuple[str, Content]] = []
        with _unwritable(self.folder):
            if not resume:
                try:
                    self.folder.mkdir(parents=True)
                except FileExistsError:
                    raise BagError("this path exists; choose another name for the bag", path=folder) from None
            self._lock = _lock_bag(self.folder)
            try:
                if resume:
                    self.custom = custom_in(read_metadata(self.folder))
                    topics, self._done = _finished(self.folder, compression)
                self._begin(topics)
            except BaseException:
                os.close(self._lock)
                if not resume:
                    shutil.rmtree(self.folder, ignore_errors=True)
                raise

    @classmethod
    def resume(cls, folder: str | os.PathLike[str], **options: Any) -> BagWriter:
        """Continue an interrupted or a finished bag with a new file. Files that were not finished are
        finished. ``topics``, ``end`` and ``custom`` of the writer describe the existing content of the bag.

        Args:
            folder: Folder of the bag.
            options: ``compression``, ``max_size`` and ``max_duration``, as for a new bag.

        Raises:
            BagError: There is no MCAP bag, or another process writes it.
        """
        return cls(folder, **options, resume=True)

    def _begin(self, topics: Sequence[BagTopic]) -> None:
        """Begin the next file."""
        self._file = McapFile(self._path(len(self._done)), topics, self._compression)
        self._write_metadata()

    def _path(self, number: int) -> Path:
        return self.folder / f"{self.folder.name}_{number}.mcap"

    def _write_metadata(self) -> None:
        self._renewed = time.monotonic()
        files = [*self._done, (self._path(len(self._done)).name, self._file.content)]
        write_metadata(self.folder, metadata_text("mcap", self._file.topics, files, self.custom))

    @property
    def topics(self) -> Sequence[BagTopic]:
        """Topics of the bag."""
        return tuple(self._file.topics)

    @property
    def end(self) -> int | None:
        """Newest log time in nanoseconds; None in an empty bag."""
        contents = [*(content for _, content in self._done), self._file.content]
        return max((content.end for content in contents if content.end is not None), default=None)

    def add_topic(self, topic: BagTopic) -> int:
        """Add a topic. Returns its index for messages.

        Raises:
            BagError: The name or type is wrong, the bag has the topic, or the disk is full.
        """
        check_topics([*self.topics, topic])
        with self._writing():
            index = self._file.add_topic(described(topic))
            self._write_metadata()
        return index

    def write(self, messages: Sequence[BagMessage]) -> None:
        """Add messages, in the order of their times. They are in the file when their chunk is complete.

        Raises:
            BagError: The disk is full.
        """
        with self._writing():
            for message in messages:
                if self._is_full(message.stamp):
                    self._split()
                self._file.write([message])
        if time.monotonic() - self._renewed > _RENEWAL:
            self.flush()

    def append(self, chunk: Sequence[BagMessage], *, ends_group: bool = True) -> None:
        """Deprecated: use :meth:`write`. ``ends_group`` has no effect."""
        warnings.warn("append is deprecated: use write; 0.4.0 removes it", DeprecationWarning, stacklevel=2)
        self.write(chunk)

    def _is_full(self, stamp: int) -> bool:
        start = self._file.content.start
        if start is None:
            return False
        return 0 < self._max_duration < stamp - start or 0 < self._max_size <= self._file.size

    def _split(self) -> None:
        """Finish the file, and begin the next one."""
        self._done.append((self._path(len(self._done)).name, self._file.close()))
        self._begin(self._file.topics)

    def flush(self) -> None:
        """Complete the chunk, so that all messages are in the file even if the process is killed. This also
        happens every second while messages are added.

        Raises:
            BagError: The disk is full.
        """
        with self._writing():
            self._file.flush()
            if time.monotonic() - self._renewed > _RENEWAL:
                self._write_metadata()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Context for writing to the files. After an error, the bag is closed as it is."""
        if self._closed:
            raise BagError("the bag is closed", path=self.folder)
        try:
            yield
        except OSError as reason:
            self._end()
            text = f"{_text(reason)}; its messages are readable up to the last complete chunk"
            raise BagError(text, path=self.folder) from None

    def _end(self) -> None:
        self._closed = True
        self._file.abandon()
        os.close(self._lock)

    def close(self) -> None:
        """Finish the bag. Further calls do nothing.

        Raises:
            BagError: The disk is full.
        """
        if self._closed:
            return
        with self._writing():
            self._file.close()
            self._write_metadata()
            if self._storage == "sqlite3":
                _convert(self.folder)
            self._end()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _check_options(storage: str, compression: str, max_size: int, max_duration: float) -> None:
    """Check options of a bag and the libraries, and warn of a storage that is deprecated. Raises BagError."""
    with needs_libraries():
        import mcap.writer  # noqa: F401
        import rosbags.typesys  # noqa: F401
    for name, value, known in (
        ("storage of bags", storage, SUFFIXES),
        ("compression of chunks", compression, get_args(Compression)),
    ):
        if value not in known:
            raise BagError(f"{value!r} is no {name}; choose one of {', '.join(known)}")
    if max_size != 0 and max_size < _SMALLEST:
        raise BagError(f"must be 0 (never split) or at least {_SMALLEST} bytes", key="max_size")
    if not max_duration >= 0:
        raise BagError("must be 0 (never split) or a number of seconds", key="max_duration")
    if storage == "sqlite3":
        if compression != "none":
            raise BagError("files of sqlite3 are not compressed; choose the storage mcap", key="storage")
        warnings.warn(SQLITE_DEPRECATED, DeprecationWarning, stacklevel=3)


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


def _finished(folder: Path, compression: Compression) -> tuple[list[BagTopic], list[tuple[str, Content]]]:
    """Finish the files of a bag that were interrupted. Returns the topics of the bag, and name and content of
    each file."""
    if not any(path.stat().st_size for path in folder.glob("*.mcap")):
        if any(path.suffix != ".mcap" for path in folder.iterdir()):
            raise BagError("there is no MCAP bag to continue here", path=folder)
        return [], []  # its writer was killed at its start
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)  # that files were not finished
        with BagReader(folder) as reader:
            topics, contents = list(reader.topics), reader.contents
        for path, _, whole in contents:
            if not whole:
                copied = path.with_name(f".{path.name}.new")
                with BagReader(path) as reader, McapFile(copied, reader.topics, compression) as file:
                    for message in reader.messages():
                        file.write([message])
                copied.replace(path)
    return topics, [(path.name, content) for path, content, _ in contents]


def _convert(folder: Path) -> None:
    """Replace the MCAP files of a bag by one sqlite3 file."""
    with BagReader(folder) as reader:
        info, topics = reader.info, reader.topics
    temporary, name = folder / ".converted", f"{folder.name}_0.db3"
    shutil.rmtree(temporary, ignore_errors=True)
    write_sqlite(info.files, temporary)
    (temporary / f"{temporary.name}.db3").rename(folder / name)
    content = Content(dict(info.counts), info.start, info.end)
    write_metadata(folder, metadata_text("sqlite3", topics, [(name, content)], info.custom))
    shutil.rmtree(temporary)
    for path in info.files:
        path.unlink()


@contextmanager
def _unwritable(folder: Path) -> Iterator[None]:
    """Convert errors of writing to BagError."""
    try:
        yield
    except OSError as reason:
        raise BagError(_text(reason), path=folder) from None


def _text(reason: OSError) -> str:
    return f"cannot be written: {reason.strerror or reason}"
