"""Read detections in images of any known format."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.images import Detections2D
from humansim_ros.evaluate.readers.coco_results import read_coco_results
from humansim_ros.evaluate.readers.estimates import is_bag, split_topic
from humansim_ros.evaluate.readers.image_options import ImageNumbers
from humansim_ros.evaluate.readers.json_files import load_json
from humansim_ros.evaluate.readers.label_images import read_label_images
from humansim_ros.evaluate.readers.numbers import MAX_BYTES
from humansim_ros.evaluate.readers.openpose import read_openpose_2d
from humansim_ros.io.files import open_file, read_text

#: Files that are looked at to find the kind of a folder.
_LOOKED_AT = 200
#: Bytes of a file in which a list begins.
_BEGINNING = 64


def is_of_images(text: str) -> bool:
    """Whether an estimate is detections in images, not 3D poses: COCO results, label images, 2D OpenPose.

    Raises EvaluationError if a file cannot be read.
    """
    name, topic = split_topic(text)
    path = Path(name)
    if topic is not None or is_bag(path) or not path.exists():
        return False
    if path.is_dir():
        return _labels(path) or _has_2d_keypoints(path)
    if path.suffix.lower() != ".json":
        return False
    with open_file(path, EvaluationError, "JSON", MAX_BYTES) as file:
        return file.read(_BEGINNING).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"[")


def _labels(path: Path) -> bool:
    return any(any(path.glob(pattern)) for pattern in ("*.png", "*/*.png", "instance/*/*.png"))


def _has_2d_keypoints(path: Path) -> bool:
    """Whether a folder has files of OpenPose without 3D keypoints."""
    if any(path.glob("hdPose3d_*/*.json")):
        return False
    own = sorted(islice(path.glob("*.json"), _LOOKED_AT))
    files = own or sorted(
        islice((file for pattern in ("*/*.json", "pose/*/*.json") for file in path.glob(pattern)), _LOOKED_AT)
    )
    for file in files:
        people = load_json(file).get("people")
        if not isinstance(people, list):
            return False
        for person in people:
            return isinstance(person, dict) and not person.get("pose_keypoints_3d")
    return bool(files) and not own


def read_image_estimates(texts: Sequence[str], images: ImageNumbers) -> Detections2D:
    """Read detections in images; several files are one estimate, such as keypoints and masks.

    Raises:
        EvaluationError: A file is missing, of another kind, empty or damaged, or of images that the truth
            has not.
    """
    parts = [_read(Path(text), images) for text in texts]
    if len(parts) == 1:
        return parts[0]
    searched = [part.images for part in parts]
    known = [each for each in searched if each is not None]
    return Detections2D(
        [row for part in parts for row in part.results],
        frozenset().union(*known) if len(known) == len(parts) else None,
        ", ".join(part.source for part in parts),
    )


def _read(path: Path, images: ImageNumbers) -> Detections2D:
    if not is_of_images(str(path)):
        raise EvaluationError(
            "these are no detections in images, but another estimate is: evaluate them one after the other",
            path=path,
        )
    if path.is_dir():
        return read_label_images(path, images) if _labels(path) else read_openpose_2d(path, images)
    text = read_text(path, EvaluationError, "JSON", MAX_BYTES)
    try:
        rows = json.loads(text)
    except (ValueError, RecursionError) as reason:
        line = getattr(reason, "lineno", None)
        raise EvaluationError(f"not valid JSON: {reason}", path=path, line=line) from None
    return read_coco_results(path, rows, images)
