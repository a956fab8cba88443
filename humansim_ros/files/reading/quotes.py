"""Hide the content of files in messages about files that somebody else has named, as in a scene."""

from __future__ import annotations

import mmap
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property
from pathlib import Path

import humansim_ros
from humansim_ros.errors import HIDING
from humansim_ros.files.reading.assets import resource_path

#: Shown in place of the content of a file.
HIDDEN = "…"
#: Parts of a message: quoted texts, and words.
_PARTS = re.compile(r"""(?<!\w)'(?:[^'\\]|\\.)+'(?!\w)|(?<!\w)"(?:[^"\\]|\\.)+"(?!\w)|[\w.:+$-]{3,}""")
_WORD, _ESCAPE = re.compile(r"\w{3,}"), re.compile(r"\\(?:x..|u.{4}|U.{8}|.)")
#: A number with fewer characters, outside quotes, may be a count or a length and equal a word of the file by
#: chance.
_NUMBER = re.compile(r"[\d.,:+-]{1,8}")
#: Largest file that is searched, bytes.
_LARGEST = 1 << 24
_ENCODINGS = ("utf-8", "utf-16-le", "utf-16-be", "latin-1", "cp932", "gb18030", "cp949", "big5", "euc_jp")


class FileQuotes:
    """Hides words of files in texts. ``known``: text with words that may be shown."""

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
    package = Path(humansim_ros.__file__).parent
    files = (*package.rglob("*.py"), *resource_path("config").rglob("*.*"))
    return tuple(
        file.read_text("utf-8", "replace").lower()
        for file in files
        if file.suffix in (".py", ".yaml", ".json")
    )


def _is_in(file: Path, word: str) -> bool:
    """Whether a file contains a word, in any encoding. For files that would take long to search, the answer
    is yes."""
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
