"""Find files of the package, humans and motions; hide the content of users' files in messages.

In a source checkout or an editable install, the files are next to the package. After an install by pip or
colcon, they are in ``share/humansim_ros`` of the prefix. AMENT_PREFIX_PATH, which pip users do not have, is
searched last.
"""

from __future__ import annotations

import functools
import json
import mmap
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

from humansim_ros.errors import HIDING, HumansimError, ResourceError, unknown
from humansim_ros.files.reading.files import exists, expand_user, missing_file

_SHARE = Path("share", "humansim_ros")


def resource_path(relative: str | os.PathLike[str]) -> Path:
    """Absolute path of a file or folder of the package, such as ``config/scenes/demo.yaml``."""
    root = resource_root()
    path = root / relative
    if not path.exists():
        raise ResourceError(f"humansim_ros has {missing_file(path)}", path=path)
    return path


@functools.cache
def read_table(name: str) -> Any:
    """Content of a table of the package, ``config/<name>.json``. Do not change it: it is cached."""
    return json.loads(resource_path(f"config/{name}.json").read_text("utf-8"))


@functools.cache
def package_version() -> str:
    """Version of the package, from ``package.xml``, which every kind of installation has."""
    import xml.etree.ElementTree as ElementTree

    return ElementTree.parse(resource_path("package.xml")).getroot().findtext("version", "unknown")


@functools.cache
def resource_root() -> Path:
    """Folder with ``config``, ``assets`` and ``launch``."""
    candidates = list(dict.fromkeys(_candidates()))
    for folder in candidates:
        # package.xml distinguishes this folder from other folders with a config/
        if (folder / "package.xml").is_file() and (folder / "config").is_dir():
            return folder
    raise ResourceError(
        "the configuration and assets of humansim_ros are missing; install it again. Searched folders: "
        + ", ".join(map(str, candidates))
    )


def _candidates() -> Iterator[Path]:
    # resolve the links of colcon's symlink install
    package = Path(__file__).resolve().parents[2]
    yield package.parent
    for parent in package.parents:
        yield parent / _SHARE
    yield Path(sys.prefix) / _SHARE
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix) / _SHARE


AssetKind = Literal["humans", "motions"]
_SUFFIXES: dict[AssetKind, str] = {"humans": ".npz", "motions": ".bvh"}


def built_in_names(kind: AssetKind) -> list[str]:
    """Names of the built-in humans or motions (``assets/<kind>``), sorted."""
    return sorted(path.stem for path in resource_path(f"assets/{kind}").glob(f"*{_SUFFIXES[kind]}"))


def find_asset(
    name: str, kind: AssetKind, folder: Path | None = None, error: type[HumansimError] = HumansimError
) -> Path:
    """Find a human or a motion by name or path.

    Args:
        name: Name of a built-in human or motion, or path of a file.
        kind: ``humans`` or ``motions``.
        folder: Folder that relative paths start from. If None, the current folder.
        error: Class of the error to raise.

    Returns:
        Path of an existing file or folder.

    Raises:
        HumansimError: ``error``, if there is neither a built-in nor a file with this name.
    """
    known = built_in_names(kind)
    if name in known:
        return resource_path(f"assets/{kind}") / f"{name}{_SUFFIXES[kind]}"
    path = (folder or Path.cwd()) / expand_user(name)
    if not exists(path):
        if Path(name).suffix:
            raise error(missing_file(path, f"the built-in {kind} are {', '.join(known)}"))
        raise error(unknown(f"built-in {kind[:-1]} and no file", name, known))
    return path


#: Shown in place of the content of a file.
HIDDEN = "…"
#: Parts of a message: quoted texts, and words.
_PARTS = re.compile(r"""(?<!\w)'(?:[^'\\]|\\.)+'(?!\w)|(?<!\w)"(?:[^"\\]|\\.)+"(?!\w)|[\w.:+$-]{3,}""")
_WORD, _ESCAPE = re.compile(r"\w{3,}"), re.compile(r"\\(?:x..|u.{4}|U.{8}|.)")
#: A short number outside quotes is not hidden: it may be a count or a length, which is in the file by chance.
_NUMBER = re.compile(r"[\d.,:+-]{1,8}")
#: Largest file that is searched, bytes.
_LARGEST = 1 << 24
_ENCODINGS = ("utf-8", "utf-16-le", "utf-16-be", "latin-1", "cp932", "gb18030", "cp949", "big5", "euc_jp")


class FileQuotes:
    """Hides words of users' files in messages. ``known``: text with words that may be shown."""

    def __init__(self, known: Callable[[], object]) -> None:
        self.files: dict[str, None] = {}
        self._known = known

    @cached_property
    def _known_text(self) -> str:
        return str(self._known()).lower()

    def hide(self, text: str) -> str:
        """Replace each part of a text that is in a file by ``…``, unless it is known or from this package."""
        return _PARTS.sub(lambda found: self._shown(found[0]), text) if self.files else text

    def _shown(self, part: str) -> str:
        quoted = part[0] in "'\""
        whole = part.strip("'\"….:")
        if not quoted and _NUMBER.fullmatch(whole):
            return part
        words = [whole, *_WORD.findall(_ESCAPE.sub(" ", whole))]
        if not any(self._is_quote(word) for word in words if len(word) > 2):
            return part
        return f"{part[0]}{HIDDEN}{part[0]}" if quoted else HIDDEN

    def _is_quote(self, word: str) -> bool:
        lower = word.lower()
        shown = (*map(str.lower, self.files), self._known_text, *_own_texts())
        if any(lower in text for text in shown):
            return False
        own = str(resource_path("assets"))
        return any(_is_in(Path(file), word) for file in self.files if not file.startswith(own))


@contextmanager
def hiding_quotes(known: Callable[[], object]) -> Iterator[None]:
    """Hide the content of the files that are read in the block, in all errors and warnings of the package.
    ``known``: returns text that may be shown, such as the settings that name the files."""
    quotes = FileQuotes(known)
    token = HIDING.set(quotes)
    try:
        yield
    finally:
        HIDING.reset(token)


@cache
def _own_texts() -> tuple[str, ...]:
    """Texts with words that reveal nothing about a file: the sources and the tables of this package."""
    package = Path(__file__).parents[2]
    files = (*package.rglob("*.py"), *resource_path("config").rglob("*.*"))
    return tuple(
        file.read_text("utf-8", "replace").lower()
        for file in files
        if file.suffix in (".py", ".yaml", ".json")
    )


def _is_in(file: Path, word: str) -> bool:
    """Whether a file contains a word, in any encoding. True for files that would take long to search."""
    forms = set[bytes]()
    for encoding in _ENCODINGS:
        with suppress(UnicodeEncodeError):
            forms |= {form.encode(encoding) for form in (word, word.lower(), word.upper())}
    with (
        suppress(OSError, ValueError),  # removed meanwhile, or empty
        open(file, "rb", opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK)) as opened,
        mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as content,
    ):
        return len(content) > _LARGEST or any(content.find(form) >= 0 for form in forms)
    return False
