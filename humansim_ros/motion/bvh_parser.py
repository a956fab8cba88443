"""The parser of BVH files: what is written becomes a Motion, or an error that knows its line."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.motion.kinematics import AXES, CHANNEL_NAMES, Motion
from humansim_ros.types import Array

_CANONICAL = {name.lower(): name for name in CHANNEL_NAMES}
#: Characters of rows that are read at a time, at least and at most: large blocks are faster, and need memory
#: beside the values.
_BLOCKS = 1 << 12, 1 << 16
#: Characters that no line of a hierarchy and no number has.
_TOO_LONG = 1 << 20
#: Characters that a joint's name may have: every end site repeats the name of its joint.
LONGEST_NAME = 1000
#: Numbers beyond are no measures of anything, and their squares not finite.
LARGEST = 1e15
#: Seconds that a frame may take.
FRAME_TIMES = 1e-9, 1e6
#: The characters of plain numbers and of white space, by their codes.
_PLAIN = np.isin(np.arange(256), list(b"0123456789+-.eE \t\n\v\f"))
_BRACE = re.compile(r"([{}])")
#: A minus sign that starts a new number although no space stands before it ("1.5-2.5"), but not in "1e-5".
_GLUED_MINUS = re.compile(r"(?<=[0-9.])-")


def warn(message: str) -> None:
    """Tells of input that is odd but clear."""
    warnings.warn(message, HumansimWarning, stacklevel=3)


class Parser:
    """One file, read once from its start to its end. The hierarchy is read statement by statement; the rows,
    which are nearly all of a file, in blocks, and word by word only where something is wrong with a block.
    """

    def __init__(self, path: str | os.PathLike[str], file: TextIO) -> None:
        self.path = os.fspath(path)
        self.file = file
        self.line = 0  # number of the last line read
        self.names: list[str] = []
        self.is_end: list[bool] = []
        self.joint_lines: list[int] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...] | None] = []
        self.is_latin = False

    def error(self, message: str, line: int | None = None) -> MotionError:
        return MotionError(message, path=self.path, line=self.line if line is None else line)

    def parse(self) -> Motion:
        has_motion = self._hierarchy()
        self._name_apart()
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
        """The next line, with its end; "" after the last."""
        text = self.file.readline(_TOO_LONG)
        if not text:
            return text
        self.line += 1
        if self.line == 1 and text.startswith(("ÿþ", "þÿ")):
            raise MotionError("this is UTF-16 text: save it as UTF-8", path=self.path)
        if "\0" in text:
            raise MotionError("this is a binary file, not a BVH motion text file", path=self.path)
        if len(text) == _TOO_LONG:
            raise self.error(f"not a BVH file: a line of more than {_TOO_LONG} characters")
        if text.isascii():
            return text
        try:
            return text.encode("latin-1").decode("utf-8-sig" if self.line == 1 else "utf-8")
        except UnicodeDecodeError:
            if not self.is_latin:
                warn(f"{self.path}:{self.line}: not UTF-8: read as Latin-1; names may look odd")
            self.is_latin = True
            return text

    def _statements(self) -> Iterator[str]:
        """Statements of the hierarchy: lines, with braces as statements of their own."""
        while text := self._next_line():
            for part in _BRACE.split(text):
                if statement := part.strip():
                    yield statement

    def _hierarchy(self) -> bool:
        """Fill the joints; returns whether a MOTION section follows."""
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
                    raise self.error(f"'{{' expected after {self._called(pending)}")
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
                    raise self.error(f"{self._called(joint)} has no OFFSET")
            elif keyword == "OFFSET" and stack:
                if self.offsets[stack[-1]]:
                    raise self.error(f"{self._called(stack[-1])} has a second OFFSET")
                self.offsets[stack[-1]] = self._offset(rest)
            elif keyword == "CHANNELS" and stack:
                if self.channels[stack[-1]] is not None:
                    raise self.error(f"{self._called(stack[-1])} has a second CHANNELS")
                self.channels[stack[-1]] = self._channels(rest)
            else:
                raise self.error(f"cannot understand {statement[:40]!r} in the hierarchy")
        if stack or pending is not None:
            raise self.error("the file ends inside the hierarchy: it is truncated")
        return False

    def _called(self, joint: int) -> str:
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

    def _name_apart(self) -> None:
        """Joints of one name are numbered as Blender does, since names are what joints are asked for by; end
        sites are named after their joints.
        """
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
            warn(f"{self.path}:{line}: a second joint is named {name!r}: it is called {unique!r}{more}")

    def _offset(self, rest: str) -> list[float]:
        try:
            values = [_float(word) for word in _GLUED_MINUS.sub(" -", rest).split()]
        except ValueError:
            values = []
        if len(values) != 3 or not all(abs(value) <= LARGEST for value in values):
            hint = _about_commas(rest)
            raise self.error(f"OFFSET needs three finite numbers, not {rest.strip()[:40]!r}{hint}")
        return values

    def _channels(self, rest: str) -> tuple[str, ...]:
        count, *words = rest.split() or [""]
        names = tuple(_CANONICAL.get(word.lower(), "") for word in words)
        if not (count.isascii() and count.isdigit()) or "" in names or len(set(names)) != len(names):
            raise self.error(f"CHANNELS needs a count and names such as Zrotation, not {rest.strip()[:60]!r}")
        # compared as text: Python does not make numbers of thousands of digits
        if (count.lstrip("0") or "0") != str(len(names)):
            warn(
                f"{self.path}:{self.line}: CHANNELS says {count[:20]} but names {len(names)}; the names count"
            )
        return names

    def _motion(self, has_motion: bool) -> tuple[Array, float]:
        if not has_motion:
            warn(f"{self.path}: no MOTION section: a static pose")
            return self._resting(), 1 / 30
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
                warn(f"{self.path}: no frames: a static pose")
                return self._resting(), frame_time
            raise self.error("no frames after 'Frame Time:': the file is truncated")
        if len(rows) != n_frames:
            warn(f"{self.path}: says {n_frames:g} frames but has {len(rows)}; the rows count")
        return rows, frame_time

    def _resting(self) -> Array:
        """The row of channel values (1, C) that leaves every joint at rest."""
        pairs = zip(self.offsets, self.channels, strict=True)
        values = [
            offset[AXES[name[0]]] if name.endswith("position") else 0.0
            for offset, names in pairs
            for name in names or ()
        ]
        return np.array(values).reshape(1, -1)

    def _header_number(self, header: dict[str, tuple[int, str]], key: str) -> float:
        found = header.get("".join(key.lower().split()))
        if found is None:
            raise self.error(f"'{key}:' is missing after MOTION: the file is truncated or damaged")
        number, text = found
        try:
            value = _float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise self.error(f"'{key}:' needs a number, not {text[:40]!r}{_about_commas(text)}", number)
        return value

    def _rows(self, n_frames: float) -> Array:
        """The rest of the file as rows of channel values (F, C)."""
        n_channels = sum(len(names or ()) for names in self.channels)
        layout = _Layout(n_channels)
        blocks = []
        for text in self._blocks():
            if n_channels == 0 and text.strip():
                raise self.error("a value, but no joint has channels", self.line + 1)
            found = _fast_values(text)
            if found is None:
                text = _GLUED_MINUS.sub(" -", text)
                found = _fast_values(text) or self._slow_values(text)
            blocks.append(found[0])
            layout.add(*found, self.line + 1)
            self.line += len(found[1])
            if layout.is_broken:
                break
        if n_channels == 0:
            return np.zeros((1, 0))
        layout.end(self.line + 1)
        n_values = sum(map(len, blocks))
        if layout.odd_line is not None:
            if layout.is_broken or n_values != n_frames * n_channels:
                # nothing after a row that is too short
                is_cut = layout.odd_line == layout.last_line and layout.odd_count < n_channels
                raise self.error(
                    f"a frame needs {n_channels} values, this has {layout.odd_count}"
                    + ("; the file is truncated" if is_cut else ""),
                    layout.odd_line,
                )
            warn(
                f"{self.path}:{layout.odd_line}: not one frame on a line ({layout.odd_count} of {n_channels} "
                f"values): there are as many values as {n_frames:g} frames have, which are taken in order"
            )
        return np.concatenate([np.empty(0), *blocks]).reshape(-1, n_channels)

    def _blocks(self) -> Iterator[str]:
        """The rest of the file, cut behind white space."""
        rest, n_read = "", 0
        while text := self.file.read(min(max(_BLOCKS[0], n_read // 16), _BLOCKS[1])):
            n_read += len(text)
            text = rest + text
            cut = max(text.rfind(" "), text.rfind("\n"), text.rfind("\t")) + 1
            if len(text) - cut > _TOO_LONG:
                raise self.error(f"a word of more than {_TOO_LONG} characters", self.line + 1)
            rest = text[cut:]
            if cut:
                yield text[:cut]
        if rest:
            yield rest

    def _slow_values(self, text: str) -> tuple[Array, NDArray[np.intp]]:
        """As :func:`_fast_values`, for text of any white space; errors know their line."""
        values: list[float] = []
        ends: list[int] = []
        for number, line in enumerate(text.split("\n"), self.line + 1):
            for word in line.split():
                try:
                    values.append(_float(word))
                except ValueError:
                    message = f"{word[:40]!r} is not a number{_about_commas(word)}"
                    raise self.error(message, number) from None
                if not abs(values[-1]) <= LARGEST:
                    raise self.error(f"{word[:40]!r} is not finite, or beyond {LARGEST:g}", number)
            ends.append(len(values))
        return np.array(values), np.array(ends[:-1], dtype=np.intp)


class _Layout:
    """How rows of C values are laid out on lines. One on each is usual; a line may also hold several whole
    rows, or a part of one row: then it is clear where each starts, if nothing is missing in the end.
    """

    def __init__(self, n_channels: int) -> None:
        self.n_channels = n_channels
        #: The first line that does not hold just one row, and its number of values.
        self.odd_line: int | None = None
        self.odd_count = 0
        #: The last line that holds anything.
        self.last_line = 0
        #: Whether a line holds the end of a row and the start of the next.
        self.is_broken = False
        self._on_line = 0  # values so far on the line that is not at its end
        self._in_row = 0  # values so far in the row that is not at its end

    def add(self, values: Array, ends: NDArray[np.intp], line: int) -> None:
        """More text: its values, how many of them stand before each of its line ends, its first line."""
        if len(ends) == 0:
            self._on_line += len(values)
            return
        counts = ends.copy()
        counts[1:] -= ends[:-1]
        counts[0] += self._on_line
        self._on_line = len(values) - int(ends[-1])
        self._add_lines(counts, line)

    def end(self, line: int) -> None:
        """The file has no more; the number of its last line."""
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


def _about_commas(text: str) -> str:
    return "; decimals need a point, not a comma" if "," in text else ""


def _float(word: str) -> float:
    """A number as files write it; ValueError for what only Python takes for one ("1_000")."""
    if "_" in word or not word.isascii():
        raise ValueError
    return float(word)


def _fast_values(text: str) -> tuple[Array, NDArray[np.intp]] | None:
    """The values in a text of plain finite numbers, and how many stand before each line end; None if there is
    anything else.
    """
    characters = np.frombuffer(text.encode("latin-1"), dtype=np.uint8)
    # only what a plain number is written with: nothing is left that only Python takes for a number
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
