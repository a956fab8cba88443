"""Folder of an export: files appear there whole, and their hashes are kept for the index."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypedDict

from humansim_ros.errors import ExportError
from humansim_ros.io.files import atomic_path, read_blocks

#: Folder of an export with what finished frames leave for the files of the whole export; removed at its end.
TEMPORARY = ".frames"


class FileEntry(TypedDict):
    """A file of an export as its index lists it: hash, and size in bytes."""

    sha256: str
    bytes: int


class ExportFolder:
    """A folder of an export. All methods raise HumansimError with the path if a file cannot be written.

    Names are relative to the folder, with ``/``; missing folders are made.

    Args:
        root: Folder of the whole export.
        prefix: Path of this folder in it; "" is the root itself.

    Attributes:
        written: Files that were written here and in :meth:`subfolder`, by path relative to the root.
    """

    def __init__(self, root: Path, prefix: str = "") -> None:
        self.root = root
        self._prefix = f"{prefix}/" if prefix else ""
        self.written: dict[str, FileEntry] = {}

    def subfolder(self, name: str) -> ExportFolder:
        """A folder in this one, with the same :attr:`written`."""
        folder = ExportFolder(self.root, self._prefix + name)
        folder.written = self.written
        return folder

    def root_folder(self) -> ExportFolder:
        """The root of the export, with the same :attr:`written`."""
        folder = ExportFolder(self.root)
        folder.written = self.written
        return folder

    def write(self, name: str, content: bytes | str) -> None:
        """Write a file at once; text as UTF-8."""
        with self.path(name) as path:
            path.write_bytes(content.encode() if isinstance(content, str) else content)

    def write_temporary(self, name: str, content: bytes) -> None:
        """Write a file that :meth:`temporary` finds until the export is complete."""
        folder = ExportFolder(self.root, f"{TEMPORARY}/{self._prefix}".rstrip("/"))
        folder.written = self.written
        folder.write(name, content)

    def temporary(self, name: str) -> Path:
        """Path of a file of :meth:`write_temporary`."""
        return self.root / TEMPORARY / f"{self._prefix}{name}"

    @contextmanager
    def path(self, name: str) -> Iterator[Path]:
        """Temporary path to write a file to, which gets its name after the block."""
        relative = self._prefix + name
        target = self.root / relative
        self._make_folder(target.parent)
        with atomic_path(target) as temporary:
            yield temporary
            self.written[relative] = _entry(temporary)

    def link(self, name: str, target: str) -> None:
        """Make a symbolic link to a file or folder of the export, so that no image is written twice.

        ``target``: path relative to the root of the export.
        """
        link = self.root / self._prefix / name
        self._make_folder(link.parent)
        text = os.path.relpath(self.root / target, link.parent)
        try:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(text)
        except OSError as reason:
            raise ExportError(f"no link can be made: {reason.strerror or reason}", path=link) from None

    @staticmethod
    def _make_folder(folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as reason:
            raise ExportError(
                f"this folder cannot be made: {reason.strerror or reason}", path=folder
            ) from None


def _entry(path: Path) -> FileEntry:
    digest, size = hashlib.sha256(), 0
    for block in read_blocks(path, ExportError, "export"):
        digest.update(block)
        size += len(block)
    return {"sha256": digest.hexdigest(), "bytes": size}
