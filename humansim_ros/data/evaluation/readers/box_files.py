"""Result files of the AI City Challenge: upright boxes of people that a tracker found in all cameras."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from humansim_ros.data.evaluation.boxes import BoxTracks
from humansim_ros.data.evaluation.readers.pose_files import MAX_BYTES
from humansim_ros.data.formats.aicity import CLASSES, COLUMNS
from humansim_ros.errors import EvaluationError, located, some_of, warn_about
from humansim_ros.files.reading import decode_text, open_file

#: Suffix of result files.
SUFFIX = ".txt"
_PERSON = 0
#: Largest number of a scene, object or frame that a file may have; and largest coordinate, metres.
_MOST, _FARTHEST = 2**31 - 1, 1e6
_WHOLE = 4  # columns with whole numbers
_SIZES = slice(3, 6)  # sizes among the other columns
#: Numbers of scene, class, object and frame of a box.
_Numbers = tuple[int, ...]


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
    known = set[_Numbers]()
    with open_file(path, EvaluationError, "result", MAX_BYTES, may_be_empty=True) as file:
        content = decode_text(file.read(), path, EvaluationError, "result")
    for line, text in enumerate(content.splitlines(), 1):
        words = text.replace(",", " ").split()
        if not words:
            continue
        with located(EvaluationError, path, line):
            numbers, box = _row(words, known)
        known.add(numbers)
        _, kind, identity, frame = numbers
        if kind == _PERSON:
            frames.setdefault(frame, {})[identity] = box
            lines.setdefault(frame, line)
    if others := sum(kind != _PERSON for _, kind, *_ in known):
        warn_about(path, f"{others} boxes of other classes than {CLASSES[_PERSON]} are left out")
    if not frames:
        warn_about(path, "nobody is in the estimate: everybody is missed")
    tables = {
        frame: (np.array(list(rows), np.intp), np.array(list(rows.values()), float))
        for frame, rows in sorted(frames.items())
    }
    return BoxTracks(tables, str(path), lines=lines)


def _row(words: Sequence[str], known: Collection[_Numbers]) -> tuple[_Numbers, list[float]]:
    """Numbers and box in the words of a line. ``known``: numbers of the boxes in the lines before. Raises
    EvaluationError."""
    if len(words) != len(COLUMNS):
        raise EvaluationError(f"{len(words)} columns, but a line has {len(COLUMNS)}: {' '.join(COLUMNS)}")
    columns = list(zip(COLUMNS, words, strict=True))
    numbers = tuple(_whole(*column) for column in columns[:_WHOLE])
    box = [_number(*column) for column in columns[_WHOLE:]]
    if min(box[_SIZES]) <= 0:
        text = f"a box needs sizes above 0, not {some_of(words[_WHOLE:][_SIZES])}"
        raise EvaluationError(text, key="width length height")
    scene, kind, identity, frame = numbers
    if kind >= len(CLASSES):
        listed = ", ".join(f"{number} {name}" for number, name in enumerate(CLASSES))
        raise EvaluationError(f"there is no class {kind}; the classes are {listed}", key="class_id")
    if numbers in known:
        raise EvaluationError(f"object {identity} has a box in frame {frame} already", key="object_id")
    if (first := next((own for own, *_ in known), scene)) != scene:
        text = f"scene {scene} after scene {first}: give a file with the lines of one scene"
        raise EvaluationError(text, key="scene_id")
    return numbers, box


def _whole(name: str, word: str) -> int:
    if not (word.isascii() and word.isdecimal() and len(word) <= 10 and int(word) <= _MOST):
        raise EvaluationError(f"{word[:40]!r} is no whole number from 0 to {_MOST}", key=name)
    return int(word)


def _number(name: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= _FARTHEST:
        raise EvaluationError(f"{word[:40]!r} is no finite number within {_FARTHEST:g}", key=name)
    return value
