"""The kinds of files of a bag: MCAP and sqlite3 behind one interface."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal, Protocol, TypeAlias

from humansim_ros.bags.chunks import Chunk
from humansim_ros.bags.libraries import needs_libraries
from humansim_ros.bags.metadata import Content
from humansim_ros.bags.topics import BagTopic
from humansim_ros.errors import BagError

Storage: TypeAlias = Literal["mcap", "sqlite3"]
SUFFIXES: dict[Storage, str] = {"mcap": ".mcap", "sqlite3": ".db3"}


class BagFile(Protocol):
    """A file of a bag that is being written. All methods raise OSError if the file cannot be written."""

    #: Smallest size in bytes at which files are split; of MCAP that of rosbag2.
    smallest: ClassVar[int]
    path: Path
    topics: list[BagTopic]
    content: Content

    @property
    def size(self) -> int:
        """Size in bytes."""

    @classmethod
    def create(cls, path: Path, topics: Sequence[BagTopic]) -> BagFile:
        """Create a file with its topics."""

    @classmethod
    def reopen(cls, path: Path, *, whole_groups: bool, spare: int = 0) -> tuple[BagFile, int | None]:
        """Open a file to continue it after its last whole chunk or group.

        Args:
            path: The file, finished or not.
            whole_groups: Keep only whole groups, not all whole chunks.
            spare: Bytes of groups to remove from the end as well, at least, to gain space.

        Returns:
            The file, and the number of whole groups in the bag up to its end; None if it has no messages.

        Raises:
            BagError: The file is damaged at its start, or was written by another program.
        """

    @classmethod
    def content_of(cls, path: Path) -> Content:
        """Content of a finished file.

        Raises:
            BagError: The file is damaged.
        """

    def add_topic(self, topic: BagTopic) -> None:
        """Add a topic after those that exist."""

    def append(self, chunk: Chunk, group: int, ends_group: bool) -> None:
        """Append a chunk. ``group``: number of its group in the bag."""

    def finish(self) -> None:
        """Write everything that belongs to a whole file, and close it."""

    def close(self) -> None:
        """Close the file as it is. More calls do nothing."""


def file_class(storage: Storage) -> type[BagFile]:
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
