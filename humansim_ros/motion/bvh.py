"""Read and write Biovision hierarchy (BVH) motion files.

Nothing is converted: positions stay in the units and axes of the file. Position channels replace the OFFSET,
as in Blender; files of old programs that add them are detected.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from humansim_ros.errors import MotionError, some_of, warn_about
from humansim_ros.io.files import atomic_path, open_file, reading_errors
from humansim_ros.motion.bvh_parser import FRAME_TIMES, LARGEST, LONGEST_NAME, Parser
from humansim_ros.motion.kinematics import CHANNEL_NAMES, Motion

__all__ = ["CHANNEL_NAMES", "Motion", "PositionChannels", "read_bvh", "write_bvh"]

#: Whether position channels replace the OFFSET or are added to it; ``auto`` detects it.
PositionChannels = Literal["auto", "replace", "add"]

#: Largest file: an hour of 60 joints at 120 frames per second.
_MAX_BYTES = 1 << 30
#: Positions are added to OFFSETs if they contain less than this share of the OFFSET.
_ADDED_SHARE = 0.1
#: Positions that vary by less than this share of the skeleton's size count as constant.
_CONSTANT_SHARE = 0.005
#: An OFFSET decides if it is at least this many standard deviations of the positions long.
_MIN_SIGNIFICANCE = 3.0
#: Deeper joints are not indented further: a chain of thousands would be mostly tabs.
_MAX_INDENT = 40


def read_bvh(path: str | os.PathLike[str], positions: PositionChannels = "auto") -> Motion:
    """Read a BVH motion file: text in UTF-8 or Latin-1 with any line ends.

    ``positions``: whether position channels ``replace`` the OFFSET, as in nearly all programs, or are to
    ``add`` to it. ``auto`` detects files that add: their positions stay near 0 beside large OFFSETs.

    Warns (HumansimWarning) where something is wrong but its meaning clear: a missing or wrong ``Frames:``
    count (the rows decide), no ``Frame Time:`` (30 frames per second), missing words HIERARCHY and MOTION,
    end sites with other words, commas, text after the rows, and others (docs/motion.md lists them). Needs
    about twice the memory of the values, whatever the header says.

    Raises:
        MotionError: The file is not valid; with file and line.

    Example:
        >>> from humansim_ros import read_bvh
        >>> from humansim_ros.io.assets import resource_path
        >>> motion = read_bvh(resource_path("assets/motions/walk.bvh"))
        >>> motion.joint_names[:3], motion.n_frames, round(motion.duration, 3)
        (('Hips', 'Chest', 'Neck'), 121, 2.0)
    """
    if positions not in ("auto", "replace", "add"):
        raise MotionError(f"positions are 'auto', 'replace' or 'add', not {positions!r}", path=path)
    # Latin-1 decodes any byte; the parser decodes the lines of the hierarchy again
    what = "BVH motion"
    file = io.TextIOWrapper(open_file(path, MotionError, what, _MAX_BYTES), "latin-1")
    with file, reading_errors(path, MotionError, what):
        motion = Parser(path, file).parse()
    if positions != "auto":
        return replace(motion, positions=positions)
    added = _joints_with_added_positions(motion)
    if not added:
        return motion
    warn_about(
        motion.path,
        f"the positions of {some_of((motion.joint_names[joint] for joint in added), 4)} stay near 0 "
        "beside large OFFSETs: added to them (positions='replace' takes them as they are)",
    )
    return replace(motion, positions="add")


def _joints_with_added_positions(motion: Motion) -> list[int]:
    """Joints whose positions contain nearly nothing of their OFFSETs, if most joints that decide do.

    The share of the OFFSET is a least-squares fit. An axis weighs more, the less the joint moves along it:
    the height of a walking person decides more than the place on the floor.
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
    noise = _CONSTANT_SHARE * float(np.ptp(motion.rest_positions(), axis=0).max())
    with np.errstate(invalid="ignore", divide="ignore"):  # a skeleton of one point
        weights = offsets / (values.var(axis=0) + noise * noise)
        significance = (weights * offsets).sum(axis=-1)
        share = (np.median(values, axis=0) * weights).sum(axis=-1) / significance
        deciding = significance > _MIN_SIGNIFICANCE**2
        added = deciding & (np.abs(share) < _ADDED_SHARE)
    return joints[added].tolist() if 2 * added.sum() > deciding.sum() else []


def write_bvh(path: str | os.PathLike[str], motion: Motion) -> None:
    """Write a motion as a BVH file (UTF-8) that :func:`read_bvh` and other programs read back exactly.

    Numbers have all their digits. Positions that are added to OFFSETs are written as positions that replace
    them, which all programs read. Warns (HumansimWarning) where ``read_bvh`` would detect added positions.

    Raises:
        MotionError: A BVH file cannot hold a name or a number of the motion.
        HumansimError: The file cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from humansim_ros import read_bvh, write_bvh
        >>> from humansim_ros.io.assets import resource_path
        >>> motion = read_bvh(resource_path("assets/motions/wave.bvh"))
        >>> with TemporaryDirectory() as folder:
        ...     write_bvh(f"{folder}/copy.bvh", motion)
        ...     print(read_bvh(f"{folder}/copy.bvh").n_frames == motion.n_frames)
        True
    """
    if motion.positions == "add":
        motion = _with_replacing_positions(motion)
    _check_writable(path, motion)
    if added := _joints_with_added_positions(motion):
        warn_about(
            path,
            f"the positions of {some_of((motion.joint_names[j] for j in added), 4)} stay near 0 "
            "beside large OFFSETs: read it with positions='replace'",
        )
    with atomic_path(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(line + "\n" for line in _lines(motion))


def _check_writable(path: str | os.PathLike[str], motion: Motion) -> None:
    names: set[str] = set()
    for name in motion.joint_names:
        if (
            name != name.strip()
            or not 0 < len(name) <= LONGEST_NAME
            or re.search("[{}\r\n\0\ud800-\udfff]", name)
        ):
            raise MotionError(f"a BVH file cannot have a joint named {name!r}", path=path)
        if name in names:
            raise MotionError(f"two joints are named {name!r}", path=path)
        names.add(name)
    for numbers in (motion.offsets, motion.values):
        if not (np.abs(numbers) <= LARGEST).all():
            raise MotionError(f"the motion has values that are not finite, or beyond {LARGEST:g}", path=path)
    if not FRAME_TIMES[0] <= motion.frame_time <= FRAME_TIMES[1]:
        raise MotionError(f"the frame time must be above zero, not {motion.frame_time:g}", path=path)


def _lines(motion: Motion) -> Iterator[str]:
    """Lines of a BVH file."""
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
        indent = "\t" * min(depth, _MAX_INDENT)
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
    """Shortest text, without an exponent, that reads back as this number."""
    text = repr(float(value))
    return np.format_float_positional(value, trim="0") if "e" in text else text


def _with_replacing_positions(motion: Motion) -> Motion:
    values = motion.values.copy()
    for joint, axis, column in motion.position_columns:
        values[:, column] += motion.offsets[joint, axis]
    return replace(motion, values=values, positions="replace")
