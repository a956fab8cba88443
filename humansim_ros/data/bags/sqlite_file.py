"""One sqlite3 file of a bag: read it with any schema of rosbag2, and convert MCAP files to it.

The reader of rosbags is not used: it ignores the journal of a process that was killed, and refuses bags with
unknown types.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from humansim_ros.data.bags.libraries import needs_libraries
from humansim_ros.data.bags.metadata import Content
from humansim_ros.data.bags.topics import FOREVER, BagMessage, BagTopic, qos_of_text
from humansim_ros.errors import BagError, warn_about
from humansim_ros.files.reading import ANY_SIZE, open_file

#: SQL condition that all rows of an undamaged file fulfil.
_VALID = "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"


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
    """Reads a sqlite3 file.

    Attributes:
        topics: Topics in the order of the file.
        content: Numbers and times of the messages.
        whole: False if the writer was killed. sqlite3 then removes the incomplete transaction.

    Raises:
        BagError: The file cannot be read, is damaged, or is no sqlite3 file of a bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = not path.with_name(f"{path.name}-journal").exists()
        self.content = Content()
        with self._errors():
            if self.whole and _was_cut(path):
                raise sqlite3.DatabaseError("the file was cut; try the command .recover of sqlite3")
            place = f"file:{quote(str(path))}?mode={'ro' if self.whole else 'rw'}"
            self._database = sqlite3.connect(place, uri=True, check_same_thread=False)
        self._database.row_factory = sqlite3.Row
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
        tables = {row["name"] for row in self._database.execute("SELECT name FROM sqlite_master")}
        definitions = {}
        if "message_definitions" in tables:  # only newer versions of rosbag2 have it
            rows = self._database.execute("SELECT * FROM message_definitions")
            definitions = {row["topic_type"]: row["encoded_message_definition"] for row in rows}
        topics = [dict(row) for row in self._database.execute("SELECT * FROM topics ORDER BY id")]
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
        for number, count, start, end in self._database.execute(
            "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages "
            f"WHERE {_VALID} GROUP BY topic_id"
        ):
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


def write_sqlite(files: Sequence[Path], folder: Path) -> None:
    """Convert MCAP files, one after the other, to one sqlite3 file.

    Args:
        files: The MCAP files.
        folder: New folder. The file in it is ``NAME.db3`` with the name of the folder.

    Raises:
        BagError: A file cannot be read.
        OSError: The folder cannot be written.
    """
    with needs_libraries():
        from rosbags.rosbag2 import StoragePlugin, Writer

        from humansim_ros.data.bags.mcap_input import McapInput

    connections: dict[str, Any] = {}
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for path in files:
            with closing(McapInput(path)) as found:
                for topic in found.topics:
                    if topic.name not in connections:
                        connections[topic.name] = writer.add_connection(
                            topic.name,
                            topic.type,
                            msgdef=topic.definition,
                            rihs01=topic.type_hash or "unknown",
                            offered_qos_profiles=[qos.as_rosbags() for qos in topic.qos],
                        )
                everything = range(len(found.topics))
                for message in found.messages(everything, 0, FOREVER):
                    connection = connections[found.topics[message.topic].name]
                    writer.write(connection, message.stamp, bytes(message.data))
