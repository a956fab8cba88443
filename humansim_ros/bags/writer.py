"""Write a bag of rosbag2: append encoded chunks, split into files, keep ``metadata.yaml`` up to date."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import NoReturn

from humansim_ros.bags.chunks import COMPRESSIONS, Chunk, Compression
from humansim_ros.bags.guardian import Guardian
from humansim_ros.bags.recovery import OpenBag, finish_bag, lock_bag, reopen_bag
from humansim_ros.bags.storages import SUFFIXES, Storage, file_class
from humansim_ros.bags.topics import BagTopic, check_topics, described
from humansim_ros.errors import BagError

#: Seconds between renewals of metadata.yaml.
_RENEWAL = 1.0


class BagWriter:
    """Writer of a bag.

    Use it in a ``with`` block, or call :meth:`close`. A bag keeps the chunks that have been appended,
    whatever happens to the process: if it is killed, a second process (the guardian) finishes the bag. All
    methods are for one thread. Start other processes by ``spawn`` or ``forkserver``: those of ``fork`` keep
    the bag open.

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
        kind = file_class(storage)
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
            lock = lock_bag(path)
            file = kind.create(path / f"{path.name}_0{SUFFIXES[storage]}", topics)
            self._begin(OpenBag(path, storage, path.name, file, custom=dict(custom or {})), lock)
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
            lock = lock_bag(path)
            try:
                bag = reopen_bag(path, whole_groups=True)
                writer._set_limits(bag.storage, max_size, max_duration)
                writer._begin(bag, lock)
            except BaseException:
                os.close(lock)
                raise
        except OSError as reason:
            raise _unwritable(path, reason) from None
        return writer

    def _set_limits(self, storage: Storage, max_size: int, max_duration: float) -> None:
        smallest = file_class(storage).smallest
        if max_size != 0 and max_size < smallest:
            raise BagError(f"must be 0 (never split) or at least {smallest} bytes", key="max_size")
        if not max_duration >= 0:
            raise BagError("must be 0 (never split) or a number of seconds", key="max_duration")
        self._max_size, self._max_duration = max_size, round(max_duration * 1e9)

    def _begin(self, bag: OpenBag, lock: int) -> None:
        self._bag, self._lock = bag, lock
        self._in_group = self._closed = self._torn = False
        self._renewed = time.monotonic()
        bag.write_metadata()
        self._guardian = Guardian(bag.folder)

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
        """Finish the bag. More calls do nothing.

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
        except BagError:
            raise
        except BaseException:  # such as a second Ctrl-C
            os.close(self._lock)
            self._lock = -1
            self._guardian.finish()
            raise
        finally:
            self._guardian.stop()
            if self._lock >= 0:
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
        self._bag = finish_bag(self.folder, whole_groups=True, custom=self.custom)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _unwritable(folder: Path, reason: OSError) -> BagError:
    return BagError(f"cannot be written: {reason.strerror or reason}", path=folder)
