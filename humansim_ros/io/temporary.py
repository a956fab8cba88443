"""Temporary folders that do not outlive their process for long, however it ends."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from humansim_ros.errors import HumansimError

_PREFIX = "humansim-"
#: File in a folder that its process keeps locked.
_LOCK = ".lock"
#: Seconds in which a process has surely locked a folder that it has made.
_MAKING = 10.0


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Temporary folder, removed at the end of ``with``.

    A process that is killed leaves its folder: this call first removes such folders of this user. A folder
    whose process lives is locked, also if the process runs in another container with the same ``/tmp``.

    Raises:
        HumansimError: No folder can be made, such as on a full disk.
    """
    _remove_dead_folders()
    try:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
    except OSError as reason:
        raise HumansimError(
            f"cannot make a temporary folder: {reason.strerror}; set TMPDIR to a folder with space"
        ) from None
    try:
        with (folder / _LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _remove_dead_folders() -> None:
    with suppress(OSError):
        for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
            with suppress(OSError):
                found = folder.lstat()
                own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()
                if own and time.time() - found.st_mtime > _MAKING:
                    _remove_if_dead(folder)


def _remove_if_dead(folder: Path) -> None:
    """Remove a folder whose lock file nobody has locked; OSError if it is locked or has no lock file."""
    lock = os.open(folder / _LOCK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)  # it follows no links
    finally:
        os.close(lock)
