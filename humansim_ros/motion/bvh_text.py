"""Text of BVH files: lines and blocks with their line numbers, errors, warnings and numbers."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from typing import TextIO

from humansim_ros.errors import MotionError, warn_about

#: Smallest and largest number of characters of a block of rows. Larger blocks are faster and need more
#: memory.
_BLOCK_SIZES = 1 << 12, 1 << 16
#: Largest number of characters of a line of the hierarchy, or of a number.
_MAX_CHARACTERS = 1 << 20
#: Larger numbers cannot be measurements, and their squares may be infinite.
LARGEST = 1e15
BRACE = re.compile(r"([{}])")
#: A minus sign that starts a new number without a space before it ("1.5-2.5"), but not that of "1e-5".
_GLUED_MINUS = re.compile(r"(?<=[0-9.])-")
#: A comma that separates numbers for certain: with white space beside it, or the second of a word.
_SEPARATOR = re.compile(r",(?:\s|$)|,[^\s,]+,")
_DECIMAL = re.compile(r"(?<=\d),(?=\d)")


class BvhText:
    """Text of one file, from its start to its end.

    Attributes:
        path: Path of the file, for messages.
        line: Number of the last line that was read.
        indent: Width of the white space before the last line of the hierarchy.
    """

    def __init__(self, path: str | os.PathLike[str], file: TextIO) -> None:
        self.path = os.fspath(path)
        self.line = 0
        self.indent = 0
        self._file = file
        self._unread = ""
        self._is_latin = False
        self._odd: dict[str, tuple[int, str, int]] = {}

    def error(self, message: str, line: int | None = None) -> MotionError:
        """Error at a line; by default the last line that was read."""
        return MotionError(message, path=self.path, line=self.line if line is None else line)

    def warn(self, message: str, line: int | None = None) -> None:
        """Warn about a line; by default the last line that was read."""
        warn_about(f"{self.path}:{self.line if line is None else line}", message)

    def warn_file(self, message: str) -> None:
        """Warn about the whole file."""
        warn_about(self.path, message)

    def note(self, kind: str, message: str) -> None:
        """Remember something odd in the last line. :meth:`warn_of_notes` warns of the first of each kind."""
        line, first, count = self._odd.get(kind, (self.line, message, 0))
        self._odd[kind] = line, first, count + 1

    def warn_of_notes(self) -> None:
        """Warn of everything odd that was noted, once for each kind."""
        for line, message, count in self._odd.values():
            self.warn(message + (f"; so are {count - 1} more" if count > 1 else ""), line)
        self._odd = {}

    def next_line(self) -> str:
        """Next line with its line end; "" after the last."""
        if self._unread:
            text, self._unread = self._unread, ""
            self.line += 1
            return text
        text = self._file.readline(_MAX_CHARACTERS)
        if not text:
            return text
        self.line += 1
        if self.line == 1 and text.startswith(("ÿþ", "þÿ")):
            raise MotionError("this is UTF-16 text: save it as UTF-8", path=self.path)
        if "\0" in text:
            raise MotionError("this is a binary file, not a BVH motion text file", path=self.path)
        if len(text) == _MAX_CHARACTERS:
            raise self.error(f"not a BVH file: a line of more than {_MAX_CHARACTERS} characters")
        if not text.isascii():
            try:
                text = text.encode("latin-1").decode("utf-8-sig" if self.line == 1 else "utf-8")
            except UnicodeDecodeError:
                if not self._is_latin:
                    self.warn("not UTF-8: read as Latin-1; names may look odd")
                self._is_latin = True
        self.indent = len(text[: len(text) - len(text.lstrip())].expandtabs(8))
        return text

    def unread(self, text: str) -> None:
        """Give the last line back: the next line or block starts with ``text``."""
        if not text.isascii():
            raise self.error(f"cannot understand {text.strip()[:40]!r}")
        self._unread = text if text.endswith("\n") else f"{text}\n"
        self.line -= 1

    def blocks(self) -> Iterator[str]:
        """The rest of the file in blocks that end with white space; they do not change ``line``."""
        rest, self._unread = self._unread, ""
        n_read = 0
        while text := self._file.read(min(max(_BLOCK_SIZES[0], n_read // 16), _BLOCK_SIZES[1])):
            n_read += len(text)
            text = rest + text
            cut = max(text.rfind(" "), text.rfind("\n"), text.rfind("\t")) + 1
            if len(text) - cut > _MAX_CHARACTERS:
                raise self.error(f"a word of more than {_MAX_CHARACTERS} characters", self.line + 1)
            rest = text[cut:]
            if cut:
                yield text[:cut]
        if rest:
            yield rest

    def numbers(self, text: str) -> list[float]:
        """Numbers of a text in the last line; ValueError if it has other words."""
        if "," in text and (mark := comma_meaning(text)) is not None:
            self.note("comma", f"commas {comma_text(mark)}")
            text = text.replace(",", mark)
        return [to_float(word) for word in split_glued(text).split()]


def to_float(word: str) -> float:
    """Number of a file; ValueError for numbers that only Python accepts ("1_000")."""
    if "_" in word or not word.isascii():
        raise ValueError
    return float(word)


def is_number(word: str) -> bool:
    """Whether a word is a number, finite or not."""
    try:
        to_float(word)
    except ValueError:
        return False
    return True


def split_glued(text: str) -> str:
    """Text with a space before each minus sign that starts a number."""
    return _GLUED_MINUS.sub(" -", text)


def comma_meaning(text: str) -> str | None:
    """What replaces the commas in a text of numbers: " " or "."; None where their meaning is not clear.

    Beside points, commas separate numbers. Without points they are decimal if each is between two digits,
    and no number has two of them. The number of values that a line needs shows whether this is right.
    """
    if "." in text or _SEPARATOR.search(text):
        return " "
    return "." if len(_DECIMAL.findall(text)) == text.count(",") else None


def comma_text(mark: str) -> str:
    """What commas do, for messages; ``mark`` as in :func:`comma_meaning`."""
    return "are read as decimal points" if mark == "." else "are read as white space between numbers"


def comma_hint(text: str) -> str:
    """End of a message about a text that is no number."""
    return "; decimals need a point, not a comma" if "," in text else ""
