"""Parser of BVH files, with the line of each error."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MotionError, warn_about
from humansim_ros.motion.kinematics import AXES, CHANNEL_NAMES, Motion
from humansim_ros.types import Array

_CANONICAL = {name.lower(): name for name in CHANNEL_NAMES}
#: Smallest and largest number of characters of a block of rows. Larger blocks are faster and need more
#: memory.
_BLOCK_SIZES = 1 << 12, 1 << 16
#: Largest number of characters of a line of the hierarchy, or of a number.
_MAX_CHARACTERS = 1 << 20
#: Most characters of a joint's name: every end site repeats the name of its joint.
LONGEST_NAME = 1000
#: Larger numbers cannot be measurements, and their squares may be infinite.
LARGEST = 1e15
#: Smallest and largest frame time, seconds.
FRAME_TIMES = 1e-9, 1e6
#: Whether a character, by its code, is part of plain numbers and white space.
_PLAIN = np.isin(np.arange(256), list(b"0123456789+-.eE \t\n\v\f"))
_BRACE = re.compile(r"([{}])")
#: A minus sign that starts a new number without a space before it ("1.5-2.5"), but not that of "1e-5".
_GLUED_MINUS = re.compile(r"(?<=[0-9.])-")


class Parser:
    """Parser of one file, from its start to its end.

    The hierarchy is read statement by statement. The rows, which are nearly all of a file, are read in
    blocks, and word by word only where a block is not plain.
    """

    def __init__(self, path: str | os.PathLike[str], file: TextIO) -> None:
        self.path = os.fspath(path)
        self.file = file
        self.line = 0  # number of the last line that was read
        self.names: list[str] = []
        self.is_end: list[bool] = []
        self.joint_lines: list[int] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...] | None] = []
        self.is_latin = False

    def error(self, message: str, line: int | None = None) -> MotionError:
        """Error at a line; by default the last line that was read."""
        return MotionError(message, path=self.path, line=self.line if line is None else line)

    def parse(self) -> Motion:
        """The motion of the file; position channels replace the OFFSET."""
        has_motion = self._hierarchy()
        self._make_names_unique()
        values, frame_time = self._motion(has_motion)
        return Motion(
            joint_names=tuple(self.names),
            parents=np.array(self.parents, dtype=np.intp),
            offsets=np.array(self.offsets, dtype=float),
            channels=tuple(names or () for names in self.channels),
            values=values,
            frame_time=frame_time,
            path=self.path,
        )

    def _next_line(self) -> str:
        """Next line with its line end; "" after the last."""
        text = self.file.readline(_MAX_CHARACTERS)
        if not text:
            return text
        self.line += 1
        if self.line == 1 and text.startswith(("ÿþ", "þÿ")):
            raise MotionError("this is UTF-16 text: save it as UTF-8", path=self.path)
        if "\0" in text:
            raise MotionError("this is a binary file, not a BVH motion text file", path=self.path)
        if len(text) == _MAX_CHARACTERS:
            raise self.error(f"not a BVH file: a line of more than {_MAX_CHARACTERS} characters")
        if text.isascii():
            return text
        try:
            return text.encode("latin-1").decode("utf-8-sig" if self.line == 1 else "utf-8")
        except UnicodeDecodeError:
            if not self.is_latin:
                warn_about(f"{self.path}:{self.line}", "not UTF-8: read as Latin-1; names may look odd")
            self.is_latin = True
            return text

    def _statements(self) -> Iterator[str]:
        """Statements of the hierarchy: lines, with braces as statements of their own."""
        while text := self._next_line():
            for part in _BRACE.split(text):
                if statement := part.strip():
                    yield statement

    def _hierarchy(self) -> bool:
        """Read the joints; True if a MOTION section follows."""
        statements = self._statements()
        first = next(statements, None)
        if first is None:
            raise MotionError("the BVH motion file is empty", path=self.path)
        if first.upper() != "HIERARCHY":
            raise self.error(f"not a BVH file: it should start with HIERARCHY, not {first[:40]!r}")
        stack: list[int] = []
        pending: int | None = None
        for statement in statements:
            keyword, rest = [*statement.split(maxsplit=1), ""][:2]
            keyword = keyword.upper()
            if statement.upper() == "MOTION":
                if stack or pending is not None:
                    raise self.error("MOTION before the hierarchy is closed: a '}' is missing above")
                return True
            if keyword in ("ROOT", "JOINT") or (keyword == "END" and rest.upper().startswith("SITE")):
                if pending is not None:
                    raise self.error(f"'{{' expected after {self._description(pending)}")
                pending = self._add_joint(keyword, rest.strip(), stack[-1] if stack else -1)
            elif statement == "{":
                if pending is None:
                    raise self.error("'{' without a joint before it")
                stack.append(pending)
                pending = None
            elif statement == "}":
                if not stack:
                    raise self.error("'}' without a matching '{'")
                joint = stack.pop()
                if not self.offsets[joint]:
                    raise self.error(f"{self._description(joint)} has no OFFSET")
            elif keyword == "OFFSET" and stack:
                if self.offsets[stack[-1]]:
                    raise self.error(f"{self._description(stack[-1])} has a second OFFSET")
                self.offsets[stack[-1]] = self._offset(rest)
            elif keyword == "CHANNELS" and stack:
                if self.channels[stack[-1]] is not None:
                    raise self.error(f"{self._description(stack[-1])} has a second CHANNELS")
                self.channels[stack[-1]] = self._channels(rest)
            else:
                raise self.error(f"cannot understand {statement[:40]!r} in the hierarchy")
        if stack or pending is not None:
            raise self.error("the file ends inside the hierarchy: it is truncated")
        return False

    def _description(self, joint: int) -> str:
        return "an End Site" if self.is_end[joint] else f"joint {self.names[joint]!r}"

    def _add_joint(self, keyword: str, name: str, parent: int) -> int:
        if not name:
            raise self.error(f"{keyword} without a name")
        if len(name) > LONGEST_NAME:
            raise self.error(f"a name of more than {LONGEST_NAME} characters: {name[:40]!r}")
        if (keyword == "ROOT") != (parent < 0):
            raise self.error(f"{keyword} {name!r} does not belong here")
        if parent >= 0 and self.is_end[parent]:
            raise self.error(f"{keyword} {name!r} inside an End Site")
        self.names.append(name)
        self.is_end.append(keyword == "END")
        self.joint_lines.append(self.line)
        self.parents.append(parent)
        self.offsets.append([])
        self.channels.append(None)
        return len(self.names) - 1

    def _make_names_unique(self) -> None:
        """Number joints of the same name as Blender does; name end sites after their joints."""
        if not self.names:
            raise self.error("the hierarchy has no joints")
        given = {name for name, is_end in zip(self.names, self.is_end, strict=True) if not is_end}
        taken: set[str] = set()
        copies: dict[str, int] = {}
        numbered = []
        for joint, name in enumerate(self.names):
            if is_end := self.is_end[joint]:
                name = f"{self.names[self.parents[joint]]}_end"
            unique = name
            while unique in taken or (unique in given and (is_end or unique != name)):
                copies[name] = copies.get(name, 0) + 1
                unique = f"{name}.{copies[name]:03d}"
            self.names[joint] = unique
            taken.add(unique)
            if unique != name and (not is_end or name in given):
                numbered.append((self.joint_lines[joint], name, unique))
        if numbered:
            (line, name, unique), others = numbered[0], len(numbered) - 1
            more = f"; so are {others} more" if others else ""
            warn_about(
                f"{self.path}:{line}", f"a second joint is named {name!r}: it is called {unique!r}{more}"
            )

    def _offset(self, rest: str) -> list[float]:
        try:
            values = [_float(word) for word in _GLUED_MINUS.sub(" -", rest).split()]
        except ValueError:
            values = []
        if len(values) != 3 or not all(abs(value) <= LARGEST for value in values):
            hint = _comma_hint(rest)
            raise self.error(f"OFFSET needs three finite numbers, not {rest.strip()[:40]!r}{hint}")
        return values

    def _channels(self, rest: str) -> tuple[str, ...]:
        count, *words = rest.split() or [""]
        names = tuple(_CANONICAL.get(word.lower(), "") for word in words)
        if not (count.isascii() and count.isdigit()) or "" in names or len(set(names)) != len(names):
            raise self.error(f"CHANNELS needs a count and names such as Zrotation, not {rest.strip()[:60]!r}")
        # compared as text: Python does not convert numbers of thousands of digits
        if (count.lstrip("0") or "0") != str(len(names)):
            warn_about(
                f"{self.path}:{self.line}",
                f"CHANNELS says {count[:20]} but names {len(names)}; the names count",
            )
        return names

    def _motion(self, has_motion: bool) -> tuple[Array, float]:
        if not has_motion:
            warn_about(self.path, "no MOTION section: a static pose")
            return self._rest_row(), 1 / 30
        header: dict[str, tuple[int, str]] = {}
        while len(header) < 2 and (text := self._next_line()):
            key, colon, value = text.partition(":")
            if key.strip() and not colon:
                raise self.error(f"'Frames:' and 'Frame Time:' expected, not {key.strip()[:40]!r}")
            if key.strip():
                header["".join(key.lower().split())] = (self.line, value.strip())
        n_frames = self._header_number(header, "Frames")
        frame_time = self._header_number(header, "Frame Time")
        if not FRAME_TIMES[0] <= frame_time <= FRAME_TIMES[1]:
            raise self.error(
                f"Frame Time must be above zero and below a million seconds, not {frame_time:g}",
                header["frametime"][0],
            )
        rows = self._rows(n_frames)
        if len(rows) == 0:
            if n_frames == 0:
                warn_about(self.path, "no frames: a static pose")
                return self._rest_row(), frame_time
            raise self.error("no frames after 'Frame Time:': the file is truncated")
        if len(rows) != n_frames:
            warn_about(self.path, f"says {n_frames:g} frames but has {len(rows)}; the rows count")
        return rows, frame_time

    def _rest_row(self) -> Array:
        """Channel values (1, C) of the rest pose."""
        pairs = zip(self.offsets, self.channels, strict=True)
        values = [
            offset[AXES[name[0]]] if name.endswith("position") else 0.0
            for offset, names in pairs
            for name in names or ()
        ]
        return np.array(values).reshape(1, -1)

    def _header_number(self, header: dict[str, tuple[int, str]], key: str) -> float:
        entry = header.get("".join(key.lower().split()))
        if entry is None:
            raise self.error(f"'{key}:' is missing after MOTION: the file is truncated or damaged")
        line, text = entry
        try:
            value = _float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise self.error(f"'{key}:' needs a number, not {text[:40]!r}{_comma_hint(text)}", line)
        return value

    def _rows(self, n_frames: float) -> Array:
        """Channel values (F, C) of the rest of the file."""
        n_channels = sum(len(names or ()) for names in self.channels)
        layout = _Layout(n_channels)
        blocks = []
        for text in self._blocks():
            if n_channels == 0 and text.strip():
                raise self.error("a value, but no joint has channels", self.line + 1)
            parsed = _fast_values(text)
            if parsed is None:
                text = _GLUED_MINUS.sub(" -", text)
                parsed = _fast_values(text) or self._slow_values(text)
            blocks.append(parsed[0])
            layout.add(*parsed, self.line + 1)
            self.line += len(parsed[1])
            if layout.is_broken:
                break
        if n_channels == 0:
            return np.zeros((1, 0))
        layout.end(self.line + 1)
        n_values = sum(map(len, blocks))
        if layout.odd_line is not None:
            if layout.is_broken or n_values != n_frames * n_channels:
                # a short row at the end of the file is a truncated file
                is_cut = layout.odd_line == layout.last_line and layout.odd_count < n_channels
                raise self.error(
                    f"a frame needs {n_channels} values, this has {layout.odd_count}"
                    + ("; the file is truncated" if is_cut else ""),
                    layout.odd_line,
                )
            warn_about(
                f"{self.path}:{layout.odd_line}",
                f"not one frame on a line ({layout.odd_count} of {n_channels} "
                f"values): there are as many values as {n_frames:g} frames have, which are taken in order",
            )
        return np.concatenate([np.empty(0), *blocks]).reshape(-1, n_channels)

    def _blocks(self) -> Iterator[str]:
        """The rest of the file in blocks that end with white space."""
        rest, n_read = "", 0
        while text := self.file.read(min(max(_BLOCK_SIZES[0], n_read // 16), _BLOCK_SIZES[1])):
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

    def _slow_values(self, text: str) -> tuple[Array, NDArray[np.intp]]:
        """As :func:`_fast_values`, for any white space and with the line of an error."""
        values: list[float] = []
        ends: list[int] = []
        for number, line in enumerate(text.split("\n"), self.line + 1):
            for word in line.split():
                try:
                    values.append(_float(word))
                except ValueError:
                    message = f"{word[:40]!r} is not a number{_comma_hint(word)}"
                    raise self.error(message, number) from None
                if not abs(values[-1]) <= LARGEST:
                    raise self.error(f"{word[:40]!r} is not finite, or beyond {LARGEST:g}", number)
            ends.append(len(values))
        return np.array(values), np.array(ends[:-1], dtype=np.intp)


class _Layout:
    """Layout of rows of C values on lines.

    One row on a line is usual. A line may also hold several whole rows, or a part of one: the start of each
    row is clear if the number of all values fits.
    """

    def __init__(self, n_channels: int) -> None:
        self.n_channels = n_channels
        #: First line without exactly one row, and its number of values.
        self.odd_line: int | None = None
        self.odd_count = 0
        #: Last line with a value.
        self.last_line = 0
        #: Whether a line holds the end of a row and the start of the next.
        self.is_broken = False
        self._on_line = 0  # values so far on the current line
        self._in_row = 0  # values so far in the current row

    def add(self, values: Array, ends: NDArray[np.intp], line: int) -> None:
        """Add values, the number of them before each line end, and the number of the first line."""
        if len(ends) == 0:
            self._on_line += len(values)
            return
        counts = ends.copy()
        counts[1:] -= ends[:-1]
        counts[0] += self._on_line
        self._on_line = len(values) - int(ends[-1])
        self._add_lines(counts, line)

    def end(self, line: int) -> None:
        """End of the file, at its last line."""
        self._add_lines(np.array([self._on_line]), line)

    def _add_lines(self, counts: NDArray[np.intp], line: int) -> None:
        places = np.flatnonzero(counts)
        if len(places) == 0:
            return
        self.last_line = line + int(places[-1])
        counts = counts[places]
        odd = counts != self.n_channels
        if self._in_row == 0 and not odd.any():
            return
        if self.odd_line is None:
            first = int(odd.argmax())
            self.odd_line, self.odd_count = line + int(places[first]), int(counts[first])
        ends = self._in_row + np.cumsum(counts)
        starts = (ends - counts) % self.n_channels
        is_part = starts + counts <= self.n_channels
        is_whole = (starts == 0) & (counts % self.n_channels == 0)
        self.is_broken |= not (is_part | is_whole).all()
        self._in_row = int(ends[-1]) % self.n_channels


def _comma_hint(text: str) -> str:
    return "; decimals need a point, not a comma" if "," in text else ""


def _float(word: str) -> float:
    """Number of a file; ValueError for numbers that only Python accepts ("1_000")."""
    if "_" in word or not word.isascii():
        raise ValueError
    return float(word)


def _fast_values(text: str) -> tuple[Array, NDArray[np.intp]] | None:
    """Values of a text of plain finite numbers, and the number of them before each line end; else None."""
    characters = np.frombuffer(text.encode("latin-1"), dtype=np.uint8)
    # with these characters only, Python accepts no more than files do
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
