"""Acclaim motions: a skeleton file (.asf) and a motion file (.amc) [Lander 1998].

The world rotation of a bone is the rotation of its parent times ``C M C^-1``. C is the rotation of the bone's
``axis``. M holds the rotations of its degrees of freedom, in their order about fixed axes (``rx ry rz``: M =
Rz Ry Rx).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MotionError, printable, some_of, warn_about
from humansim_ros.files.reading import read_text, resolve_inside
from humansim_ros.motion.body.kinematics import Motion, motion_of_rotations, refuse_cycle
from humansim_ros.types import Array

#: Largest size of each file in bytes, and most bones.
_MAX_SKELETON, _MAX_MOTION, _MAX_BONES = 4 << 20, 1 << 29, 1000
#: Frames per second of a file that does not state its rate. Files of the CMU database do not.
_RATE = 120.0
#: Value of ``length`` in files of CMU. Their lengths are in inches times this number.
_CMU_LENGTH, _INCH = 0.45, 0.0254
#: Largest absolute value of a number in a file.
_LARGEST = 1e9
_ROOT = "root"
_AXES = ("x", "y", "z")
_WORDS = tuple(f"{kind}{axis}" for kind in "tr" for axis in _AXES)
#: Degrees of each unit of angles.
_ANGLES = dict.fromkeys(("deg", "degree", "degrees"), 1.0)
_ANGLES |= dict.fromkeys(("rad", "radian", "radians"), 180 / np.pi)
_ANGLES["radians"] = _ANGLES["rad"]


@dataclass
class _Bone:
    """A bone of the skeleton file, with angles in degrees."""

    line: int
    name: str = ""
    direction: Array = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    axis: Array = field(default_factory=lambda: np.zeros(3))
    axis_order: str = "xyz"
    dof: tuple[str, ...] = ()


def read_acclaim(path: str | os.PathLike[str], skeleton: str | None = None) -> Motion:
    """Read an .amc file with its .asf file.

    ``skeleton``: name of the .asf file in the folder of the .amc file or below. If None, these are tried: the
    .asf file with the same name; an .asf file with the beginning of the name (``07.asf`` for ``07_01.amc``);
    the only .asf file of the folder.

    Each joint is at the start of a bone and has the name of the bone. Lengths stay in the unit of the file.
    The unit is known only for files of CMU: there ``length`` is 0.45, and the unit is 1/0.45 inch. Files
    without a rate have 120 frames/s.

    Raises:
        MotionError: A file is missing or not valid, or the two files do not belong together. The error names
            file and line.
    """
    file = Path(path)
    if file.suffix.lower() == ".asf":
        raise MotionError("this is a skeleton without a motion: give the .amc file", path=path)
    return _Amc(file, _Skeleton(_find_skeleton(file, skeleton))).motion()


def _find_skeleton(path: Path, name: str | None) -> Path:
    if name is None:
        # if a file is missing, its error comes before other errors
        read_text(path, MotionError, "AMC motion", _MAX_MOTION)
        try:
            names = [entry.name for entry in os.scandir(path.parent)]
        except OSError as reason:
            raise MotionError(f"cannot look for its .asf file: {reason.strerror}", path=path) from None
        found = sorted(file for file in names if file.lower().endswith(".asf"))
        stem = path.stem.lower().lstrip(".")  # the web page reads an uploaded file under a hidden name first
        begins = [file for file in found if stem.startswith(tuple(file[:-4].lower() + mark for mark in "_-"))]
        fitting = [file for file in found if stem == file[:-4].lower()] or begins
        if not fitting and len(found) == 1:
            warn_about(path, f"its skeleton is taken from {found[0]}, the only .asf file of the folder")
            fitting = found
        if not fitting:
            there = f"; there are {some_of(found)}" if found else ""
            message = f"its skeleton is missing: put {path.stem}.asf beside it, or name the file: "
            raise MotionError(f"{message}{path.name}#NAME.asf{there}", path=path)
        name = fitting[0]
    target = resolve_inside(path.parent, name)
    if target is None:
        raise MotionError(f"the skeleton {name!r} is not in the folder of the motion", path=path)
    return target


class _Text:
    """Words of the lines of a file, without comments. Errors name the file."""

    def __init__(self, path: Path, what: str, most: int) -> None:
        self.path = path
        lines = enumerate(read_text(path, MotionError, what, most).splitlines(), 1)
        self.rows = ((line, words) for line, text in lines if (words := text.partition("#")[0].split()))

    def error(self, message: str, line: int | None = None) -> MotionError:
        return MotionError(message, path=self.path, line=line)

    def numbers(self, words: list[str], count: int, what: str, line: int) -> Array:
        """Read ``count`` finite numbers."""
        values = _finite(words)
        if len(values) != count:
            shown = printable(" ".join(words), 60)
            raise self.error(f"{what} needs {count} finite numbers, not {shown!r}", line)
        return np.array(values)


def _finite(words: list[str]) -> list[float]:
    """Numbers of some words. Empty if a word is not a finite number."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        return []
    return values if all(abs(value) <= _LARGEST for value in values) else []


class _Skeleton(_Text):
    """Content of an .asf file.

    Attributes:
        bones: Bones by name; the root is a bone without length.
        parents: Parent of each bone except the root. Parents come before their children.
        position: Position of the root, (3,).
        length, degrees: Factor of lengths, and degrees per unit of angles.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "ASF skeleton", _MAX_SKELETON)
        sections: dict[str, list[tuple[int, list[str]]]] = {}
        current = sections.setdefault("", [])
        for line, words in self.rows:
            if words[0].startswith(":"):
                current = sections.setdefault(words.pop(0)[1:].lower(), [])
            if words:
                current.append((line, words))
        for name in ("root", "bonedata", "hierarchy"):
            if name not in sections:
                raise self.error(f"not an ASF skeleton: it has no section :{name}")
        self.length, self.degrees = self._units(sections.get("units", []))
        root, self.position = self._root(sections["root"])
        self.bones = {_ROOT: root}
        self._bones(sections["bonedata"])
        self.parents = self._hierarchy(sections["hierarchy"])
        if lost := [name for name in self.bones if name != _ROOT and name not in self.parents]:
            warn_about(path, f"the hierarchy does not contain {some_of(lost)}: left out")

    def _units(self, rows: list[tuple[int, list[str]]]) -> tuple[float, float]:
        length, degrees = 1.0, 1.0
        for line, (word, *rest) in rows:
            if word.lower() == "length":
                length = float(self.numbers(rest, 1, "length", line)[0])
                if not length > 0:
                    raise self.error(f"the scale of lengths must be above 0, not {length:g}", line)
            elif word.lower() == "angle":
                unit = " ".join(rest).lower()
                if unit not in _ANGLES:
                    raise self.error(f"unknown unit of angles '{printable(unit, 40)}': deg or rad", line)
                degrees = _ANGLES[unit]
        return length, degrees

    def _root(self, rows: list[tuple[int, list[str]]]) -> tuple[_Bone, Array]:
        root, position = _Bone(rows[0][0] if rows else 0, _ROOT, dof=_WORDS), np.zeros(3)
        for line, (word, *rest) in rows:
            key = word.lower()
            if key == "order":
                root.dof = self._dof(rest, line)
            elif key == "axis":
                root.axis_order = self._order(" ".join(rest), line)
            elif key == "position":
                position = self.numbers(rest, 3, "position", line)
            elif key == "orientation":
                root.axis = self.degrees * self.numbers(rest, 3, "orientation", line)
        return root, position

    def _dof(self, words: list[str], line: int) -> tuple[str, ...]:
        names = tuple(word.lower() for word in words)
        unknown = [word for word in names if word not in (*_WORDS, "l")]
        if unknown or len(set(names)) < len(names):
            shown = printable(" ".join(words), 60)
            raise self.error(f"degrees of freedom are {', '.join(_WORDS)}, each once; not '{shown}'", line)
        return names

    def _order(self, text: str, line: int) -> str:
        order = text.lower()
        if sorted(order) != list(_AXES):
            raise self.error(f"an order of axes is XYZ or another order of them, not {text[:20]!r}", line)
        return order

    def _bones(self, rows: list[tuple[int, list[str]]]) -> None:
        bone: _Bone | None = None
        for line, (word, *rest) in rows:
            key = word.lower()
            if key == "begin":
                bone = _Bone(line)
            elif bone is None:
                raise self.error(f"'{printable(word, 40)}' outside 'begin' and 'end'", line)
            elif key == "end":
                if not bone.name or bone.name in self.bones:
                    raise self.error(f"a bone needs a name of its own, not {bone.name!r}", bone.line)
                if len(self.bones) > _MAX_BONES:
                    raise self.error(f"more than {_MAX_BONES} bones", line)
                self.bones[bone.name] = bone
                bone = None
            elif key == "name":
                bone.name = printable(" ".join(rest), 100)
            elif key == "direction":
                bone.direction = self.numbers(rest, 3, "direction", line)
            elif key == "length":
                bone.length = float(self.numbers(rest, 1, "length", line)[0])
            elif key == "axis":
                bone.axis = self.degrees * self.numbers(rest[:3], 3, "axis", line)
                bone.axis_order = self._order(rest[3], line) if len(rest) > 3 else "xyz"
            elif key == "dof":
                bone.dof = self._dof(rest, line)
        if bone is not None:
            raise self.error("a bone without 'end': the file is cut off", bone.line)

    def _hierarchy(self, rows: list[tuple[int, list[str]]]) -> dict[str, str]:
        """Find the parent of each bone. Parents come before their children."""
        children: dict[str, list[str]] = {}
        above_of: dict[str, str] = {}
        for line, (parent, *names) in rows:
            if parent.lower() in ("begin", "end") and not names:
                continue
            for name in (parent, *names):
                if name not in self.bones:
                    raise self.error(f"the hierarchy has no bone '{printable(name, 40)}'", line)
            for name in names:
                if name in above_of or name == _ROOT:
                    raise self.error(f"bone {name!r} has two parents", line)
                above_of[name] = parent
            children.setdefault(parent, []).extend(names)
        number = {name: place for place, name in enumerate(self.bones)}
        above_numbers = np.array([number.get(above_of.get(name, ""), -1) for name in self.bones])
        refuse_cycle(list(self.bones), above_numbers, self.path)
        parents: dict[str, str] = {}
        pending = [_ROOT]
        while pending:
            above, below = pending[-1], children.get(pending.pop(), [])
            parents |= dict.fromkeys(below, above)
            pending += reversed(below)
        if not parents:
            raise self.error("the hierarchy has no bone below the root")
        return parents


class _Amc(_Text):
    """Content of an .amc file for a skeleton: values (F, D) of the bones that move, by name."""

    def __init__(self, path: Path, skeleton: _Skeleton) -> None:
        super().__init__(path, "AMC motion", _MAX_MOTION)
        self.skeleton, self.degrees = skeleton, skeleton.degrees
        self.rate: float | None = None
        moving = [name for name in (_ROOT, *skeleton.parents) if skeleton.bones[name].dof]
        self.values: dict[str, list[list[float]]] = {name: [] for name in moving}
        frames, start = 0, 0
        seen: set[str] = set()
        for line, words in self.rows:
            if words[0].startswith(":"):
                self._keyword(words, line)
            elif len(words) == 1 and words[0].isdigit():
                if frames:
                    self._close(seen, start)
                frames, start, seen = frames + 1, line, set()
            elif not frames:
                raise self.error("not an AMC motion: a line before the number of the first frame", line)
            else:
                self._row(words, seen, line)
        if not frames:
            raise self.error("not an AMC motion: it has no frames")
        if len(seen) < len(self.values) and frames > 1:
            warn_about(path, f"the file ends within frame {frames}: this frame is left out")
            self.values = {name: rows[: frames - 1] for name, rows in self.values.items()}
        else:
            self._close(seen, start)

    def _keyword(self, words: list[str], line: int) -> None:
        key = words[0][1:].lower()
        if key in _ANGLES:
            self.degrees = _ANGLES[key]
        elif key == "samples-per-second" and len(words) > 1:
            self.rate = float(self.numbers(words[1:2], 1, words[0], line)[0])
            if not 1e-3 <= self.rate <= 1e6:
                raise self.error(f"{self.rate:g} frames per second are not possible", line)

    def _row(self, words: list[str], seen: set[str], line: int) -> None:
        name, of = words[0], self.skeleton.path.name
        if name not in self.values:
            why = "has no degrees of freedom" if name in self.skeleton.bones else "does not exist"
            what = f"bone '{printable(name, 40)}' {why} in {of}"
            raise self.error(f"{what}: this skeleton does not belong to the motion", line)
        if name in seen:
            raise self.error(f"bone {name!r} is given twice in one frame", line)
        seen.add(name)
        dof, values = self.skeleton.bones[name].dof, _finite(words[1:])
        if len(values) != len(dof):
            needed = f"the {len(dof)} values {' '.join(dof)} in {of}"
            shown = printable(" ".join(words[1:]), 60)
            raise self.error(f"bone {name!r} has {needed}, not '{shown}'", line)
        self.values[name].append(values)

    def _close(self, seen: set[str], start: int) -> None:
        if lost := [name for name in self.values if name not in seen]:
            needed = f"{some_of(lost)}, which {self.skeleton.path.name} needs"
            raise self.error(f"this frame has no values of {needed}", start)

    def motion(self) -> Motion:
        """Make the motion: joints where bones start, and end sites where the last bones end."""
        skeleton, bones = self.skeleton, self.skeleton.bones
        names = [_ROOT, *skeleton.parents]
        number = {name: index for index, name in enumerate(names)}
        parents = [-1] + [number[skeleton.parents[name]] for name in names[1:]]
        along = {name: bones[name].direction * bones[name].length for name in names}
        offsets = [skeleton.position] + [along[skeleton.parents[name]] for name in names[1:]]
        frames = len(next(iter(self.values.values())))
        rotations = np.broadcast_to(np.eye(3), (frames, len(names), 3, 3)).copy()
        positions: dict[int, Array] = {}
        for name, rows in self.values.items():
            joint, bone, table = number[name], bones[name], np.array(rows)
            axis = Rotation.from_euler(bone.axis_order, bone.axis, degrees=True)
            columns = {word[1]: column for column, word in enumerate(bone.dof) if word[0] == "r"}
            order = bone.axis_order if name == _ROOT else columns
            turn = Rotation.identity(frames)
            for letter in (letter for letter in order if letter in columns):
                angles = self.degrees * table[:, [columns[letter]]]
                turn = Rotation.from_euler(letter, angles, degrees=True) * turn
            rotations[:, joint] = (turn * axis if name == _ROOT else axis * turn * axis.inv()).as_matrix()
            shift = np.zeros((frames, 3))
            for column, word in enumerate(bone.dof):
                if word[0] == "t":
                    shift[:, _AXES.index(word[1])] = table[:, column]
            if name == _ROOT:
                positions[joint] = offsets[joint] + shift
            elif shift.any():
                positions[joint] = offsets[joint] + axis.apply(shift)
        if any("l" in bones[name].dof for name in self.values):
            warn_about(self.path, "bones change their length (dof l): this is ignored")
        ends = [name for name in names if name not in set(skeleton.parents.values())]
        parents += [number[name] for name in ends]
        names += [f"{name}_end" for name in ends]
        offsets += [along[name] for name in ends]
        if self.rate is None:
            text = f"the file states no rate: {_RATE:g} frames per second (else set the speed)"
            warn_about(self.path, text)
        return motion_of_rotations(
            names,
            np.array(parents, dtype=np.intp),
            np.array(offsets),
            rotations,
            positions,
            1 / (self.rate or _RATE),
            path=str(self.path),
            # lengths of CMU are in inches times 0.45. For other scales, the unit is detected
            unit=_INCH / _CMU_LENGTH if skeleton.length == _CMU_LENGTH else None,
        )
