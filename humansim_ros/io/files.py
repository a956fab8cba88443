"""Read input files with clear errors, resolve file names in files, and write files atomically."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from humansim_ros.errors import HumansimError, did_you_mean, near_names

#: Names of a folder that are compared with the name of a missing file.
_MOST_NAMES = 5000


@contextmanager
def reading_errors(path: str | os.PathLike[str], error: type[HumansimError], what: str) -> Iterator[None]:
    """Convert exceptions of opening and reading a file to ``error`` with path and reason."""
    if "\0" in os.fspath(path):
        raise error("a file name cannot contain a NUL character", path=path)
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        near = near_file(Path(path))
        raise error(f"no such {what} file; {near or 'check the path'}", path=path) from None
    except IsADirectoryError:
        raise error(f"this is a folder, not a {what} file", path=path) from None
    except OSError as reason:
        raise error(f"cannot read the {what} file: {reason.strerror or reason}", path=path) from None


def read_bytes(
    path: str | os.PathLike[str], error: type[HumansimError], what: str, most: int | None = None
) -> bytes:
    """Read a file.

    Args:
        path: File to read.
        error: Error class to raise.
        what: Kind of file for messages, such as ``mesh``.
        most: Maximum size in bytes.

    Raises:
        HumansimError: ``error``, if the file is missing, a folder, unreadable, empty or too large.
    """
    with reading_errors(path, error, what), Path(path).open("rb") as file:
        data = file.read() if most is None else file.read(most + 1)
    if most is not None and len(data) > most:
        raise error(f"this is too large for a {what} file: more than {most >> 20} MB", path=path)
    if not data.strip():
        raise error(f"the {what} file is empty", path=path)
    return data


def read_text(
    path: str | os.PathLike[str], error: type[HumansimError], what: str, most: int | None = None
) -> str:
    """Read a text file: UTF-8 with or without BOM, or else Latin-1.

    Args:
        path: File to read.
        error: Error class to raise.
        what: Kind of file for messages, such as ``scene``.
        most: Maximum size in bytes.

    Raises:
        HumansimError: ``error``, as for :func:`read_bytes`, and for binary files.
    """
    return decode_text(read_bytes(path, error, what, most), path, error, what)


def decode_text(data: bytes, path: str | os.PathLike[str], error: type[HumansimError], what: str) -> str:
    """Text of the content of a file: UTF-8 with or without BOM, or else Latin-1.

    Args:
        data: Content of the file.
        path: File, for messages.
        error: Error class to raise.
        what: Kind of file for messages, such as ``scene``.

    Raises:
        HumansimError: ``error``, if the file is binary.
    """
    if b"\0" in data:
        raise error(f"this is a binary file, not a {what} text file", path=path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def missing_file(path: Path, hint: str = "") -> str:
    """Message about a file that is missing, with a file of its folder that resembles it.

    ``hint``: what to use instead of a file.
    """
    return "; ".join(filter(None, (f"no such file {str(path)!r}", hint, near_file(path))))


def near_file(path: Path) -> str:
    """What was probably meant by the path of a missing file; empty if nothing resembles it."""
    try:
        if path.is_symlink():
            return "it is a link to a file that is missing"
        folder = next((parent for parent in path.parents if parent.exists()), None)
        if folder is None:
            return ""
        if not folder.is_dir():
            return f"{str(folder)!r} is not a folder"
        missing = path.relative_to(folder).parts[0]
        if folder != path.parent:
            return f"{str(folder)!r} has no folder {missing!r}{did_you_mean(missing, _names(folder))}"
        stems: dict[str, list[str]] = {}
        for name in _names(folder):
            stems.setdefault(Path(name).stem, []).append(name)
        nearest = next(iter(near_names(path.stem, stems)), None)
        if nearest is None:
            return ""
        # a file of the same kind comes first
        meant = min(stems[nearest], key=lambda name: (Path(name).suffix != path.suffix, name))
        return f"did you mean {meant!r}?"
    except (OSError, ValueError):  # not readable, name too long, or with a NUL character
        return ""


def _names(folder: Path) -> list[str]:
    """Names in a folder, the first thousands."""
    with os.scandir(folder) as entries:
        return [entry.name for entry in islice(entries, _MOST_NAMES)]


def expand_user(name: str) -> Path:
    """Expand ``~`` in a path; unknown users stay as they are."""
    try:
        return Path(name).expanduser()
    except RuntimeError:  # unknown user
        return Path(name)


def exists(path: Path) -> bool:
    """Whether a path exists; False for impossible names."""
    try:
        return path.exists()
    except (OSError, ValueError):  # name too long, or with a NUL character
        return False


def resolve_relative(file: str | os.PathLike[str], name: str) -> tuple[Path, bool]:
    """Resolve a name in a file from the folder of the file; also return whether it exists."""
    path = Path(file).resolve().parent / expand_user(name)
    return path, exists(path)


def resolve_inside(folder: Path, name: str) -> Path | None:
    """Resolve a name in a file to a path in the folder or below it; None for all other paths."""
    try:
        target = (folder.resolve() / name).resolve()
        target.exists()  # raises for names that are too long
        return target if target.is_relative_to(folder.resolve()) and name[:1] not in "/\\" else None
    except (ValueError, OSError, RuntimeError):  # NUL character, name too long, circular links
        return None


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Temporary path in the same folder: renamed to ``path`` after the block, deleted on exceptions."""
    target = Path(path)
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
