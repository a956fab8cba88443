"""Positions of points in ``map``: TRC and C3D of motion capture, JSON of CMU Panoptic and Human3.6M."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.formats import H36M, PANOPTIC, Z_UP_FROM_FILE, CalibrationFormat
from humansim_ros.data.formats.openpose import calibration_text
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, ExportSettings, FormatWriter, Record
from humansim_ros.geometry import WORLD_FROM_BODY
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.types import Array

_MILLIMETRES = 1000.0
#: Most names in one parameter of a C3D file, since the number of names is stored in a byte.
_C3D_LABELS = 255


@dataclass(frozen=True)
class MarkerPaths:
    """Paths of K points (keypoints or markers) of one person over F frames.

    Attributes:
        names: K names, all different.
        positions: (F, K, 3) in ``map``, metres; NaN where a point is missing.
        rate: Frames per second.
        first_frame: Number of the first frame in its scene, from 0. Its time is ``first_frame / rate``.
    """

    names: tuple[str, ...]
    positions: Array
    rate: float
    first_frame: int = 0

    @property
    def missing(self) -> NDArray[np.bool_]:
        """(F, K) bool: points without a position."""
        return np.asarray(~np.isfinite(self.positions).all(axis=-1))


def trc_text(paths: MarkerPaths, name: str) -> str:
    """Text of a TRC file, as OpenSim, Pose2Sim and OpenCap read it: metres, y up.

    The axes are those of OpenSim and of body space: x_trc = y_map, y_trc = z_map, z_trc = x_map. A missing
    point has three empty fields. Frames count from 1, times are seconds from the start of the scene.
    ``name``: name of the file, which is in its first line.
    """
    return "".join(f"{line}\n" for line in _trc_lines(name, paths))


def _trc_lines(name: str, paths: MarkerPaths) -> Iterator[str]:
    frames, points = paths.positions.shape[:2]
    first, rate = paths.first_frame + 1, f"{paths.rate:.10g}"
    yield f"PathFileType\t4\t(X/Y/Z)\t{name}"
    header = {
        "DataRate": rate,
        "CameraRate": rate,
        "NumFrames": frames,
        "NumMarkers": points,
        "Units": "m",
        "OrigDataRate": rate,
        "OrigDataStartFrame": first,
        "OrigNumFrames": frames,
    }
    yield "\t".join(header)
    yield "\t".join(str(value) for value in header.values())
    yield "Frame#\tTime\t" + "\t\t\t".join(paths.names) + "\t\t"
    yield "\t\t" + "\t".join(f"X{point}\tY{point}\tZ{point}" for point in range(1, points + 1))
    yield ""
    rows = (paths.positions @ WORLD_FROM_BODY).tolist()
    missing = paths.missing.tolist()
    for index, (row, gaps) in enumerate(zip(rows, missing, strict=True)):
        fields = [
            "\t\t" if gap else "\t".join(f"{value:.6f}" for value in point)
            for point, gap in zip(row, gaps, strict=True)
        ]
        frame = paths.first_frame + index
        yield "\t".join([str(frame + 1), f"{frame / paths.rate:.6f}", *fields])


def c3d_bytes(paths: MarkerPaths) -> bytes:
    """Content of a C3D file (32 bit floats): millimetres, the axes of ``map`` (z up).

    A missing point has the residual -1. Frames count as in the scene, from 1. Names after the 255th are in
    ``POINT:LABELS2``, ``LABELS3`` and so on. Needs the package c3d.
    """
    import c3d  # of an extra

    writer = c3d.Writer(point_rate=paths.rate, point_units="mm")
    parts = [paths.names[first : first + _C3D_LABELS] for first in range(0, len(paths.names), _C3D_LABELS)]
    for number, part in enumerate(parts, 1):
        suffix, width = "" if number == 1 else str(number), max(map(len, part))  # all have the same length
        labels = "".join(name.ljust(width) for name in part)
        writer.point_group.add_str(f"LABELS{suffix}", "Point labels.", labels, width, len(part))
        blank = " " * len(part)
        writer.point_group.add_str(f"DESCRIPTIONS{suffix}", "Point descriptions.", blank, 1, len(part))
    writer.set_screen_axis("+X", "+Z")
    writer.set_start_frame(paths.first_frame + 1)
    # x, y, z, residual, cameras
    rows = np.zeros((*paths.positions.shape[:2], 5), dtype=np.float32)
    rows[..., :3] = np.where(paths.missing[..., None], 0.0, paths.positions * _MILLIMETRES)
    rows[..., 3] = np.where(paths.missing, -1.0, 0.0)
    no_analog = np.zeros((0, 0), dtype=np.float32)
    writer.add_frames([(row, no_analog) for row in rows])
    content = BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # there is no analog data
        writer.write(content)
    return content.getvalue()


class _MarkerWriter(FormatWriter):
    """Base class of writers that need the keypoints of each person over all frames."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Positions of the keypoints by person."""
        return frame.frame.keypoint_positions[self.settings.keypoints]

    def people(self, records: Iterable[tuple[int, Record]]) -> dict[str, MarkerPaths]:
        """Paths of the keypoints of each person."""
        positions: dict[str, list[Array]] = {}
        for _, people in records:
            for person, points in people.items():
                positions.setdefault(person, []).append(np.asarray(points, dtype=float))
        names = keypoint_set(self.settings.keypoints).names
        rate, first = self.settings.rate, self.settings.frames.start
        return {
            person: MarkerPaths(names, np.array(points), rate, first) for person, points in positions.items()
        }


class TrcWriter(_MarkerWriter):
    """Writes a TRC file for each person."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        for person, paths in self.people(records).items():
            folder.write(f"{person}.trc", trc_text(paths, f"{person}.trc"))


class C3dWriter(_MarkerWriter):
    """Writes a C3D file for each person."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        for person, paths in self.people(records).items():
            folder.write(f"{person}.c3d", c3d_bytes(paths))


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
    """Convert positions (..., 3) to the unit and axes of the calibration files of a format."""
    return positions @ Z_UP_FROM_FILE[format.up] / format.unit


class PanopticWriter(FormatWriter):
    """Writes a sequence of CMU Panoptic: a file of 19 joints for each frame, and the calibration."""

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        self._calibration = calibration_text(settings, PANOPTIC.name)

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the file of the frame."""
        people = frame.frame.keypoint_positions["panoptic19"].values()
        text = panoptic_text(dict(enumerate(people)), frame.frame.scene_time * 1e-9)
        folder.write(f"{PANOPTIC_JOINTS}/body3DScene_{frame.index:08d}.json", text)

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        folder.write("calibration_panoptic.json", self._calibration)


class Human36mWriter(FormatWriter):
    """Writes files of Human3.6M: 17 joints of each person, who becomes a subject, and the cameras."""

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
