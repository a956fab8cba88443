"""Label images: one for each camera and frame, with a number for each person and object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.images import Detections2D
from humansim_ros.evaluate.readers.coco_results import encoded_mask
from humansim_ros.evaluate.readers.image_options import ImageNumbers, camera_folders, image_of
from humansim_ros.io.files import read_bytes
from humansim_ros.io.images import MAX_IMAGE_BYTES, declared_size


def read_label_images(path: Path, images: ImageNumbers) -> Detections2D:
    """Read a folder of label images (PNG, 8 or 16 bit) for each camera; 0 is nobody.

    Raises EvaluationError.
    """
    results: list[dict[str, Any]] = []
    numbers: list[int] = []
    for camera, files in camera_folders(path, ".png", images).items():
        for file in files:
            number = image_of(file, camera, images)
            numbers.append(number)
            labels = _labels(file, images.size(number))
            for label in np.unique(labels[labels > 0]).tolist():
                results.append(
                    {"image_id": number, "segmentation": encoded_mask(labels == label), "score": 1.0}
                )
    return Detections2D(results, frozenset(numbers), str(path))


def _labels(path: Path, size: tuple[int, int] | None) -> NDArray[Any]:
    """Labels (H, W) of a file; its size is checked before it is decoded."""
    data = read_bytes(path, EvaluationError, "label image", MAX_IMAGE_BYTES)
    declared = declared_size(data)
    if declared is None:
        raise EvaluationError("this is no PNG image", path=path)
    if declared != size:
        own, known = ("x".join(map(str, each or ())) for each in (declared, size))
        raise EvaluationError(f"its size is {own}, but that of the image {known}", path=path)
    labels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if labels is None or labels.ndim != 2:
        reason = "it is damaged" if labels is None else "it has colours; a label image has one channel"
        raise EvaluationError(f"no label image: {reason}", path=path)
    return np.asarray(labels)
