"""Bags whose writing was interrupted: finish them as they are, or open them to continue."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from humansim_ros.bags.metadata import (
    Content,
    metadata_text,
    read_metadata,
    topics_in,
    write_metadata,
)
from humansim_ros.bags.storages import SUFFIXES, BagFile, Storage, file_class
from humansim_ros.bags.topics import described
from humansim_ros.errors import BagError

#: Errors of a disk without space.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Bytes that are freed at first on a full disk, for the summary and metadata.yaml.
_SPARE = 1 << 14
#: Seconds in which a process that was killed, or its guardian, leaves a bag.
_LEAVING = 10.0


@dataclass
class OpenBag:
    """A bag that is being written: finished files, the one that grows, and the number of whole groups."""

    folder: Path
    storage: Storage
    #: Beginning of the names of all files.
    prefix: str
    file: BagFile
    done: list[tuple[str, Content]] = field(default_factory=list)
    groups: int = 0
    custom: dict[str, str] = field(default_factory=dict)

    def path(self, number: int) -> Path:
        """Path of a file of the bag."""
        return self.folder / f"{self.prefix}_{number}{SUFFIXES[self.storage]}"

    def write_metadata(self) -> None:
        """Bring metadata.yaml up to date. Raises OSError."""
        files = [*self.done, (self.file.path.name, self.file.content)]
        text = metadata_text(self.storage, self.file.topics, files, self.custom)
        write_metadata(self.folder, text)

    def split(self) -> None:
        """Finish the file, and begin the next. Raises OSError."""
        self.file.finish()
        following = file_class(self.storage).create(self.path(len(self.done) + 1), self.file.topics)
        self.done.append((self.file.path.name, self.file.content))
        self.file = following
        self.write_metadata()


def lock_bag(folder: Path) -> int:
    """Lock a bag for this process; close the descriptor that is returned to unlock it.

    Waits for a process that was killed, and for its guardian.

    Raises:
        BagError: Another process writes the bag.
        OSError: The folder cannot be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    until = time.monotonic() + _LEAVING
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return descriptor
        except BlockingIOError:
            if time.monotonic() > until:
                os.close(descriptor)
                raise BagError("another process is writing this bag", path=folder) from None
            time.sleep(0.05)
        except OSError:  # a file system without locks
            return descriptor


def reopen_bag(folder: Path, *, whole_groups: bool, spare: int = 0) -> OpenBag:
    """Open a bag to continue it, finished or not; what is not whole is removed from the end of its files.

    Args:
        folder: Folder of the bag.
        whole_groups: Keep only whole groups, not all whole chunks.
        spare: Bytes of groups to remove from the end as well, at least.

    Raises:
        BagError: The folder holds no bag of humansim, or the bag is damaged.
        OSError: A file cannot be written.
    """
    information = read_metadata(folder)
    storage: Storage = "sqlite3" if information.get("storage_identifier") == "sqlite3" else "mcap"
    numbers = _files(folder, SUFFIXES[storage])
    if not numbers:
        raise BagError("there is no bag to continue here; remove the folder, and record again", path=folder)
    kind = file_class(storage)
    prefix, paths = numbers
    for path in folder.glob(".*.new"):
        path.unlink()
    while True:
        file, groups = kind.reopen(paths[-1], whole_groups=whole_groups, spare=spare)
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
    custom = {str(key): str(text) for key, text in (information.get("custom_data") or {}).items()}
    return OpenBag(folder, storage, prefix, file, done, groups or 0, custom)


def _files(folder: Path, suffix: str) -> tuple[str, list[Path]] | None:
    """Common beginning of the names, and files of a bag in their order."""
    found: dict[str, dict[int, Path]] = {}
    for path in folder.glob(f"*{suffix}"):
        if match := re.fullmatch(r"(.+)_(\d+)", path.stem):
            found.setdefault(match[1], {})[int(match[2])] = path
    if len(found) != 1:
        return None
    ((prefix, paths),) = found.items()
    ordered = [paths[number] for number in range(len(paths)) if number in paths]
    return (prefix, ordered) if len(ordered) == len(paths) else None


def is_finished(folder: Path) -> bool:
    """Whether all files of a bag are finished, and metadata.yaml agrees with them.

    Raises:
        BagError: metadata.yaml is damaged.
    """
    information = read_metadata(folder)
    listed = information.get("relative_file_paths")
    number = 0
    try:
        for name in listed if isinstance(listed, list) else []:
            path = folder / str(name)
            storage: Storage = "sqlite3" if path.suffix == SUFFIXES["sqlite3"] else "mcap"
            number += file_class(storage).content_of(path).total
    except BagError:
        return False
    files = [path for suffix in SUFFIXES.values() for path in folder.glob(f"*{suffix}")]
    names = {path.name for path in files}
    return names == set(listed or ()) and number == information.get("message_count")


def finish_bag(
    folder: Path, *, whole_groups: bool = False, custom: Mapping[str, str] | None = None
) -> OpenBag:
    """Finish an interrupted bag: it ends with its last whole chunk or group.

    On a full disk, groups are removed from the end until there is space for the rest.

    Args:
        folder: Folder of the bag.
        whole_groups: Keep only whole groups.
        custom: Texts for metadata.yaml in place of those that it has.

    Returns:
        The bag, whose file is closed.

    Raises:
        BagError: The folder holds no bag of humansim, or the bag is damaged.
        OSError: A file cannot be written.
    """
    spare = 0
    while True:
        bag = reopen_bag(folder, whole_groups=whole_groups or spare > 0, spare=spare)
        try:
            if custom is not None:
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
