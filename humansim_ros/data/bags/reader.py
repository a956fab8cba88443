"""Read all complete messages of bags of rosbag2, also of bags that were interrupted or cut."""

from __future__ import annotations

import heapq
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePath
from types import TracebackType
from typing import TYPE_CHECKING, Any

from humansim_ros.data.bags.libraries import needs_libraries
from humansim_ros.data.bags.metadata import SUFFIXES, Content, Storage, custom_in, read_metadata
from humansim_ros.data.bags.topics import FOREVER, BagMessage, BagTopic
from humansim_ros.errors import BagError, unknown, warn_about

if TYPE_CHECKING:
    from humansim_ros.data.bags.mcap_input import McapInput
    from humansim_ros.data.bags.sqlite_file import SqliteInput


@dataclass(frozen=True)
class BagInfo:
    """Summary of a bag. ``counts`` are the numbers of messages by topic index, ``start`` and ``end`` the
    first and last log time in nanoseconds (None if there are no messages), ``size`` the bytes of all files.
    ``whole`` is False if the bag was interrupted or cut. ``custom`` are the texts of ``custom_data``."""

    storage: Storage
    files: tuple[Path, ...]
    size: int
    counts: Mapping[int, int]
    start: int | None
    end: int | None
    whole: bool
    custom: Mapping[str, str]

    @property
    def messages(self) -> int:
        """Number of messages."""
        return sum(self.counts.values())


class BagReader:
    """Reader of a bag: a folder of rosbag2, or one ``.mcap`` or ``.db3`` file.

    A bag that was interrupted or cut is read up to its end, with a HumansimWarning. Use it in a ``with``
    block, or call :meth:`close`.

    Raises:
        BagError: There is no bag, it cannot be read, or no message is complete.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._inputs: list[McapInput | SqliteInput] = []
        storage, paths, metadata = _files(self.path)
        try:
            for file in paths:
                if len(paths) > 1 and not file.stat().st_size:  # its writer was killed when it began the file
                    warn_about(file, "this file of the bag is empty; the other files are read")
                else:
                    self._inputs.append(_open(storage, file))
        except BaseException:
            self.close()
            raise
        #: Topics of all files. A message refers to its topic by the index in this sequence.
        self.topics: Sequence[BagTopic] = self._merge_topics()
        self.info = self._make_info(storage, metadata)
        for each in self._inputs:
            if not each.whole:
                warn_about(
                    each.path,
                    "this file was not finished, or was cut; "
                    f"its {each.content.total} whole messages are read",
                )

    def _merge_topics(self) -> tuple[BagTopic, ...]:
        topics: dict[tuple[str, str], BagTopic] = {}
        for each in self._inputs:
            for topic in each.topics:
                topics.setdefault((topic.name, topic.type), topic)
        places = {key: index for index, key in enumerate(topics)}
        #: For each file: by topic of the file, the index of this topic in the bag.
        self._indices = [[places[topic.name, topic.type] for topic in each.topics] for each in self._inputs]
        return tuple(topics.values())

    @property
    def contents(self) -> list[tuple[Path, Content, bool]]:
        """Path and content of each file, and whether the file was finished. Contents count messages by topic
        index of the bag."""
        return [
            (
                each.path,
                Content(
                    {indices[index]: number for index, number in each.content.counts.items()},
                    each.content.start,
                    each.content.end,
                ),
                each.whole,
            )
            for each, indices in zip(self._inputs, self._indices, strict=True)
        ]

    def _make_info(self, storage: Storage, metadata: Mapping[str, Any]) -> BagInfo:
        content = Content()
        for _, of_file, _ in self.contents:
            content.add(of_file.counts, of_file.start, of_file.end)
        files = tuple(each.path for each in self._inputs)
        return BagInfo(
            storage=storage,
            files=files,
            size=sum(path.stat().st_size for path in files),
            counts=content.counts,
            start=content.start,
            end=content.end,
            whole=all(each.whole for each in self._inputs),
            custom=custom_in(metadata),
        )

    def messages(
        self, topics: Collection[str] | None = None, *, start: int = 0, end: int = FOREVER
    ) -> Iterator[BagMessage]:
        """Messages in the order of their log times. Damaged messages are left out, with a HumansimWarning.

        Args:
            topics: Names of topics. If None, all.
            start: Smallest log time, nanoseconds.
            end: Only messages before this log time, nanoseconds.

        Raises:
            BagError: The bag has no topic with one of the names.
        """
        known = [topic.name for topic in self.topics]
        for name in topics or ():
            if name not in known:
                raise BagError(unknown("topic", name, known, "the bag", 8), path=self.path)
        wanted = {index for index, name in enumerate(known) if topics is None or name in topics}
        streams = [
            self._messages_of(each, indices, wanted, start, end)
            for each, indices in zip(self._inputs, self._indices, strict=True)
        ]
        if self._in_order():
            for stream in streams:
                yield from stream
        else:
            yield from heapq.merge(*streams, key=lambda message: message.stamp)

    def _in_order(self) -> bool:
        """Whether no file has messages before the end of the previous file."""
        contents = [each.content for each in self._inputs if each.content.total]
        return all((before.end or 0) <= (after.start or 0) for before, after in pairwise(contents))

    @staticmethod
    def _messages_of(
        each: McapInput | SqliteInput, indices: Sequence[int], wanted: Collection[int], start: int, end: int
    ) -> Iterator[BagMessage]:
        own = {index for index, place in enumerate(indices) if place in wanted}
        for message in each.messages(own, start, end):
            yield message._replace(topic=indices[message.topic])

    def close(self) -> None:
        """Close the files."""
        for each in self._inputs:
            each.close()

    def __enter__(self) -> BagReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _open(storage: Storage, path: Path) -> McapInput | SqliteInput:
    with needs_libraries():
        from humansim_ros.data.bags.mcap_input import McapInput
        from humansim_ros.data.bags.sqlite_file import SqliteInput
    return McapInput(path) if storage == "mcap" else SqliteInput(path)


def _files(path: Path) -> tuple[Storage, list[Path], Mapping[str, Any]]:
    """Find storage format, files and metadata of a bag."""
    if not path.is_dir():
        for storage, suffix in SUFFIXES.items():
            if path.suffix == suffix and path.exists():
                return storage, [path], {}
        if path.exists():
            raise BagError("this is no bag: neither a folder nor a .mcap or .db3 file", path=path)
        raise BagError("there is no such bag; check the path", path=path)
    metadata = read_metadata(path)
    if metadata.get("compression_mode"):
        raise BagError(
            "rosbag2 has compressed the files or messages of this bag; write it without `compression_mode` "
            "with `ros2 bag convert`",
            path=path,
        )
    for storage, suffix in SUFFIXES.items():
        listed = metadata.get("relative_file_paths")
        names = [PurePath(str(name)).name for name in listed] if isinstance(listed, list) else []
        found = sorted((file.name for file in path.glob(f"*{suffix}")), key=lambda name: (len(name), name))
        names = [name for name in names if name.endswith(suffix)]
        names += [name for name in found if name not in names]
        for name in names:
            if name not in found:
                warn_about(path / name, "this file of the bag is missing; the other files are read")
        if found:
            return storage, [path / name for name in names if name in found], metadata
    raise BagError("there is no bag in this folder", path=path)
