"""3D poses in JSON: one file a frame as CMU Panoptic, and OpenPose with 3D keypoints."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.alignment import axes_matrix
from humansim_ros.evaluate.readers.numbers import MAX_BYTES
from humansim_ros.evaluate.readers.options import ReadOptions
from humansim_ros.evaluate.tracks import PoseSequence, SequenceBuilder
from humansim_ros.io.files import read_text
from humansim_ros.types import Array

#: Metres of a unit of Panoptic.
_CENTIMETRE = 0.01
#: Names of the joints of Panoptic [Joo 2015] by the key of their list.
_PANOPTIC: dict[str, tuple[str, ...]] = {
    "joints19": (
        *("neck", "nose", "mid_hip", "l_shoulder", "l_elbow", "l_wrist", "l_hip", "l_knee", "l_ankle"),
        *("r_shoulder", "r_elbow", "r_wrist", "r_hip", "r_knee", "r_ankle"),
        *("l_eye", "l_ear", "r_eye", "r_ear"),
    ),
}
_PANOPTIC["joints15"] = _PANOPTIC["joints19"][:15]


def read_json_3d(path: Path, options: ReadOptions) -> PoseSequence:
    """Read a folder with a file a frame, or one such file. The folder may be a sequence of Panoptic.

    Positions of Panoptic (centimetres, y down) become those of ``map``. The last number in the name of a
    file is its frame. Raises EvaluationError.
    """
    sequence = sorted(path.glob("hdPose3d_*/*.json"))
    files = (sequence or sorted(path.glob("*.json"))) if path.is_dir() else [path]
    if not files:
        raise EvaluationError("there are no .json files in this folder", path=path)
    builder = SequenceBuilder(str(path))
    for file in files:
        content = load_json(file)
        time = _time(file, options)
        builder.add_frame(time)
        if isinstance(content.get("bodies"), list):
            _add_panoptic(builder, time, content["bodies"], file, options)
        elif isinstance(content.get("people"), list):
            _add_openpose(builder, time, content["people"], file, options)
        else:
            raise EvaluationError("neither Panoptic (key bodies) nor OpenPose (key people)", path=file)
    return builder.build()


def load_json(path: Path) -> dict[str, Any]:
    """Content of a JSON file, a mapping. Raises EvaluationError."""
    text = read_text(path, EvaluationError, "JSON", MAX_BYTES)
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as reason:
        line = getattr(reason, "lineno", None)
        raise EvaluationError(f"not valid JSON: {reason}", path=path, line=line) from None
    if not isinstance(content, dict):
        raise EvaluationError("a list at the top; 3D poses of Panoptic or OpenPose are a mapping", path=path)
    return content


def _time(path: Path, options: ReadOptions) -> int:
    numbers = re.findall(r"\d+", path.stem.replace("body3DScene", "").replace("_keypoints", ""))
    if not numbers:
        raise EvaluationError("the name of the file needs the number of its frame at the end", path=path)
    if not options.period:
        raise EvaluationError("frame numbers need a truth with more than one frame", path=path)
    return options.start + int(numbers[-1][-12:]) * options.period


def _add_panoptic(
    builder: SequenceBuilder, time: int, bodies: Sequence[Any], path: Path, options: ReadOptions
) -> None:
    to_map = np.eye(3) if options.axes else axes_matrix("y-down")
    for body in bodies:
        key = next((key for key in _PANOPTIC if isinstance(body, dict) and key in body), None)
        if key is None:
            raise EvaluationError(f"a body without {' or '.join(_PANOPTIC)}", path=path, key="bodies")
        values = _matrix(body[key], 4, path, f"bodies.{key}")
        if len(values) != len(_PANOPTIC[key]):
            raise EvaluationError(f"{len(values)} joints", path=path, key=f"bodies.{key}")
        values[values[:, 3] < 0] = np.nan  # Panoptic marks joints that were not seen so
        person = body.get("id")
        score = body.get("score")
        builder.add(
            time,
            None if person is None else str(person),
            _PANOPTIC[key],
            _CENTIMETRE * values[:, :3] @ to_map.T,
            float(score) if isinstance(score, (int, float)) else None,
        )


def _add_openpose(
    builder: SequenceBuilder, time: int, people: Sequence[Any], path: Path, options: ReadOptions
) -> None:
    for person in people:
        points = person.get("pose_keypoints_3d") if isinstance(person, dict) else None
        if not points:
            raise EvaluationError(
                "these are 2D keypoints of one camera (pose_keypoints_3d is empty); give a 3D estimate",
                path=path,
                key="people",
            )
        values = _matrix(points, 4, path, "people.pose_keypoints_3d")
        if options.names is None or len(options.names) != len(values):
            known = f"the set has {len(options.names)}" if options.names else "give --keypoints"
            raise EvaluationError(f"{len(values)} keypoints without names; {known}", path=path, key="people")
        values[values[:, 3] <= 0] = np.nan  # OpenPose marks absent keypoints so
        number = person.get("person_id", [-1])
        number = number[0] if isinstance(number, list) and number else number
        name = str(number) if isinstance(number, int) and number >= 0 else None
        builder.add(time, name, options.names, values[:, :3])


def _matrix(values: Any, columns: int, path: Path, key: str) -> Array:
    try:
        numbers = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise EvaluationError("not a list of numbers", path=path, key=key) from None
    if numbers.ndim != 1 or len(numbers) % columns or not len(numbers):
        raise EvaluationError(f"the numbers must come in groups of {columns}", path=path, key=key)
    return numbers.reshape(-1, columns)
