"""Sweeps of laser scanners with boxes of people, as the 3D benchmark of KITTI has them [Geiger 2012].

Labels of points are those of SemanticKITTI [Behley 2019].
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.errors import ExportError
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.scene.features import Sweep
from humansim_ros.scene.truth import BodyBox, UprightBox
from humansim_ros.types import Array

#: Smallest visible shares of people who are fully visible, and partly occluded. Others are largely occluded.
_VISIBLE, _PARTLY = 0.9, 0.5
_UP = np.array([0.0, 0.0, 1.0])
#: Class numbers of points in SemanticKITTI: a moving person, a standing person, another labelled object.
_MOVING_PERSON, _PERSON, _OBJECT = 254, 30, 99
#: A person moves if the speed of the hips is above this, m/s.
MOVING_SPEED = 0.1


class KittiWriter(FormatWriter):
    """Writes ``<scanner>/velodyne`` and ``labels``, and by camera ``image_2``, ``calib`` and ``label_2``.

    Each file belongs to the frame at which a sweep ends, or to the first frame after it. Labels are those of
    this frame. Cameras may have their own rates, so the list of frames has only those with images of all
    cameras. KITTI's boxes are upright in the frame of the rectified camera. Here this frame is levelled: z is
    horizontal and y down, so that boxes are exact also for cameras that look down. ``R0_rect`` turns from the
    camera to this frame, and ``P2`` turns back.
    """

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the files of the sweeps that end with a frame. Returns the names of their scanners."""
        name, ended = frame.name, {key: sweeps[-1] for key, sweeps in frame.frame.sweeps.items() if sweeps}
        for scanner, sweep in ended.items():
            cloud = np.column_stack([sweep.points, np.minimum(sweep.returns.intensities, 1.0)])
            folder.write(f"{scanner}/velodyne/{name}.bin", cloud.astype("<f4").tobytes())
            folder.write(f"{scanner}/labels/{name}.label", self._point_labels(frame, sweep).tobytes())
            for camera, posed in frame.frame.cameras.items():
                root = f"{scanner}/{camera}"
                folder.write(f"{root}/calib/{name}.txt", calibration_text(posed, sweep))
                folder.write(f"{root}/label_2/{name}.txt", self._labels(frame, camera, posed))
        return list(ended)

    def _point_labels(self, frame: ExportFrame, sweep: Sweep) -> NDArray[np.uint32]:
        """Label of each point: instance label << 16 | class."""
        people = {
            name: _MOVING_PERSON if state.speed > MOVING_SPEED else _PERSON
            for name, state in frame.frame.humans.items()
        }
        classes = point_classes(self.settings.scene.labels, sweep, people, _OBJECT)
        return np.asarray(sweep.instances.astype("<u4") << 16 | classes, dtype="<u4")

    def _labels(self, frame: ExportFrame, camera: str, posed: Camera) -> str:
        boxes = frame.frame.truth[camera].boxes
        return "".join(
            label_line(state.upright_box, boxes[name], posed)
            for name, state in frame.frame.humans.items()
            if boxes[name].truncation < 1 and boxes[name].pixels
        )

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Link the images, and list the frames. Raises ExportError if no sweep has ended."""
        frames: dict[str, list[int]] = {}
        cameras = self.settings.scene.cameras.values()
        for index, scanners in records:
            for scanner in scanners if all(index in known.frames for known in cameras) else ():
                frames.setdefault(scanner, []).append(index)
        if not frames:
            text = "no sweep of a scanner ends within these frames, at a frame with pictures of all cameras"
            raise ExportError(text, key="--frames")
        for scanner, indices in frames.items():
            lines = "".join(f"{index:06d}\n" for index in indices)
            folder.write(f"{scanner}/ImageSets/trainval.txt", lines)
            for camera in self.settings.cameras:
                for index in indices:
                    link = f"{scanner}/{camera}/image_2/{index:06d}{self.settings.image_suffix}"
                    folder.link(link, self.settings.image(camera, index))


def point_classes(
    labels: Mapping[str, int], sweep: Sweep, people: Mapping[str, int], other: int
) -> NDArray[np.uint32]:
    """Class (N,) of each point of a sweep; 0 where nothing has a label.

    Args:
        labels: Instance labels by name.
        sweep: The sweep.
        people: Class of each person by name.
        other: Class of the other things that have a label.
    """
    classes = np.zeros(1 << 16, np.uint32)
    for name, label in labels.items():
        classes[label] = people.get(name, other)
    return np.asarray(classes[sweep.instances])


def levelled(camera: Camera) -> Array:
    """Rotation (3, 3) from ``map`` to the levelled camera: z in the horizontal direction of view, y down."""
    forward = camera.R[2] * (1, 1, 0)
    if np.linalg.norm(forward) < 1e-6:  # it looks straight down or up
        forward = camera.R[1] * (-1, -1, 0) * np.sign(-camera.R[2, 2])
    forward = forward / np.linalg.norm(forward)
    return np.stack([np.cross(forward, _UP), -_UP, forward])


def calibration_text(camera: Camera, sweep: Sweep) -> str:
    """Text of ``calib``. A point x of the scanner is at the pixel P2 R0_rect Tr_velo_to_cam x."""
    level = levelled(camera)
    rectify = level @ camera.R.T
    projection = np.column_stack([camera.K @ rectify.T, np.zeros(3)])
    turn = quaternion_to_matrix(sweep.rotation)
    to_camera = np.column_stack([camera.R @ turn, camera.R @ sweep.position + camera.t])
    rows = {
        **{f"P{number}": projection for number in range(4)},
        "R0_rect": rectify,
        "Tr_velo_to_cam": to_camera,
        "Tr_imu_to_velo": np.eye(4)[:3],
    }
    return "".join(
        f"{name}: {' '.join(f'{value:.12e}' for value in matrix.ravel())}\n" for name, matrix in rows.items()
    )


def label_line(box: UprightBox, seen: BodyBox, camera: Camera) -> str:
    """Line of ``label_2`` for a person.

    Args:
        box: Box of the body.
        seen: Box in the image.
        camera: The camera at its pose.
    """
    length, width, height = box.size
    level = levelled(camera)
    x, y, z = level @ (box.bottom - camera.center)
    ahead = level @ (np.cos(box.yaw), np.sin(box.yaw), 0.0)
    # about y, which points down, from x towards -z
    rotation = float(np.arctan2(-ahead[2], ahead[0]))
    alpha = float(np.mod(rotation - np.arctan2(x, z) + np.pi, 2 * np.pi) - np.pi)
    columns, rows = camera.size
    left, top, right, bottom = np.clip(seen.whole, 0, [columns - 1, rows - 1] * 2)
    occluded = 0 if seen.visible_fraction >= _VISIBLE else 1 if seen.visible_fraction >= _PARTLY else 2
    numbers = (alpha, left, top, right, bottom, height, width, length, x, y, z, rotation)
    words = [f"{seen.truncation:.2f}", str(occluded), *(f"{number:.4f}" for number in numbers)]
    return f"Pedestrian {' '.join(words)}\n"
