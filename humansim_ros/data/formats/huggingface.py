"""Metadata of the ``imagefolder`` of Hugging Face ``datasets``: a line of JSON for each image.

``load_dataset`` reads the lines together with the images, which may be in any folder below the file
(https://huggingface.co/docs/datasets/image_dataset). Boxes and keypoints are the same as in :mod:`coco`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

from humansim_ros.data.formats.coco import image_entry, person_keypoints
from humansim_ros.data.formats.webdataset import box_entry
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, FormatWriter, Record

#: Name of the file, in the root of the export.
METADATA = "metadata.jsonl"


class MetadataWriter(FormatWriter):
    """Writes a line for each image: file, camera and people. People without visible pixels are left out."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Return the lines of the images of a frame."""
        lines = []
        for camera, truth in frame.frame.truth.items():
            keypoints = frame.frame.keypoints[self.settings.keypoints][camera]
            people = [name for name in self.settings.scene.people if truth.boxes[name].pixels]
            boxes = [box_entry(truth.boxes[name]) for name in people]
            configs = self.settings.scene.configs
            lines.append(
                {
                    "file_name": frame.image(camera),
                    "scene": self.settings.scene.title,
                    **image_entry(frame, camera),
                    "objects": {
                        "name": people,
                        "body": [str(configs[name].body) if name in configs else "" for name in people],
                        "bbox": [box["bbox"] for box in boxes],
                        "category": [0] * len(people),
                        "area": [box["area"] for box in boxes],
                        "visible_fraction": [box["visible_fraction"] for box in boxes],
                        "keypoints": [person_keypoints(keypoints[name])["keypoints"] for name in people],
                    },
                }
            )
        return lines

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the lines of all frames to the file."""
        with folder.root_folder().path(METADATA) as path, path.open("w", encoding="utf-8") as file:
            for _, lines in records:
                file.writelines(json.dumps(line) + "\n" for line in lines)
