"""MOTChallenge: for each camera a sequence with ``gt/gt.txt``, ``seqinfo.ini``, calibration [Dendorfer 2021].

Numbers of frames, identities and pixels count from 1. A box is that of the whole person, also where it is
hidden or outside of the image; the last column is the visible share of it. A person has the same identity in
all cameras. The format has no keypoints.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from humansim_ros.camera import write_calibration
from humansim_ros.export.folder import ExportFolder
from humansim_ros.export.writer import ExportFrame, FormatWriter, Record

#: Pedestrian, the only class that is evaluated.
_PEDESTRIAN = 1
#: From pixels whose first has its centre at 0 to pixels whose first begins at 1.
_FROM_CORNER = 1.5


class MotWriter(FormatWriter):
    """Tracks of people."""

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
        """Write the sequences, with links to their images."""
        scene, settings = self.settings.scene, self.settings
        lines: dict[str, list[str]] = {camera: [] for camera in settings.cameras}
        for number, (_, rows) in enumerate(records, 1):
            for camera, boxes in rows.items():
                lines[camera] += [_line(number, box) for box in boxes]
        for name, known in scene.cameras.items():
            camera, sequence = known.camera, folder.subfolder(name)
            sequence.write("gt/gt.txt", "".join(lines[name]))
            sequence.write("seqinfo.ini", self._sequence_info(name, camera.size))
            with sequence.path("calibration.yaml") as path:
                write_calibration(path, {name: camera}, "scene")
            for number, index in enumerate(settings.frames, 1):
                sequence.link(f"img1/{number:06d}{settings.image_suffix}", settings.image(name, index))
        folder.write("seqmap.txt", "\n".join(["name", *scene.cameras]) + "\n")

    def _sequence_info(self, name: str, size: tuple[int, int]) -> str:
        values = {
            "name": name,
            "imDir": "img1",
            "frameRate": f"{self.settings.rate:g}",
            "seqLength": len(self.settings.frames),
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
