"""Write a bag of rosbag2: append encoded chunks, split into files, keep ``metadata.yaml`` up to date.

An interrupted bag is finished as it is, or opened to be continued.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, NoReturn

from humansim_ros.bags import needs_libraries
from humansim_ros.bags.chunks import COMPRESSIONS, Chunk, Compression
from humansim_ros.bags.metadata import (
    SUFFIXES,
    Content,
    Storage,
    custom_in,
    metadata_text,
    read_metadata,
    topics_in,
    write_metadata,
)
from humansim_ros.bags.topics import BagTopic, check_topics, described
from humansim_ros.errors import BagError

if TYPE_CHECKING:
    from humansim_ros.bags.mcap_file import McapFile
    from humansim_ros.bags.sqlite_file import SqliteFile

#: Seconds between renewals of metadata.yaml.
_RENEWAL = 1.0
#: Errors of a disk without space.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Bytes that are freed at first on a full disk, for the summary and metadata.yaml.
_SPARE = 1 << 14


def _file_class(storage: Storage) -> type[McapFile] | type[SqliteFile]:
    """The class of the files of a storage.

    Raises:
        BagError: There is no such storage, or the libraries of bags are not installed.
    """
    if storage not in SUFFIXES:
        raise BagError(f"{storage!r} is no storage of bags; choose one of {', '.join(SUFFIXES)}")
    with needs_libraries():
        import rosbags.rosbag2  # noqa: F401

        from humansim_ros.bags.mcap_file import McapFile
        from humansim_ros.bags.sqlite_file import SqliteFile
    return McapFile if storage == "mcap" else SqliteFile


@dataclass
class _OpenBag:
    """A bag that is being written: finished files, the one that grows, and the number of whole groups.

    ``prefix`` is the beginning of the names of all files.
    """

    folder: Path
    storage: Storage
    prefix: str
    file: McapFile | SqliteFile
    done: list[tuple[str, Content]] = field(default_factory=list)
    groups: int = 0
    custom: dict[str, str] = field(default_factory=dict)

    def write_metadata(self) -> None:
        """Bring metadata.yaml up to date. Raises OSError."""
        files = [*self.done, (self.file.path.name, self.file.content)]
        write_metadata(self.folder, metadata_text(self.storage, self.file.topics, files, self.custom))

    def split(self) -> None:
        """Finish the file, and begin the next. Raises OSError."""
        self.file.finish()
        name = f"{self.prefix}_{len(self.done) + 1}{SUFFIXES[self.storage]}"
        following = _file_class(self.storage).create(self.folder / name, self.file.topics)
        self.done.append((self.file.path.name, self.file.content))
        self.file = following
        self.write_metadata()


def _lock_bag(folder: Path) -> int:
    """Lock a bag for this process; close the descriptor that is returned to unlock it.

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
    except OSError:  # a file system without locks
        pass
    return descriptor


def _reopen_bag(folder: Path, *, spare: int = 0) -> _OpenBag:
    """Open a bag to continue it, finished or not; what is not whole is removed from the end of its files.

    Args:
        folder: Folder of the bag.
        spare: Bytes of groups to remove from the end as well, at least.

    Raises:
        BagError: The folder holds no bag of humansim, or the bag is damaged.
        OSError: A file cannot be written.
    """
    information = read_metadata(folder)
    storage: Storage = "sqlite3" if information.get("storage_identifier") == "sqlite3" else "mcap"
    prefix, paths = _files(folder, SUFFIXES[storage])
    kind = _file_class(storage)
    for path in folder.glob(".*.new"):
        path.unlink()
    while True:
        file, groups = kind.reopen(paths[-1], spare=spare)
        if groups is not None:
            break
        # without messages: perhaps not even its topics are whole
        file.close()
        paths[-1].unlink()
        if len(paths) == 1:
            listed = topics_in(information)
            topics = file.topics if len(file.topics) >= len(listed) else listed
            file = kind.create(paths[0], [described(topic) for topic in topics])
            break
        paths.pop()
        spare = 0
    try:
        done = [(path.name, kind.content_of(path)) for path in paths[:-1]]
    except BaseException:
        file.close()
        raise
    return _OpenBag(folder, storage, prefix, file, done, groups or 0, custom_in(information))


def _files(folder: Path, suffix: str) -> tuple[str, list[Path]]:
    """Common beginning of the names, and files of a bag in their order. Raises BagError if there are none."""
    found: dict[str, dict[int, Path]] = {}
    for path in folder.glob(f"*{suffix}"):
        if match := re.fullmatch(r"(.+)_(\d+)", path.stem):
            found.setdefault(match[1], {})[int(match[2])] = path
    for prefix, paths in found.items():
        if len(found) == 1 and sorted(paths) == list(range(len(paths))):
            return prefix, [paths[number] for number in range(len(paths))]
    raise BagError("there is no bag to continue here; remove the folder, and record again", path=folder)


def _finish_bag(folder: Path, custom: Mapping[str, str]) -> _OpenBag:
    """Finish an interrupted bag after its last whole group, and close its file.

    On a full disk, groups are removed from the end until there is space for the rest.

    Raises:
        BagError: The folder holds no bag of humansim, or the bag is damaged.
        OSError: A file cannot be written.
    """
    spare = 0
    while True:
        bag = _reopen_bag(folder, spare=spare)
        try:
            bag.custom = dict(custom)
            bag.file.finish()
            bag.write_metadata()
            return bag
        except OSError as reason:
            if reason.errno not in _FULL or bag.groups == 0:
                raise
            spare = max(_SPARE, 2 * spare)
        finally:
            with suppress(OSError):
                bag.file.close()


class BagWriter:
    """Writer of a bag.

    Use it in a ``with`` block, or call :meth:`close`. A bag keeps the chunks that have been appended,
    whatever happens to the process: if it is killed, BagReader reads the bag, and :meth:`resume` continues or
    finishes it. All methods are for one thread. Start other processes by ``spawn`` or ``forkserver``:
    processes of ``fork`` keep the bag locked.

    Args:
        folder: Folder of the bag, which is created.
        topics: Topics; a chunk names them by their index. Missing definitions are looked up.
        storage: ``mcap`` or ``sqlite3``.
        compression: Compression of the chunks that will come; sqlite3 files have none.
        max_size: Size in bytes at which the next group begins a new file; 0: never.
        max_duration: Duration in seconds after which the next group begins a new file; 0: never.
        custom: Texts for ``custom_data`` of metadata.yaml; ``writer.custom`` can change until the end.

    Raises:
        BagError: The folder exists, cannot be created, or an option or a topic is wrong.
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
        path = Path(folder).resolve()
        kind = _file_class(storage)
        if compression not in COMPRESSIONS:
            raise BagError(
                f"{compression!r} is no compression of chunks; choose one of {', '.join(COMPRESSIONS)}"
            )
        if storage == "sqlite3" and compression != "none":
            raise BagError("files of sqlite3 are not compressed; choose the storage mcap", path=folder)
        check_topics(topics)
        topics = [described(topic) for topic in topics]
        self._set_limits(storage, max_size, max_duration)
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            raise BagError("this path exists; choose another name for the bag", path=folder) from None
        except OSError as reason:
            raise _unwritable(path, reason) from None
        try:
            lock = _lock_bag(path)
            file = kind.create(path / f"{path.name}_0{SUFFIXES[storage]}", topics)
            self._begin(_OpenBag(path, storage, path.name, file, custom=dict(custom or {})), lock)
        except BaseException as reason:
            shutil.rmtree(path, ignore_errors=True)
            if isinstance(reason, OSError):
                raise _unwritable(path, reason) from None
            raise

    @classmethod
    def resume(
        cls, folder: str | os.PathLike[str], *, max_size: int = 0, max_duration: float = 0.0
    ) -> BagWriter:
        """Continue an interrupted bag, or a finished one, after its last whole group.

        ``groups``, ``topics``, ``end`` and ``custom`` of the writer say what the bag holds. With the same
        limits and the same chunks as before, the bag becomes the same as one that was not interrupted.

        Args:
            folder: Folder of the bag.
            max_size: As for a new bag.
            max_duration: As for a new bag.

        Raises:
            BagError: There is no bag of humansim, another process writes it, or it is damaged.
        """
        path = Path(folder).resolve()
        if not path.is_dir():
            raise BagError("there is no bag to continue here", path=folder)
        writer = cls.__new__(cls)
        try:
            lock = _lock_bag(path)
            try:
                bag = _reopen_bag(path)
                writer._set_limits(bag.storage, max_size, max_duration)
                writer._begin(bag, lock)
            except BaseException:
                os.close(lock)
                raise
        except OSError as reason:
            raise _unwritable(path, reason) from None
        return writer

    def _set_limits(self, storage: Storage, max_size: int, max_duration: float) -> None:
        smallest = _file_class(storage).smallest
        if max_size != 0 and max_size < smallest:
            raise BagError(f"must be 0 (never split) or at least {smallest} bytes", key="max_size")
        if not max_duration >= 0:
            raise BagError("must be 0 (never split) or a number of seconds", key="max_duration")
        self._max_size, self._max_duration = max_size, round(max_duration * 1e9)

    def _begin(self, bag: _OpenBag, lock: int) -> None:
        self._bag, self._lock = bag, lock
        self._in_group = self._closed = self._torn = False
        self._renewed = time.monotonic()
        bag.write_metadata()

    @property
    def folder(self) -> Path:
        """Folder of the bag."""
        return self._bag.folder

    @property
    def custom(self) -> dict[str, str]:
        """Texts for ``custom_data`` of metadata.yaml."""
        return self._bag.custom

    @property
    def topics(self) -> Sequence[BagTopic]:
        """Topics of the bag."""
        return tuple(self._bag.file.topics)

    @property
    def groups(self) -> int:
        """Number of groups in the bag that are whole."""
        return self._bag.groups

    @property
    def end(self) -> int | None:
        """Newest log time in nanoseconds; None in an empty bag."""
        contents = [*(content for _, content in self._bag.done), self._bag.file.content]
        return max((content.end for content in contents if content.end is not None), default=None)

    @property
    def size(self) -> int:
        """Size in bytes of the file that is being written."""
        return self._bag.file.size

    def add_topic(self, topic: BagTopic) -> int:
        """Add a topic; return its index for messages.

        Raises:
            BagError: The name or type is wrong, the bag has the topic, or the disk is full.
        """
        check_topics([*self.topics, topic])
        topic = described(topic)
        self._write(lambda: self._bag.file.add_topic(topic))
        self.sync()
        return len(self.topics) - 1

    def append(self, chunk: Chunk, *, ends_group: bool = True) -> None:
        """Append a chunk. Its bytes are given to the system at once, and may change afterwards.

        Args:
            chunk: Encoded messages; chunks come in the order of their times.
            ends_group: False if the next chunk belongs to the same group, such as another camera of a frame.
                Files are split, and interrupted bags are continued, only between groups.

        Raises:
            BagError: The disk is full. The bag is finished with the groups before.
        """
        self._write(lambda: self._append(chunk, ends_group))
        if time.monotonic() - self._renewed > _RENEWAL:
            self.sync()

    def _append(self, chunk: Chunk, ends_group: bool) -> None:
        if not self._in_group and self._is_full(chunk.end):
            self._bag.split()
        self._bag.file.append(chunk, self._bag.groups, ends_group)
        self._in_group = not ends_group
        self._bag.groups += ends_group

    def _is_full(self, end: int) -> bool:
        content = self._bag.file.content
        if content.start is None:
            return False
        too_long = 0 < self._max_duration < end - content.start
        return too_long or 0 < self._max_size <= self._bag.file.size

    def _write(self, write: Callable[[], None]) -> None:
        """Write to the files; if that fails, finish the bag with what is whole."""
        if self._closed:
            raise BagError("the bag is closed", path=self.folder)
        try:
            write()
        except OSError as reason:
            self._give_up(reason)
        except BaseException:  # such as KeyboardInterrupt
            self._torn = True
            raise

    def _give_up(self, reason: OSError) -> NoReturn:
        self._torn = True
        with suppress(BagError):
            self.close()
        what = _unwritable(self.folder, reason).message
        raise BagError(
            f"{what}; the bag ends after {self.groups} whole groups of messages", path=self.folder
        ) from None

    def sync(self) -> None:
        """Bring metadata.yaml up to date; this happens every second while chunks come.

        Raises:
            BagError: The disk is full. The bag is finished with the groups before.
        """
        self._renewed = time.monotonic()
        self._write(self._bag.write_metadata)

    def close(self) -> None:
        """Finish the bag. More calls do nothing. An interrupt meanwhile leaves a bag for :meth:`resume`.

        Raises:
            BagError: The disk is full. The bag ends with the groups for which there is space.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._finish()
        except OSError as reason:
            raise _unwritable(self.folder, reason) from None
        finally:
            os.close(self._lock)

    def _finish(self) -> None:
        if self._torn:
            self._finish_again()
            return
        try:
            self._bag.file.finish()
            self._bag.write_metadata()
        except OSError as reason:
            self._finish_again()
            raise _unwritable(self.folder, reason) from None

    def _finish_again(self) -> None:
        """Finish the bag from what its files hold."""
        self._bag.file.close()
        self._bag = _finish_bag(self.folder, self.custom)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _unwritable(folder: Path, reason: OSError) -> BagError:
    return BagError(f"cannot be written: {reason.strerror or reason}", path=folder)
