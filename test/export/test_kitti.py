"""KITTI: files read as its development kit describes them; points and boxes against the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_support import exported

from humansim_ros import Camera, Scene, Simulation
from humansim_ros.data.formats.kitti import levelled
from humansim_ros.errors import ExportError
from humansim_ros.scene.features.scanners.feature import Sweep
from humansim_ros.types import Array

CAMERAS: dict[str, Any] = {
    "level": {"size": [320, 240], "position": [3.5, 0.4, 1.2], "look_at": [0, 0.2, 1.2]},
    "above": {"size": [320, 240], "position": [2.2, 1.8, 2.4], "look_at": [0, 0, 0.7], "up": [0.3, 0, 1]},
}
SCENE: dict[str, Any] = {
    "rate": 20,
    "room": None,
    "humans": {"anna": {"body": "adult_woman", "motion": {"file": "walk", "yaw_deg": 70}}},
    "cameras": CAMERAS,
    "scanners": {
        "lidar": {
            "pattern": {"elevations_deg": list(range(-20, 21, 2)), "columns": 720},
            "rate": 10,
            "range": [0.2, 30],
            "position": [3.0, -0.5, 1.0],
            "rotation_deg": [3, 5, 170],
            "stamp": "end",
        }
    },
}


def calibration(path: Path) -> dict[str, Array]:
    """Matrices of a file of calib, as the development kit reads them."""
    found = {}
    for line in path.read_text().splitlines():
        name, numbers = line.split(":")
        found[name] = np.array(numbers.split(), dtype=float).reshape(3, -1)
    return found


def corners(label: list[str]) -> Array:
    """Corners (8, 3) of a box, as computeBox3D of the development kit has them."""
    height, width, length, x, y, z, turn = map(float, label[8:15])
    along = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * length / 2
    up = np.array([0, 0, 0, 0, -1, -1, -1, -1]) * height
    across = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * width / 2
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return np.asarray((rotation @ np.stack([along, up, across])).T + np.array([x, y, z]))


@pytest.mark.slow
def test_points_of_a_person_are_in_its_box_and_in_its_pixels(tmp_path: Path) -> None:
    scene = Scene.from_dict(SCENE)
    root = exported(tmp_path / "out", "kitti", scene, frames="0:6") / "kitti" / "lidar"
    assert (root / "ImageSets" / "trainval.txt").read_text().split() == ["000002", "000004"]
    with Simulation(scene, ("instance",)) as simulation:
        frame = simulation.frame(4)
    (sweep,) = frame.sweeps["lidar"]
    cloud = np.fromfile(root / "velodyne" / "000004.bin", np.float32).reshape(-1, 4)
    np.testing.assert_allclose(cloud[:, :3], sweep.points, atol=1e-6)
    # as semantic-kitti-api reads labels
    labels = np.fromfile(root / "labels" / "000004.label", np.uint32)
    anna = sweep.instances == 1
    np.testing.assert_array_equal(labels >> 16, sweep.instances)
    assert set(labels[anna] & 0xFFFF) == {254}  # moving-person
    assert not (labels[~anna] & 0xFFFF).any()
    # fired near the end of the sweep, when she is where the frame shows her
    late = anna & (sweep.times > 0.6e8)
    assert anna.sum() > 80
    for name in CAMERAS:
        matrices = calibration(root / name / "calib" / "000004.txt")
        (line,) = (root / name / "label_2" / "000004.txt").read_text().splitlines()
        label = line.split()
        assert (len(label), label[0], label[2]) == (15, "Pedestrian", "0")
        to_camera = np.vstack([matrices["Tr_velo_to_cam"], [0, 0, 0, 1]])
        rectified = (
            matrices["R0_rect"] @ (to_camera @ np.column_stack([cloud[:, :3], np.ones(len(cloud))]).T)[:3]
        ).T
        low, high = corners(label)[:, 1].min(), corners(label)[:, 1].max()
        assert high - low == pytest.approx(float(label[8]))
        turn = float(label[14])
        offset = rectified[anna] - np.array(label[11:14], dtype=float)
        along = offset[:, 0] * np.cos(turn) - offset[:, 2] * np.sin(turn)
        across = offset[:, 0] * np.sin(turn) + offset[:, 2] * np.cos(turn)
        slack = 0.12  # she walks 0.1 m during a sweep
        assert (np.abs(along) < float(label[10]) / 2 + slack).all()
        assert (np.abs(across) < float(label[9]) / 2 + slack).all()
        assert ((offset[:, 1] < 0.02) & (offset[:, 1] > -float(label[8]) - 0.02)).all()
        pixels = matrices["P2"] @ np.column_stack([rectified, np.ones(len(rectified))]).T
        pixels = (pixels[:2] / pixels[2]).T
        expected = frame.cameras[name].project(sweep.points @ rotation_of(sweep).T + sweep.position)[0]
        np.testing.assert_allclose(pixels, expected, atol=1e-3)
        inside = ((pixels >= 0) & (pixels < (319, 239))).all(axis=1) & late
        seen = frame.views[name].instance[tuple(np.rint(pixels[inside]).astype(int).T[::-1])]
        assert inside.sum() < 5 or (seen == 1).mean() > 0.6


def rotation_of(sweep: Sweep) -> Array:
    x, y, z, w = sweep.rotation
    vector, angle = np.array([x, y, z]), 2 * np.arccos(np.clip(w, -1, 1))
    axis = vector / max(np.linalg.norm(vector), 1e-12)
    return np.asarray(cv2.Rodrigues(axis * angle)[0])


def test_a_rectified_frame_is_upright() -> None:
    for position, target in (((3, 1, 2), (0, 0, 0.5)), ((0, 0, 4), (0, 0, 0)), ((1, 1, 0.2), (0, 0, 3))):
        camera = Camera.look_at(position, target, up=(0.6, 0.8, 0))
        level = levelled(camera)
        np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(level @ (0, 0, 1), (0, -1, 0), atol=1e-12)
        assert np.linalg.det(level) == pytest.approx(1)


def test_a_scene_without_scanners_is_refused(tmp_path: Path) -> None:
    scene = Scene.from_dict({key: value for key, value in SCENE.items() if key != "scanners"})
    with pytest.raises(ExportError, match="needs a laser scanner"):
        exported(tmp_path / "out", "kitti", scene, frames="0:6")


def test_frames_without_the_end_of_a_sweep_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="no sweep of a scanner ends"):
        exported(tmp_path / "out", "kitti", Scene.from_dict(SCENE), frames="0:2")
