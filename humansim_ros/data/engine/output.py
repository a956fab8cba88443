"""Output folders on any file system of fsspec, such as a local disk or s3. Files appear there only when
complete."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from humansim_ros.errors import BagError, HumansimError

#: File systems where a file appears only when its upload is complete. Renaming a file there would copy it.
_OBJECT_STORES = {"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oss", "oci", "http", "https"}
#: Prefix of the names of incomplete files.
_PARTIAL = ".partial-"


def is_url(text: str) -> bool:
    """Whether an output is a URL, such as ``s3://bucket/walks``, and not a path."""
    return "://" in text


@dataclass(frozen=True)
class OutputFolder:
    """A folder, named by a path or a URL that fsspec knows. It can be sent to other processes. All methods
    raise BagError, which names the URL, if the file system fails."""

    url: str

    @cached_property
    def _place(self) -> tuple[Any, str]:
        """File system, and the path of the folder on it."""
        try:
            import fsspec
        except ImportError:
            message = "a URL as output needs fsspec; install it: pip install 'humansim_ros[ray]'"
            raise BagError(message, path=self.url) from None
        with self._errors():
            system, path = fsspec.core.url_to_fs(self.url)
            return system, str(path).rstrip("/")

    def __reduce__(self) -> tuple[type[OutputFolder], tuple[str]]:
        return OutputFolder, (self.url,)  # file systems with threads cannot be sent to other processes

    @property
    def local(self) -> Path | None:
        """The folder as a path on this machine; None for other file systems."""
        system, path = self._place
        return Path(path) if "file" in self._protocols(system) else None

    @property
    def name(self) -> str:
        """Last part of the path."""
        return PurePosixPath(self._place[1]).name

    def folder(self, name: str) -> OutputFolder:
        """A folder in this folder."""
        return OutputFolder(f"{self.url.rstrip('/')}/{name}")

    def names(self) -> set[str]:
        """Names of files and subfolders. Empty if the folder does not exist."""
        system, path = self._place
        with self._errors():
            system.invalidate_cache()
            try:
                found = system.ls(path, detail=False)
            except FileNotFoundError:
                return set()
            if not system.isdir(path):
                raise BagError("this is a file, not a folder", path=self.url)
        names = {PurePosixPath(each.rstrip("/")).name for each in found}
        return {name for name in names if not name.startswith(_PARTIAL)}

    def create(self) -> None:
        """Create the folder, if the file system has folders, and check that it can be written."""
        system, path = self._place
        with self._errors():
            system.makedirs(path, exist_ok=True)
        probe = f"{_PARTIAL}{uuid.uuid4().hex}"
        with self._errors():
            system.pipe_file(f"{path}/{probe}", b"")
            system.rm_file(f"{path}/{probe}")

    def put(self, source: Path, name: str) -> None:
        """Move a local file into the folder. It appears there only when it is complete."""
        if (folder := self.local) is not None:
            with suppress(OSError):  # the file is on another disk
                source.replace(folder / name)
                return
        with self._complete(name) as partial, self._errors():
            self._place[0].put_file(str(source), partial)
        source.unlink()

    def write(self, name: str, content: bytes) -> None:
        """Write a small file atomically."""
        with self._complete(name) as partial, self._errors():
            self._place[0].pipe_file(partial, content)

    @contextmanager
    def _complete(self, name: str) -> Iterator[str]:
        """Give a path to write a file to. If the file system shows incomplete files, it has another name
        until the end."""
        system, path = self._place
        if self._protocols(system) & _OBJECT_STORES:
            yield f"{path}/{name}"
            return
        partial = f"{path}/{_PARTIAL}{uuid.uuid4().hex}"
        try:
            yield partial
            with self._errors():
                system.mv(partial, f"{path}/{name}")
        except BaseException:
            with suppress(Exception):
                system.rm_file(partial)
            raise

    def read(self, name: str) -> bytes:
        """Content of a small file."""
        with self._errors():
            return bytes(self._place[0].cat_file(f"{self._place[1]}/{name}"))

    def get(self, name: str, target: Path) -> None:
        """Copy a file to a local path."""
        with self._errors():
            self._place[0].get_file(f"{self._place[1]}/{name}", str(target))

    def open(self, name: str) -> BinaryIO:
        """Open a file to read it from its start to its end."""
        with self._errors():
            file: BinaryIO = self._place[0].open(f"{self._place[1]}/{name}", "rb")
            return file

    def remove(self, name: str) -> None:
        """Remove a file."""
        with self._errors():
            self._place[0].rm_file(f"{self._place[1]}/{name}")

    def delete(self) -> None:
        """Remove the folder with all files."""
        with self._errors():
            self._place[0].rm(self._place[1], recursive=True)

    @staticmethod
    def _protocols(system: Any) -> set[str]:
        protocol = system.protocol
        return {protocol} if isinstance(protocol, str) else set(protocol)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Convert the exceptions of file systems, since each library has its own."""
        try:
            yield
        except HumansimError:
            raise
        except ImportError as reason:  # such as "Install s3fs to access S3"
            raise BagError(f"{reason}, or write to a folder of this machine", path=self.url) from None
        except Exception as reason:
            text = getattr(reason, "strerror", None) or str(reason) or type(reason).__name__
            raise BagError(f"the output cannot be used: {text}", path=self.url) from reason
