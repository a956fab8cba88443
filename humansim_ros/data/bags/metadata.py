"""Storage formats of bags; and ``metadata.yaml`` (version 9), as rosbag2 of ROS 2 Jazzy writes it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import yaml

from humansim_ros.data.bags.topics import BagTopic
from humansim_ros.errors import BagError
from humansim_ros.files.reading import read_bytes

Storage: TypeAlias = Literal["mcap", "sqlite3"]
SUFFIXES: dict[Storage, str] = {"mcap": ".mcap", "sqlite3": ".db3"}
NAME = "metadata.yaml"
#: Start time of a bag without messages, as rosbag2 writes it.
_NEVER = (1 << 63) - 1
# libyaml writes the same text ten times faster
_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_MAX_BYTES = 1 << 26


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a folder of rosbag2, or one of its files."""
    return path.suffix.lower() in SUFFIXES.values() or (path / NAME).is_file()


@dataclass
class Content:
    """Numbers and times of the messages of a file. ``counts``: number of messages by topic index. ``start``,
    ``end``: first and last log time, nanoseconds."""

    counts: dict[int, int] = field(default_factory=dict)
    start: int | None = None
    end: int | None = None

    @property
    def total(self) -> int:
        """Number of all messages."""
        return sum(self.counts.values())

    def add(self, counts: Mapping[int, int], start: int | None, end: int | None) -> None:
        """Add the numbers and times of further messages."""
        for topic, count in counts.items():
            self.counts[topic] = self.counts.get(topic, 0) + count
        if start is not None:
            self.start = start if self.start is None else min(self.start, start)
        if end is not None:
            self.end = end if self.end is None else max(self.end, end)


def _times(content: Content) -> dict[str, Any]:
    start = _NEVER if content.start is None else content.start
    duration = 0 if content.end is None or content.start is None else content.end - content.start
    return {"duration": {"nanoseconds": duration}, "starting_time": {"nanoseconds_since_epoch": start}}


def metadata_text(
    storage: str, topics: Sequence[BagTopic], files: Sequence[tuple[str, Content]], custom: Mapping[str, str]
) -> str:
    """Make the text of ``metadata.yaml``.

    Args:
        storage: ``mcap`` or ``sqlite3``.
        topics: Topics of the bag.
        files: Name and content of each file.
        custom: Texts for ``custom_data``.
    """
    whole = Content()
    for _, content in files:
        whole.add(content.counts, content.start, content.end)
    information = {
        "version": 9,
        "storage_identifier": storage,
        **_times(whole),
        "message_count": whole.total,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [qos.as_yaml() for qos in topic.qos],
                    "type_description_hash": topic.type_hash,
                },
                "message_count": whole.counts.get(index, 0),
            }
            for index, topic in enumerate(topics)
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [name for name, _ in files],
        "files": [
            {
                "path": name,
                "starting_time": _times(content)["starting_time"],
                "duration": _times(content)["duration"],
                "message_count": content.total,
            }
            for name, content in files
        ],
        "custom_data": dict(custom) or None,
        "ros_distro": "jazzy",
    }
    text: str = yaml.dump(
        {"rosbag2_bagfile_information": information}, Dumper=_Dumper, sort_keys=False, width=1 << 20
    )
    return text


def read_metadata(folder: Path) -> dict[str, Any]:
    """Content of ``metadata.yaml`` of a bag; empty if the file is missing.

    Raises:
        BagError: The file cannot be read, or has no metadata of rosbag2.
    """
    path = folder / NAME
    return parse_metadata(read_bytes(path, BagError, "metadata", _MAX_BYTES), path) if path.exists() else {}


def parse_metadata(text: bytes, path: str | os.PathLike[str]) -> dict[str, Any]:
    """Content of the text of ``metadata.yaml``. Raises BagError, which names ``path``, if it has none."""
    try:
        data = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError):
        raise BagError("this file is damaged: it is not valid YAML", path=path) from None
    information = data.get("rosbag2_bagfile_information") if isinstance(data, dict) else None
    if not isinstance(information, dict):
        raise BagError("this file is no metadata of a bag of rosbag2", path=path)
    return information


def custom_in(information: Mapping[str, Any]) -> dict[str, str]:
    """Texts in ``custom_data`` of the metadata of a bag."""
    custom = information.get("custom_data")
    return {str(key): str(text) for key, text in custom.items()} if isinstance(custom, dict) else {}


def write_metadata(folder: Path, text: str) -> None:
    """Replace ``metadata.yaml`` of a bag atomically.

    Raises:
        OSError: The file cannot be written.
    """
    temporary = folder / f".{NAME}.new"
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(folder / NAME)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
