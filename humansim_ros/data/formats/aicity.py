"""Upright boxes of people over all cameras, in the format of track 1 of the AI City Challenge [Tang 2025].

The layout is that of ``MTMC_Tracking_2025``; ``ground_truth.txt`` has the lines of a result file. Pixels are
measured from the corner of the image, and the camera matrices fit such pixels.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.writer import (
    FROM_CORNER,
    ExportFolder,
    ExportFrame,
    ExportSettings,
    FormatWriter,
    Record,
    corner_matrix,
    warn_of_lenses,
)
from humansim_ros.errors import ExportError

#: Classes of the challenge in the order of their numbers.
CLASSES = ("Person", "Forklift", "NovaCarter", "Transporter", "FourierGR1T2", "AgilityDigit")
#: Columns of a line of a result file.
COLUMNS = (
    *("scene_id", "class_id", "object_id", "frame_id"),
    *("x", "y", "z", "width", "length", "height", "yaw"),
)
#: Ground truth in the lines of a result file.
TRUTH_FILE = "ground_truth.txt"
#: Keys of the 3D box in ``ground_truth.json``, in the order of the columns of a line.
_NUMBERS = ("location", "bounding box scale", "bounding box rotation")
#: Number of the scene in an export. An export has one scene.
_SCENE = 0


class AiCityWriter(FormatWriter):
    """Writes ``ground_truth.json``, ``calibration.json`` and ``ground_truth.txt``.

    Width is the size along the x axis of the box and length the size along its y axis, as the challenge
    defines them; x is the direction that the hips face.

    ``settings``: settings of the export.

    Raises:
        ExportError: A camera moves, but the files hold only one pose of each camera.
    """

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        if moving := [name for name, known in settings.scene.cameras.items() if known.moves]:
            text = f"camera {moving[0]} moves, and calibration.json of aicity has one pose of a camera"
            raise ExportError(text, key="--format")

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Return the boxes of the people as entries of ``ground_truth.json``."""
        return [
            {
                "object type": CLASSES[0],
                "object name": name,
                "object id": self.settings.scene.labels[name],
                "3d location": (box := state.upright_box).center,
                "3d bounding box scale": box.size,
                "3d bounding box rotation": [0.0, 0.0, box.yaw],
                "2d bounding box visible": {
                    camera: truth.boxes[name].visible + FROM_CORNER
                    for camera, truth in frame.frame.truth.items()
                    if truth.boxes[name].pixels
                },
            }
            for name, state in frame.frame.humans.items()
        ]

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the three files from the boxes of all frames."""
        cameras = self.settings.scene.cameras
        frames = dict(records)
        lenses = {name: known.camera for name, known in cameras.items()}
        warn_of_lenses("AI City", lenses, has_skew=True)
        folder.write("ground_truth.json", json.dumps({str(index): frames[index] for index in frames}))
        lines = []
        for index, people in frames.items():
            for person in people:
                place, size, turn = (person[f"3d {key}"] for key in _NUMBERS)
                numbers = " ".join(f"{value:.6f}" for value in (*place, *size, turn[2]))
                lines.append(f"{_SCENE} 0 {person['object id']} {index} {numbers}\n")
        folder.write(TRUTH_FILE, "".join(lines))
        sensors = [sensor(name, known.camera, self.settings.rate_of(name)) for name, known in cameras.items()]
        content = {"calibrationType": "cartesian", "sensors": sensors}
        folder.write("calibration.json", json.dumps(content, indent=1) + "\n")


def sensor(name: str, camera: Camera, rate: float) -> dict[str, Any]:
    """Entry of a camera in ``calibration.json``. ``rate``: images per second."""
    intrinsic = corner_matrix(camera)
    extrinsic = np.column_stack([camera.R, camera.t])
    matrix = intrinsic @ extrinsic
    floor = matrix[:, [0, 1, 3]]  # pixels of points of the floor
    width, height = camera.size
    attributes = {"fps": f"{rate:g}", "frameWidth": str(width), "frameHeight": str(height)}
    return {
        "type": "camera",
        "id": name,
        "coordinates": {"x": float(camera.center[0]), "y": float(camera.center[1])},
        "scaleFactor": 1.0,
        "translationToGlobalCoordinates": {"x": 0.0, "y": 0.0},
        "attributes": [{"name": key, "value": value} for key, value in attributes.items()],
        "intrinsicMatrix": intrinsic.tolist(),
        "extrinsicMatrix": extrinsic.tolist(),
        "cameraMatrix": matrix.tolist(),
        "homography": (floor / floor[2, 2] if abs(floor[2, 2]) > 1e-9 else floor).tolist(),
    }
