"""YOLO-pose: labels as shares of the image, found from the paths of the images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from export_support import exported, small_scene

from humansim_ros import Frame, Simulation
from humansim_ros.export.people_boxes import mirrored
from humansim_ros.keypoints.sets import KEYPOINT_SETS
from humansim_ros.truth import OUTSIDE


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("yolo") / "out", "yolo")


@pytest.fixture(scope="module")
def frame() -> Frame:
    with Simulation(small_scene(), ("depth", "instance", "part", "amodal")) as simulation:
        return simulation.frame(4)


@pytest.mark.daily("bent")
@pytest.mark.parametrize("camera", ["noisy", "bent"])
def test_labels_are_the_boxes_and_keypoints(root: Path, frame: Frame, camera: str) -> None:
    size = np.array(frame.cameras[camera].size)
    rows = np.loadtxt(root / f"yolo/labels/{camera}/000004.txt")
    assert rows.shape == (2, 5 + 17 * 3) and (rows[:, 0] == 0).all()
    assert (rows[:, 1:5] >= 0).all() and (rows[:, 1:5] <= 1).all()
    for row, name in zip(rows, ("anna", "bert"), strict=True):
        corner = (row[1:3] - row[3:5] / 2) * size - 0.5
        np.testing.assert_allclose(corner, frame.truth[camera].boxes[name].visible[:2], atol=1e-3)
        view = frame.keypoints["coco17"][camera][name]
        points = row[5:].reshape(-1, 3)
        np.testing.assert_array_equal(points[:, 2], view.visible)
        inside = view.visible != OUTSIDE
        np.testing.assert_allclose(points[inside, :2] * size - 0.5, view.pixels[inside], atol=1e-3)


def test_each_listed_image_has_its_labels(root: Path) -> None:
    """Ultralytics replaces the last /images/ of a path by /labels/, and does not follow links."""
    listed = (root / "yolo/train.txt").read_text().split()
    assert len(listed) == 4
    for line in listed:
        assert (root / "yolo" / line).exists()
        assert (root / "yolo" / line.replace("/images/", "/labels/")).with_suffix(".txt").exists()


def test_the_data_set_is_described(root: Path) -> None:
    dataset = yaml.safe_load((root / "yolo/dataset.yaml").read_text())
    assert dataset["kpt_shape"] == [17, 3] and dataset["names"] == {0: "person"}
    # as Ultralytics' coco-pose.yaml
    assert dataset["flip_idx"] == [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]


@pytest.mark.parametrize("name", KEYPOINT_SETS)
def test_the_other_side_of_the_other_side_is_the_keypoint(name: str) -> None:
    keypoints = KEYPOINT_SETS[name]
    other = mirrored(keypoints.points)
    assert [other[number] for number in other] == list(range(len(keypoints)))
    for number, point in enumerate(keypoints.points):
        has_side = point.startswith(("l_", "r_", "left_", "right_"))
        # the right back of Plug-in Gait has a marker by which programs tell the sides
        assert (other[number] != number) == (has_side and point != "right_scapula"), point
