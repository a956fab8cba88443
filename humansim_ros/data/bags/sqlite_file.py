"""One sqlite3 file of a bag, with the tables of rosbag2 (schema version 4): append, continue, read.

Each group is one transaction, so that a killed process leaves complete groups. ``user_version`` is the number
of groups.

rosbags does not replace this module. Its writer has one transaction for the whole bag. A killed process loses
the whole bag, and writing takes twice the processor time (0.75 ms instead of 0.37 ms for 0.6 MB). The reader
of rosbags ignores locks and the journal of a killed process, and refuses bags with unknown types.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import ClassVar
from urllib.parse import quote

from humansim_ros.data.bags.chunks import BagMessage, Chunk, chunk_messages
from humansim_ros.data.bags.metadata import Content
from humansim_ros.data.bags.topics import BagTopic, qos_of_text, qos_text
from humansim_ros.errors import BagError, warn_about
from humansim_ros.files.reading import ANY_SIZE, open_file

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
#: Size of a page, bytes. Writing images takes half of the time of the usual 4096 bytes.
_PAGE = 1 << 16
#: Number in the header of files of this package. Files of other programs are not continued.
_APPLICATION = 0x68736D62
#: SQL condition that all rows of an undamaged file fulfil.
_VALID = "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open a database. ``mode``: ``ro`` (read), ``rw`` (write) or ``rwc`` (create)."""
    return sqlite3.connect(
        f"file:{quote(str(path))}?mode={mode}", uri=True, isolation_level=None, check_same_thread=False
    )


class SqliteFile:
    """A sqlite3 file that is being written. Topics have the ``id`` 1, 2 … in their order.

    Raises:
        sqlite3.Error, OSError: Raised by all methods if the file cannot be written.
    """

    smallest: ClassVar[int] = 1 << 20

    def __init__(self, path: Path, database: sqlite3.Connection) -> None:
        self.path = path
        self.topics: list[BagTopic] = []
        self.content = Content()
        self._database = database
        self._types = set[str]()
        # safe when the process is killed; only a loss of power could damage the file
        self._database.execute("PRAGMA synchronous=OFF")
        # otherwise a program that reads the bag for a long time could stop the recording
        self._database.execute("PRAGMA locking_mode=EXCLUSIVE")

    @property
    def size(self) -> int:
        """Size in bytes."""
        return self.path.stat().st_size

    @classmethod
    def create(cls, path: Path, topics: Sequence[BagTopic]) -> SqliteFile:
        """Create a file with its topics. The file appears under its name when these are written."""
        temporary = path.with_name(f".{path.name}.new")
        try:
            temporary.unlink(missing_ok=True)
            file = cls(temporary, _connect(temporary, "rwc"))
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
        created = cls(path, _connect(path, "rw"))
        created.topics, created._types = file.topics, file._types
        return created

    @classmethod
    def reopen(cls, path: Path, *, spare: int = 0) -> tuple[SqliteFile, int | None]:
        """Open a file to continue it after its last complete group. See :meth:`GroupFile.reopen`. Incomplete
        groups are removed by sqlite3. ``spare`` has no effect, since finishing needs no disk space."""
        file = cls(path, _connect(path, "rw"))
        try:
            (application,) = file._database.execute("PRAGMA application_id").fetchone()
            (groups,) = file._database.execute("PRAGMA user_version").fetchone()
            # sqlite3 has used and removed a journal of an incomplete group. A journal of a process that was
            # killed between two groups is empty, and would stay if nothing is written to this file.
            path.with_name(f"{path.name}-journal").unlink(missing_ok=True)
            if application != _APPLICATION:
                raise BagError("this file was not written by humansim: it cannot be continued", path=path)
            with closing(SqliteInput(path)) as found:
                file.topics, file.content = found.topics, found.content
            file._types = {topic.type for topic in file.topics}
        except BaseException:
            file.close()
            raise
        return file, groups if file.content.total else None

    @classmethod
    def content_of(cls, path: Path) -> Content:
        """Read numbers and times of the messages of a finished file. Raises BagError if damaged."""
        with closing(SqliteInput(path)) as found:
            if not found.whole:
                raise BagError("this file was not finished", path=path)
            return found.content

    def add_topic(self, topic: BagTopic) -> None:
        """Add a topic. It comes after the existing topics."""
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
        """Append a chunk. ``group``: number of the group in the bag."""
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
        """Close the file. No more work is needed, since each group has been written as a whole."""
        self.close()

    def close(self) -> None:
        """Close the file. An incomplete group is lost. Further calls do nothing."""
        self._database.close()


def _was_cut(path: Path) -> bool:
    """Whether a file is shorter than its header says, since sqlite3 would take the missing bytes for
    zeros."""
    with open_file(path, BagError, "bag", ANY_SIZE) as file:
        header = file.read(100)
        size = file.seek(0, os.SEEK_END)
    if len(header) < 100:
        return True
    (page,), (pages,) = struct.unpack_from(">H", header, 16), struct.unpack_from(">I", header, 28)
    return size < int(pages) * (1 << 16 if page == 1 else int(page))


class SqliteInput:
    """Reads a sqlite3 file. ``whole`` is False if the file had to be repaired.

    Raises:
        BagError: The file cannot be read, is damaged, or is no sqlite3 file of a bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        journal = path.with_name(f"{path.name}-journal")
        #: A killed process leaves a journal, with which sqlite3 undoes the incomplete transaction.
        self.whole = not journal.exists()
        with self._errors():
            if self.whole and _was_cut(path):
                raise sqlite3.DatabaseError("the file was cut; try the command .recover of sqlite3")
            self._database = _connect(path, "ro" if self.whole else "rw")
        try:
            with self._errors():
                self._read_topics()
        except BaseException:
            self.close()
            raise

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error) as reason:
            hint = "" if self.whole else "; its folder must be writable, because it was interrupted"
            raise BagError(f"cannot be read: {reason}{hint}", path=self.path) from None

    def _read_topics(self) -> None:
        columns = [row[1] for row in self._database.execute("PRAGMA table_info(topics)")]
        rows = self._database.execute("SELECT * FROM topics ORDER BY id").fetchall()
        topics = [dict(zip(columns, row, strict=True)) for row in rows]
        query = "SELECT topic_type, encoded_message_definition FROM message_definitions"
        has_definitions = self._database.execute("PRAGMA table_info(message_definitions)").fetchall()
        definitions = dict(self._database.execute(query).fetchall()) if has_definitions else {}
        self.topics = [
            BagTopic(
                name=str(topic.get("name")),
                type=str(topic.get("type")),
                qos=qos_of_text(str(topic.get("offered_qos_profiles", ""))),
                definition=definitions.get(str(topic.get("type")), ""),
                type_hash=str(topic.get("type_description_hash", "")),
            )
            for topic in topics
        ]
        self._indices = {topic.get("id"): index for index, topic in enumerate(topics)}
        numbers = self._database.execute(
            f"SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages WHERE {_VALID} "
            "GROUP BY topic_id"
        )
        self.content = Content()
        for number, count, start, end in numbers:
            counts = {self._indices[number]: count} if number in self._indices else {}
            self.content.add(counts, start, end)

    def messages(self, topics: Collection[int], start: int, end: int) -> Iterator[BagMessage]:
        """Messages in the order of their times.

        Args:
            topics: Indices of the topics.
            start: Smallest log time, nanoseconds.
            end: Only messages before this log time, nanoseconds.
        """
        query = (
            "SELECT topic_id, timestamp, data FROM messages "
            f"WHERE timestamp >= ? AND timestamp < ? AND {_VALID} ORDER BY timestamp, id"
        )
        try:
            for number, stamp, data in self._database.execute(query, (start, end)):
                if self._indices.get(number) in topics:
                    yield BagMessage(self._indices[number], stamp, data)
        except sqlite3.Error as reason:
            warn_about(self.path, f"the file is damaged ({reason}); only the messages before are read")

    def close(self) -> None:
        """Close the file."""
        self._database.close()
