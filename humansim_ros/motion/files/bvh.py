"""Read and write Biovision hierarchy (BVH) motion files.

Nothing is converted: positions stay in the units and axes of the file. Position channels replace the OFFSET,
as in Blender. Old programs add them to the OFFSET: files of such programs are detected.
"""

from __future__ import annotations

import io
import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Literal, TextIO

import numpy as np

from humansim_ros.errors import MotionError, some_of, warn_about
from humansim_ros.files.reading import atomic_path, open_file, reading_errors, text_encoding
from humansim_ros.motion.body.kinematics import AXES, CHANNEL_NAMES, Motion
from humansim_ros.motion.files.bvh_text import (
    BRACE,
    FRAME_TIMES,
    LARGEST,
    BvhText,
    comma_hint,
    read_motion_section,
    starts_motion,
)
from humansim_ros.types import Array

#: Channels of files by their name in lower case. Channels of scales are read, but not kept.
_CANONICAL = {name.lower(): name for name in (*CHANNEL_NAMES, "Xscale", "Yscale", "Zscale")}
#: Most characters of the name of a joint, since every end site repeats the name of its joint.
LONGEST_NAME = 1000
#: Most joints, end sites included. A person with face, fingers and hair has some hundreds.
_MAX_JOINTS = 20_000
#: Words that start an end site. After the first of them comes the word "Site".
_ENDS = ("END", "ENDSITE", "END_SITE")
#: Words that start a statement, and those after which a statement may go on in the next lines.
_KEYWORDS = ("HIERARCHY", "MOTION", "ROOT", "JOINT", *_ENDS, "OFFSET", "CHANNELS")
_GOING_ON = ("ROOT", "JOINT", "END", "OFFSET", "CHANNELS")


@dataclass
class _Joint:
    """A joint or an end site as stated in the hierarchy, and the number of its parent (-1 for a root)."""

    name: str
    is_end: bool
    parent: int
    line: int
    indent: int
    offset: list[float] = field(default_factory=list)
    channels: tuple[str, ...] | None = None

    def __str__(self) -> str:
        return "an End Site" if self.is_end else f"joint {self.name!r}"


class Parser:
    """Parser of one file. It reads the hierarchy by statements; :mod:`.bvh_text` reads the rows."""

    def __init__(self, path: str | os.PathLike[str], file: TextIO, encoding: str = "latin-1") -> None:
        self.text = BvhText(path, file, encoding)
        self.joints: list[_Joint] = []

    def parse(self) -> Motion:
        """Read the motion of the file. Position channels replace the OFFSET."""
        has_motion = self._hierarchy()
        self._make_names_unique()
        values, frame_time = self._motion(has_motion)
        channels = ((name for name in j.channels or () if not name.endswith("scale")) for j in self.joints)
        return Motion(
            joint_names=tuple(joint.name for joint in self.joints),
            parents=np.array([joint.parent for joint in self.joints], dtype=np.intp),
            offsets=np.array([joint.offset for joint in self.joints], dtype=float),
            channels=tuple(map(tuple, channels)),
            values=self._without_scales(values),
            frame_time=frame_time,
            path=self.text.path,
        )

    def _statements(self) -> Iterator[str]:
        """Statements of the hierarchy. They end at a brace, and before a line that begins with a keyword."""
        text, statement, place = self.text, "", (0, 0)
        while line := text.next_line():
            for part in filter(None, map(str.strip, BRACE.split(line))):
                keyword = part.split()[0].rstrip(":").upper()
                if 0 < len(statement) < LONGEST_NAME and part not in "{}" and keyword not in _KEYWORDS:
                    statement = f"{statement}\n{part}"
                    continue
                here = text.line, text.indent
                if statement:
                    text.line, text.indent = place
                    yield statement
                    text.line, text.indent = here
                statement, place = part, here
                if keyword not in _GOING_ON:
                    yield statement
                    statement = ""
        if statement:
            yield statement

    def _hierarchy(self) -> bool:
        """Read the joints. Returns True if a MOTION section follows."""
        text = self.text
        stack: list[int] = []  # numbers of open joints
        pending: int | None = None
        surplus: int | None = None  # line of the first '}' that comes after the end of the hierarchy
        for statement in self._from_first_joint():
            keyword, rest = [*statement.split(maxsplit=1), ""][:2]
            keyword = keyword.upper()
            is_outside = not stack and pending is None and bool(self.joints)
            if keyword == "HIERARCHY" and is_outside and not rest:
                continue
            if keyword == "MOTION" and starts_motion(rest.strip()):
                statement = keyword
                text.unread(rest)
            if statement.rstrip(": \t").upper() == "MOTION" or (is_outside and starts_motion(statement)):
                self._check_braces(stack, pending, surplus)
                if starts_motion(statement):
                    text.warn("the word MOTION is missing before this line")
                    text.unread(statement)
                return True
            joint = self.joints[stack[-1]] if stack else None
            if keyword in ("ROOT", "JOINT", *_ENDS):
                if pending is not None:
                    raise text.error(f"'{{' expected after {self.joints[pending]}")
                self._add_joint(keyword, rest.strip(), stack[-1] if stack else -1)
                pending = len(self.joints) - 1
            elif statement == "{":
                if pending is None:
                    raise text.error("'{' without a joint before it")
                stack.append(pending)
                pending = None
            elif statement == "}" and joint is None:
                if not is_outside:
                    raise text.error("'}' without a matching '{'")
                surplus = surplus or text.line
            elif joint is None:
                raise text.error(f"cannot understand {statement[:40]!r} in the hierarchy")
            elif statement == "}":
                stack.pop()
                if not joint.offset:
                    raise text.error(f"{joint} has no OFFSET")
            elif keyword == "OFFSET":
                if joint.offset:
                    raise text.error(f"{joint} has a second OFFSET")
                joint.offset = self._offset(rest)
            elif keyword == "CHANNELS":
                if joint.channels is not None:
                    raise text.error(f"{joint} has a second CHANNELS")
                joint.channels = self._channels(rest)
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
        """Check the braces after the hierarchy was read. A wrong brace at its end only gives a warning. A
        wrong brace further up is an error: it changes the hierarchy, which then contradicts the indents."""
        text = self.text
        is_open = pending is not None or not all(self.joints[joint].offset for joint in stack)
        if is_open or (stack and not self._indents_agree()):
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
            (joint.parent < 0 or joint.indent > self.joints[joint.parent].indent)
            and of_children.setdefault(joint.parent, joint.indent) == joint.indent
            for joint in self.joints
        )

    def _add_joint(self, keyword: str, name: str, parent: int) -> None:
        text = self.text
        is_end = keyword in _ENDS
        if is_end:
            if keyword != "END" or not name.upper().startswith("SITE"):
                text.note("end", f"{f'End {name}'.strip()[:40]!r} is read as 'End Site'")
            name = name or "Site"
        if not name:
            raise text.error(f"{keyword} without a name")
        if "\n" in name:
            raise text.error(f"cannot understand {name.splitlines()[1][:40]!r} after this line")
        if len(name) > LONGEST_NAME:
            raise text.error(f"a name of more than {LONGEST_NAME} characters: {name[:40]!r}")
        if (keyword == "ROOT") != (parent < 0):
            raise text.error(f"{keyword} {name!r} does not belong here")
        if parent >= 0 and self.joints[parent].is_end:
            raise text.error(f"{keyword} {name!r} inside an End Site")
        if len(self.joints) == _MAX_JOINTS:
            raise text.error(f"more than {_MAX_JOINTS} joints and end sites: this is no skeleton of a person")
        self.joints.append(_Joint(name, is_end, parent, text.line, text.indent))

    def _make_names_unique(self) -> None:
        """Number joints of the same name as Blender does, and name end sites after their joints."""
        if not self.joints:
            raise self.text.error("the hierarchy has no joints")
        given = {joint.name for joint in self.joints if not joint.is_end}
        taken: set[str] = set()
        copies: Counter[str] = Counter()
        numbered = []
        for joint in self.joints:
            name = f"{self.joints[joint.parent].name}_end" if joint.is_end else joint.name
            unique = name
            while unique in taken or (unique in given and (joint.is_end or unique != name)):
                copies[name] += 1
                unique = f"{name}.{copies[name]:03d}"
            joint.name = unique
            taken.add(unique)
            if unique != name and (not joint.is_end or name in given):
                numbered.append((joint.line, name, unique))
        if numbered:
            (line, name, unique), others = numbered[0], len(numbered) - 1
            more = f"; so are {others} more" if others else ""
            self.text.warn(f"a second joint is named {name!r}: it is called {unique!r}{more}", line)

    def _offset(self, rest: str) -> list[float]:
        try:
            values = self.text.numbers(rest)
        except ValueError:
            values = []
        # SOMA writes the rotation at rest after the OFFSET. The rows replace this rotation
        if len(values) == 6:
            message = "six numbers after OFFSET: the last three, a rotation at rest, are not used"
            self.text.note("offset", message)
            values = values[:3]
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
            shown = rest.strip()[:60]
            raise self.text.error(f"CHANNELS needs a count and names such as Zrotation, not {shown!r}")
        # compared as text: Python does not convert numbers of thousands of digits
        if (count.lstrip("0") or "0") != str(len(names)):
            self.text.warn(f"CHANNELS says {count[:20]} but names {len(names)}; the names count")
        return names

    def _motion(self, has_motion: bool) -> tuple[Array, float]:
        if not has_motion:
            self.text.warn_file("no MOTION section: a static pose")
            return self._rest_row(), 1 / 30
        angles = [name.endswith("rotation") for name in self._channel_names]
        rows, frame_time = read_motion_section(self.text, np.array(angles, dtype=bool))
        if len(rows) == 0:
            self.text.warn_file("no frames: a static pose")
            rows = self._rest_row()
        return rows, frame_time

    @property
    def _channel_names(self) -> list[str]:
        return [name for joint in self.joints for name in joint.channels or ()]

    def _without_scales(self, values: Array) -> Array:
        """Values of all channels except scales. Warns if there are scales."""
        scales = np.array([name.endswith("scale") for name in self._channel_names])
        if not scales.any():
            return values
        low, high = values[:, scales].min(), values[:, scales].max()
        self.text.warn_file(f"the scale channels, which are from {low:g} to {high:g}, are not used")
        return values[:, ~scales]

    def _rest_row(self) -> Array:
        """Channel values (1, C) of the rest pose."""
        channels = [(joint, name) for joint in self.joints for name in joint.channels or ()]
        values = [j.offset[AXES[name[0]]] if name.endswith("position") else 0.0 for j, name in channels]
        return np.array(values).reshape(1, -1)


#: Whether position channels replace the OFFSET or are added to it; ``auto`` detects it.
PositionChannels = Literal["auto", "replace", "add"]

#: Largest file, bytes: an hour of 60 joints at 120 frames/s. First bytes, which show the encoding.
_MAX_BYTES, _HEAD = 1 << 30, 1 << 16
#: Position channels count as added to the OFFSET if their values contain less than this share of the OFFSET.
_ADDED_SHARE = 0.1
#: Positions that vary by less than this share of the skeleton's size count as constant.
_CONSTANT_SHARE = 0.005
#: An OFFSET is evidence if its length is at least this number of standard deviations of the positions.
_MIN_SIGNIFICANCE = 3.0
#: The length of a link changes if the change is more than the first share of the size of the skeleton, and
#: more than the second share of the length. If a length changes by more than the third value (a factor), its
#: joints are not linked by a bone.
_CHANGES, _CHANGED_SHARE, _MOST_CHANGED = 0.004, 0.02, 1.5
#: Deeper joints get no further indent, since a chain of thousands of joints would be mostly tabs.
_MAX_INDENT = 40


def read_bvh(path: str | os.PathLike[str], positions: PositionChannels = "auto") -> Motion:
    """Read a BVH motion file. Its text may be in UTF-8, UTF-16, Latin-1 or an encoding of East Asia, with any
    line ends.

    ``positions``: ``replace`` if position channels replace the OFFSET, as in nearly all programs. ``add`` if
    they are added to the OFFSET. ``auto`` detects which: added positions stay near 0 although the OFFSETs are
    large.

    A fault with a clear meaning gives a HumansimWarning. docs/motion.md lists all of these faults. For
    example, the rows decide if the ``Frames:`` count is wrong or missing, and the rate is 30 frames per
    second if ``Frame Time:`` is missing. Up to 1 % of the rows may be bad. Reading needs about twice the
    memory of the values, whatever the header says.

    Raises:
        MotionError: The file is not valid. The error names file and line.

    Example:
        >>> from humansim_ros import read_bvh
        >>> from humansim_ros.files.reading.assets import resource_path
        >>> motion = read_bvh(resource_path("assets/motions/walk.bvh"))
        >>> motion.joint_names[:3], motion.n_frames, round(motion.duration, 3)
        (('Hips', 'Chest', 'Neck'), 121, 2.0)
    """
    if positions not in ("auto", "replace", "add"):
        raise MotionError(f"positions are 'auto', 'replace' or 'add', not {positions!r}", path=path)
    what = "BVH motion"
    with open_file(path, MotionError, what, _MAX_BYTES) as stream, reading_errors(path, MotionError, what):
        encoding = text_encoding(stream.read(_HEAD))
        stream.seek(0)
        # Latin-1 decodes any byte. The parser later decodes the lines of the hierarchy again
        decoded = encoding if encoding.startswith("utf-16") else "latin-1"
        file = io.TextIOWrapper(stream, decoded, errors="replace")
        motion = Parser(path, file, encoding).parse()
    if positions != "auto":
        motion = replace(motion, positions=positions)
    elif found := _added_positions(motion):
        warn_about(motion.path, f"{found}: added to them (positions='replace' takes them as they are)")
        motion = replace(motion, positions="add")
    _warn_of_lengths(motion)
    return motion


def _warn_of_lengths(motion: Motion) -> None:
    """Warn about links between joints that change their length, since the links of a person do not."""
    names, parents, count = motion.joint_names, motion.parents, np.bincount(motion.parents + 1)
    inner = {parent for name, parent in zip(names, parents, strict=True) if not name.endswith("_end")}
    joints = [
        joint
        for joint in sorted({joint for joint, *_ in motion.position_columns})
        # joints directly below a root are left out if they are trackers or the only joint: they may move as a
        # whole
        if (up := parents[joint]) >= 0 and (parents[up] >= 0 or (joint in inner and count[up + 1] > 1))
    ]
    frames = slice(None, None, max(1, motion.n_frames // 1000))
    lengths = np.linalg.norm(motion.local_translations(frames)[:, joints], axis=-1)
    least = _CHANGES * float(np.ptp(motion.rest_positions(), axis=0).max())
    texts = [
        f"{names[parents[joint]]} to {names[joint]} from {low:.2f} to {high:.2f} "
        f"(OFFSET {np.linalg.norm(motion.offsets[joint]):.2f})"
        for joint, low, high in zip(joints, lengths.min(axis=0), lengths.max(axis=0), strict=True)
        if max(least, _CHANGED_SHARE * high) < high - low < (_MOST_CHANGED - 1) * low
    ]
    if texts:
        warn_about(motion.path, f"links change their length by their position channels: {some_of(texts, 3)}")


def _added_positions(motion: Motion) -> str:
    """Describe joints with positions that seem to be added to OFFSETs. Empty if most joints contradict this.

    Added positions contain nearly nothing of their OFFSETs. A least-squares fit gives the share of the
    OFFSET. An axis has more weight if the joint moves less along it. For a walking person, for example, the
    height decides more than the place on the floor.
    """
    by_joint: dict[int, dict[int, int]] = {}
    for joint, axis, column in motion.position_columns:
        by_joint.setdefault(joint, {})[axis] = column
    joints = np.array([joint for joint, columns in by_joint.items() if len(columns) == 3], dtype=int)
    if not motion.offsets[joints].any():
        return ""
    columns = [[by_joint[joint][axis] for axis in range(3)] for joint in joints.tolist()]
    values = motion.values[:: max(1, motion.n_frames // 1000)][:, columns]
    offsets = motion.offsets[joints]
    noise = _CONSTANT_SHARE * float(np.ptp(motion.rest_positions(), axis=0).max())
    with np.errstate(invalid="ignore", divide="ignore"):  # a skeleton of one point divides by zero
        weights = offsets / (values.var(axis=0) + noise * noise)
        significance = (weights * offsets).sum(axis=-1)
        share = (np.median(values, axis=0) * weights).sum(axis=-1) / significance
        deciding = significance > _MIN_SIGNIFICANCE**2
        added = deciding & (np.abs(share) < _ADDED_SHARE)
    if 2 * added.sum() <= deciding.sum():
        return ""
    names = some_of((motion.joint_names[joint] for joint in joints[added]), 4)
    return f"the positions of {names} stay near 0 beside large OFFSETs"


def write_bvh(path: str | os.PathLike[str], motion: Motion) -> None:
    """Write a motion as a BVH file (UTF-8). :func:`read_bvh` and other programs read it back exactly.

    Numbers keep all their digits. Positions always replace the OFFSETs in the new file, even if they were
    added in the source, since all programs read such files. Gives a HumansimWarning if ``read_bvh`` would
    wrongly detect added positions.

    Raises:
        MotionError: A BVH file cannot hold a name or a number of the motion.
        HumansimError: The file cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from humansim_ros import read_bvh, write_bvh
        >>> from humansim_ros.files.reading.assets import resource_path
        >>> motion = read_bvh(resource_path("assets/motions/wave.bvh"))
        >>> with TemporaryDirectory() as folder:
        ...     write_bvh(f"{folder}/copy.bvh", motion)
        ...     print(read_bvh(f"{folder}/copy.bvh").n_frames == motion.n_frames)
        True
    """
    if motion.positions == "add":
        values = motion.values.copy()
        for joint, axis, column in motion.position_columns:
            values[:, column] += motion.offsets[joint, axis]
        motion = replace(motion, values=values, positions="replace")
    _check_writable(path, motion)
    if found := _added_positions(motion):
        warn_about(path, f"{found}: read it with positions='replace'")
    with atomic_path(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(line + "\n" for line in _lines(motion))


def _check_writable(path: str | os.PathLike[str], motion: Motion) -> None:
    for name, count in Counter(motion.joint_names).items():
        is_trimmed = name == name.strip() and 0 < len(name) <= LONGEST_NAME
        if not is_trimmed or re.search("[{}\r\n\0\ud800-\udfff]", name):
            raise MotionError(f"a BVH file cannot have a joint named {name!r}", path=path)
        if count > 1:
            raise MotionError(f"two joints are named {name!r}", path=path)
    if not all((np.abs(numbers) <= LARGEST).all() for numbers in (motion.offsets, motion.values)):
        raise MotionError(f"the motion has values that are not finite, or beyond {LARGEST:g}", path=path)
    if not FRAME_TIMES[0] <= motion.frame_time <= FRAME_TIMES[1]:
        raise MotionError(f"the frame time must be above zero, not {motion.frame_time:g}", path=path)


def _lines(motion: Motion) -> Iterator[str]:
    """Lines of a BVH file."""
    yield "HIERARCHY"
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(motion.parents.tolist()):
        children.setdefault(parent, []).append(joint)
    stack = [(joint, 0, False) for joint in reversed(children[-1])]
    columns: list[int] = []
    while stack:
        joint, depth, closing = stack.pop()
        indent = "\t" * min(depth, _MAX_INDENT)
        if closing:
            yield f"{indent}}}"
            continue
        parent = motion.parents[joint]
        is_end = parent >= 0 and motion.joint_names[joint] == f"{motion.joint_names[parent]}_end"
        is_end = is_end and joint not in children and not motion.channels[joint]
        kind = "ROOT" if parent < 0 else "JOINT"
        yield indent + ("End Site" if is_end else f"{kind} {motion.joint_names[joint]}")
        yield indent + "{"
        yield indent + "\tOFFSET " + " ".join(map(_number, motion.offsets[joint].tolist()))
        if not is_end:
            names = motion.channels[joint]
            yield indent + " ".join(("\tCHANNELS", str(len(names)), *names))
            columns += motion.columns(joint)
        stack.append((joint, depth, True))
        stack += [(child, depth + 1, False) for child in reversed(children.get(joint, []))]
    yield from ("MOTION", f"Frames: {motion.n_frames}", f"Frame Time: {_number(motion.frame_time)}")
    for row in motion.values:
        yield " ".join(map(_number, row[columns].tolist()))


def _number(value: float) -> str:
    """Write a number as the shortest text without an exponent that reads back as the same number."""
    text = repr(float(value))
    return np.format_float_positional(value, trim="0") if "e" in text else text
