"""Shared memory of Fast DDS in /dev/shm: sizes that fit, and removal of files that dead processes have left.

A participant of Fast DDS has a segment for its messages and a port for each address at which it receives. It
keeps their lock files open and locked until it ends. A process that is killed leaves 70 MB. If it is killed
while it makes a port, every later process with this port waits for ever for the other half.
"""

from __future__ import annotations

import fcntl
import math
import os
import re
import stat
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

#: Bytes of a segment on a machine with enough memory: frames of several cameras.
FULL_SEGMENT = 1 << 26
#: Bytes of a segment below which it loses more images than UDP.
_MIN_SEGMENT = 1 << 20
#: Share of the free memory for processes that start together; the rest is for subscribers and ports.
_SHARE = 0.8
_FOLDER = Path("/dev/shm")
_SEGMENT, _PORT = re.compile(r"fastrtps_[0-9a-f]{16}"), re.compile(r"fastrtps_port\d+")
_LOCK = re.compile(r"/dev/shm/(fastrtps_\w+)_[es]l")
#: First bytes of a segment or port that its process has completed (boost::interprocess).
_COMPLETE = (2).to_bytes(4, "little")
#: Seconds in which a live process has surely made and locked a file that it has begun.
_MAKING = 3.0
#: Seconds between two looks at the files of a process.
_INTERVAL = 1.0


def free_memory(folder: Path | None = None) -> float:
    """Free bytes of /dev/shm: 0 if there is none or it is not writable, infinity without a limit.

    ``folder``: another folder in its place.
    """
    folder = folder or _FOLDER
    try:
        found = os.statvfs(folder)
    except OSError:
        return 0
    if not os.access(folder, os.W_OK):
        return 0
    return found.f_bavail * found.f_frsize if found.f_blocks else math.inf


def segment_size(free: float, participants: int | None = None) -> int:
    """Bytes of a segment for which /dev/shm has space; 0 if it has too little.

    Args:
        free: Free bytes of /dev/shm.
        participants: Number of processes that start together. If None, a process that starts alone takes a
            quarter, so that those that follow have something left.
    """
    share = free / 4 if participants is None else free * _SHARE / participants
    return 0 if share < _MIN_SEGMENT else int(min(share, FULL_SEGMENT))


class SharedMemoryFiles:
    """Segments and ports of child processes, noted while they live, removed after their death."""

    def __init__(self) -> None:
        self._names: dict[int, set[str]] = {}
        self._next = 0.0

    def note(self, pids: Iterable[int], now: bool = False) -> None:
        """Note the files of living processes, once a second or ``now``. Call it as often as you like."""
        if not now and time.monotonic() < self._next:
            return
        for pid in pids:
            self._names.setdefault(pid, set()).update(owned_names(pid))
        self._next = time.monotonic() + _INTERVAL

    def remove(self, pids: Iterable[int]) -> None:
        """Remove the files that dead processes have left."""
        for pid in pids:
            for name in self._names.pop(pid, ()):
                _remove(name)


def owned_names(pid: int) -> set[str]:
    """Names of the segments and ports that a living process of this user owns."""
    names = set()
    with suppress(OSError):
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                if match := _LOCK.fullmatch(str(descriptor.readlink())):
                    names.add(match[1])
    return names


def remove_dead_files() -> None:
    """Remove segments of dead processes of this user, and ports that were not completed.

    Complete ports stay: Fast DDS takes them over, and another process may be about to do so.
    """
    with suppress(OSError):
        for path in _FOLDER.glob("fastrtps_*"):
            with suppress(OSError):
                found = path.lstat()
                own = stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid()
                if not own or time.time() - found.st_mtime < _MAKING:
                    continue
                if _SEGMENT.fullmatch(path.name.removesuffix("_el")):
                    _remove(path.name.removesuffix("_el"))
                elif _PORT.fullmatch(path.name) and not _is_complete(path):
                    path.unlink()


def _is_complete(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_COMPLETE)) == _COMPLETE


def _remove(name: str) -> None:
    """Remove a segment or port, unless a living process has locked it."""
    with suppress(OSError), _locked(_FOLDER / f"{name}_el") as lock:
        for path in (_FOLDER / name, _FOLDER / f"sem.{name}_mutex", lock):
            path.unlink(missing_ok=True)


@contextmanager
def _locked(path: Path) -> Iterator[Path]:
    """Lock a file as Fast DDS does, so that no process takes it over meanwhile; OSError if it is locked."""
    flags = os.O_RDONLY | os.O_CREAT | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(path, flags, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield path
    finally:
        os.close(descriptor)
