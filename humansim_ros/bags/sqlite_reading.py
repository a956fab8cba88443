"""Read a sqlite3 file of a bag of rosbag2, also one that was not finished."""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from humansim_ros.bags.chunks import BagMessage
from humansim_ros.bags.metadata import Content
from humansim_ros.bags.topics import BagTopic, qos_of_text
from humansim_ros.errors import BagError, warn_about
from humansim_ros.io.files import ANY_SIZE, open_file

#: Rows that a damaged file does not have.
_VALID = "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open a database; ``mode``: ``ro``, ``rw`` or ``rwc``."""
    return sqlite3.connect(
        f"file:{quote(str(path))}?mode={mode}", uri=True, isolation_level=None, check_same_thread=False
    )


def content_of_table(database: sqlite3.Connection) -> tuple[dict[int, int], int | None, int | None]:
    """Number of messages of each topic by its ``id``, and the first and last time."""
    rows = database.execute(
        f"SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages WHERE {_VALID} "
        "GROUP BY topic_id"
    ).fetchall()
    counts = {topic: number for topic, number, _, _ in rows}
    return counts, min((row[2] for row in rows), default=None), max((row[3] for row in rows), default=None)


def _was_cut(path: Path) -> bool:
    """Whether a file is shorter than its header says; sqlite3 takes the missing bytes for zeros."""
    with open_file(path, BagError, "bag", ANY_SIZE) as file:
        header = file.read(100)
        size = file.seek(0, os.SEEK_END)
    if len(header) < 100:
        return True
    (page,), (pages,) = struct.unpack_from(">H", header, 16), struct.unpack_from(">I", header, 28)
    return size < int(pages) * (1 << 16 if page == 1 else int(page))


class SqliteInput:
    """A sqlite3 file that is read; ``whole`` is False if it had to be repaired.

    Raises:
        BagError: The file cannot be read, is damaged, or is no sqlite3 file of a bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        journal = path.with_name(f"{path.name}-journal")
        #: A journal is left by a process that was killed: sqlite3 takes back what was not whole.
        self.whole = not journal.exists()
        with self._errors():
            if self.whole and _was_cut(path):
                raise sqlite3.DatabaseError("the file was cut; try the command .recover of sqlite3")
            self._database = connect(path, "ro" if self.whole else "rw")
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
        definitions: dict[str, str] = {}
        if self._database.execute("PRAGMA table_info(message_definitions)").fetchall():
            definitions = dict(
                self._database.execute(
                    "SELECT topic_type, encoded_message_definition FROM message_definitions"
                ).fetchall()
            )
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
        counts, start, end = content_of_table(self._database)
        known = {self._indices[number]: n for number, n in counts.items() if number in self._indices}
        self.content = Content(known, start, end)

    def messages(self, topics: Collection[int], start: int, end: int) -> Iterator[BagMessage]:
        """Messages in the order of their times.

        Args:
            topics: Indices of the topics.
            start: First log time in nanoseconds.
            end: Log time after the last one.
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

    def __enter__(self) -> SqliteInput:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
