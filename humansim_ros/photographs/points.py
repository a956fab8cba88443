"""2D points of a person in photographs: own JSON, COCO and OpenPose files.

The own form is ``{"keypoints": "coco17", "frames": [{"nose": [x, y, confidence], ...}, ...]}``. A confidence
that is absent is 1.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.bounds import MAX_COORDINATE
from humansim_ros.errors import PhotographError, did_you_mean
from humansim_ros.io.files import atomic_path, read_text
from humansim_ros.keypoints.sets import KeypointSet
from humansim_ros.types import Array

MAX_BYTES = 1 << 28


def read_points(path: Path, keypoints: KeypointSet, images: Sequence[Path] | None = None) -> list[Array]:
    """Points (K, 3) of each frame: x, y in pixels, confidence; zeros where a point is absent.

    A folder has one file for each frame, in the order of their numbers. Of several people in one, it takes
    the one with the largest sum of confidences.

    Args:
        path: JSON file, or folder of JSON files.
        keypoints: Set of the points.
        images: Images of the frames: COCO files find their images by name.

    Raises:
        PhotographError: The file is wrong; the message has file and key.
    """
    if path.is_dir():
        files = sorted(path.glob("*.json"), key=_number)
        if not files:
            raise PhotographError("no .json file in this folder", path=path)
        return [frame for file in files for frame in read_points(file, keypoints)]
    text = read_text(path, PhotographError, "points", MAX_BYTES)
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as reason:
        line = getattr(reason, "lineno", None)
        raise PhotographError(f"not valid JSON: {reason}", path=path, line=line) from None
    reader = _PointsReader(path, keypoints)
    if isinstance(content, dict) and "frames" in content:
        return reader.own(content)
    if isinstance(content, dict) and "people" in content:
        return [reader.openpose(content["people"])]
    if isinstance(content, dict) and "annotations" in content:
        return reader.coco(content.get("annotations"), reader.image_numbers(content, images))
    if isinstance(content, list):
        return reader.coco(content, None)
    raise PhotographError(
        "not a file of 2D points: it needs the key frames (own form), people (OpenPose) or annotations "
        "(COCO), or is a list of results of COCO",
        path=path,
    )


def write_points(path: str | os.PathLike[str], keypoints: KeypointSet, frames: Sequence[Array]) -> None:
    """Write points (K, 3) of each frame in the own form, atomically; absent points are left out."""
    content = {
        "keypoints": keypoints.name,
        "frames": [
            {
                name: np.round(point, 3).tolist()
                for name, point in zip(keypoints.names, points, strict=True)
                if point[2] > 0
            }
            for points in frames
        ],
    }
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


class _PointsReader:
    """Reads the forms of files of one keypoint set; errors name the file and the key."""

    def __init__(self, path: Path, keypoints: KeypointSet) -> None:
        self._path, self._keypoints = path, keypoints

    def own(self, content: Mapping[str, Any]) -> list[Array]:
        """Frames of our own form."""
        name = content.get("keypoints", self._keypoints.name)
        if name != self._keypoints.name:
            raise self._error(
                f"points of {str(name)[:40]!r}, but the views file says {self._keypoints.name}", "keypoints"
            )
        frames = content["frames"]
        if not isinstance(frames, list) or not frames:
            raise self._error("needs a list with the points of each frame", "frames")
        return [self._named(frame, f"frames[{number}]") for number, frame in enumerate(frames)]

    def _named(self, frame: Any, key: str) -> Array:
        if not isinstance(frame, dict):
            raise self._error("needs a mapping from names of points to x, y", key)
        points = np.zeros((len(self._keypoints), 3))
        for name, value in frame.items():
            if name not in self._keypoints.names:
                hint = did_you_mean(name, self._keypoints.names)
                raise self._error(f"{self._keypoints.name} has no point {name[:40]!r}{hint}", key)
            numbers = self._numbers(value, f"{key}.{name}")
            if len(numbers) not in (2, 3):
                raise self._error("needs x, y, and the confidence if it is known", f"{key}.{name}")
            points[self._keypoints.index(name)] = [*numbers, 1.0][:3]
        return self._present(points)

    def openpose(self, people: Any) -> Array:
        """Points of the person with the largest confidence of an OpenPose file."""
        if not isinstance(people, list):
            raise self._error("a list of people is needed", "people")
        found = [
            self._row(
                person.get("pose_keypoints_2d") if isinstance(person, dict) else None,
                f"people[{number}].pose_keypoints_2d",
            )
            for number, person in enumerate(people)
        ]
        return self._best(found)

    def image_numbers(self, content: Mapping[str, Any], images: Sequence[Path] | None) -> list[Any]:
        """Image ids of the frames of a COCO file: by the names of the images, or in the order of its list."""
        listed = content.get("images")
        if not isinstance(listed, list) or not all(isinstance(row, dict) for row in listed) or not listed:
            raise self._error("a list of images is needed", "images")
        if images is None:
            return [row.get("id") for row in listed]
        by_name = {Path(str(row.get("file_name"))).name: row.get("id") for row in listed}
        missing = [image.name for image in images if image.name not in by_name]
        if missing:
            raise self._error(f"no image {missing[0]!r}{did_you_mean(missing[0], by_name)}", "images")
        return [by_name[image.name] for image in images]

    def coco(self, rows: Any, numbers: Sequence[Any] | None) -> list[Array]:
        """Points of the best person of each image. ``numbers``: ids of the images; all rows' if None."""
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise self._error("a list of annotations is needed", "annotations")
        found: dict[str, list[Array]] = {}
        for place, row in enumerate(rows):
            if "keypoints" in row:
                key = f"annotations[{place}].keypoints"
                found.setdefault(repr(row.get("image_id")), []).append(self._row(row["keypoints"], key))
        if numbers is None:
            if not found:
                raise self._error("no result has keypoints", "keypoints")
            numbers = sorted({row.get("image_id") for row in rows if "keypoints" in row}, key=_sortable)
        return [self._best(found.get(repr(number), [])) for number in numbers]

    def _row(self, values: Any, key: str) -> Array:
        """x, y, confidence (K, 3) of a flat list; the visibility of COCO (0, 1, 2) becomes a confidence."""
        numbers = self._numbers(values, key)
        count = 3 * len(self._keypoints)
        if len(numbers) != count:
            raise self._error(
                f"{len(numbers)} numbers, but {count} for {self._keypoints.name}: x, y, confidence of each "
                "point; the key keypoints of the views file names the set",
                key,
            )
        points = np.array(numbers).reshape(-1, 3)
        if points[:, 2].max() > 1:  # visibility: 2 visible, 1 occluded
            points[:, 2] = np.clip(points[:, 2] / 2, 0, 1)
        return self._present(points)

    def _numbers(self, value: Any, key: str) -> list[float]:
        if not isinstance(value, list) or not all(
            isinstance(each, (int, float)) and not isinstance(each, bool) and abs(each) <= MAX_COORDINATE
            for each in value
        ):
            raise self._error("needs a list of finite numbers", key)
        return [float(each) for each in value]

    def _present(self, points: Array) -> Array:
        points[points[:, 2] <= 0] = 0.0
        points[:, 2] = np.minimum(points[:, 2], 1.0)
        return points

    def _best(self, people: Sequence[Array]) -> Array:
        if not people:
            return np.zeros((len(self._keypoints), 3))
        return max(people, key=lambda points: float(points[:, 2].sum()))

    def _error(self, message: str, key: str) -> PhotographError:
        return PhotographError(message, path=self._path, key=key)


def _number(path: Path) -> tuple[int, str]:
    numbers = re.findall(r"[0-9]+", path.stem.replace("_keypoints", ""))
    return (int(numbers[-1][-12:]) if numbers else 0, path.name)


def _sortable(value: Any) -> tuple[bool, Any]:
    return (True, value) if isinstance(value, (int, float)) else (False, str(value))
