"""Folders on this machine, or on any file system of fsspec, such as s3. Files appear there only when
complete."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from humansim_ros.errors import HumansimError

#: File systems where a file appears only when its upload is complete. Renaming a file there would copy it.
_OBJECT_STORES = {"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oss", "oci", "http", "https"}
#: Name of the folder of work that is not finished, in the folder of the product.
WORK = ".work"
#: Part of the names of incomplete files. A library may add a dot and a suffix while it writes one.
PARTIAL = ".partial-"


def is_url(text: str) -> bool:
    """Whether an output is a URL, such as ``s3://bucket/walks``, and not a path."""
    return "://" in text


class OutputFolder:
    """A folder on this machine. It can be sent to other processes.

    Names are relative to the folder, with ``/``. Missing folders are created. All methods raise
    HumansimError, which names the folder, if the file system fails.
    """

    def __init__(self, url: str | os.PathLike[str]) -> None:
        self.url = os.fspath(url)

    @staticmethod
    def at(url: str | os.PathLike[str]) -> OutputFolder:
        """A folder at a path or URL."""
        return UrlFolder(url) if is_url(os.fspath(url)) else OutputFolder(url)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.url,)

    @property
    def local(self) -> Path | None:
        """The folder as a path on this machine; None for other file systems."""
        return Path(self.url)

    @property
    def name(self) -> str:
        """Last part of the path."""
        return Path(self.url).name or Path(self.url).resolve().name

    def path(self, name: str = "") -> Path:
        """Path of a file in a folder on this machine."""
        return Path(self.url, name)

    def exists(self) -> bool:
        """Whether there is anything at this path, such as a folder, a file or a broken link."""
        return os.path.lexists(self.url)

    def names(self, name: str = "") -> set[str]:
        """Names of files and subfolders in a subfolder. Empty if the folder does not exist.

        ``name``: the subfolder. If empty, the folder itself.
        """
        with self._errors():
            try:
                found = [each.name for each in self.path(name).iterdir()]
            except FileNotFoundError:
                return set()
        return {each for each in found if PARTIAL not in each}

    def size(self, name: str) -> int | None:
        """Size of a file, bytes. None if there is no such file."""
        with self._errors():
            try:
                return self.path(name).lstat().st_size
            except (FileNotFoundError, NotADirectoryError):
                return None

    def create(self) -> None:
        """Create the folder, and check that files can be written there. Raises HumansimError if it exists."""
        with self._errors("cannot be written"):
            if not self.path().parent.exists():
                self.path().parent.mkdir(parents=True, exist_ok=True)
            self.path().mkdir()

    def put(self, source: Path, name: str) -> None:
        """Move a local file into the folder. It appears there only when it is complete."""
        with self._errors("cannot be written"):
            target = self.path(name)
            target.parent.mkdir(parents=True, exist_ok=True)
            source.replace(target)

    def write(self, name: str, content: bytes | str) -> None:
        """Write a small file atomically. Text is UTF-8."""
        data = content.encode() if isinstance(content, str) else content
        with self._errors("cannot be written"):
            target = self.path(name)
            # in the folder of the work, so that nothing else is left after a kill
            partial = self.path(f"{WORK}/{PARTIAL}{uuid.uuid4().hex}")
            for folder in (target.parent, partial.parent):
                folder.mkdir(parents=True, exist_ok=True)
            try:
                partial.write_bytes(data)
                partial.replace(target)
            except BaseException:
                partial.unlink(missing_ok=True)
                raise

    def read(self, name: str) -> bytes:
        """Content of a small file."""
        with self.open(name) as file, self._errors():
            return file.read()

    def open(self, name: str) -> BinaryIO:
        """Open a file to read it from its start to its end."""
        with self._errors():
            path = self.path(name)
            if not path.is_file():  # to open a named pipe would wait
                raise HumansimError("is missing, or is not a regular file", path=path)
            return path.open("rb")

    def remove(self, name: str) -> None:
        """Remove a file, if there is one."""
        with self._errors("cannot be written"):
            self.path(name).unlink(missing_ok=True)

    def delete(self, name: str = "") -> None:
        """Remove a subfolder with all its files, if there is one. ``name``: the subfolder. If empty, the
        folder itself."""
        with self._errors("cannot be written"), suppress(FileNotFoundError):
            shutil.rmtree(self.path(name))

    @contextmanager
    def _errors(self, what: str = "cannot be read") -> Iterator[None]:
        """Convert errors of the file system."""
        try:
            yield
        except OSError as reason:
            text = f"{what}: {reason.strerror or reason}"
            path = reason.filename2 or reason.filename or self.url
            raise HumansimError(text, path=path) from reason


class UrlFolder(OutputFolder):
    """A folder on a file system of fsspec."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.url,)  # file systems with threads cannot be sent to other processes

    @cached_property
    def _place(self) -> tuple[Any, str]:
        """File system, and the path of the folder on it."""
        try:
            import fsspec
        except ImportError:
            message = "a URL as output needs fsspec; install it: pip install 'humansim_ros[ray]'"
            raise HumansimError(message, path=self.url) from None
        with self._errors():
            system, path = fsspec.core.url_to_fs(self.url)
            return system, str(path).rstrip("/")

    def _full(self, name: str) -> str:
        return f"{self._place[1]}/{name}".rstrip("/")

    @property
    def local(self) -> Path | None:
        return None

    @property
    def name(self) -> str:
        return PurePosixPath(self._place[1]).name

    def exists(self) -> bool:
        with self._errors():
            return bool(self._place[0].exists(self._place[1]))

    def names(self, name: str = "") -> set[str]:
        system, path = self._place[0], self._full(name)
        with self._errors():
            system.invalidate_cache()
            try:
                found = system.ls(path, detail=False)
            except FileNotFoundError:
                return set()
            if not system.isdir(path):
                raise HumansimError("this is a file, not a folder", path=self.url)
        names = {PurePosixPath(each.rstrip("/")).name for each in found}
        return {each for each in names if PARTIAL not in each}

    def size(self, name: str) -> int | None:
        with self._errors():
            try:
                return int(self._place[0].info(self._full(name))["size"])
            except FileNotFoundError:
                return None

    def create(self) -> None:
        system, path = self._place
        probe = f"{path}/{PARTIAL}{uuid.uuid4().hex}"
        with self._errors():
            system.makedirs(path, exist_ok=True)
            system.pipe_file(probe, b"")
            system.rm_file(probe)

    def put(self, source: Path, name: str) -> None:
        with self._complete(name) as partial, self._errors():
            self._place[0].put_file(str(source), partial)
        source.unlink()

    def write(self, name: str, content: bytes | str) -> None:
        with self._complete(name) as partial, self._errors():
            data = content.encode() if isinstance(content, str) else content
            self._place[0].pipe_file(partial, data)

    @contextmanager
    def _complete(self, name: str) -> Iterator[str]:
        """Give a path to write a file to. If the file system shows incomplete files, it has another name
        until the end."""
        system, path = self._place[0], self._full(name)
        protocols = {system.protocol} if isinstance(system.protocol, str) else set(system.protocol)
        if protocols & _OBJECT_STORES:
            yield path
            return
        partial = self._full(f"{WORK}/{PARTIAL}{uuid.uuid4().hex}")
        try:
            with self._errors():
                for each in (path, partial):
                    system.makedirs(each.rpartition("/")[0], exist_ok=True)
            yield partial
            with self._errors():
                system.mv(partial, path)
        except BaseException:
            with suppress(Exception):
                system.rm_file(partial)
            raise

    def open(self, name: str) -> BinaryIO:
        with self._errors():
            file: BinaryIO = self._place[0].open(self._full(name), "rb")
            return file

    def remove(self, name: str) -> None:
        with self._errors(), suppress(FileNotFoundError):
            self._place[0].rm_file(self._full(name))

    def delete(self, name: str = "") -> None:
        with self._errors(), suppress(FileNotFoundError):
            self._place[0].rm(self._full(name), recursive=True)

    @contextmanager
    def _errors(self, what: str = "cannot be used") -> Iterator[None]:
        """Convert the exceptions of file systems, since each library has its own."""
        try:
            yield
        except HumansimError:
            raise
        except ImportError as reason:  # such as "Install s3fs to access S3"
            raise HumansimError(f"{reason}, or write to a folder of this machine", path=self.url) from None
        except Exception as reason:
            text = getattr(reason, "strerror", None) or str(reason) or type(reason).__name__
            raise HumansimError(f"the output {what}: {text}", path=self.url) from reason
