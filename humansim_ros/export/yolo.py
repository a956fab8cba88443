"""YOLO-pose: a text file of people for each image, and ``dataset.yaml``, as Ultralytics reads them.

A line has the class (0), the box of the visible pixels (centre, width, height) and the keypoints (x, y, v),
all as shares of the image. Programs find the labels of ``images/…`` in ``labels/…`` beside it: therefore
``images`` is a link.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import yaml

from humansim_ros.export.folder import ExportFolder
from humansim_ros.export.writer import ExportFrame, FormatWriter, Record
from humansim_ros.keypoints.sets import keypoint_set
from humansim_ros.truth import OUTSIDE, BodyBox, KeypointView

_SIDES = {"left": "right", "right": "left", "l": "r", "r": "l"}


class YoloWriter(FormatWriter):
    """Labels of people with keypoints."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write a file for each camera; it is empty where nobody is seen."""
        for camera, truth in frame.frame.truth.items():
            keypoints = frame.frame.keypoints[self.settings.keypoints][camera]
            size = frame.frame.cameras[camera].size
            lines = [
                label_line(truth.boxes[name], view, size)
                for name, view in keypoints.items()
                if truth.boxes[name].pixels
            ]
            folder.write(f"labels/{camera}/{frame.name}.txt", "".join(lines))

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write ``dataset.yaml``, the list of the images, and the link to them."""
        settings = self.settings
        keypoints = keypoint_set(settings.keypoints)
        images = [settings.image(camera, index) for camera in settings.cameras for index in settings.frames]
        folder.write("train.txt", "".join(f"./{image}\n" for image in images))
        dataset = {
            "train": "train.txt",
            "val": "train.txt",
            "names": {0: "person"},
            "kpt_shape": [len(keypoints), 3],
            "flip_idx": mirrored(keypoints.points),
        }
        folder.write("dataset.yaml", yaml.safe_dump(dataset, sort_keys=False))
        folder.link("images", "images")


def label_line(box: BodyBox, view: KeypointView, size: tuple[int, int]) -> str:
    """Line of a person. ``size``: width and height of the image in pixels."""
    scale = np.array(size, dtype=float)
    low, high = (box.visible.reshape(2, 2) + 0.5) / scale
    inside = (view.visible != OUTSIDE)[:, None]
    points = np.where(inside, np.column_stack([(view.pixels + 0.5) / scale, view.visible]), 0.0)
    numbers = [*((low + high) / 2), *(high - low)]
    words = [f"{value:.6f}" for value in numbers]
    words += [word for x, y, v in points for word in (f"{x:.6f}", f"{y:.6f}", f"{v:.0f}")]
    return f"0 {' '.join(words)}\n"


def mirrored(points: Sequence[str]) -> list[int]:
    """Keypoint of the other side of each keypoint; one without sides is its own.

    Some markers are at different heights on both sides, such as on the upper arms: they belong together, too.

    ``points``: anatomical points of a keypoint set, such as ``l_knee`` and ``left_heel``.
    """
    numbers = {_stem(point): number for number, point in enumerate(points)}
    numbers |= {point: number for number, point in enumerate(points)}
    found = []
    for number, point in enumerate(points):
        side, _, rest = point.partition("_")
        other = f"{_SIDES[side]}_{rest}" if side in _SIDES else point
        found.append(numbers.get(other, numbers.get(_stem(other), number)))
    return found


def _stem(point: str) -> str:
    """A point of three words or more without its last word, which may be its height on the limb."""
    return point.rpartition("_")[0] if point.count("_") > 1 else point
