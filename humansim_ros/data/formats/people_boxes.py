"""Boxes of people in images: MOTChallenge [Dendorfer 2021] and YOLO-pose of Ultralytics."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import yaml

from humansim_ros.cameras.formats import write_calibration
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.scene.truth import OUTSIDE, BodyBox, KeypointView

#: Class of pedestrians, the only class that is evaluated.
_PEDESTRIAN = 1
#: Added to pixels of this package (centre of the first at 0), gives pixels of MOTChallenge (its border at 1).
_FROM_CORNER = 1.5


class MotWriter(FormatWriter):
    """Writes tracks of people: for each camera ``gt/gt.txt``, ``seqinfo.ini`` and the calibration.

    Numbers of images, identities and pixels count from 1. A box encloses the whole person, including parts
    that are hidden or outside the image. The last column is the visible share. A person has the same identity
    in all cameras. The format has no keypoints.
    """

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Boxes of the people by camera: identity, left, top, width, height, visible share."""
        scene = self.settings.scene
        rows: dict[str, list[list[float]]] = {}
        for camera, truth in frame.frame.truth.items():
            rows[camera] = []
            for name in scene.people:
                box = truth.boxes[name]
                if box.truncation >= 1:  # nothing of the box is in the image
                    continue
                left, top, right, bottom = box.whole.tolist()
                share = 0.0 if np.isnan(box.visible_fraction) else box.visible_fraction
                visible = share * (1 - box.truncation)
                place = [left + _FROM_CORNER, top + _FROM_CORNER, right - left, bottom - top]
                rows[camera].append([scene.labels[name], *place, visible])
        return rows

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write a sequence for each camera, with a link to its images."""
        scene, settings = self.settings.scene, self.settings
        lines: dict[str, list[str]] = {camera: [] for camera in settings.cameras}
        numbers = dict.fromkeys(settings.cameras, 0)
        for _, rows in records:
            for camera, boxes in rows.items():
                numbers[camera] += 1
                lines[camera] += [_line(numbers[camera], box) for box in boxes]
        for name, known in scene.cameras.items():
            camera, sequence = known.camera, folder.subfolder(name)
            sequence.write("gt/gt.txt", "".join(lines[name]))
            sequence.write("seqinfo.ini", self._sequence_info(name, camera.size))
            with sequence.path("calibration.yaml") as path:
                write_calibration(path, {name: camera}, "scene")
            for number, index in enumerate(settings.frames_of(name), 1):
                sequence.link(f"img1/{number:06d}{settings.image_suffix}", settings.image(name, index))
        folder.write("seqmap.txt", "\n".join(["name", *scene.cameras]) + "\n")

    def _sequence_info(self, name: str, size: tuple[int, int]) -> str:
        values = {
            "name": name,
            "imDir": "img1",
            "frameRate": f"{self.settings.rate_of(name):g}",
            "seqLength": len(self.settings.frames_of(name)),
            "imWidth": size[0],
            "imHeight": size[1],
            "imExt": self.settings.image_suffix,
        }
        return "[Sequence]\n" + "".join(f"{key}={value}\n" for key, value in values.items())


def _line(number: int, box: list[float]) -> str:
    """Line of gt.txt. ``box``: identity, left, top, width, height, visible share."""
    identity, left, top, width, height, visible = box
    place = f"{left:.3f},{top:.3f},{width:.3f},{height:.3f}"
    return f"{number},{identity:.0f},{place},1,{_PEDESTRIAN},{visible:.5f}\n"


class YoloWriter(FormatWriter):
    """Writes labels of people with keypoints. A line of a text file has the class (0), the box of the visible
    pixels (centre, width, height) and the keypoints (x, y, v), all as shares of the image. Programs find the
    labels of ``images/…`` in the folder ``labels/…`` next to it, so ``images`` is a link to the images."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write a file for each camera. It is empty if nobody is visible."""
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
        """Write ``dataset.yaml``, the list of the images, and the link to the folder of images."""
        settings = self.settings
        keypoints = keypoint_set(settings.keypoints)
        images = [
            settings.image(camera, index)
            for camera in settings.cameras
            for index in settings.frames_of(camera)
        ]
        folder.write("train.txt", "".join(f"./{image}\n" for image in images))
        dataset = {
            "train": "train.txt",
            "val": "train.txt",
            "names": {0: "person"},
            "kpt_shape": [len(keypoints), 3],
            "flip_idx": list(keypoints.mirrored),
        }
        folder.write("dataset.yaml", yaml.safe_dump(dataset, sort_keys=False))
        folder.link("images", "images")


def label_line(box: BodyBox, view: KeypointView, size: tuple[int, int]) -> str:
    """Line of a label file for a person. ``size``: width and height of the image in pixels."""
    scale = np.array(size, dtype=float)
    low, high = (box.visible.reshape(2, 2) + 0.5) / scale
    inside = (view.visible != OUTSIDE)[:, None]
    points = np.where(inside, np.column_stack([(view.pixels + 0.5) / scale, view.visible]), 0.0)
    numbers = [*((low + high) / 2), *(high - low)]
    words = [f"{value:.6f}" for value in numbers]
    words += [word for x, y, v in points for word in (f"{x:.6f}", f"{y:.6f}", f"{v:.0f}")]
    return f"0 {' '.join(words)}\n"
