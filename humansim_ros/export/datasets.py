"""3D poses in the formats of public data sets: CMU Panoptic and Human3.6M."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

import numpy as np

from humansim_ros.camera.calibration import Z_UP_FROM_FILE
from humansim_ros.camera.formats import CalibrationFormat
from humansim_ros.camera.formats.datasets import H36M, PANOPTIC
from humansim_ros.export.calibrations import calibration_text
from humansim_ros.export.folder import ExportFolder
from humansim_ros.export.writer import ExportFrame, ExportSettings, FormatWriter, Record
from humansim_ros.types import Array

#: Folder of the joints in a sequence of CMU Panoptic.
PANOPTIC_JOINTS = "hdPose3d_stage1_coco19"


def panoptic_text(people: Mapping[int, Array], seconds: float) -> str:
    """Text of the file of one frame, ``body3DScene_<frame>.json`` of CMU Panoptic: centimetres, y down.

    The score of a point is 1, or -1 where it is missing. ``people``: positions (K, 3) in ``map`` by number of
    the person. ``seconds``: time of the frame from the start of the scene.
    """
    bodies = []
    for number, positions in people.items():
        in_file = _in_file(positions, PANOPTIC)
        found = np.isfinite(in_file).all(axis=-1, keepdims=True)
        rows = np.where(found, np.hstack([in_file, np.ones((len(in_file), 1))]), (0.0, 0.0, 0.0, -1.0))
        bodies.append({"id": number, f"joints{len(rows)}": np.round(rows, 6).ravel().tolist()})
    data = {"version": 0.7, "univTime": round(seconds * 1000, 3), "fpsType": "hd_29_97", "bodies": bodies}
    return json.dumps(data, allow_nan=False)


def human36m_text(positions: Array, first_frame: int = 0) -> str:
    """Text of the file of one person, ``Human36M_subject<n>_joint_3d.json``: frames by action and subaction.

    This is the layout of 3DMPPE and of the projects that build on it: millimetres, the axes of ``map``.
    Human3.6M has one person in a sequence; here each person of a scene is a subject, with action 1 and
    subaction 1.

    ``positions``: (F, K, 3) in ``map``, metres; ``null`` in the file where a point is missing.
    ``first_frame``: number of the first frame in its scene.
    """
    in_file = np.round(_in_file(positions, H36M), 6)
    frames = {
        str(first_frame + index): [
            point if np.isfinite(point).all() else [None] * 3 for point in frame.tolist()
        ]
        for index, frame in enumerate(in_file)
    }
    return json.dumps({"1": {"1": frames}}, allow_nan=False)


def _in_file(positions: Array, format: CalibrationFormat) -> Array:
    """Positions (..., 3) in the unit and axes of the calibration files of a format."""
    return positions @ Z_UP_FROM_FILE[format.up] / format.unit


class PanopticWriter(FormatWriter):
    """A sequence of CMU Panoptic: a file of 19 joints for each frame, and the calibration."""

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        self._calibration = calibration_text(settings, PANOPTIC.name)

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the file of the frame."""
        people = frame.frame.keypoint_positions["panoptic19"].values()
        text = panoptic_text(dict(enumerate(people)), frame.frame.scene_time * 1e-9)
        folder.write(f"{PANOPTIC_JOINTS}/body3DScene_{frame.index:08d}.json", text)

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the calibration."""
        folder.write("calibration_panoptic.json", self._calibration)


class Human36mWriter(FormatWriter):
    """Human3.6M: 17 joints of each person as a subject, and the cameras."""

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        self._calibration = calibration_text(settings, H36M.name)

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Positions of the joints of each person."""
        return list(frame.frame.keypoint_positions["h36m17"].values())

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the joints and the cameras."""
        folder.write("camera-parameters.json", self._calibration)
        by_person = zip(*(people for _, people in records), strict=True)
        for number, positions in enumerate(by_person, 1):
            text = human36m_text(np.array(positions, dtype=float), self.settings.frames.start)
            folder.write(f"Human36M_subject{number}_joint_3d.json", text)
