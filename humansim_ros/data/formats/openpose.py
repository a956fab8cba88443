"""2D keypoints as OpenPose writes them, one JSON file per image, in the folders of a Pose2Sim project."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.formats import write_calibration
from humansim_ros.data.formats.markup import document
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, ExportSettings, FormatWriter, Record
from humansim_ros.errors import ExportError, HumansimError, HumansimWarning
from humansim_ros.files.reading import ANY_SIZE, read_text
from humansim_ros.people.keypoints import KeypointSet, keypoint_set
from humansim_ros.scene.truth import OCCLUDED, VISIBLE
from humansim_ros.types import Array


def calibration_text(settings: ExportSettings, format: str, cameras: Sequence[str] | None = None) -> str:
    """Text of the calibration file of the cameras of a scene.

    ``format``: name of a calibration format with one file for all cameras (docs/cameras.md). ``cameras``:
    names of cameras in the order of the file; all by default.

    Raises:
        ExportError: A camera moves, or the format cannot store its lens.
    """
    known = settings.scene.cameras
    names = list(known) if cameras is None else cameras
    if moving := [name for name in names if known[name].moves]:
        raise ExportError(f"the camera {moving[0]} moves: this file is for fixed cameras only", key=format)
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)  # of values that the format never has
        path = Path(folder) / "calibration"
        try:
            write_calibration(path, {name: known[name].camera for name in names}, format)
        except HumansimError as error:
            raise ExportError(error.message, key=f"{format}: {error.key}" if error.key else format) from None
        return read_text(path, ExportError, "calibration", ANY_SIZE)


class AniposeWriter(FormatWriter):
    """Writes ``calibration.toml`` of Anipose and aniposelib, in metres."""

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        self._calibration = calibration_text(settings, "anipose")

    def finish(self, records: object, folder: ExportFolder) -> None:
        folder.write("calibration.toml", self._calibration)


#: Confidence of a visible keypoint, and of an occluded keypoint. It is not 0, which readers take for "not
#: found".
VISIBLE_CONFIDENCE, OCCLUDED_CONFIDENCE = 1.0, 0.5
#: Keypoint sets that Pose2Sim knows, and its names of them.
POSE2SIM_MODELS = {"body25": "BODY_25", "openpose137": "BODY_25", "coco17": "COCO_17", "halpe26": "HALPE_26"}


def openpose_keypoints(pixels: Array, visible: NDArray[np.uint8]) -> Array:
    """Convert pixels (K, 2) and visibility (K,) to rows x, y, confidence (K, 3); zeros outside the image."""
    confidence = np.where(visible == VISIBLE, VISIBLE_CONFIDENCE, 0.0)
    confidence[visible == OCCLUDED] = OCCLUDED_CONFIDENCE
    found = confidence > 0
    return np.where(found[:, None], np.column_stack([np.nan_to_num(pixels), confidence]), 0.0)


def openpose_text(people: Sequence[Array], keypoints: KeypointSet) -> str:
    """Text of the OpenPose file of one image.

    The file lists all people in the given order. People out of sight have zeros, so that entry n is the same
    person in all files. ``person_id`` counts from 1.

    Args:
        people: Keypoints (K, 3) of each person, from :func:`openpose_keypoints`.
        keypoints: Set of the keypoints. In ``openpose137``, the face and each hand have fields of their own.
    """
    entries = [
        {
            "person_id": [number],
            **{
                f"{field}_keypoints_2d": np.round(points[list(own)], 6).ravel().tolist()
                for field, own in keypoints.openpose_fields.items()
            },
            **{f"{field}_keypoints_3d": [] for field in keypoints.openpose_fields},
        }
        for number, points in enumerate(people, 1)
    ]
    return json.dumps({"version": 1.3, "people": entries})


def openpose_file(camera: str, frame: int) -> str:
    """Path of the file of an image in a Pose2Sim project, such as
    ``pose/camera_1_json/camera_1_000000000012_keypoints.json``.
    """
    return f"pose/{camera}_json/{camera}_{frame:012d}_keypoints.json"


def pose2sim_order(cameras: Iterable[str]) -> list[str]:
    """Sort cameras as Pose2Sim sorts their folders: by the last number in the name, then names without
    number.

    Pose2Sim takes calibrations in the order of ``Calib.toml``, so the file needs this order.

    Example:
        >>> pose2sim_order(["camera_10", "left", "camera_2"])
        ['camera_2', 'camera_10', 'left']
    """

    def key(name: str) -> tuple[bool, int, str]:
        numbers = re.findall(r"\d+", name)
        return (False, int(numbers[-1]), "") if numbers else (True, 0, name)

    return sorted(cameras, key=key)


class OpenPoseWriter(FormatWriter):
    """Writes a project of Pose2Sim: keypoints of all cameras in OpenPose's format, ``calibration/Calib.toml``
    and ``Config.toml``. With this configuration, ``Pose2Sim.triangulation()`` runs."""

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        for name in settings.cameras:
            if len(settings.frames_of(name)) < len(settings.frames):
                raise ExportError(
                    f"camera {name} has images at {settings.rate_of(name):g} Hz only, and Pose2Sim needs an "
                    "image of every camera in each frame: export the scene without rates of its cameras",
                    key="openpose",
                )
        self._cameras = pose2sim_order(settings.cameras)
        self._calibration = calibration_text(settings, "anipose", self._cameras)

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        keypoints = keypoint_set(self.settings.keypoints)
        views = frame.frame.keypoints[keypoints.name]
        for camera, people in views.items():
            rows = [openpose_keypoints(person.pixels, person.visible) for person in people.values()]
            folder.write(openpose_file(camera, frame.index), openpose_text(rows, keypoints))

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the calibration and the configuration."""
        folder.write("calibration/Calib.toml", self._calibration)
        settings, cameras = self.settings, self.settings.scene.cameras.values()
        text = document(
            "pose2sim.toml",
            several=len(settings.scene.people) > 1,
            rate=round(settings.rate),
            frames=settings.frames,
            model=POSE2SIM_MODELS.get(settings.keypoints),
            names=keypoint_set(settings.keypoints).names,
            distorted=any(camera.camera.distorted for camera in cameras),
        )
        folder.write("Config.toml", text)
