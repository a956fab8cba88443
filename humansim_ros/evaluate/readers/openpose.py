"""2D keypoints of OpenPose: a JSON file for each camera and frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.images import Detections2D
from humansim_ros.evaluate.readers.image_options import ImageNumbers, camera_folders, image_of
from humansim_ros.evaluate.readers.json_files import load_json

_PERSON = 1


def read_openpose_2d(path: Path, images: ImageNumbers) -> Detections2D:
    """Read a folder of OpenPose JSON files for each camera; the score of a person is the mean of its points.

    The last number in the name of a file is its frame. Raises EvaluationError.
    """
    results: list[dict[str, Any]] = []
    numbers: list[int] = []
    for camera, files in camera_folders(path, ".json", images).items():
        for file in files:
            number = image_of(file, camera, images)
            numbers.append(number)
            people = load_json(file).get("people")
            if not isinstance(people, list):
                raise EvaluationError("a list of people is needed", path=file, key="people")
            for index, person in enumerate(people):
                keypoints = _keypoints(person, images, file, f"people[{index}].pose_keypoints_2d")
                if keypoints.any():
                    results.append(
                        {
                            "image_id": number,
                            "category_id": _PERSON,
                            "keypoints": keypoints.ravel().tolist(),
                            "score": float(keypoints[:, 2].mean()),
                        }
                    )
    return Detections2D(results, frozenset(numbers), str(path))


def _keypoints(person: Any, images: ImageNumbers, path: Path, key: str) -> Any:
    """Keypoints (K, 3): x, y, confidence; zeros where the confidence is 0."""
    values = person.get("pose_keypoints_2d") if isinstance(person, dict) else None
    count = len(images.keypoints)
    try:
        points = np.array(values, dtype=float)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.shape != (3 * count,):
        raise EvaluationError(
            f"{points.size} numbers, but {3 * count} for {images.keypoints.name}: x, y, confidence of each "
            "point; another set is chosen with --keypoints",
            path=path,
            key=key,
        )
    points = points.reshape(-1, 3)
    if not np.isfinite(points).all():
        raise EvaluationError("a number is not finite", path=path, key=key)
    points[points[:, 2] <= 0] = 0.0
    return points
