"""Write a bag of rosbag2: append encoded chunks, split into files, keep ``metadata.yaml`` up to date."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, TypeAlias

from humansim_ros.bags.chunks import Chunk, Compression
from humansim_ros.bags.libraries import needs_libraries
from humansim_ros.bags.metadata import Content, metadata_text, write_metadata
from humansim_ros.bags.topics import BagTopic, check_topics, described
from humansim_ros.errors import BagError

Storage: TypeAlias = Literal["mcap", "sqlite3"]
#: Seconds between renewals of metadata.yaml.
_RENEWAL = 1.0


class BagWriter:
    """Writer of a new bag.

    Use it in a ``with`` block, or call :meth:`close`. Whatever happens to the process, the bag keeps all
    chunks that have been appended. All methods are for one thread.

    Args:
        folder: Folder of the bag, which is created.
        topics: Topics; a chunk names them by their index. Missing definitions are looked up.
        storage: ``mcap`` or ``sqlite3``.
        compression: Compression of the chunks that will come; sqlite3 files have none.
        max_size: Size in bytes at which the next group begins a new file; 0: never.
        max_duration: Duration in seconds after which the next group begins a new file; 0: never.
        custom: Texts for ``custom_data`` of metadata.yaml; they can be changed until the bag is closed.

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
        self.folder = Path(folder).resolve()
        self.storage = storage
        self.custom = dict(custom or {})
        #: Number of groups that are whole.
        self.groups = 0
        self._max_size, self._max_duration = max_size, round(max_duration * 1e9)
        self._done: list[tuple[str, Content]] = []
        self._in_group = False
        self._closed = False
        check_topics(topics)
        topics = [described(topic) for topic in topics]
        with needs_libraries():
            from humansim_ros.bags.mcap_file import McapFile
        self._kind = McapFile
        try:
            self.folder.mkdir(parents=True)
        except FileExistsError:
            raise BagError("this path exists; choose another name for the bag", path=folder) from None
        except OSError as reason:
            raise self._unwritable(reason) from None
        try:
            self._file = McapFile.create(self._path(0), topics)
        except OSError as reason:
            raise self._unwritable(reason) from None
        self.sync()

    def _path(self, number: int) -> Path:
        return self.folder / f"{self.folder.name}_{number}{self._kind.suffix}"

    def _unwritable(self, reason: OSError) -> BagError:
        return BagError(f"cannot be written: {reason.strerror or reason}", path=self.folder)

    @property
    def topics(self) -> Sequence[BagTopic]:
        """Topics of the bag."""
        return tuple(self._file.topics)

    def add_topic(self, topic: BagTopic) -> int:
        """Add a topic; return its index for messages.

        Raises:
            BagError: The name or type is wrong, or the bag has the topic.
        """
        check_topics([*self.topics, topic])
        self._file.add_topic(described(topic))
        self.sync()
        return len(self.topics) - 1

    def append(self, chunk: Chunk, *, ends_group: bool = True) -> None:
        """Append a chunk. Its bytes are given to the system at once, and may change afterwards.

        Args:
            chunk: Encoded messages; chunks come in the order of their times.
            ends_group: False if the next chunk belongs to the same group, such as another camera of a frame.
                Files are split, and interrupted bags are continued, only between groups.

        Raises:
            BagError: The disk is full. The bag has been finished with the groups before.
        """
        if not self._in_group and self._is_full(chunk.end):
            self._split()
        try:
            self._file.append(chunk, self.groups, ends_group)
        except OSError as reason:
            raise self._unwritable(reason) from None
        self._in_group = not ends_group
        self.groups += ends_group
        if time.monotonic() - self._synced > _RENEWAL:
            self.sync()

    def _is_full(self, end: int) -> bool:
        content = self._file.content
        if content.start is None:
            return False
        too_long = 0 < self._max_duration < end - content.start
        return too_long or 0 < self._max_size <= self._file.size

    def _split(self) -> None:
        topics = self.topics
        self._file.finish()
        self._done.append((self._file.path.name, self._file.content))
        self._file = self._kind.create(self._path(len(self._done)), topics)
        self.sync()

    def sync(self) -> None:
        """Bring metadata.yaml up to date; this happens every second while chunks come."""
        self._synced = time.monotonic()
        files = [*self._done, (self._file.path.name, self._file.content)]
        text = metadata_text(self.storage, self.topics, files, self.custom)
        try:
            write_metadata(self.folder, text)
        except OSError as reason:
            raise self._unwritable(reason) from None

    def close(self) -> None:
        """Finish the bag. More calls do nothing."""
        if not self._closed:
            self._closed = True
            self._file.finish()
            self.sync()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
