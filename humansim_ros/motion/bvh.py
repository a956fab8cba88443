"""Biovision hierarchy (BVH) files: read as they are found, written so that every program reads them.

Nothing is converted: positions stay in the file's own units and axes. Position channels replace the OFFSET
(as in Blender), but for files of old programs that want them added and are found by that.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.io.files import atomic_path, reading_errors
from humansim_ros.motion.bvh_parser import FRAME_TIMES, LARGEST, LONGEST_NAME, Parser, warn
from humansim_ros.motion.kinematics import CHANNEL_NAMES, Motion

__all__ = ["CHANNEL_NAMES", "Motion", "Positions", "read_bvh", "write_bvh"]

#: How position channels and OFFSET go together; "auto" finds it out.
Positions = Literal["auto", "replace", "add"]

#: Positions are added to OFFSETs if there is less than this part of an OFFSET in them.
_NEAR_ZERO = 0.1
#: Positions that vary less than this part of the skeleton's size are as good as constant.
_STILL = 0.005
#: OFFSETs of fewer standard deviations of the positions do not tell what these mean.
_CLEAR = 3.0
#: Deeper joints are not indented more: a chain of thousands would be mostly tabs.
_DEEPEST_INDENT = 40


def read_bvh(path: str | os.PathLike[str], positions: Positions = "auto") -> Motion:
    """Read a BVH file: text in UTF-8 or Latin-1 with any line ends.

    ``positions``: whether position channels replace the OFFSET, as nearly all programs mean them, or are
    added to it; "auto" finds the files of those that add: their positions stay near 0 beside large OFFSETs.

    Raises MotionError, with file and line, on anything that cannot be understood. Warns (HumansimWarning)
    where something is odd but its meaning clear: a wrong ``Frames:`` count (the rows decide), a wrong
    ``CHANNELS`` count (the names decide), frames broken over lines (if ``Frames:`` fits), no MOTION or no
    frames (a static pose), joints of one name (they are numbered), names that are not UTF-8, added positions.

    Needs about twice the memory of the values, whatever the file's length or header says.
    """
    if positions not in ("auto", "replace", "add"):
        raise MotionError(f"positions are 'auto', 'replace' or 'add', not {positions!r}", path=path)
    # Latin-1 takes every byte; the hierarchy is decoded again
    with reading_errors(path, MotionError, "BVH motion"), Path(path).open(encoding="latin-1") as file:
        motion = Parser(path, file).parse()
    if positions != "auto":
        return replace(motion, positions=positions)
    added = _joints_with_added_positions(motion)
    if not added:
        return motion
    warn(
        f"{motion.path}: the positions of {_some(motion.joint_names[joint] for joint in added)} stay near 0 "
        "beside large OFFSETs: added to them (positions='replace' takes them as they are)"
    )
    return replace(motion, positions="add")


def _some(names: Iterable[str]) -> str:
    first, *others = [str(name) for name in names]
    return ", ".join([first, *others[:3]]) + (f" and {len(others) - 3} more" if len(others) > 3 else "")


def _joints_with_added_positions(motion: Motion) -> list[int]:
    """Joints whose positions have next to nothing of their OFFSETs in them, if they are most of those that
    tell.

    The share of the OFFSET is a least-squares fit in which each axis weighs the more, the less the joint
    moves along it: the height of a person who walks about says more than the place on the floor.
    """
    by_joint: dict[int, dict[int, int]] = {}
    for joint, axis, column in motion.position_columns:
        by_joint.setdefault(joint, {})[axis] = column
    joints = np.array([joint for joint, columns in by_joint.items() if len(columns) == 3], dtype=int)
    if not motion.offsets[joints].any():
        return []
    columns = [[by_joint[joint][axis] for axis in range(3)] for joint in joints.tolist()]
    values = motion.values[:: max(1, motion.n_frames // 1000)][:, columns]
    offsets = motion.offsets[joints]
    still = _STILL * float(np.ptp(motion.rest_positions(), axis=0).max())
    with np.errstate(invalid="ignore", divide="ignore"):  # a skeleton of one point tells nothing
        weights = offsets / (values.var(axis=0) + still * still)
        clear = (weights * offsets).sum(axis=-1)
        share = (np.median(values, axis=0) * weights).sum(axis=-1) / clear
        telling = clear > _CLEAR**2
        added = telling & (np.abs(share) < _NEAR_ZERO)
    return joints[added].tolist() if 2 * added.sum() > telling.sum() else []


def write_bvh(path: str | os.PathLike[str], motion: Motion) -> None:
    """Write a motion as a BVH file (UTF-8) that :func:`read_bvh` and other programs read back the same.

    Numbers are written with all the digits they have. Positions that are added to OFFSETs are written as
    positions that replace them, as all programs read them. Warns (HumansimWarning) where the positions would
    be taken for added ones unless ``read_bvh`` is told otherwise.

    Raises MotionError if a name or number cannot be written so that it is read back.
    """
    if motion.positions == "add":
        motion = _with_replacing_positions(motion)
    _check_writable(path, motion)
    if added := _joints_with_added_positions(motion):
        warn(
            f"{os.fspath(path)}: the positions of {_some(motion.joint_names[j] for j in added)} stay near 0 "
            "beside large OFFSETs: read it with positions='replace'"
        )
    with atomic_path(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(line + "\n" for line in _written(motion))


def _check_writable(path: str | os.PathLike[str], motion: Motion) -> None:
    seen: set[str] = set()
    for name in motion.joint_names:
        if (
            name != name.strip()
            or not 0 < len(name) <= LONGEST_NAME
            or re.search("[{}\r\n\0\ud800-\udfff]", name)
        ):
            raise MotionError(f"a BVH file cannot have a joint named {name!r}", path=path)
        if name in seen:
            raise MotionError(f"two joints are named {name!r}", path=path)
        seen.add(name)
    for numbers in (motion.offsets, motion.values):
        if not (np.abs(numbers) <= LARGEST).all():
            raise MotionError(f"the motion has values that are not finite, or beyond {LARGEST:g}", path=path)
    if not FRAME_TIMES[0] <= motion.frame_time <= FRAME_TIMES[1]:
        raise MotionError(f"the frame time must be above zero, not {motion.frame_time:g}", path=path)


def _written(motion: Motion) -> Iterator[str]:
    """The lines of a file."""
    yield "HIERARCHY"
    children: list[list[int]] = [[] for _ in motion.joint_names]
    for joint, parent in enumerate(motion.parents):
        if parent >= 0:
            children[parent].append(joint)
    stack: list[tuple[int, int, bool]] = [
        (joint, 0, False) for joint in reversed(range(motion.n_joints)) if motion.parents[joint] < 0
    ]
    columns: list[int] = []
    while stack:
        joint, depth, closing = stack.pop()
        indent = "\t" * min(depth, _DEEPEST_INDENT)
        if closing:
            yield f"{indent}}}"
            continue
        parent = motion.parents[joint]
        is_end = parent >= 0 and motion.joint_names[joint] == f"{motion.joint_names[parent]}_end"
        is_end = is_end and not children[joint] and not motion.channels[joint]
        yield indent + (
            "End Site" if is_end else f"{'ROOT' if parent < 0 else 'JOINT'} {motion.joint_names[joint]}"
        )
        yield indent + "{"
        yield indent + "\tOFFSET " + " ".join(map(_number, motion.offsets[joint].tolist()))
        if not is_end:
            names = motion.channels[joint]
            yield indent + " ".join(("\tCHANNELS", str(len(names)), *names))
            columns += motion.columns(joint)
        stack.append((joint, depth, True))
        stack += [(child, depth + 1, False) for child in reversed(children[joint])]
    yield from ("MOTION", f"Frames: {motion.n_frames}", f"Frame Time: {_number(motion.frame_time)}")
    for row in motion.values:
        yield " ".join(map(_number, row[columns].tolist()))


def _number(value: float) -> str:
    """The shortest text that is read back as this number, without an exponent."""
    text = repr(float(value))
    return np.format_float_positional(value, trim="0") if "e" in text else text


def _with_replacing_positions(motion: Motion) -> Motion:
    values = motion.values.copy()
    for joint, axis, column in motion.position_columns:
        values[:, column] += motion.offsets[joint, axis]
    return replace(motion, values=values, positions="replace")
