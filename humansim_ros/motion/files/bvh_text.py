"""Text of BVH files: lines and blocks with line numbers, errors and warnings, and the rows of numbers."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MotionError, some_of, warn_about
from humansim_ros.files.reading import ENCODINGS
from humansim_ros.types import Array, Indices

#: Smallest and largest block of rows, characters. Larger blocks are faster and need more memory.
_BLOCK_SIZES = 1 << 12, 1 << 16
#: Most characters of a line of the hierarchy, or of a number.
_MAX_CHARACTERS = 1 << 20
#: Larger numbers cannot be measurements, and their squares may be infinite.
LARGEST = 1e15
BRACE = re.compile(r"([{}])")
#: A minus sign that starts a new number without a space before it ("1.5-2.5"); not the sign in "1e-5".
_GLUED_MINUS = re.compile(r"(?<=[0-9.])-")
#: A comma that certainly separates numbers: it is next to white space, or it is the second comma of a word.
_SEPARATOR = re.compile(r",(?:\s|$)|,[^\s,]+,")
_DECIMAL = re.compile(r"(?<=\d),(?=\d)")
#: A comment: a line that starts with such a mark, or the end of a line from a mark between white space.
_COMMENT = re.compile(r"^[ \t]*(?://|/?\*|[#;%]).*|(?<=[ \t])(?://|[#;][ \t]).*", re.MULTILINE)


class BvhText:
    """Text of one file, read from its start to its end.

    Attributes:
        path: Path of the file, for messages.
        line: Number of the last line that was read.
        indent: Width of the white space before the last line of the hierarchy.

    ``encoding``: the same as in ``text_encoding``. ``file`` decodes UTF-16 itself. It decodes every other
    text as Latin-1.
    """

    def __init__(self, path: str | os.PathLike[str], file: TextIO, encoding: str) -> None:
        self.path = os.fspath(path)
        self.line = 0
        self.indent = 0
        self._file = file
        self._unread = ""
        self._encoding = encoding
        self._is_foreign = False
        self._noted: set[str] = set()

    def error(self, message: str, line: int | None = None) -> MotionError:
        """Make an error for a line. If ``line`` is not given, for the last line that was read."""
        return MotionError(message, path=self.path, line=self.line if line is None else line)

    def warn(self, message: str, line: int | None = None) -> None:
        """Warn about a line: ``line``, or by default the last line that was read."""
        warn_about(f"{self.path}:{self.line if line is None else line}", message)

    def warn_file(self, message: str) -> None:
        """Warn about the whole file."""
        warn_about(self.path, message)

    def note(self, kind: str, message: str) -> None:
        """Warn about something odd in the last line, unless it is the second of its kind."""
        if kind not in self._noted:
            self.warn(message)
        self._noted.add(kind)

    def next_line(self) -> str:
        """Return the next line with its line end, without comments. After the last line, return ""."""
        if self._unread:
            text, self._unread = self._unread, ""
            self.line += 1
            return text
        text = self._file.readline(_MAX_CHARACTERS)
        if not text:
            return text
        self.line += 1
        if "\0" in text:
            raise MotionError("this is a binary file, not a BVH motion text file", path=self.path)
        if len(text) == _MAX_CHARACTERS:
            raise self.error(f"not a BVH file: a line of more than {_MAX_CHARACTERS} characters")
        if not text.isascii() and not self._encoding.startswith("utf-16"):
            text = self._decoded(text.encode("latin-1"))
        self.indent = len(text[: len(text) - len(text.lstrip())].expandtabs(8))
        return _COMMENT.sub("", text)

    def _decoded(self, line: bytes) -> str:
        if self._encoding == "latin-1":
            with suppress(UnicodeDecodeError):
                return line.decode("utf-8-sig" if self.line == 1 else "utf-8")
        if not self._is_foreign:
            name = ENCODINGS.get(self._encoding, "Latin-1; names may look odd")
            self.warn(f"not UTF-8: read as {name}")
        self._is_foreign = True
        return line.decode(self._encoding, "replace")

    def unread(self, text: str) -> None:
        """Give back the last line, so that the next line or block starts with ``text``."""
        if not text.isascii():
            raise self.error(f"cannot understand {text.strip()[:40]!r}")
        self._unread = text if text.endswith("\n") else f"{text}\n"
        self.line -= 1

    def blocks(self) -> Iterator[str]:
        """Return the unread text in blocks of whole lines; a line that is too long is split between words."""
        rest, self._unread, n_read = self._unread, "", 0
        while text := self._file.read(min(max(_BLOCK_SIZES[0], n_read // 16), _BLOCK_SIZES[1])):
            n_read += len(text)
            text = rest + text
            cut = text.rfind("\n") + 1 or max(text.rfind(" "), text.rfind("\t")) + 1
            if len(text) - cut > _MAX_CHARACTERS:
                raise self.error(f"a word of more than {_MAX_CHARACTERS} characters", self.line + 1)
            rest = text[cut:]
            if cut:
                yield _without_comments(text[:cut])
        if rest:
            yield _without_comments(rest)

    def numbers(self, text: str) -> list[float]:
        """Numbers of a text in the last line. Raises ValueError for other words."""
        if "," in text and (mark := comma_meaning(text)) is not None:
            self.note("comma", f"commas {_COMMAS[mark]}")
            text = text.replace(",", mark)
        return [to_float(word) for word in split_glued(text).split()]


def _without_comments(rows: str) -> str:
    return _COMMENT.sub("", rows) if any(mark in rows for mark in "#;%/*") else rows


def to_float(word: str) -> float:
    """Read a number of a file. Raises ValueError for numbers that only Python accepts ("1_000")."""
    if "_" in word or not word.isascii():
        raise ValueError
    return float(word)


def split_glued(text: str) -> str:
    """Text with a space before each minus sign that starts a number."""
    return _GLUED_MINUS.sub(" -", text)


def comma_meaning(text: str) -> str | None:
    """Return the character that replaces the commas in a text of numbers: " " or ".". None if their meaning
    is not clear.

    If the text also has points, the commas separate numbers. Otherwise they are decimal if each comma is
    between two digits and no number has two commas. The number of values that a line needs shows whether this
    is right.
    """
    if "." in text or _SEPARATOR.search(text):
        return " "
    return "." if len(_DECIMAL.findall(text)) == text.count(",") else None


#: Words for messages that say how commas are read, by the character that replaces them.
_COMMAS = {".": "are read as decimal points", " ": "are read as white space between numbers"}


def comma_hint(text: str) -> str:
    """Return a hint, for the end of a message about a wrong number, if the text has a comma; else ""."""
    return "; decimals need a point, not a comma" if "," in text else ""


#: Shortest and longest frame time, seconds.
FRAME_TIMES = 1e-9, 1e6
#: Frame time of files that do not state it, seconds.
_USUAL_FRAME_TIME = 1 / 30
#: A line of the header: its key, the colon and its value.
_HEADER = re.compile(r"(frames|frame[\s_]*time)\s*(?P<colon>[:=]?)\s*(?P<value>.*)", re.IGNORECASE)
#: White space between two lines of the header that are on one line.
_NEXT_KEY = re.compile(r"(?<=\S)\s+(?=frames\b|frame[\s_]*time\b)", re.IGNORECASE)
_NUMBER_START = re.compile(r"[+-]?[.,]?\d")
#: Whether a character, by its code, is part of plain numbers and white space.
_PLAIN = np.isin(np.arange(256), list(b"0123456789+-.eE \t\n\v\f"))


def starts_motion(statement: str) -> bool:
    """Whether a statement is a line of the header, or a row."""
    return bool(_HEADER.fullmatch(statement) or _NUMBER_START.match(statement))


def read_motion_section(text: BvhText, angles: NDArray[np.bool_]) -> tuple[Array, float]:
    """Read channel values (F, C) and frame time after the word MOTION. F is 0 if ``Frames:`` says so.
    ``angles``: (C,) whether each channel is an angle."""
    n_frames, frame_time = _read_header(text)
    rows = _Rows(text, angles, n_frames).read()
    if len(rows) == 0:
        if n_frames == 0:
            return rows, frame_time
        raise text.error("no frames after 'Frame Time:': the file is truncated")
    if not np.isnan(n_frames) and len(rows) != n_frames:
        text.warn_file(f"says {n_frames:g} frames but has {len(rows)}; the rows count")
    return rows, frame_time


def _read_header(text: BvhText) -> tuple[float, float]:
    """Read the number of frames (NaN if missing) and the frame time."""
    header: dict[str, tuple[int, str]] = {}
    awaited = ""  # key that waits for its number on the next line
    while len(header) < 2 or awaited:
        line = text.next_line()
        if not line:
            missing = "Frame Time" if "Frames" in header else "Frames"
            raise text.error(f"'{missing}:' is missing after MOTION: the file is truncated or damaged")
        if not (line := line.strip()):
            continue
        if awaited and _NUMBER_START.match(line):
            header[awaited], awaited = (text.line, line), ""
        elif all(keys := [_HEADER.fullmatch(part) for part in _NEXT_KEY.split(line)]):
            for found in filter(None, keys):
                key = "Frames" if found[1].lower() == "frames" else "Frame Time"
                header[key] = text.line, found["value"]
                awaited = "" if found["value"] else key
                if not found["colon"]:
                    text.warn(f"'{key}' without a colon")
        elif _NUMBER_START.match(line):
            text.unread(line)
            break
        else:
            raise text.error(f"'Frames:' and 'Frame Time:' expected, not {line[:40]!r}")
    n_frames, frame_time = np.nan, _USUAL_FRAME_TIME
    usual = f"{1 / _USUAL_FRAME_TIME:g} frames per second are assumed"
    if "Frames" in header:
        n_frames = _header_number(text, "Frames", *header["Frames"])
    else:
        text.warn("'Frames:' is missing before this line: the rows count", text.line + 1)
    if "Frame Time" in header:
        line_number = header["Frame Time"][0]
        frame_time = _header_number(text, "Frame Time", *header["Frame Time"])
        if frame_time == 0:
            text.warn(f"the Frame Time is 0: {usual}", line_number)
            frame_time = _USUAL_FRAME_TIME
        if not FRAME_TIMES[0] <= frame_time <= FRAME_TIMES[1]:
            wrong = f"above zero and below a million seconds, not {frame_time:g}"
            raise text.error(f"Frame Time must be {wrong}", line_number)
    else:
        text.warn(f"'Frame Time:' is missing before this line: {usual}", text.line + 1)
    return n_frames, frame_time


def _header_number(text: BvhText, key: str, line: int, value: str) -> float:
    try:
        numbers = text.numbers(value)
    except ValueError:
        numbers = []
    if len(numbers) != 1 or not np.isfinite(numbers[0]):
        raise text.error(f"'{key}:' needs a number, not {value[:40]!r}{comma_hint(value)}", line)
    return numbers[0]


#: A file is refused if this share of its rows is bad, or if this number of rows is bad.
_BAD_SHARE, _MAX_BAD = 0.01, 10_000
#: The share counts only from this number of bad rows on.
_FIRST_BAD = 10
#: An angle that changes by less (degrees) in a frame is interpolated. Else the pose before is held.
_STEADY = 45.0


@dataclass(frozen=True)
class _BadLine:
    """A line that is not a row of numbers: its number, the index of its first value, its number of values,
    the reason; the first ``word``, if it has no number; and how many such lines follow one another."""

    line: int
    start: int
    count: int
    reason: str
    word: str = ""
    n_lines: int = 1


class _Rows:
    """Reader of rows of C values. Blocks of plain numbers are converted at once, others word by word. A line
    may hold one row, several, or a part: the total number of values shows where rows start."""

    def __init__(self, text: BvhText, angles: NDArray[np.bool_], n_frames: float) -> None:
        self.text = text
        self.angles = angles
        self.n_channels = len(angles)
        self.n_frames = n_frames
        self.bad: list[_BadLine] = []  # lines with a word that is not a number
        self.n_damaged = 0  # how many of the bad lines also have a number
        self.odd: list[_BadLine] = []  # first lines that do not have exactly one row
        self.n_odd = 0  # number of all such lines
        self.is_broken = False  # whether a line has the end of one row and the start of the next
        self.n_lines = 0  # number of lines with values
        self.last_line = 0  # last line with a value
        self.n_values = 0
        self.n_on_lines = 0  # values on the lines that are complete
        self.comma: str | None = None  # character that replaces commas
        self.has_points = False

    def read(self) -> Array:
        """Read all rows that are left in the file: channel values (F, C)."""
        parts: list[Array] = [np.empty(0)]
        for block in self.text.blocks():
            if self.n_channels == 0 and block.strip():
                raise self.text.error("a value, but no joint has channels", self.text.line + 1)
            self.has_points = self.has_points or "." in block
            if (parsed := _fast_values(block)) is None:
                block = split_glued(self._without_commas(block) if "," in block else block)
                parsed = _fast_values(block) or self._slow_values(block)
            values, ends = parsed
            parts.append(values)
            self._add_lines(ends + self.n_values)
            self.n_values += len(values)
            self.text.line += len(ends)
            if self._is_over(self.n_values) or self._is_hopeless():
                break
        if self.n_channels == 0:
            return np.zeros((1, 0))
        self._add_lines(np.array([self.n_values]))
        return self._rows(np.concatenate(parts))

    def _add_lines(self, ends: Indices) -> None:
        """Count the values of the next lines. ``ends``: number of values before the end of each line."""
        counts = np.diff(ends, prepend=self.n_on_lines)
        places = np.flatnonzero(counts)
        if len(places) == 0:
            return
        first_line = self.text.line + 1
        self.last_line = first_line + int(places[-1])
        self.n_lines += len(places)
        counts, ends = counts[places], ends[places]
        odd = np.flatnonzero(counts != self.n_channels)
        self.n_on_lines, starts = int(ends[-1]), (ends - counts) % self.n_channels
        if starts[0] == 0 and not len(odd):
            return
        for place in odd[: _MAX_BAD + 1 - len(self.odd)].tolist():
            count = int(counts[place])
            reason = f"a frame needs {self.n_channels} values, this has {count}"
            self.odd.append(
                _BadLine(first_line + int(places[place]), int(ends[place]) - count, count, reason)
            )
        self.n_odd += len(odd)
        is_part = starts + counts <= self.n_channels
        is_whole = (starts == 0) & (counts % self.n_channels == 0)
        self.is_broken |= not (is_part | is_whole).all()

    def _is_over(self, n_values: int) -> bool:
        """Whether there are as many values as ``Frames:`` says, so that only other text can follow."""
        is_text = len(self.bad) == 1 and self.bad[0].word and self.bad[0].start == n_values
        return bool(is_text and n_values and n_values == self.n_frames * self.n_channels)

    def _is_hopeless(self) -> bool:
        """Whether there are too many bad lines. Most text lines do not count: the file may end there."""
        n_bad = self.n_damaged + self.n_odd * self.is_broken
        n_lines = max(self.n_lines, 0 if np.isnan(self.n_frames) else self.n_frames)
        return n_bad > min(_MAX_BAD, max(_FIRST_BAD, _BAD_SHARE * n_lines)) or len(self.bad) > _MAX_BAD

    def _rows(self, values: Array) -> Array:
        """Make rows (F, C) from all values. Bad lines are left out, or replaced by interpolated frames."""
        bad, odd, n_channels = self._without_tail(), self.odd, self.n_channels
        if odd and not bad and not self.is_broken and len(values) == self.n_frames * n_channels:
            found = f"not one frame on a line ({odd[0].count} of {n_channels} values): there are as many "
            found += f"values as {self.n_frames:g} frames have, which are taken in order"
            self.text.warn(found, odd[0].line)
            return values.reshape(-1, n_channels)
        n_good, bad = self.n_lines - self.n_odd, sorted([*bad, *odd], key=lambda each: each.line)
        n_bad = sum(each.n_lines for each in bad) + self.n_odd - len(odd)
        if n_bad > min(_MAX_BAD, _BAD_SHARE * (n_good + n_bad)) or (bad and self._is_hopeless()):
            first = bad[0]
            # a short last row means that the file was cut off
            is_cut = first in odd and first.line == self.last_line and first.count < n_channels
            share = f"; {n_bad} of {n_good + n_bad} rows are bad, more than {_BAD_SHARE:.0%}" * (n_good > 0)
            raise self.text.error(first.reason + "; the file is truncated" * is_cut + share, first.line)
        return self._mended(values, bad) if bad else values.reshape(-1, n_channels)

    def _without_tail(self) -> list[_BadLine]:
        """Return the bad lines, except text after the last row. A warning tells about this text."""
        tail = len(self.bad)
        while tail and self.bad[tail - 1].word and self.bad[tail - 1].start == self.n_values:
            tail -= 1
        if self.n_values and tail < len(self.bad):
            first = self.bad[tail]
            more = "; a second motion needs a file of its own" * (first.word.upper() == "HIERARCHY")
            text = f"the text from {first.word[:40]!r} on is not part of the motion: left out{more}"
            self.text.warn(text, first.line)
            return self.bad[:tail]
        return self.bad

    def _mended(self, values: Array, bad: list[_BadLine]) -> Array:
        """Make rows (F, C) with a new frame in place of each bad line that was a frame."""
        starts, counts = np.array([each.start for each in bad]), np.array([each.count for each in bad])
        spans = [np.arange(each.start, each.start + each.count) for each in bad]
        rows = np.delete(values, np.concatenate(spans)).reshape(-1, self.n_channels)
        places = (starts - np.cumsum(counts) + counts) // self.n_channels
        is_frame = self._were_frames(bad, len(rows)) & (places < len(rows))
        for chosen, what in ((~is_frame, "the line is left out"), (is_frame, "a frame is put in its place")):
            lines = [each for each, this in zip(bad, chosen, strict=True) if this]
            if lines:
                more = f" (so in line {some_of(each.line for each in lines[1:])})" if lines[1:] else ""
                self.text.warn(f"{lines[0].reason}: {what}{more}", lines[0].line)
        n_lines = np.array([each.n_lines for each in bad])
        return _filled(rows, np.repeat(places, n_lines * is_frame), self.angles)

    def _were_frames(self, bad: list[_BadLine], n_rows: int) -> NDArray[np.bool_]:
        """Decide by ``Frames:`` whether each bad line is a damaged frame, or text between frames."""
        if self.n_frames in (n_rows, n_rows + sum(each.n_lines for each in bad)):
            return np.full(len(bad), self.n_frames > n_rows)
        return np.array([not each.word for each in bad])

    def _without_commas(self, block: str) -> str:
        """Replace the commas of a block. If their meaning is not clear, the block does not change."""
        mark = " " if self.has_points else comma_meaning(block)
        if mark is None or self.comma not in (None, mark):
            return block
        if self.comma is None:
            line = self.text.line + 1 + block.count("\n", 0, block.index(","))
            self.text.warn(f"commas {_COMMAS[mark]}", line)
            self.comma = mark
        return block.replace(",", mark)

    def _slow_values(self, block: str) -> tuple[Array, Indices]:
        """Do what :func:`_fast_values` does for other text. Notes bad lines; stops when only text follows."""
        values: list[float] = []
        ends: list[int] = []
        for number, line in enumerate(block.split("\n"), self.text.line + 1):
            numbers, reason, word = _read_line(line.split())
            if not reason:
                values += numbers
            ends.append(len(values))
            if not reason:
                continue
            start, last = self.n_values + len(values), self.bad[-1] if self.bad else None
            if word and last is not None and last.word and start == last.start:
                self.bad[-1] = replace(last, n_lines=last.n_lines + 1)
            else:
                self.bad.append(_BadLine(number, start, 0, reason, word))
            self.n_damaged += not word
            if self._is_over(start):
                break
        return np.array(values), np.array(ends[:-1], dtype=np.intp)


def _read_line(words: list[str]) -> tuple[list[float], str, str]:
    """Numbers of a line, the reason if a word is bad, and the first word of a line without any number."""
    numbers: list[float] = []
    reason = bad_word = ""
    for word in words:
        try:
            numbers.append(to_float(word))
        except ValueError:
            bad_word = bad_word or word
            reason = reason or f"{word[:40]!r} is not a number{comma_hint(word)}"
            continue
        if not abs(numbers[-1]) <= LARGEST:
            reason = reason or f"{word[:40]!r} is not finite, or beyond {LARGEST:g}"
    is_text = bool(reason) and not numbers and not _NUMBER_START.match(words[0])
    return numbers, reason, bad_word if is_text else ""


def _filled(rows: Array, places: Indices, angles: NDArray[np.bool_]) -> Array:
    """Insert frames into the good rows (R, C), and return rows (F, C). A new frame is interpolated between
    its neighbours, or equals the nearer one. ``places``: sorted numbers of the rows before which a frame is
    missing, twice for two frames. ``angles``: (C,) whether a channel is an angle in degrees."""
    out = np.insert(rows, places, 0.0, axis=0)
    missing = places + np.arange(len(places))
    known = np.setdiff1d(np.arange(len(out)), missing)
    for frame, place in zip(missing.tolist(), places.tolist(), strict=True):
        if place == 0:
            out[frame] = rows[0]
            continue
        change = rows[place] - rows[place - 1]
        change[angles] = (change[angles] + 180) % 360 - 180
        share = (frame - known[place - 1]) / (known[place] - known[place - 1])
        if np.abs(change[angles]).max(initial=0.0) > _STEADY:
            share = np.round(share)
        out[frame] = rows[place - 1] + share * change if share < 1 else rows[place]
    return out


def _fast_values(text: str) -> tuple[Array, Indices] | None:
    """Return the values in a text of plain finite numbers, and the number of values before each line end.
    None if the text has anything else."""
    characters = np.frombuffer(text.encode("latin-1", "replace"), dtype=np.uint8)
    # with these characters only, Python accepts the same numbers as files do
    if not _PLAIN[characters].all():
        return None
    blank = characters <= 32
    starts = ~blank
    starts[1:] &= blank[:-1]
    places = np.flatnonzero(starts)
    line_ends = np.flatnonzero(characters == ord("\n"))
    if len(places) == 0:
        return np.empty(0), np.zeros_like(line_ends)
    words = text.split()
    try:
        values = np.fromiter(map(float, words), float, len(words))
    except ValueError:
        return None
    if not (values.min() >= -LARGEST and values.max() <= LARGEST):
        return None
    return values, np.searchsorted(places, line_ends)
