"""Recordings of faces: CSV files of Live Link Face, and animations of glTF and VRM files."""

from __future__ import annotations

import csv
import io
import os
import re

import numpy as np

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import read_bytes
from humansim_ros.motion.body import ACTIONS
from humansim_ros.motion.files import motion_format
from humansim_ros.scene.features.face.tracks import WeightTrack, linear
from humansim_ros.types import Array

#: Largest file that is read, bytes, and most frames.
_MAX_BYTES, _MAX_FRAMES = 32 << 20, 1_000_000
#: Hours, minutes, seconds, and the number of the frame within the second, with its fraction.
_TIMECODE = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2})[:;](\d{1,3}(?:\.\d+)?)")
_RATES = (24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 120.0)
_DAY = 86400.0
#: Number of an action by its name in lower case.
_NUMBERS = {action.lower(): number for number, action in enumerate(ACTIONS)}
#: Columns that are not actions: rotations of head and eyes. The actions already say where the eyes look.
_OTHER = re.compile(r"(head|lefteye|righteye)(yaw|pitch|roll)")


def read_face_file(path: str | os.PathLike[str], animation: str | None = None) -> WeightTrack:
    """Read the weights of a face over time: a CSV file of Live Link Face, a glTF file or a VRM animation.

    Args:
        path: File.
        animation: Name of the animation of a glTF file. If None, the first animation that moves a face.

    Raises:
        MotionError: The file is not a recording of a face. The error names the file, and the line and column
            or the key.
    """
    known = motion_format(path)
    if known is not None and known.name in ("gltf", "vrma"):
        # imported here, since most faces are CSV files
        from humansim_ros.scene.features.face.gltf import read_gltf_face

        return read_gltf_face(path, animation)
    return _read_live_link(path)


def _read_live_link(path: str | os.PathLike[str]) -> WeightTrack:
    """Read a CSV file of Live Link Face.

    A time code counts the frames within each second. So the rate is the smallest usual rate that has all of
    these frames. For a recording shorter than a second, the rate is 60. The first frame is at time 0. Between
    frames, weights change linearly. The first line has the names of the columns. Rows without weights, where
    no face was found, are left out.

    Raises:
        MotionError: The file is not such a recording. The error names file, line and column.
    """
    text = read_bytes(path, MotionError, "face", _MAX_BYTES).decode("utf-8-sig", errors="replace")
    try:
        rows = list(csv.reader(io.StringIO(text, newline="")))
    except csv.Error as reason:
        raise MotionError(f"not a CSV file: {reason}", path=path) from None
    columns = _columns(rows[0] if rows else [], path)
    frames = [(line, row) for line, row in enumerate(rows[1:], 2) if len(row) > max(columns.values())]
    if not 0 < len(frames) <= _MAX_FRAMES:
        raise MotionError(f"{len(frames)} frames with weights; a recording has 1 to {_MAX_FRAMES}", path=path)
    times = _times([(line, row[columns["timecode"]]) for line, row in frames], path)
    names = [name for name in columns if name != "timecode"]
    weights = np.array(
        [[_weight(row[columns[name]], line, name, path) for name in names] for line, row in frames]
    )
    # a frame that repeats the time of the frame before is left out
    order = np.flatnonzero(np.diff(times, prepend=-1.0) > 0)
    if len(order) < len(times) and (np.diff(times) < 0).any():
        line = frames[int(np.argmax(np.diff(times) < 0)) + 1][0]
        raise MotionError("the time code goes back", path=path, line=line)
    return WeightTrack(tuple(_NUMBERS[name] for name in names), times[order], weights[order], ease=linear)


def _columns(head: list[str], path: str | os.PathLike[str]) -> dict[str, int]:
    """Number of the column of the time code and of each action, by its name in lower case."""
    columns: dict[str, int] = {}
    for number, title in enumerate(head):
        name = title.strip().lower()
        if name in columns:
            raise MotionError(f"the column {title.strip()[:40]!r} is there twice", path=path, line=1)
        if name == "timecode" or name in _NUMBERS:
            columns[name] = number
        elif name and name != "blendshapecount" and not _OTHER.fullmatch(name):
            text = unknown("action of the face", title.strip(), ACTIONS, most=5)
            raise MotionError(text, path=path, line=1)
    if "timecode" not in columns or len(columns) < 2:
        raise MotionError(
            "not a recording of Live Link Face: its first line has Timecode, BlendShapeCount and the names "
            "of the actions (other recordings are .glb, .gltf, .vrm and .vrma files)",
            path=path,
            line=1,
        )
    return columns


def _times(codes: list[tuple[int, str]], path: str | os.PathLike[str]) -> Array:
    """Seconds (F,) of time codes, from 0. ``codes`` have the numbers of their lines."""
    parts = []
    for line, code in codes:
        match = _TIMECODE.fullmatch(code.strip())
        if match is None:
            raise MotionError(
                f"{code.strip()[:40]!r} is no time code: HH:MM:SS:FF or HH:MM:SS:FF.FFF", path=path, line=line
            )
        parts.append([float(part) for part in match.groups()])
    hours, minutes, seconds, frames = np.array(parts).T
    whole = hours * 3600 + minutes * 60 + seconds
    last = np.floor(frames.max())
    rate = (
        60.0 if np.ptp(whole) == 0 and last < 60 else next((each for each in _RATES if last < each), last + 1)
    )
    times = whole + frames / rate
    times = times - times[0]
    return np.where(times < -_DAY / 2, times + _DAY, times)  # a recording that goes on after midnight


def _weight(text: str, line: int, name: str, path: str | os.PathLike[str]) -> float:
    try:
        weight = float(text)
    except ValueError:
        weight = float("nan")
    if not 0 <= weight <= 1 + 1e-3:
        raise MotionError(f"{name} must be from 0 to 1, not {text.strip()[:40]!r}", path=path, line=line)
    return min(weight, 1.0)
