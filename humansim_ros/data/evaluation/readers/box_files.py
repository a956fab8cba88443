"""Result files of the AI City Challenge: upright boxes of people that a tracker found in all cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from humansim_ros.data.evaluation.boxes import BoxTracks
from humansim_ros.data.evaluation.readers.pose_files import MAX_BYTES
from humansim_ros.data.formats.aicity import CLASSES, COLUMNS
from humansim_ros.errors import EvaluationError, some_of, warn_about
from humansim_ros.files.reading import decode_text, open_file

#: Suffix of result files.
SUFFIX = ".txt"
_PERSON = 0
#: Largest number of a scene, object or frame that a file may have; and largest coordinate, metres.
_MOST, _FARTHEST = 2**31 - 1, 1e6
_WHOLE = 4  # columns with whole numbers
_SIZES = slice(3, 6)  # sizes among the other columns


def is_box_file(text: str) -> bool:
    """Whether an estimate is a result file with 3D boxes. Other ``.txt`` files have detections in images."""
    return Path(text).suffix.lower() == SUFFIX and ":/" not in text and not Path(text).is_dir()


def read_box_file(path: Path) -> BoxTracks:
    """Read the people of a result file of one scene.

    Raises:
        EvaluationError: The file is missing, or a line is wrong. The error names file and line.
    """
    frames: dict[int, dict[int, list[float]]] = {}
    lines: dict[int, int] = {}
    scene, others, known = -1, 0, set[tuple[int, ...]]()
    with open_file(path, EvaluationError, "result", MAX_BYTES, may_be_empty=True) as file:
        content = decode_text(file.read(), path, EvaluationError, "result")
    for line, text in enumerate(content.splitlines(), 1):
        words = text.replace(",", " ").split()
        if not words:
            continue
        if len(words) != len(COLUMNS):
            raise EvaluationError(
                f"{len(words)} columns, but a line has {len(COLUMNS)}: {' '.join(COLUMNS)}",
                path=path,
                line=line,
            )
        numbers, box = _whole(words[:_WHOLE], path, line), _numbers(words[_WHOLE:], path, line)
        if numbers[1] >= len(CLASSES):
            listed = ", ".join(f"{number} {name}" for number, name in enumerate(CLASSES))
            raise EvaluationError(
                f"there is no class {numbers[1]}; the classes are {listed}",
                path=path,
                line=line,
                key="class_id",
            )
        if tuple(numbers) in known:
            raise EvaluationError(
                f"object {numbers[2]} has a box in frame {numbers[3]} already",
                path=path,
                line=line,
                key="object_id",
            )
        known.add(tuple(numbers))
        if scene not in (-1, numbers[0]):
            raise EvaluationError(
                f"scene {numbers[0]} after scene {scene}: give a file with the lines of one scene",
                path=path,
                line=line,
                key="scene_id",
            )
        scene, others = numbers[0], others + (numbers[1] != _PERSON)
        if numbers[1] == _PERSON:
            frames.setdefault(numbers[3], {})[numbers[2]] = box
            lines.setdefault(numbers[3], line)
    if others:
        warn_about(path, f"{others} boxes of other classes than {CLASSES[_PERSON]} are left out")
    if not frames:
        warn_about(path, "nobody is in the estimate: everybody is missed")
    tables = {
        frame: (np.array(list(rows), np.intp), np.array(list(rows.values()), float))
        for frame, rows in sorted(frames.items())
    }
    return BoxTracks(tables, str(path), lines=lines)


def _whole(words: Sequence[str], path: Path, line: int) -> list[int]:
    for name, word in zip(COLUMNS, words, strict=False):
        if not (word.isascii() and word.isdecimal() and len(word) <= 10 and int(word) <= _MOST):
            text = f"{word[:40]!r} is no whole number from 0 to {_MOST}"
            raise EvaluationError(text, path=path, line=line, key=name)
    return [int(word) for word in words]


def _numbers(words: Sequence[str], path: Path, line: int) -> list[float]:
    values = []
    for name, word in zip(COLUMNS[_WHOLE:], words, strict=True):
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not abs(value) <= _FARTHEST:
            wrong = f"{word[:40]!r} is no finite number within {_FARTHEST:g}"
            raise EvaluationError(wrong, path=path, line=line, key=name)
        values.append(value)
    if min(values[_SIZES]) <= 0:
        listed = some_of(words[_SIZES])
        raise EvaluationError(
            f"a box needs sizes above 0, not {listed}", path=path, line=line, key="width length height"
        )
    return values
