"""Reading input files with errors that a person can act on, and writing output files whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from humansim_ros.errors import HumansimError


@contextmanager
def reading_errors(path: str | os.PathLike[str], error: type[HumansimError], what: str) -> Iterator[None]:
    """Turns what opening and reading a file raises into ``error``, which names the path and the reason."""
    if "\0" in os.fspath(path):
        raise error("no file can have this name: there is a NUL in it", path=path)
    try:
        yield
    except FileNotFoundError:
        raise error(f"no such {what} file; check the path", path=path) from None
    except IsADirectoryError:
        raise error(f"this is a folder, not a {what} file", path=path) from None
    except OSError as reason:
        raise error(f"cannot read the {what} file: {reason.strerror or reason}", path=path) from None


def read_bytes(
    path: str | os.PathLike[str], error: type[HumansimError], what: str, most: int | None = None
) -> bytes:
    """Content of a file; ``error`` names the path and the reason if it is missing, a folder, unreadable,
    empty, or longer than ``most`` bytes.
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
    """Text of a file (UTF-8, with or without BOM; bytes that are not UTF-8 are read as Latin-1)."""
    data = read_bytes(path, error, what, most)
    if b"\0" in data:
        raise error(f"this is a binary file, not a {what} text file", path=path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def expand_user(name: str) -> Path:
    """A path as people write it; ``~`` is their home."""
    try:
        return Path(name).expanduser()
    except RuntimeError:  # of somebody who is not known here
        return Path(name)


def exists(path: Path) -> bool:
    """Whether a file or folder is there; also of names that none can have."""
    try:
        return path.exists()
    except (OSError, ValueError):  # too long for the file system, or a NUL in it
        return False


def resolve_relative(file: str | os.PathLike[str], name: str) -> tuple[Path, bool]:
    """A file or folder that another file names from its own folder, and whether it is there."""
    path = Path(file).resolve().parent / expand_user(name)
    return path, exists(path)


def resolve_inside(folder: Path, name: str) -> Path | None:
    """A file that another one names, in the folder of that one or below; None for any other place."""
    try:
        target = (folder.resolve() / name).resolve()
        target.exists()  # tells a name that is too long
        return target if target.is_relative_to(folder.resolve()) and name[:1] not in "/\\" else None
    except (ValueError, OSError, RuntimeError):  # a zero byte, a name too long, links in a circle
        return None


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its name when the block ends well, and vanishes when it
    does not.
    """
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
