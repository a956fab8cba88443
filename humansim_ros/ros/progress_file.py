"""A file with the stamp of the frame in flight: it survives the death of its process."""

from __future__ import annotations

import os
from pathlib import Path


class ProgressFile:
    """Stamp of a frame in a file.

    ``path``: the file; it is created if it is missing.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    @property
    def stamp(self) -> int:
        """Stamp that was written last, nanoseconds; 0 if there is none."""
        text = os.pread(self._file, 20, 0)
        return int(text) if text.isdigit() else 0

    def write(self, stamp: int) -> None:
        """Write a stamp. One write of 20 bytes is whole or absent also if the process is killed."""
        os.pwrite(self._file, b"%020d" % stamp, 0)

    def remove(self) -> None:
        """Close and remove the file: a later run begins at its start."""
        os.close(self._file)
        self._path.unlink(missing_ok=True)
