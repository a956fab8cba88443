"""Read files and JSON with clear errors, find files that files name, write atomically, make temporary
folders."""

from __future__ import annotations

import fcntl
import json
import math
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

from humansim_ros.errors import HIDING, HumansimError, did_you_mean, near_names

#: Number of bytes that :func:`read_blocks` reads at once.
_BLOCK = 1 << 20
#: Most names of a folder that are compared with the name of a missing file.
_MOST_NAMES = 5000
#: What to call entries of a folder that are not regular files, by their type.
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@contextmanager
def reading_errors(path: str | os.PathLike[str], error: type[HumansimError], what: str) -> Iterator[None]:
    """Convert exceptions of opening and reading a file, in the block, to ``error`` with path and reason."""
    if "\0" in os.fspath(path):
        raise error("a file name cannot contain a NUL character", path=path)
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        near = near_file(Path(path))
        raise error(f"no such {what} file; {near or 'check the path'}", path=path) from None
    except OSError as reason:
        raise error(f"cannot read the {what} file: {reason.strerror or reason}", path=path) from None


#: Flags for opening files. Opening never waits.
_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY
#: Limit of :func:`open_file` for files that are read block by block.
ANY_SIZE = 1 << 62


def open_file(
    path: str | os.PathLike[str],
    error: type[HumansimError],
    what: str,
    most: int,
    *,
    may_be_empty: bool = False,
) -> BinaryIO:
    """Open a regular file to read it. All files of users are opened by this function.

    Opening never waits. The kind of the file and its size are checked before anything is read.

    Args:
        path: File to open.
        error: Error class to raise.
        what: Kind of file for messages, such as ``mesh``.
        most: Maximum size in bytes.
        may_be_empty: Whether empty files are opened, too.

    Raises:
        HumansimError: ``error``, if the file is missing, not a regular file (a folder, a named pipe, a
            device), unreadable, empty or too large.
    """
    with reading_errors(path, error, what):
        # checked before it is opened, since to open a pipe or a device can have effects
        _check_entry(Path(path).stat(), path, error, what)
        descriptor = os.open(path, _READ)
        try:
            status = os.fstat(descriptor)
            _check_entry(status, path, error, what)
            if (quotes := HIDING.get()) is not None:
                quotes.files[os.fspath(path)] = None
            if status.st_size == 0 and not may_be_empty:
                raise error(f"the {what} file is empty", path=path)
            if status.st_size > most:
                size, limit = size_text(status.st_size), size_text(most)
                raise error(f"the {what} file is too large: {size}; at most {limit} are read", path=path)
        except BaseException:
            os.close(descriptor)
            raise
    return os.fdopen(descriptor, "rb")


def read_blocks(path: str | os.PathLike[str], error: type[HumansimError], what: str) -> Iterator[bytes]:
    """Content of a file of any size, block by block. No block if the file is empty. Errors are those of
    :func:`open_file`."""
    with open_file(path, error, what, ANY_SIZE, may_be_empty=True) as file, reading_errors(path, error, what):
        while block := file.read(_BLOCK):
            yield block


def _check_entry(
    status: os.stat_result, path: str | os.PathLike[str], error: type[HumansimError], what: str
) -> None:
    """Raise ``error`` unless the entry is a regular file."""
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "something else")
        raise error(f"cannot read the {what} file: this is {kind}, not a regular file", path=path)


def size_text(size: int) -> str:
    """Number of bytes in words, such as ``1.5 MB``."""
    for unit, bits in (("GB", 30), ("MB", 20), ("kB", 10)):
        if size >= 1 << bits:
            return f"{size / (1 << bits):.1f}".removesuffix(".0") + f" {unit}"
    return f"{size} bytes"


def read_bytes(path: str | os.PathLike[str], error: type[HumansimError], what: str, most: int) -> bytes:
    """Read a file.

    Args:
        path, error, what, most: The same as in :func:`open_file`, which also lists the errors.
    """
    with open_file(path, error, what, most) as file, reading_errors(path, error, what):
        data = file.read(os.fstat(file.fileno()).st_size)
    if not data or data.isspace():
        raise error(f"the {what} file is empty", path=path)
    return data


def read_text(path: str | os.PathLike[str], error: type[HumansimError], what: str, most: int) -> str:
    """Read a text file: UTF-8 with or without BOM, or else Latin-1. Binary files raise ``error``, too.

    Args:
        path, error, what, most: The same as in :func:`open_file`, which also lists the errors.
    """
    return decode_text(read_bytes(path, error, what, most), path, error, what)


def decode_text(data: bytes, path: str | os.PathLike[str], error: type[HumansimError], what: str) -> str:
    """Decode the content of a text file: UTF-8 with or without BOM, or else Latin-1.

    Args:
        data: Content of the file.
        path, error, what: The same as in :func:`open_file`. The error is raised if the file is binary.
    """
    if b"\0" in data:
        raise error(f"this is a binary file, not a {what} text file", path=path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


#: East Asian encodings, with their names in messages.
ENCODINGS = {"cp932": "Shift-JIS", "gb18030": "GBK", "cp949": "EUC-KR", "big5": "Big5", "euc_jp": "EUC-JP"}
#: An encoding is accepted if at least this share of the decoded characters is in ``_BODY``.
_LEAST_BODY = 0.2
#: Characters in names of joints in these scripts: left, right, and parts of the body.
_BODY = frozenset(
    "左右上下手足腕脚腳腿臂膝首頭头頸颈肩腰胸身骨根踝肘趾指髋髖盆脊親人中先大小捩両目"
    "ンスセタルーひじざつまさき왼오른쪽팔다리발손머목허무릎어깨가슴척추골반꿈치"
)


def text_encoding(data: bytes) -> str:
    """Detect the encoding of a text with names of joints, from characters for parts of the body. Returns a
    codec of Python: ``utf-16`` or a variant of it, one of :data:`ENCODINGS`, or ``latin-1``, also for UTF-8.
    ``data``: start of the text. The last line is ignored, since it may be cut."""
    if b"\0" in data[:2] or data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return {b"\0": "utf-16-be", b"\xff": "utf-16", b"\xfe": "utf-16"}.get(data[:1], "utf-16-le")
    names = b"\n".join(line for line in data.splitlines()[:-1] if not line.isascii())
    shares = {"latin-1": _LEAST_BODY}
    for encoding in ("utf-8", *ENCODINGS):
        with suppress(UnicodeDecodeError):
            wide = [letter for letter in names.decode(encoding) if not letter.isascii()]
            if encoding == "utf-8":
                break
            shares[encoding] = sum(letter in _BODY for letter in wide) / len(wide)
    return max(shares, key=lambda encoding: shares[encoding])


#: Most values of a JSON text (each value needs some fifty bytes of memory), and most nested levels.
MAX_JSON_VALUES, _MAX_JSON_DEPTH = 100_000_000, 100


def parse_json(
    text: str,
    error: type[HumansimError],
    path: str | os.PathLike[str] | None = None,
    *,
    kind: str = "valid JSON",
    most: int = MAX_JSON_VALUES,
    nan: bool = False,
    pairs: Callable[[list[tuple[str, Any]]], Any] | None = None,
) -> Any:
    """Parse untrusted JSON. All JSON of users is parsed by this function.

    A whole number beyond 64 bits becomes a float, as in JavaScript.

    Args:
        text: The JSON text.
        error: Error class to raise.
        path: File, for messages.
        kind: What the text should be, for messages.
        most: Maximum count of values and keys.
        nan: Whether NaN and Infinity are accepted. They are not valid JSON, but common. The caller must check
            its numbers.
        pairs: Function that makes an object from its keys and values. If None, an object becomes a dict.

    Raises:
        HumansimError: ``error`` with path and line, if the text is no JSON, has too many values or levels,
            or a number that a float cannot hold.

    Example:
        >>> parse_json('{"a": [1, 2.5, 100000000000000000000]}', HumansimError)
        {'a': [1, 2.5, 1e+20]}
    """
    try:
        if sum(text.count(mark) for mark in ",[{") > most:
            raise ValueError(f"more than {most} values")
        content = json.loads(
            text,
            object_pairs_hook=pairs,
            parse_int=_json_integer,
            parse_float=_json_float,
            parse_constant=float if nan else _no_json_number,
        )
        if _is_deep(content):
            raise RecursionError
    except json.JSONDecodeError as reason:
        raise error(f"not {kind}: {reason}", path=path, line=reason.lineno) from None
    except ValueError as reason:
        raise error(f"not {kind}: {reason}", path=path) from None
    except RecursionError:
        raise error(f"not {kind}: more than {_MAX_JSON_DEPTH} nested levels", path=path) from None
    return content


def read_json(
    path: str | os.PathLike[str], error: type[HumansimError], what: str, most: int, *, nan: bool = False
) -> Any:
    """Read a JSON file. Raises ``error``, in the cases of :func:`read_text` and :func:`parse_json`.

    Args:
        path, error, what, most: The same as in :func:`read_text`.
        nan: The same as in :func:`parse_json`.
    """
    return parse_json(read_text(path, error, what, most), error, path, nan=nan)


def _json_integer(digits: str) -> int | float:
    if len(digits) <= 18:
        return int(digits)
    number = _json_float(digits) if len(digits) > 20 else int(digits)
    return number if -(1 << 63) <= number < 1 << 63 else float(number)


def _json_float(digits: str) -> float:
    number = float(digits)
    if math.isinf(number):
        shown = digits if len(digits) <= 20 else f"{digits[:10]}… ({len(digits)} characters)"
        raise ValueError(f"the number {shown} is too large")
    return number


def _no_json_number(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _is_deep(content: Any) -> bool:
    level: list[Any] = [[content]]
    for _ in range(_MAX_JSON_DEPTH + 2):
        inner = (each.values() if isinstance(each, dict) else each for each in level)
        level = [child for children in inner for child in children if isinstance(child, (dict, list))]
    return bool(level)


def missing_file(path: Path, hint: str = "") -> str:
    """Message about a missing file, with the name of a similar file if the folder has one. ``hint``: what to
    use instead of a file."""
    return "; ".join(filter(None, (f"no such file {str(path)!r}", hint, near_file(path))))


def near_file(path: Path) -> str:
    """Suggest what the path of a missing file probably means. Empty if nothing resembles it."""
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
    """Names in a folder, but at most ``_MOST_NAMES`` of them."""
    with os.scandir(folder) as entries:
        return [entry.name for entry in islice(entries, _MOST_NAMES)]


def expand_user(name: str) -> Path:
    """Expand ``~`` in a path. The name of an unknown user is not changed."""
    try:
        return Path(name).expanduser()
    except RuntimeError:  # unknown user
        return Path(name)


def exists(path: Path) -> bool:
    """Whether a path exists. False for impossible names."""
    try:
        return path.exists()
    except (OSError, ValueError):  # name too long, or with a NUL character
        return False


def resolve_relative(file: str | os.PathLike[str], name: str) -> tuple[Path, bool]:
    """Resolve a name in a file, relative to the folder of the file. Returns also whether the path exists."""
    path = Path(file).resolve().parent / expand_user(name)
    return path, exists(path)


def resolve_inside(folder: Path, name: str) -> Path | None:
    """Resolve a name in a file to a path in the folder or below it. Returns None for all other paths."""
    try:
        target = (folder.resolve() / name).resolve()
        target.exists()  # raises for names that are too long
        return target if target.is_relative_to(folder.resolve()) and name[:1] not in "/\\" else None
    except (ValueError, OSError, RuntimeError):  # NUL character, name too long, circular links
        return None


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Temporary path in the same folder. It is renamed to ``path`` after the block, and deleted on
    exceptions. Raises HumansimError if the file cannot be written, in the block or after it.

    If ``path`` is a link, the file behind it is replaced. A device or pipe, such as ``/dev/stdout``, gets the
    content.
    """
    target = Path(path)
    try:
        if target.exists() and not target.is_file() and not target.is_dir():
            with tempfile.TemporaryDirectory() as folder:
                temporary = Path(folder) / target.name
                yield temporary
                with temporary.open("rb") as content, target.open("wb") as device:
                    shutil.copyfileobj(content, device)
        else:
            with _beside(target.resolve()) as temporary:
                yield temporary
    except OSError as reason:
        raise HumansimError(f"cannot be written: {reason.strerror or reason}", path=path) from None


def write_file(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write a file atomically, text as UTF-8. Raises HumansimError if the file cannot be written."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def make_folder(path: str | os.PathLike[str]) -> None:
    """Make a folder and its parents, unless they exist. Raises HumansimError if it cannot be made."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise HumansimError("this is a file: give a folder", path=path) from None
    except OSError as reason:
        raise HumansimError(f"cannot be written: {reason.strerror or reason}", path=path) from None


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    """Temporary path in the folder of ``target``, renamed to it after the block."""
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


# --- temporary folders, and the cache


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Temporary folder. It is removed at the end of ``with``. Raises HumansimError if no folder can be made,
    such as on a full disk."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="humansim-", ignore_cleanup_errors=True)
    except OSError as reason:
        raise HumansimError(
            f"cannot make a temporary folder: {reason.strerror}; set TMPDIR to a folder with space"
        ) from None
    with folder as name:
        yield Path(name)


def cache_folder() -> Path | None:
    """Folder of the cache: ``$HUMANSIM_CACHE``, or else ``humansim_ros/humans`` in the user's cache folder.
    Returns None if HUMANSIM_CACHE is ``off``."""
    own = os.environ.get("HUMANSIM_CACHE")
    if own:
        return None if own == "off" else expand_user(own)
    base = os.environ.get("XDG_CACHE_HOME") or expand_user("~/.cache")
    return Path(base) / "humansim_ros" / "humans"


@contextmanager
def only_one_process(path: Path) -> Iterator[None]:
    """Make processes that want to create the same file do so one after the other. A process that has waited
    finds the file ready. Without write access no process waits. ``path``: lock file, which is removed
    afterwards."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    except OSError:
        yield
        return
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)
            # unlocked explicitly, since a child process may have it open
            fcntl.flock(lock, fcntl.LOCK_UN)
        os.close(lock)
