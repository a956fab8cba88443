"""Transports of Fast DDS: profiles, shared memory in /dev/shm, and ROS domains that no other process uses."""

from __future__ import annotations

import fcntl
import functools
import math
import os
import re
import stat
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from humansim_ros.files.reading import resource_path

#: Size of a segment of shared memory if there is enough memory, bytes: frames of several cameras fit.
FULL_SEGMENT = 1 << 26
#: With a segment smaller than this, bytes, more images would be lost than with UDP.
_MIN_SEGMENT = 1 << 20
#: Share of the free memory for processes that start together. Subscribers and ports need the rest.
_SHARE = 0.8
_FOLDER = Path("/dev/shm")
#: Pattern for the beginning of file names of Fast DDS 2 (Jazzy) and Fast DDS 3 (Kilted and later).
_PREFIX = "fast(?:rtps|dds)_"
_SEGMENT, _PORT = re.compile(rf"{_PREFIX}[0-9a-f]{{16}}"), re.compile(rf"{_PREFIX}port\d+")
_LOCK = re.compile(rf"/dev/shm/({_PREFIX}\w+)_[es]l")
#: First bytes of a segment or port that its process has completed (boost::interprocess).
_COMPLETE = (2).to_bytes(4, "little")
#: A live process needs less than this time, seconds, to create and lock a file.
_MAKING = 3.0
#: Shortest time between two checks of the files of processes, seconds.
_INTERVAL = 1.0


def free_memory(folder: Path | None = None) -> float:
    """Free bytes of /dev/shm. 0 if it is missing or not writable, infinity if it has no limit. ``folder``:
    folder to check in place of /dev/shm."""
    folder = folder or _FOLDER
    try:
        found = os.statvfs(folder)
    except OSError:
        return 0
    if not os.access(folder, os.W_OK):
        return 0
    return found.f_bavail * found.f_frsize if found.f_blocks else math.inf


def segment_size(free: float, participants: int | None = None) -> int:
    """Size of a segment that fits into /dev/shm, bytes. 0 if there is too little space.

    Args:
        free: Free bytes of /dev/shm.
        participants: Number of processes that start together. If None, one process starts alone and takes a
            quarter, so that memory is left for later processes.
    """
    share = free / 4 if participants is None else free * _SHARE / participants
    return 0 if share < _MIN_SEGMENT else int(min(share, FULL_SEGMENT))


class SharedMemoryFiles:
    """Remembers the shared memory files (segments and ports) of child processes, and removes them after their
    death."""

    def __init__(self) -> None:
        self._names: dict[int, set[str]] = {}
        self._next = 0.0

    def note(self, pids: Iterable[int], now: bool = False) -> None:
        """Remember the files of living processes, but at most once a second unless ``now`` is set."""
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


def files_of_fast_dds(folder: Path) -> list[Path]:
    """Segments and ports of Fast DDS in /dev/shm, with their locks."""
    return [path for path in folder.glob("fast*_*") if re.match(_PREFIX, path.name)]


def remove_dead_files() -> None:
    """Remove segments of dead processes of this user, and ports that were not completed. Complete ports stay,
    since Fast DDS reuses them, and another process may be about to do so."""
    with suppress(OSError):
        for path in files_of_fast_dds(_FOLDER):
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
    """Lock a file in the same way as Fast DDS, so that no process reuses it. OSError if it is locked."""
    flags = os.O_RDONLY | os.O_CREAT | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(path, flags, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield path
    finally:
        os.close(descriptor)


#: Environment variables that name the profiles of Fast DDS: version 2 reads the first, version 3 the second.
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
#: Environment variables by which a user configures the transport.
_TRANSPORT_SETTINGS = (
    *PROFILES,
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_DISCOVERY_SERVER",
)
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
#: Environment variables by which a user decides which hosts may find the nodes.
_DISCOVERY_SETTINGS = (_RANGE, "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY", *_TRANSPORT_SETTINGS)
_FAST_DDS = ("", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
#: Environment variable with the segment size, which the profiles of Fast DDS read.
_SEGMENT_BYTES = "HUMANSIM_SEGMENT_BYTES"
#: Environment variable that makes rmw_fastrtps take the memory policy of readers from the profiles.
_MEMORY_POLICY = "RMW_FASTRTPS_USE_QOS_FROM_XML"
#: With a smaller segment than this, bytes, large images may be lost.
_SMALL_SEGMENT = 1 << 24
#: Memory in /dev/shm that a process with a segment of full size uses, bytes.
_FULL_PROCESS = 70e6


@dataclass(frozen=True)
class Transport:
    """Transport for this process and the nodes that it starts.

    Attributes:
        environment: Environment variables that set this transport.
        reach: Text for the user on which hosts can find the nodes.
        warning: Effect of too little shared memory, and the remedy. Empty if there is enough.
    """

    environment: dict[str, str]
    reach: str
    warning: str = ""


def choose_transport(participants: int | None = None, network: bool = True) -> Transport:
    """Choose the transport for this machine, unless the user has configured it.

    Args:
        participants: Number of processes that start together. If None, this process starts alone.
        network: Whether other hosts may find the nodes.
    """
    for name in _DISCOVERY_SETTINGS:
        if os.environ.get(name):
            network, reach = True, f"found by other hosts as {name} says"
            break
    else:
        everyone = "found by every host on the network, which can also steer them"
        reach = everyone if network else "visible on this machine only; --network opens it"
    if any(name in os.environ for name in _TRANSPORT_SETTINGS):
        return Transport({}, reach)
    if os.environ.get("RMW_IMPLEMENTATION", "") not in _FAST_DDS:
        return Transport({} if network else {_RANGE: "LOCALHOST"}, reach)
    free = free_memory()
    segment = segment_size(free, participants)
    # with LOCALHOST, the ports would stay open on all interfaces
    limit = {} if network else {_RANGE: "SYSTEM_DEFAULT"}
    environment = {
        PROFILES[_has_fast_dds_3()]: str(resource_path(f"config/{_profile(segment, network)}.xml")),
        _SEGMENT_BYTES: str(segment),
        _MEMORY_POLICY: "1",
        **limit,
    }
    return Transport(environment, reach, _warning(segment, free, participants))


@functools.cache
def _has_fast_dds_3() -> bool:
    """Whether the ROS of this process has Fast DDS 3 (Kilted and later). Its library has another name."""
    folders = [f"{sys.prefix}/lib", *os.environ.get("LD_LIBRARY_PATH", "").split(":")]
    return any(any(Path(folder).glob("libfastdds.so*")) for folder in folders if folder)


def _profile(segment: int, network: bool) -> str:
    """Name of the Fast DDS profile for a segment size. 0 stands for no shared memory."""
    if segment == FULL_SEGMENT and network:
        return "fastdds"
    if segment:
        return "fastdds_small" if network else "fastdds_local"
    return "fastdds_udp" if network else "fastdds_local_udp"


def _warning(segment: int, free: float, participants: int | None) -> str:
    if segment >= _SMALL_SEGMENT:
        return ""
    gigabytes = max(1, math.ceil((participants or 1) * _FULL_PROCESS / 1e9))
    effect = (
        f"a process gets {segment / 1e6:.1f} MB of shared memory instead of {FULL_SEGMENT / 1e6:.0f}: "
        f"best-effort subscribers may lose images above {segment / 2e6:.1f} MB"
        if segment
        else "images go over UDP: best-effort subscribers lose many of them, reliable ones get all"
    )
    return f"/dev/shm has {free / 1e6:.0f} MB free, so {effect}. In Docker: --shm-size={gigabytes}g"


#: Domains with UDP ports below the ephemeral ports of Linux. Domain 0 is left out, since everybody uses it.
_DOMAINS = range(1, 100)


def claim_domain() -> int:
    """Reserve a ROS domain for this process, which no other test or challenge on this machine then uses."""
    return _claim(os.getpid())[0]


@functools.cache
def _claim(process: int) -> tuple[int, int | None]:
    """Reserve a domain for a process. Returns the domain, and the descriptor of its locked file."""
    first = process % len(_DOMAINS)
    for domain in (*_DOMAINS[first:], *_DOMAINS[:first]):
        path = Path(tempfile.gettempdir()) / f"humansim_test_domain_{domain}.lock"
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError:  # of another user
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # locked
            os.close(descriptor)
            continue
        return domain, descriptor
    return _DOMAINS[first], None


def domain_environment(domain: int) -> dict[str, str]:
    """Environment variables for a ROS domain that other hosts do not see."""
    return {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
