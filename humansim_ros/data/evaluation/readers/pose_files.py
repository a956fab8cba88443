"""Files of 3D poses: CSV, TRC, C3D, NumPy arrays, and JSON of CMU Panoptic, OpenPose and EasyMocap."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.data.evaluation.alignment import axes_matrix, body_size
from humansim_ros.data.evaluation.pose_sequence import PoseSequence, SequenceBuilder
from humansim_ros.errors import EvaluationError, located
from humansim_ros.files.reading import npy_array, read_bytes, read_json, read_text
from humansim_ros.motion.files import MarkerFile, label_parts, number, read_c3d_points, read_trc_points
from humansim_ros.people.keypoints import COUNTED_SETS, keypoint_set
from humansim_ros.types import Array

#: Largest file of poses, bytes. As text, this is an hour of ten people at 30 Hz.
MAX_BYTES = 1 << 31
#: Times beyond this, seconds, do not fit into a stamp of 64 bits.
_MAX_SECONDS = 9e9
_AXIS = re.compile(r"(.+?)[_ .:]?([xyz])", re.IGNORECASE)
_HELP = (
    "the first line must name the columns: time (seconds), stamp (nanoseconds) or frame; person, if there "
    "are several; then joint, x, y, z, or three columns of each joint, such as l_knee_x, l_knee_y, l_knee_z"
)
_NO_PERIOD = "frame numbers need a truth with more than one frame"
#: Names of columns in files of Anipose and FreeMoCap, with the names that this module uses.
_FOREIGN = {"fnum": "frame", "keypoint": "joint"}
#: Columns of FreeMoCap: those with times, in files where each row is a frame; and those that tell which rows
#: belong to the body, with a pattern of their values.
_TIMES, _BODY_ROWS = {"timestamp", "timestamp_by_camera"}, {"model": ".*body", "trajectory": "3d_xyz"}
#: Keypoint set of the body, and possible numbers of points in arrays of FreeMoCap: body first, then hands and
#: face.
_BODY, _FREEMOCAP = "mediapipe33", (33, 75, 543, 553)
#: Metres per unit of Panoptic, and of FreeMoCap; and a spread of joints that no person has, metres.
_CENTIMETRE, _MILLIMETRE, _GIANT = 0.01, 0.001, 20.0
#: Names of the joints of Panoptic [Joo 2015], by key of their list.
_PANOPTIC: dict[str, tuple[str, ...]] = {
    "joints19": (
        *("neck", "nose", "mid_hip", "l_shoulder", "l_elbow", "l_wrist", "l_hip", "l_knee", "l_ankle"),
        *("r_shoulder", "r_elbow", "r_wrist", "r_hip", "r_knee", "r_ankle"),
        *("l_eye", "l_ear", "r_eye", "r_ear"),
    ),
}
_PANOPTIC["joints15"] = _PANOPTIC["joints19"][:15]


@dataclass(frozen=True)
class ReadOptions:
    """Facts that the reader needs, but some formats lack.

    Attributes:
        names: Names of the points, in their order, for formats without names.
        period: Nanoseconds between frames, for formats that number frames. 0 if unknown.
        start: Stamp of frame 0 and of time 0, nanoseconds.
        axes: Axes of the file, the same as in ``axes_matrix``. If None, the usual axes of the format.
        scale: Factor to metres, in addition to the unit that the file states.
    """

    names: tuple[str, ...] | None = None
    period: int = 0
    start: int = 0
    axes: str | None = None
    scale: float = 1.0


def nanoseconds(value: float, path: str | os.PathLike[str], line: int, key: str) -> int:
    """Convert seconds to nanoseconds.

    Args:
        value: Seconds.
        path, line, key: File, its line and the name of the field, for messages.

    Raises:
        EvaluationError: The time is not finite, or beyond all stamps. The error names path, line and key.
    """
    if not abs(value) < _MAX_SECONDS:
        raise EvaluationError(f"{value:g} s is no time", path=path, line=line, key=key)
    return round(value * 1e9)


def split_name(label: str, path: Path) -> tuple[str, str]:
    """Split a label such as ``anna:l_knee`` into person and joint. Without a person, the file name is the
    person."""
    person, joint = label_parts(label)
    return person or path.stem, joint


def read_csv(path: Path, options: ReadOptions) -> PoseSequence:
    """Read a CSV file with a line of column names (docs/evaluation.md). Raises EvaluationError."""
    text = read_text(path, EvaluationError, "CSV", MAX_BYTES)
    sample = text[: text.find("\n") + 1] or text
    separator = max(",;\t", key=sample.count)
    try:
        return _read(csv.reader(io.StringIO(text), delimiter=separator), path, options)
    except csv.Error as reason:
        raise EvaluationError(f"not valid CSV: {reason}", path=path) from None


def _read(rows: Any, path: Path, options: ReadOptions) -> PoseSequence:
    header = [word.strip() for word in next(rows)]
    columns = {word.lower(): index for index, word in enumerate(header)}
    foreign = {new: columns[old] for old, new in _FOREIGN.items() if old in columns and new not in columns}
    columns |= foreign
    clock = next((word for word in ("time", "stamp", "frame") if word in columns), None)
    by_joint = {"joint", "x", "y", "z"} <= columns.keys()
    joints = {} if by_joint else _joint_columns(header)
    if clock is None and joints and 3 * len(joints) == len(columns.keys() - _TIMES):
        clock, joints = "row", {name.removeprefix("body_"): places for name, places in joints.items()}
    if clock is None or not (by_joint or joints):
        raise EvaluationError(_HELP, path=path, line=1)
    if clock in ("frame", "row") and not options.period:
        raise EvaluationError(_NO_PERIOD, path=path, line=1)
    chosen = {name: text for name, text in _BODY_ROWS.items() if name in columns and "joint" in foreign}
    alone = path.stem if foreign or clock == "row" else "1"
    poses: dict[tuple[int, str], tuple[list[str], list[list[float]], float | None]] = {}
    for row in rows:
        line = rows.line_num
        if not any(field.strip() for field in row) and not (row and clock == "row"):
            continue
        if len(row) != len(header):
            raise EvaluationError(f"{len(row)} fields, but {len(header)} column names", path=path, line=line)
        if not all(re.fullmatch(text, row[columns[name]]) for name, text in chosen.items()):
            continue
        word = row[columns[clock]] if clock in columns else str(len(poses))
        time = _csv_time(word, clock, options, path, line)
        person = row[columns["person"]].strip() if "person" in columns else alone
        score = None
        if "score" in columns:
            score = number(row[columns["score"]], EvaluationError, path, line, "score")
        names, positions, _ = poses.setdefault((time, person), ([], [], score))
        given = {row[columns["joint"]].strip(): [columns[a] for a in "xyz"]} if by_joint else joints
        for name, places in given.items():
            if name in names:
                raise EvaluationError(
                    f"joint {name!r} of person {person!r} is given twice for one time", path=path, line=line
                )
            names.append(name)
            positions.append(
                [number(row[place], EvaluationError, path, line, header[place]) for place in places]
            )
    builder = SequenceBuilder(str(path))
    for (time, person), (names, positions, score) in poses.items():
        builder.add(time, person, tuple(names), np.array(positions), score)
    return builder.build() if alone == "1" else _metres(builder.build(), options)


def _metres(sequence: PoseSequence, options: ReadOptions) -> PoseSequence:
    """Convert poses of unknown unit to metres. If no scale is given, the unit is metres or, if people would
    then be larger than 20 m, millimetres."""
    size = body_size(pose for people in sequence.people for pose in people.values())
    return sequence.mapped(_MILLIMETRE * np.eye(3)) if options.scale == 1 and size > _GIANT else sequence


def _csv_time(text: str, clock: str, options: ReadOptions, path: Path, line: int) -> int:
    if clock == "stamp" and text.strip().lstrip("-").isdecimal():
        return nanoseconds(int(text) * 1e-9, path, line, clock) and int(text)
    value = number(text, EvaluationError, path, line, clock)
    if clock == "stamp":
        return nanoseconds(value * 1e-9, path, line, clock)
    if clock in ("frame", "row"):
        return options.start + nanoseconds(value * options.period * 1e-9, path, line, clock)
    return nanoseconds(value, path, line, clock)


def _joint_columns(header: Sequence[str]) -> dict[str, list[int]]:
    """Indices of the columns with x, y, z, by joint. Joints without all three columns are left out."""
    found: dict[str, dict[str, int]] = {}
    for index, word in enumerate(header):
        if (match := _AXIS.fullmatch(word)) and word.lower() not in ("x", "y", "z"):
            found.setdefault(match[1], {})[match[2].lower()] = index
    return {name: [axes[a] for a in "xyz"] for name, axes in found.items() if len(axes) == 3}


def read_trc(path: Path, options: ReadOptions) -> PoseSequence:
    """Read a TRC file. Times count from the start of the truth. Positions are converted to metres. A marker
    ``anna:l_knee`` belongs to anna. A marker without person belongs to the person that the file is named
    after. Raises EvaluationError."""
    file = read_trc_points(path, EvaluationError, MAX_BYTES)
    stamps = [
        options.start + nanoseconds(time, path, line, "Time")
        for time, line in zip(file.times.tolist(), file.lines, strict=True)
    ]
    return _of_markers(path, file, stamps)


def _of_markers(path: Path, file: MarkerFile, stamps: Sequence[int]) -> PoseSequence:
    """Make poses from the markers of a TRC or C3D file. ``stamps``: stamp of each frame, nanoseconds."""
    markers = [split_name(label, path) for label in file.labels]
    people: dict[str, list[int]] = {}
    for index, (person, _) in enumerate(markers):
        people.setdefault(person, []).append(index)
    builder = SequenceBuilder(str(path))
    for stamp, positions in zip(stamps, file.points, strict=True):
        builder.add_frame(stamp)
        for person, indices in people.items():
            builder.add(stamp, person, tuple(markers[i][1] for i in indices), positions[indices])
    return builder.build()


def read_c3d(path: Path, options: ReadOptions) -> PoseSequence:
    """Read the points of a C3D file. Times count from the start of the truth. Positions are converted to
    metres. A label ``anna:l_knee`` belongs to anna. A label without person belongs to the person that the
    file is named after. Raises EvaluationError."""
    file = read_c3d_points(path, EvaluationError, MAX_BYTES)
    return _of_markers(path, file, [options.start + round(time * 1e9) for time in file.times.tolist()])


def read_json_3d(path: Path, options: ReadOptions) -> PoseSequence:
    """Read one JSON file, or a folder with one file per frame: a sequence of Panoptic, or output of
    EasyMocap. Positions of Panoptic (centimetres, y down) are converted to ``map``. The last number in the
    name of a file is its frame. Raises EvaluationError."""
    sequence = sorted(path.glob("hdPose3d_*/*.json")) or sorted(path.glob("keypoints3d/*.json"))
    files = (sequence or sorted(path.glob("*.json"))) if path.is_dir() else [path]
    if not files:
        raise EvaluationError("there are no .json files in this folder", path=path)
    builder = SequenceBuilder(str(path))
    for file in files:
        content = read_json(file, EvaluationError, "JSON", MAX_BYTES, nan=True)
        facts = content if isinstance(content, dict) else {}
        with located(EvaluationError, file):
            time = _file_time(file.stem, options)
            builder.add_frame(time)
            if isinstance(content, list):
                _add_people(builder, time, content, "keypoints3d", options)
            elif isinstance(facts.get("bodies"), list):
                _add_panoptic(builder, time, facts["bodies"], options)
            elif isinstance(facts.get("people"), list):
                _add_people(builder, time, facts["people"], "pose_keypoints_3d", options)
            else:
                text = "neither Panoptic (key bodies), OpenPose (key people) nor EasyMocap (a list)"
                raise EvaluationError(text)
    return builder.build()


def read_npy(path: Path, options: ReadOptions) -> PoseSequence:
    """Read an array (frames, points, 3) of one person, as FreeMoCap writes it. Raises EvaluationError."""
    try:
        values = npy_array(read_bytes(path, EvaluationError, "NumPy", MAX_BYTES))
        if values.ndim != 3 or values.shape[2] != 3 or values.dtype.kind not in "iuf" or not options.period:
            raise ValueError(
                f"needed are numbers (frames, points, 3) and a truth of several frames, not {values.shape}"
            )
    except ValueError as reason:
        raise EvaluationError(f"no poses of FreeMoCap: {reason}", path=path) from None
    body, count = keypoint_set(_BODY).names, values.shape[1]
    with located(EvaluationError, path):
        names = body if count in _FREEMOCAP and options.names in (None, body) else _names(count, options)
    builder = SequenceBuilder(str(path))
    for frame, points in enumerate(values[:, : len(names)].astype(float)):
        builder.add(options.start + frame * options.period, path.stem, names, points)
    return _metres(builder.build(), options)


def _names(count: int, options: ReadOptions) -> tuple[str, ...]:
    """Names of ``count`` points: from the options, or from the keypoint set with as many points. Raises
    EvaluationError."""
    names = options.names or (COUNTED_SETS[count].names if count in COUNTED_SETS else ())
    if len(names) != count:
        known = f"the set has {len(names)}" if names else "give --keypoints"
        raise EvaluationError(f"{count} keypoints without names; {known}")
    return names


def _file_time(name: str, options: ReadOptions) -> int:
    """Stamp of the frame that a file is named after, nanoseconds."""
    numbers = re.findall(r"\d+", name.replace("body3DScene", "").replace("_keypoints", ""))
    if not numbers:
        raise EvaluationError("the name of the file needs the number of its frame at the end")
    if not options.period:
        raise EvaluationError(_NO_PERIOD)
    return options.start + int(numbers[-1][-12:]) * options.period


def _add_panoptic(builder: SequenceBuilder, time: int, bodies: Sequence[Any], options: ReadOptions) -> None:
    to_map = np.eye(3) if options.axes else axes_matrix("y-down")
    for body in bodies:
        key = next((key for key in _PANOPTIC if isinstance(body, dict) and key in body), None)
        if key is None:
            raise EvaluationError(f"a body without {' or '.join(_PANOPTIC)}", key="bodies")
        with located(key=f"bodies.{key}"):
            values = _matrix(body[key])
            if len(values) != len(_PANOPTIC[key]):
                raise EvaluationError(f"{len(values)} joints")
        values[values[:, 3] < 0] = np.nan  # Panoptic marks joints that were not seen in this way
        person, score = body.get("id"), body.get("score")
        builder.add(
            time,
            None if person is None else str(person),
            _PANOPTIC[key],
            _CENTIMETRE * values[:, :3] @ to_map.T,
            float(score) if isinstance(score, (int, float)) else None,
        )


def _add_people(
    builder: SequenceBuilder, time: int, people: Sequence[Any], field: str, options: ReadOptions
) -> None:
    """Add the people of one frame of OpenPose or EasyMocap. ``field``: key of the points of a person."""
    for person in people:
        points = person.get(field) if isinstance(person, dict) else None
        if not points:
            text = f"these are 2D keypoints of one camera ({field} is empty); give a 3D estimate"
            raise EvaluationError(text, key="people")
        with located(key=f"people.{field}"):
            values = _matrix(points)
        with located(key="people"):
            names = _names(len(values), options)
        values[values[:, 3] <= 0] = np.nan  # both mark absent keypoints in this way
        number = person.get("person_id", person.get("id", -1))
        number = number[0] if isinstance(number, list) and number else number
        name = str(number) if isinstance(number, int) and number >= 0 else None
        builder.add(time, name, names, values[:, :3])


def _matrix(values: Any) -> Array:
    """Rows x, y, z and confidence or score (N, 4) of a list of numbers or rows."""
    try:
        numbers = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise EvaluationError("not a list of numbers") from None
    if numbers.ndim == 2 and numbers.shape[1] == 4:
        return numbers
    if numbers.ndim != 1 or len(numbers) % 4 or not len(numbers):
        raise EvaluationError("the numbers must come in groups of 4")
    return numbers.reshape(-1, 4)
