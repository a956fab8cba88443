"""Biovision hierarchy (BVH) files and their forward kinematics.

Conventions (agree with Blender's importer): a joint's rotation is ``R_channel1 R_channel2 R_channel3`` in the
order of its CHANNELS line, on column vectors; the translation is outermost wherever its channels stand;
position channels replace the OFFSET, but for files of old programs that want them added and are found by
that. Nothing is converted: positions stay in the file's own units and axes.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.files import atomic_path, read_bytes
from humansim_ros.hierarchy import levels
from humansim_ros.rotations import Array, quaternion_to_matrix, transform

CHANNEL_NAMES = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
_CANONICAL = {name.lower(): name for name in CHANNEL_NAMES}
#: A frame number, a slice of them, or an array or list of them.
Frames = int | slice | Sequence[int] | NDArray[np.integer]
_ALL = slice(None)
_AXES = {"X": 0, "Y": 1, "Z": 2}
#: The line that ends the hierarchy.
_MOTION = re.compile(rb"(?:^|\})[ \t]*MOTION\b[^\n]*\n?", re.IGNORECASE | re.MULTILINE)
#: Bytes of rows that are read at a time.
_BLOCK = 1 << 17
#: The characters of plain numbers and of white space, by their codes.
_PLAIN = np.isin(np.arange(256), list(b"0123456789+-.eE \t\n\v\f\r"))
#: OFFSETs shorter than this part of the skeleton's size say nothing of what positions mean.
_NO_OFFSET = 0.005
#: Positions are added to an OFFSET if they reach less than this part of it.
_NEAR_ZERO = 0.3
#: Deeper joints are not indented more: a chain of thousands would be mostly tabs.
_DEEPEST_INDENT = 40
#: A minus sign that starts a new number although no space stands before it ("1.5-2.5"), but not in "1e-5".
_GLUED_MINUS = re.compile(r"(?<=[0-9.])-")


@dataclass(frozen=True)
class Motion:
    """A skeleton of joints and what its channels say in each frame, exactly as in the file.

    ``joint_names``: J names, parents before children; end sites are joints without channels named
    ``<parent>_end``.
    ``parents``: (J,) index of each parent, -1 for a root. ``offsets``: (J, 3) in file units.
    ``channels``: per joint the names of its channels. ``values``: (F, C) channel values (file units and
    degrees).
    ``frame_time``: seconds. ``positions``: whether position channels replace the OFFSET or are added to it.
    """

    joint_names: tuple[str, ...]
    parents: NDArray[np.intp]
    offsets: Array
    channels: tuple[tuple[str, ...], ...]
    values: Array
    frame_time: float
    path: str = field(default="", compare=False)
    positions: Literal["replace", "add"] = "replace"

    @property
    def n_frames(self) -> int:
        return len(self.values)

    @property
    def n_joints(self) -> int:
        return len(self.joint_names)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (self.n_frames - 1) * self.frame_time

    def joint(self, name: str) -> int:
        """Index of a joint; MotionError if there is none of that name."""
        try:
            return self.joint_names.index(name)
        except ValueError:
            raise MotionError(
                f"no joint {name!r}; the joints are {', '.join(self.joint_names)}", path=self.path
            ) from None

    @cached_property
    def _levels(self) -> tuple[NDArray[np.intp], ...]:
        return levels(self.parents)

    @cached_property
    def _columns(self) -> tuple[int, ...]:
        """First column of each joint's channels in ``values``."""
        counts = [len(names) for names in self.channels]
        return tuple(int(n) for n in np.concatenate(([0], np.cumsum(counts)))[:-1])

    def local_translations(self, frames: Frames = _ALL) -> Array:
        """Translation of each joint in its parent (..., J, 3), file units; position channels replace the
        OFFSET, or are added to it, as :attr:`positions` says.
        """
        values = self.values[frames]
        out = np.broadcast_to(self.offsets, (*values.shape[:-1], *self.offsets.shape)).copy()
        for joint, (names, start) in enumerate(zip(self.channels, self._columns, strict=True)):
            for column, name in enumerate(names, start):
                if name.endswith("position"):
                    axis = _AXES[name[0]]
                    base = self.offsets[joint, axis] if self.positions == "add" else 0.0
                    out[..., joint, axis] = base + values[..., column]
        return out

    def local_rotations(self, frames: Frames = _ALL) -> Array:
        """Rotation of each joint in its parent (..., J, 4), quaternions xyzw."""
        values = self.values[frames]
        out = np.zeros((*values.shape[:-1], self.n_joints, 4))
        out[..., 3] = 1.0
        by_order: dict[tuple[int, ...], list[tuple[int, list[int]]]] = {}
        for joint, (names, start) in enumerate(zip(self.channels, self._columns, strict=True)):
            turns = [(_AXES[n[0]], c) for c, n in enumerate(names, start) if n.endswith("rotation")]
            if turns:
                by_order.setdefault(tuple(a for a, _ in turns), []).append((joint, [c for _, c in turns]))
        for axes, group in by_order.items():
            columns = np.array([c for _, c in group])
            half = np.radians(values[..., columns]) / 2
            out[..., [joint for joint, _ in group], :] = _compose(np.sin(half), np.cos(half), axes)
        return out

    def world_transforms(self, frames: Frames = _ALL) -> Array:
        """Joint frames in file space (..., J, 4, 4) for a frame number, a slice or frame numbers."""
        rotations = quaternion_to_matrix(self.local_rotations(frames))
        return self.compose_world(self.local_translations(frames), rotations)

    def compose_world(self, translations: Array, rotations: Array) -> Array:
        """Joint frames (..., J, 4, 4) from local translations (..., J, 3) and rotation matrices (..., J, 3,
        3).
        """
        world_r = np.array(np.broadcast_to(rotations, (*translations.shape[:-1], 3, 3)))
        world_t = np.array(translations)
        for level in self._levels[1:]:
            parents = self.parents[level]
            parent_r = world_r[..., parents, :, :]
            world_t[..., level, :] = (parent_r @ world_t[..., level, :, None])[..., 0] + world_t[
                ..., parents, :
            ]
            world_r[..., level, :, :] = parent_r @ world_r[..., level, :, :]
        return transform(world_r, world_t)

    def world_positions(self, frames: Frames = _ALL) -> Array:
        """Joint positions (..., J, 3) in file units and axes; (J, 3) for one frame number."""
        return self.world_transforms(frames)[..., :3, 3]

    def rest_positions(self) -> Array:
        """Joint positions (J, 3), every rotation zero and every joint at its OFFSET, file units and axes."""
        return self.compose_world(self.offsets, np.broadcast_to(np.eye(3), (self.n_joints, 3, 3)))[..., :3, 3]


def _compose(sine: Array, cosine: Array, axes: Sequence[int]) -> Array:
    """Quaternion product of turns about coordinate axes; half-angle sines and cosines (..., N, len(axes))."""
    total = np.zeros((*sine.shape[:-1], 4))
    total[..., 3] = 1.0
    for k, axis in enumerate(axes):
        s, c = sine[..., k], cosine[..., k]
        j, l = (axis + 1) % 3, (axis + 2) % 3  # noqa: E741
        turned = np.empty_like(total)
        turned[..., axis] = total[..., axis] * c + total[..., 3] * s
        turned[..., j] = total[..., j] * c + total[..., l] * s
        turned[..., l] = total[..., l] * c - total[..., j] * s
        turned[..., 3] = total[..., 3] * c - total[..., axis] * s
        total = turned
    return total


Positions = Literal["auto", "replace", "add"]


def read_bvh(path: str | os.PathLike[str], positions: Positions = "auto") -> Motion:
    """Read a BVH file (text, any line ends).

    ``positions``: whether position channels replace the OFFSET, as nearly all programs mean them, or are
    added to it; "auto" finds the files of those that add: their positions stay near 0 beside large OFFSETs.

    Raises MotionError, with file and line, on anything that cannot be understood. Warns (HumansimWarning)
    where something is odd but its meaning clear: a wrong ``Frames:`` count (the rows decide), no MOTION (a
    static pose), joints of one name (they are numbered), added positions.
    """
    if positions not in ("auto", "replace", "add"):
        raise MotionError(f"positions are 'auto', 'replace' or 'add', not {positions!r}", path=path)
    motion = _Parser(path, read_bytes(path, MotionError, "BVH motion")).parse()
    if positions != "auto":
        return replace(motion, positions=positions)
    added = _joints_with_added_positions(motion)
    if not added:
        return motion
    names = ", ".join(motion.joint_names[joint] for joint in added[:4]) + (", …" if len(added) > 4 else "")
    _warn(
        f"{motion.path}: the positions of {names} stay near 0 beside their OFFSETs: added to them "
        "(positions='replace' takes them as they are)"
    )
    return replace(motion, positions="add")


def _warn(message: str) -> None:
    warnings.warn(message, HumansimWarning, stacklevel=3)


def _joints_with_added_positions(motion: Motion) -> list[int]:
    """Joints whose positions never come near their OFFSETs, if they are most of those that have both."""
    size = float(np.ptp(motion.rest_positions(), axis=0).max())
    added, judged = [], 0
    for joint, (names, start) in enumerate(zip(motion.channels, motion._columns, strict=True)):
        columns = [(_AXES[n[0]], c) for c, n in enumerate(names, start) if n.endswith("position")]
        offset = motion.offsets[joint]
        length = float(np.linalg.norm(offset))
        if len(columns) < 3 or length <= _NO_OFFSET * size:
            continue
        judged += 1
        values = motion.values[:, [c for _, c in sorted(columns)]]
        if abs(float(np.median(values @ offset))) < _NEAR_ZERO * length**2:
            added.append(joint)
    return added if 2 * len(added) > judged else []


class _Parser:
    """One file. The hierarchy is read statement by statement; the rows, which are nearly all of a file, in
    blocks of bytes, and word by word only where something is wrong with a block.
    """

    def __init__(self, path: str | os.PathLike[str], data: bytes) -> None:
        self.path = os.fspath(path)
        if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise self.error("this is UTF-16 text: save it as UTF-8", None)
        if b"\0" in data:
            raise self.error("this is a binary file, not a BVH motion text file", None)
        if data.count(b"\r") != data.count(b"\r\n"):  # old Macintosh line ends
            data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        self.data = data
        found = _MOTION.search(data)
        # where the rows' section starts: behind the line of MOTION
        self.body = len(data) if found is None else found.end()
        self.lines = self._decoded(data[: self.body])
        self.last_line = data.count(b"\n") + (not data.endswith(b"\n"))
        self.names: list[str] = []
        self.joint_lines: list[int] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...]] = []

    @staticmethod
    def _decoded(data: bytes) -> list[str]:
        try:
            return data.decode("utf-8-sig").split("\n")
        except UnicodeDecodeError:
            return data.decode("latin-1").split("\n")

    def error(self, message: str, line: int | None) -> MotionError:
        return MotionError(message, path=self.path, line=line)

    def parse(self) -> Motion:
        has_motion = self._hierarchy()
        values, frame_time = self._motion(has_motion)
        return Motion(
            joint_names=tuple(self.names),
            parents=np.array(self.parents, dtype=np.intp),
            offsets=np.array(self.offsets, dtype=float),
            channels=tuple(self.channels),
            values=values,
            frame_time=frame_time,
            path=self.path,
        )

    def _statements(self) -> Iterator[tuple[int, str]]:
        """Numbered statements of the hierarchy: lines, with braces as statements of their own."""
        for number, line in enumerate(self.lines, 1):
            for part in re.split(r"([{}])", line):
                if part.strip():
                    yield number, part.strip()

    def _hierarchy(self) -> bool:
        """Fill the joints; returns whether a MOTION section follows."""
        statements = self._statements()
        number, first = next(statements, (1, ""))
        if first.upper() != "HIERARCHY":
            raise self.error(f"not a BVH file: it should start with HIERARCHY, not {first[:40]!r}", number)
        stack: list[int] = []
        pending: int | None = None
        for number, statement in statements:
            keyword, rest = [*statement.split(maxsplit=1), ""][:2]
            keyword = keyword.upper()
            if keyword == "MOTION":
                if stack or pending is not None:
                    raise self.error("MOTION before the hierarchy is closed: a '}' is missing above", number)
                self._checked(number)
                return True
            if keyword in ("ROOT", "JOINT") or statement.upper().split() == ["END", "SITE"]:
                if pending is not None:
                    raise self.error(f"'{{' expected after joint {self.names[pending]!r}", number)
                pending = self._add_joint(keyword, rest.strip(), stack[-1] if stack else -1, number)
            elif statement == "{":
                if pending is None:
                    raise self.error("'{' without a joint before it", number)
                stack.append(pending)
                pending = None
            elif statement == "}":
                if not stack:
                    raise self.error("'}' without a matching '{'", number)
                self._close_joint(stack.pop(), number)
            elif keyword == "OFFSET" and stack:
                self.offsets[stack[-1]] = self._offset(rest, number)
            elif keyword == "CHANNELS" and stack:
                self.channels[stack[-1]] = self._channels(rest, number)
            else:
                raise self.error(f"cannot understand {statement[:40]!r} in the hierarchy", number)
        if stack or pending is not None:
            raise self.error("the file ends inside the hierarchy: it is truncated", self.last_line)
        self._checked(number)
        return False

    def _checked(self, number: int) -> None:
        """Joints of one name are numbered as Blender does, since names are what joints are asked for by."""
        if not self.names:
            raise self.error("the hierarchy has no joints", number)
        seen = set(self.names)
        if len(seen) == len(self.names):
            return
        taken: set[str] = set()
        copies: dict[str, int] = {}
        for joint, name in enumerate(self.names):
            if name in taken:
                unique = name
                while unique in seen:
                    copies[name] = copies.get(name, 0) + 1
                    unique = f"{name}.{copies[name]:03d}"
                self.names[joint] = unique
                seen.add(unique)
                is_end = self.parents[joint] >= 0 and not self.channels[joint]
                if not (is_end and name == f"{self.names[self.parents[joint]]}_end"):
                    line = self.joint_lines[joint]
                    _warn(f"{self.path}:{line}: a second joint is named {name!r}: it is called {unique!r}")
            taken.add(self.names[joint])

    def _add_joint(self, keyword: str, name: str, parent: int, number: int) -> int:
        if keyword == "END":
            name = f"{self.names[parent]}_end" if parent >= 0 else ""
        if not name:
            raise self.error(f"{keyword} without a name", number)
        if (keyword == "ROOT") != (parent < 0):
            raise self.error(f"{keyword} {name!r} does not belong here", number)
        self.names.append(name)
        self.joint_lines.append(number)
        self.parents.append(parent)
        self.offsets.append([])
        self.channels.append(())
        return len(self.names) - 1

    def _close_joint(self, joint: int, number: int) -> None:
        if not self.offsets[joint]:
            raise self.error(f"joint {self.names[joint]!r} has no OFFSET", number)

    def _offset(self, rest: str, number: int) -> list[float]:
        words = _GLUED_MINUS.sub(" -", rest).split()
        try:
            values = [_float(word) for word in words]
        except ValueError:
            raise self.error(f"OFFSET needs three numbers, not {rest.strip()[:40]!r}", number) from None
        if len(values) != 3 or not np.isfinite(values).all():
            raise self.error(f"OFFSET needs three finite numbers, not {rest.strip()[:40]!r}", number)
        return values

    def _channels(self, rest: str, number: int) -> tuple[str, ...]:
        words = rest.split()
        names = tuple(_CANONICAL.get(word.lower(), "") for word in words[1:])
        if (
            not words
            or not (words[0].isascii() and words[0].isdigit())
            or "" in names
            or len(set(names)) != len(names)
        ):
            raise self.error(
                f"CHANNELS needs a count and names such as Zrotation, not {rest.strip()[:60]!r}", number
            )
        if int(words[0]) != len(names):
            raise self.error(f"CHANNELS says {words[0]} but names {len(names)}", number)
        return names

    def _motion(self, has_motion: bool) -> tuple[Array, float]:
        n_channels = sum(len(names) for names in self.channels)
        if not has_motion:
            _warn(f"{self.path}: no MOTION section: a static pose")
            return self._resting(), 1 / 30
        header: dict[str, tuple[int, str]] = {}
        number, at = len(self.lines), self.body
        while at < len(self.data) and len(header) < 2:
            end = self.data.find(b"\n", at)
            end = len(self.data) if end < 0 else end
            line = self.data[at : min(end, at + 1000)].decode("latin-1")
            key, colon, value = line.partition(":")
            if key.strip() and not colon:
                raise self.error(f"'Frames:' and 'Frame Time:' expected, not {key.strip()[:40]!r}", number)
            if key.strip():
                header["".join(key.lower().split())] = (number, value.strip())
            at, number = end + 1, number + 1
        n_frames = self._header_number(header, "Frames", number)
        frame_time = self._header_number(header, "Frame Time", number)
        if frame_time <= 0:
            raise self.error(f"Frame Time must be above zero, not {frame_time:g}", header["frametime"][0])
        rows = self._rows(at, number, n_channels)
        if len(rows) == 0:
            if n_frames == 0:
                _warn(f"{self.path}: no frames: a static pose")
                return self._resting(), frame_time
            raise self.error("no frames after 'Frame Time:': the file is truncated", self.last_line)
        if len(rows) != n_frames:
            _warn(f"{self.path}: says {n_frames:g} frames but has {len(rows)}; the rows count")
        return rows, frame_time

    def _resting(self) -> Array:
        """The row of channel values (1, C) that leaves every joint at rest."""
        pairs = zip(self.offsets, self.channels, strict=True)
        values = [
            offset[_AXES[name[0]]] if name.endswith("position") else 0.0
            for offset, names in pairs
            for name in names
        ]
        return np.array(values).reshape(1, -1)

    def _header_number(self, header: dict[str, tuple[int, str]], key: str, line: int) -> float:
        found = header.get("".join(key.lower().split()))
        if found is None:
            raise self.error(
                f"'{key}:' is missing after MOTION: the file is truncated or damaged",
                min(line, self.last_line),
            )
        number, text = found
        try:
            value = _float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise self.error(f"'{key}:' needs a number, not {text[:40]!r}", number)
        return value

    def _rows(self, at: int, line: int, n_channels: int) -> Array:
        """Frame rows (F, C) from a byte on, which starts a line of that number."""
        if n_channels == 0:
            return np.zeros((1, 0))
        # never more than the rows there can be, whatever the header says; memory is touched only as it fills
        most = (len(self.data) - at) // (2 * n_channels) + 1
        rows = np.empty((min(most, self.data.count(b"\n", at) + 1), n_channels))
        n_rows = 0
        while at < len(self.data):
            end = len(self.data) if at + _BLOCK >= len(self.data) else self.data.find(b"\n", at + _BLOCK) + 1
            end = end or len(self.data)
            block = self.data[at:end]
            values = _fast_rows(block, n_channels)
            if values is None:
                values = self._slow_rows(block, line, n_channels, last=end == len(self.data))
            rows[n_rows : n_rows + len(values)] = values
            n_rows += len(values)
            at, line = end, line + block.count(b"\n")
        # a copy only where blank lines would keep much memory
        return rows[:n_rows] if n_rows > 0.9 * len(rows) else rows[:n_rows].copy()

    def _slow_rows(self, block: bytes, first: int, n_channels: int, last: bool) -> Array:
        """Rows of a block, line by line: numbers glued together are parted, and errors know their line."""
        rows = []
        lines = block.decode("latin-1").split("\n")
        while lines and not lines[-1].strip():
            lines.pop()
        for number, line in enumerate(lines, first):
            words = _GLUED_MINUS.sub(" -", line).split()
            if not words:
                continue
            row = np.array([self._number(word, number) for word in words])
            if len(row) != n_channels:
                reason = "; the file is truncated" if last and number == first + len(lines) - 1 else ""
                raise self.error(f"a frame needs {n_channels} values, this has {len(row)}{reason}", number)
            if not np.isfinite(row).all():
                raise self.error("a value is not finite (NaN or infinity)", number)
            rows.append(row)
        return np.array(rows).reshape(-1, n_channels)

    def _number(self, word: str, line: int) -> float:
        try:
            return _float(word)
        except ValueError:
            comma = "; decimals need a point, not a comma" if "," in word else ""
            raise self.error(f"{word[:40]!r} is not a number{comma}", line) from None


def _float(word: str) -> float:
    """A number as files write it; ValueError for what only Python takes for one ("1_000")."""
    if "_" in word or not word.isascii():
        raise ValueError
    return float(word)


def _fast_rows(block: bytes, n_channels: int) -> Array | None:
    """Rows (F, C) of whole lines of plain finite numbers, or None where any line is anything else."""
    characters = np.frombuffer(block, dtype=np.uint8)
    # only what a plain number is written with: nothing is left that could be parted or read by half
    if not _PLAIN[characters].all():
        return None
    blank = characters <= 32
    starts = ~blank
    starts[1:] &= blank[:-1]
    places = np.flatnonzero(starts)
    if len(places) % n_channels:
        return None
    # numbers before each line's end: every line with numbers has a row of them
    before = np.searchsorted(places, np.append(np.flatnonzero(characters == 10), len(characters)))
    rows = before[np.diff(before, prepend=0) > 0]
    if (rows % n_channels).any() or len(rows) * n_channels != len(places):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.fromstring(block.decode("ascii"), sep=" ")
    except (DeprecationWarning, ValueError):
        return None
    if len(values) != len(places) or not np.isfinite(values).all():
        return None
    return values.reshape(-1, n_channels)


def write_bvh(path: str | os.PathLike[str], motion: Motion) -> None:
    """Write a motion as a BVH file that :func:`read_bvh` and other programs read back the same.

    Numbers are written with as many digits as they have. Positions that are added to OFFSETs are written as
    positions that replace them, as all programs read them.
    """
    if motion.positions == "add":
        motion = _with_replacing_positions(motion)
    lines = ["HIERARCHY"]
    children: list[list[int]] = [[] for _ in motion.joint_names]
    for joint, parent in enumerate(motion.parents):
        if parent >= 0:
            children[parent].append(joint)
    stack: list[tuple[int, int, bool]] = [
        (joint, 0, False) for joint in reversed(range(motion.n_joints)) if motion.parents[joint] < 0
    ]
    order: list[int] = []
    while stack:
        joint, depth, closing = stack.pop()
        indent = "\t" * min(depth, _DEEPEST_INDENT)
        if closing:
            lines.append(f"{indent}}}")
            continue
        order.append(joint)
        parent = motion.parents[joint]
        is_end = parent >= 0 and motion.joint_names[joint] == f"{motion.joint_names[parent]}_end"
        is_end = is_end and not children[joint] and not motion.channels[joint]
        title = "End Site" if is_end else f"{'ROOT' if parent < 0 else 'JOINT'} {motion.joint_names[joint]}"
        lines += [indent + title, indent + "{"]
        lines.append(indent + "\tOFFSET " + " ".join(map(_number, motion.offsets[joint].tolist())))
        if not is_end:
            names = motion.channels[joint]
            lines.append(indent + f"\tCHANNELS {len(names)} " + " ".join(names))
        stack.append((joint, depth, True))
        stack += [(child, depth + 1, False) for child in reversed(children[joint])]
    columns = np.concatenate([motion._columns[j] + np.arange(len(motion.channels[j])) for j in order]).astype(
        int
    )
    lines += ["MOTION", f"Frames: {motion.n_frames}", f"Frame Time: {_number(motion.frame_time)}"]
    lines += [" ".join(map(_number, row)) for row in motion.values[:, columns].tolist()]
    with atomic_path(Path(path)) as temporary:
        temporary.write_text("\n".join(lines) + "\n")


def _number(value: float) -> str:
    """The shortest text that is read back as this number, without an exponent."""
    text = repr(float(value))
    return np.format_float_positional(value, trim="0") if "e" in text else text


def _with_replacing_positions(motion: Motion) -> Motion:
    values = motion.values.copy()
    for joint, (names, start) in enumerate(zip(motion.channels, motion._columns, strict=True)):
        for column, name in enumerate(names, start):
            if name.endswith("position"):
                values[:, column] += motion.offsets[joint, _AXES[name[0]]]
    return replace(motion, values=values, positions="replace")
