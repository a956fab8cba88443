"""One sqlite3 file of a bag, with the tables of rosbag2 (schema version 4).

Each group is one transaction, so that a killed process leaves whole groups; ``user_version`` counts them.
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

from humansim_ros.bags.chunks import Chunk, chunk_messages
from humansim_ros.bags.metadata import Content
from humansim_ros.bags.sqlite_reading import SqliteInput, connect
from humansim_ros.bags.topics import BagTopic, qos_text
from humansim_ros.errors import BagError

_TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
    type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
    encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'jazzy');
"""
#: Bytes of a page: images are written in half of the processor time that the usual 4096 bytes take.
_PAGE = 1 << 16
#: In the header of our files, so that they are not taken for those of other programs.
_APPLICATION = 0x68736D62


@contextmanager
def as_os_errors() -> Iterator[None]:
    """Convert errors of sqlite3 to OSError, as other files raise them."""
    try:
        yield
    except sqlite3.Error as reason:
        code = errno.ENOSPC if "full" in str(reason) else errno.EIO
        raise OSError(code, str(reason)) from None


class SqliteFile:
    """A sqlite3 file that is being written; see :class:`BagFile`. Topics have the ``id`` 1, 2 …."""

    smallest: ClassVar[int] = 1 << 20

    def __init__(self, path: Path, database: sqlite3.Connection) -> None:
        self.path = path
        self.topics: list[BagTopic] = []
        self.content = Content()
        self._database = database
        self._types = set[str]()
        # safe when the process is killed; only a loss of power could damage the file
        self._database.execute("PRAGMA synchronous=OFF")
        # otherwise a program that reads the bag for long could stop the recording
        self._database.execute("PRAGMA locking_mode=EXCLUSIVE")

    @property
    def size(self) -> int:
        """Size in bytes."""
        return self.path.stat().st_size

    @classmethod
    def create(cls, path: Path, topics: Sequence[BagTopic]) -> SqliteFile:
        """Create a file with its topics; it gets its name when these are whole."""
        temporary = path.with_name(f".{path.name}.new")
        try:
            temporary.unlink(missing_ok=True)
            with as_os_errors():
                file = cls(temporary, connect(temporary, "rwc"))
                try:
                    pragmas = f"PRAGMA page_size={_PAGE}; PRAGMA application_id={_APPLICATION};"
                    file._database.executescript(f"{pragmas} BEGIN; {_TABLES} COMMIT")
                    for topic in topics:
                        file.add_topic(topic)
                finally:
                    file.close()
            temporary.rename(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        with as_os_errors():
            created = cls(path, connect(path, "rw"))
        created.topics, created._types = file.topics, file._types
        return created

    @classmethod
    def reopen(cls, path: Path, *, whole_groups: bool, spare: int = 0) -> tuple[SqliteFile, int | None]:
        """Open a file to continue it; see :class:`BagFile`. sqlite3 itself removes what is not whole.

        Nothing is written to finish a file: so no group is removed to gain space.
        """
        with as_os_errors():
            file = cls(path, connect(path, "rw"))
        try:
            with as_os_errors():
                (application,) = file._database.execute("PRAGMA application_id").fetchone()
                (groups,) = file._database.execute("PRAGMA user_version").fetchone()
            # sqlite3 has used and removed a journal with a group that is not whole; one of a process that was
            # killed between two groups is empty, and would stay if nothing is written to this file
            path.with_name(f"{path.name}-journal").unlink(missing_ok=True)
            if application != _APPLICATION:
                raise BagError("this file was not written by humansim: it cannot be continued", path=path)
            with SqliteInput(path) as found:
                file.topics, file.content = found.topics, found.content
            file._types = {topic.type for topic in file.topics}
        except BaseException:
            file.close()
            raise
        return file, groups if file.content.total else None

    @classmethod
    def content_of(cls, path: Path) -> Content:
        """Content of a finished file; see :class:`BagFile`."""
        with SqliteInput(path) as found:
            if not found.whole:
                raise BagError("this file was not finished", path=path)
            return found.content

    def add_topic(self, topic: BagTopic) -> None:
        """Add a topic after those that exist."""
        with as_os_errors():
            if topic.type not in self._types:
                self._database.execute(
                    "INSERT INTO message_definitions(topic_type, encoding, encoded_message_definition, "
                    "type_description_hash) VALUES(?,?,?,?)",
                    (topic.type, topic.encoding, topic.definition, topic.type_hash),
                )
            self._database.execute(
                "INSERT INTO topics VALUES(?,?,?,?,?,?)",
                (len(self.topics) + 1, topic.name, topic.type, "cdr", qos_text(topic), topic.type_hash),
            )
        self._types.add(topic.type)
        self.topics.append(topic)

    def append(self, chunk: Chunk, group: int, ends_group: bool) -> None:
        """Append a chunk. ``group``: number of its group in the bag."""
        with as_os_errors():
            record = memoryview(chunk.data())[: chunk.chunk_length]
            if not self._database.in_transaction:
                self._database.execute("BEGIN")
            self._database.executemany(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES(?,?,?)",
                ((message.topic + 1, message.stamp, message.data) for message in chunk_messages(record)),
            )
            if ends_group:
                self._database.execute(f"PRAGMA user_version={group + 1}")
                self._database.execute("COMMIT")
        self.content.add(chunk.counts, chunk.start, chunk.end)

    def finish(self) -> None:
        """Close the file: everything has been written with its group."""
        self.close()

    def close(self) -> None:
        """Close the file; a group that is not whole is lost. More calls do nothing."""
        self._database.close()
