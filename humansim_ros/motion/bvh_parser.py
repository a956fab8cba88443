"""Parser of BVH files, with the line of each error."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import chain
from typing import TextIO

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.motion.bvh_text import (
    BRACE,
    FRAME_TIMES,
    LARGEST,
    BvhText,
    comma_hint,
    read_motion_section,
    starts_motion,
)
from humansim_ros.motion.kinematics import AXES, CHANNEL_NAMES, Motion
from humansim_ros.types import Array

__all__ = ["FRAME_TIMES", "LARGEST", "LONGEST_NAME", "Parser"]

_CANONICAL = {name.lower(): name for name in CHANNEL_NAMES}
#: Most characters of a joint's name: every end site repeats the name of its joint.
LONGEST_NAME = 1000
#: Words that start an end site; the first is followed by "Site".
_ENDS = ("END", "ENDSITE", "END_SITE")


class Parser:
    """Parser of one file, from its start to its end.

    The hierarchy is read statement by statement, the rows by :mod:`.bvh_rows`.
    """

    def __init__(self, path: str | os.PathLike[str], file: TextIO) -> None:
        self.text = BvhText(path, file)
        self.names: list[str] = []
        self.is_end: list[bool] = []
        self.joint_lines: list[int] = []
        self.indents: list[int] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...] | None] = []

    def parse(self) -> Motion:
        """The motion of the file; position channels replace the OFFSET."""
        has_motion = self._hierarchy()
        self.text.warn_of_notes()
        self._make_names_unique()
        values, frame_time = self._motion(has_motion)
        return Motion(
            joint_names=tuple(self.names),
            parents=np.array(self.parents, dtype=np.intp),
            offsets=np.array(self.offsets, dtype=float),
            channels=tuple(names or () for names in self.channels),
            values=values,
            frame_time=frame_time,
            path=self.text.path,
        )

    def _statements(self) -> Iterator[str]:
        """Statements of the hierarchy: lines, with braces as statements of their own."""
        while text := self.text.next_line():
            for part in BRACE.split(text):
                if statement := part.strip():
                    yield statement

    def _hierarchy(self) -> bool:
        """Read the joints; True if a MOTION section follows."""
        text = self.text
        stack: list[int] = []
        pending: int | None = None
        surplus: int | None = None  # line of the first '}' after the hierarchy is closed
        for statement in self._from_first_joint():
            keyword, rest = [*statement.split(maxsplit=1), ""][:2]
            keyword = keyword.upper()
            is_outside = not stack and pending is None and bool(self.names)
            if statement.rstrip(": \t").upper() == "MOTION" or (is_outside and starts_motion(statement)):
                self._check_braces(stack, pending, surplus)
                if starts_motion(statement):
                    text.warn("the word MOTION is missing before this line")
                    text.unread(statement)
                return True
            if keyword in ("ROOT", "JOINT", *_ENDS):
                if pending is not None:
                    raise text.error(f"'{{' expected after {self._description(pending)}")
                pending = self._add_joint(keyword, rest.strip(), stack[-1] if stack else -1)
            elif statement == "{":
                if pending is None:
                    raise text.error("'{' without a joint before it")
                stack.append(pending)
                pending = None
            elif statement == "}":
                if not stack:
                    if not is_outside:
                        raise text.error("'}' without a matching '{'")
                    surplus = surplus or text.line
                    continue
                joint = stack.pop()
                if not self.offsets[joint]:
                    raise text.error(f"{self._description(joint)} has no OFFSET")
            elif keyword == "OFFSET" and stack:
                if self.offsets[stack[-1]]:
                    raise text.error(f"{self._description(stack[-1])} has a second OFFSET")
                self.offsets[stack[-1]] = self._offset(rest)
            elif keyword == "CHANNELS" and stack:
                if self.channels[stack[-1]] is not None:
                    raise text.error(f"{self._description(stack[-1])} has a second CHANNELS")
                self.channels[stack[-1]] = self._channels(rest)
            else:
                raise text.error(f"cannot understand {statement[:40]!r} in the hierarchy")
        if stack or pending is not None:
            raise text.error("the file ends inside the hierarchy: it is truncated")
        self._check_braces(stack, pending, surplus)
        return False

    def _from_first_joint(self) -> Iterator[str]:
        """Statements after the word HIERARCHY."""
        statements = self._statements()
        first = next(statements, None)
        if first is None:
            raise MotionError("the BVH motion file is empty", path=self.text.path)
        keyword, rest = [*first.split(maxsplit=1), ""][:2]
        if keyword.upper() == "HIERARCHY":
            return chain([rest], statements) if rest else statements
        if keyword.upper() == "ROOT":
            self.text.warn("the word HIERARCHY is missing before this line")
            return chain([first], statements)
        raise self.text.error(f"not a BVH file: it should start with HIERARCHY, not {first[:40]!r}")

    def _check_braces(self, stack: list[int], pending: int | None, surplus: int | None) -> None:
        """Accept braces that are missing or left over at the end of the hierarchy, with a warning.

        In its middle they would change the hierarchy; then it disagrees with the indents.
        """
        text = self.text
        if pending is not None or not all(self.offsets[joint] for joint in stack):
            raise text.error("MOTION before the hierarchy is closed: a '}' is missing above")
        if stack and not self._indents_agree():
            raise text.error("MOTION before the hierarchy is closed: a '}' is missing above")
        if surplus is not None and not self._indents_agree():
            raise text.error("'}' without a matching '{'", surplus)
        if stack:
            text.warn(f"{len(stack)} '}}' missing at the end of the hierarchy, before this line")
        if surplus is not None:
            text.warn("'}' without a matching '{' at the end of the hierarchy: left out", surplus)

    def _indents_agree(self) -> bool:
        """Whether each joint is indented more than its parent, and as much as its siblings."""
        of_children: dict[int, int] = {}
        return all(
            (parent < 0 or indent > self.indents[parent]) and of_children.setdefault(parent, indent) == indent
            for parent, indent in zip(self.parents, self.indents, strict=True)
        )

    def _description(self, joint: int) -> str:
        return "an End Site" if self.is_end[joint] else f"joint {self.names[joint]!r}"

    def _add_joint(self, keyword: str, name: str, parent: int) -> int:
        text = self.text
        is_end = keyword in _ENDS
        if is_end:
            if keyword != "END" or not name.upper().startswith("SITE"):
                text.note("end", f"{f'End {name}'.strip()[:40]!r} is read as 'End Site'")
            name = name or "Site"
        if not name:
            raise text.error(f"{keyword} without a name")
        if len(name) > LONGEST_NAME:
            raise text.error(f"a name of more than {LONGEST_NAME} characters: {name[:40]!r}")
        if (keyword == "ROOT") != (parent < 0):
            raise text.error(f"{keyword} {name!r} does not belong here")
        if parent >= 0 and self.is_end[parent]:
            raise text.error(f"{keyword} {name!r} inside an End Site")
        self.names.append(name)
        self.is_end.append(is_end)
        self.joint_lines.append(text.line)
        self.indents.append(text.indent)
        self.parents.append(parent)
        self.offsets.append([])
        self.channels.append(None)
        return len(self.names) - 1

    def _make_names_unique(self) -> None:
        """Number joints of the same name as Blender does; name end sites after their joints."""
        if not self.names:
            raise self.text.error("the hierarchy has no joints")
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
            self.text.warn(f"a second joint is named {name!r}: it is called {unique!r}{more}", line)

    def _offset(self, rest: str) -> list[float]:
        try:
            values = self.text.numbers(rest)
        except ValueError:
            values = []
        if len(values) != 3 or not all(abs(value) <= LARGEST for value in values):
            hint = comma_hint(rest)
            raise self.text.error(f"OFFSET needs three finite numbers, not {rest.strip()[:40]!r}{hint}")
        return values

    def _channels(self, rest: str) -> tuple[str, ...]:
        if "," in rest:
            self.text.note("channels", "the commas after CHANNELS are read as white space")
        count, *words = rest.replace(",", " ").split() or [""]
        names = tuple(_CANONICAL.get(word.lower(), "") for word in words)
        if not (count.isascii() and count.isdigit()) or "" in names or len(set(names)) != len(names):
            raise self.text.error(
                f"CHANNELS needs a count and names such as Zrotation, not {rest.strip()[:60]!r}"
            )
        # compared as text: Python does not convert numbers of thousands of digits
        if (count.lstrip("0") or "0") != str(len(names)):
            self.text.warn(f"CHANNELS says {count[:20]} but names {len(names)}; the names count")
        return names

    def _motion(self, has_motion: bool) -> tuple[Array, float]:
        if not has_motion:
            self.text.warn_file("no MOTION section: a static pose")
            return self._rest_row(), 1 / 30
        n_channels = sum(len(names or ()) for names in self.channels)
        rows, frame_time = read_motion_section(self.text, n_channels)
        if len(rows) == 0:
            self.text.warn_file("no frames: a static pose")
            rows = self._rest_row()
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
