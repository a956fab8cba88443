"""Biovision hierarchy (BVH) files and their forward kinematics.

Conventions (agree with Blender's importer): a joint's rotation is ``R_channel1 R_channel2 R_channel3`` in the
order of its CHANNELS line, on column vectors; the translation is outermost wherever its channels stand;
position channels replace the OFFSET. Nothing is converted: positions stay in the file's own units and axes.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.files import atomic_path, read_text
from humansim_ros.hierarchy import levels
from humansim_ros.rotations import Array, quaternion_to_matrix, transform

CHANNEL_NAMES = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
_CANONICAL = {name.lower(): name for name in CHANNEL_NAMES}
#: A frame number, a slice of them, or an array or list of them.
Frames = int | slice | Sequence[int] | NDArray[np.integer]
_ALL = slice(None)
_AXES = {"X": 0, "Y": 1, "Z": 2}
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
    ``frame_time``: seconds.
    """

    joint_names: tuple[str, ...]
    parents: NDArray[np.intp]
    offsets: Array
    channels: tuple[tuple[str, ...], ...]
    values: Array
    frame_time: float
    path: str = field(default="", compare=False)

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
        OFFSET.
        """
        values = self.values[frames]
        out = np.broadcast_to(self.offsets, (*values.shape[:-1], *self.offsets.shape)).copy()
        for joint, (names, start) in enumerate(zip(self.channels, self._columns, strict=True)):
            for column, name in enumerate(names, start):
                if name.endswith("position"):
                    out[..., joint, _AXES[name[0]]] = values[..., column]
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


def read_bvh(path: str | os.PathLike[str]) -> Motion:
    """Read a BVH file (text, any line ends).

    Raises MotionError, with file and line, on anything that cannot be understood; warns (HumansimWarning)
    where the
    ``Frames:`` count is wrong but the rows are whole: the rows decide.
    """
    return _Parser(path, read_text(path, MotionError, "BVH motion")).parse()


class _Parser:
    def __init__(self, path: str | os.PathLike[str], text: str) -> None:
        self.path = os.fspath(path)
        self.lines = text.splitlines()
        self.names: list[str] = []
        self.joint_lines: list[int] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...]] = []

    def error(self, message: str, line: int | None) -> MotionError:
        return MotionError(message, path=self.path, line=line)

    def parse(self) -> Motion:
        motion_line = self._hierarchy()
        values, frame_time = self._motion(motion_line)
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

    def _hierarchy(self) -> int | None:
        """Fill the joints; returns the number of the MOTION line, None where the file has none."""
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
                return self._checked(number)
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
            raise self.error("the file ends inside the hierarchy: it is truncated", len(self.lines))
        self._checked(number)
        return None

    def _checked(self, number: int) -> int:
        if not self.names:
            raise self.error("the hierarchy has no joints", number)
        seen: set[str] = set()
        for name, line in zip(self.names, self.joint_lines, strict=True):
            if name in seen:
                raise self.error(f"two joints are named {name!r}; names must differ", line)
            seen.add(name)
        return number

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
        try:
            values = [float(word) for word in rest.split()]
        except ValueError:
            raise self.error(f"OFFSET needs three numbers, not {rest.strip()[:40]!r}", number) from None
        if len(values) != 3 or not np.isfinite(values).all():
            raise self.error(f"OFFSET needs three finite numbers, not {rest.strip()[:40]!r}", number)
        return values

    def _channels(self, rest: str, number: int) -> tuple[str, ...]:
        words = rest.split()
        names = tuple(_CANONICAL.get(word.lower(), "") for word in words[1:])
        if not words or not words[0].isdigit() or "" in names or len(set(names)) != len(names):
            raise self.error(
                f"CHANNELS needs a count and names such as Zrotation, not {rest.strip()[:60]!r}", number
            )
        if int(words[0]) != len(names):
            raise self.error(f"CHANNELS says {words[0]} but names {len(names)}", number)
        return names

    def _motion(self, motion_line: int | None) -> tuple[Array, float]:
        n_channels = sum(len(names) for names in self.channels)
        if motion_line is None:
            warnings.warn(f"{self.path}: no MOTION section: a static pose", HumansimWarning, stacklevel=4)
            return np.zeros((1, n_channels)), 1 / 30
        header: dict[str, tuple[int, str]] = {}
        number = motion_line
        while number < len(self.lines) and len(header) < 2:
            number += 1
            key, colon, value = self.lines[number - 1].partition(":")
            if not key.strip():
                continue
            if not colon:
                raise self.error(f"'Frames:' and 'Frame Time:' expected, not {key.strip()[:40]!r}", number)
            header[" ".join(key.lower().split())] = (number, value.strip())
        n_frames = self._header_number(header, "frames", number)
        frame_time = self._header_number(header, "frame time", number)
        if frame_time <= 0:
            raise self.error(f"Frame Time must be above zero, not {frame_time:g}", header["frame time"][0])
        rows = self._rows(number + 1, n_channels)
        if len(rows) == 0:
            raise self.error("no frames after 'Frame Time:': the file is truncated", len(self.lines))
        if len(rows) != n_frames:
            warnings.warn(
                f"{self.path}: says {n_frames:g} frames but has {len(rows)}; the rows count",
                HumansimWarning,
                stacklevel=4,
            )
        return rows, frame_time

    def _header_number(self, header: dict[str, tuple[int, str]], key: str, line: int) -> float:
        if key not in header:
            raise self.error(
                f"'{key.title()}:' is missing after MOTION: the file is truncated or damaged", line
            )
        number, text = header[key]
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise self.error(f"'{key.title()}:' needs a number, not {text[:40]!r}", number)
        return value

    def _rows(self, first: int, n_channels: int) -> Array:
        """Frame rows from line ``first`` on (F, C)."""
        if n_channels == 0:
            return np.zeros((1, 0))
        rows: list[Array] = []
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for number, line in enumerate(self.lines[first - 1 :], first):
                if line.strip():
                    rows.append(self._row(line, number, n_channels))
        return np.array(rows).reshape(-1, n_channels)

    def _row(self, line: str, number: int, n_channels: int) -> Array:
        try:
            row = np.fromstring(line, sep=" ")
            # fromstring also parts "1.52.5": as many numbers as words, or each word is looked at
            plain = len(row) == len(line.split())
        except (DeprecationWarning, ValueError):
            plain = False
        if not plain:
            row = np.array([self._number(word, number) for word in _GLUED_MINUS.sub(" -", line).split()])
        if len(row) != n_channels:
            reason = "; the file is truncated" if number == len(self.lines) else ""
            raise self.error(f"a frame needs {n_channels} values, this has {len(row)}{reason}", number)
        if not np.isfinite(row).all():
            raise self.error("a value is not finite (NaN or infinity)", number)
        return row

    def _number(self, word: str, line: int) -> float:
        try:
            return float(word)
        except ValueError:
            raise self.error(f"{word[:40]!r} is not a number", line) from None


def write_bvh(path: str | os.PathLike[str], motion: Motion) -> None:
    """Write a motion as a BVH file that :func:`read_bvh` and other programs read back (values to 1e-6)."""
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
        indent = "\t" * depth
        if closing:
            lines.append(f"{indent}}}")
            continue
        order.append(joint)
        parent = motion.parents[joint]
        is_end = parent >= 0 and motion.joint_names[joint] == f"{motion.joint_names[parent]}_end"
        is_end = is_end and not children[joint] and not motion.channels[joint]
        title = "End Site" if is_end else f"{'ROOT' if parent < 0 else 'JOINT'} {motion.joint_names[joint]}"
        lines += [indent + title, indent + "{"]
        lines.append(indent + "\tOFFSET " + " ".join(f"{v:.6f}" for v in motion.offsets[joint]))
        if not is_end:
            names = motion.channels[joint]
            lines.append(indent + f"\tCHANNELS {len(names)} " + " ".join(names))
        stack.append((joint, depth, True))
        stack += [(child, depth + 1, False) for child in reversed(children[joint])]
    columns = np.concatenate([motion._columns[j] + np.arange(len(motion.channels[j])) for j in order]).astype(
        int
    )
    lines += ["MOTION", f"Frames: {motion.n_frames}", f"Frame Time: {motion.frame_time:.9f}"]
    lines += [" ".join(f"{v:.6f}" for v in row) for row in motion.values[:, columns]]
    with atomic_path(Path(path)) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
