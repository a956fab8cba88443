"""MOTChallenge (sequences, boxes, links to the images) and YOLO-pose (labels as shares of the image)."""

from __future__ import annotations

import configparser
from pathlib import Path

import numpy as np
import pytest
import yaml
from export_support import SCENE, exported, small_scene

from humansim_ros import Frame, Scene, Simulation, read_calibration
from humansim_ros.people.keypoints.sets import KEYPOINT_SETS
from humansim_ros.scene import OUTSIDE


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("boxes") / "out", "mot,yolo", frames="3:6")


@pytest.fixture(scope="module")
def frame() -> Frame:
    with Simulation(small_scene(), ("depth", "instance", "part", "amodal")) as simulation:
        return simulation.frame(4)


@pytest.mark.nightly
def test_boxes_are_those_of_the_whole_people(root: Path, frame: Frame) -> None:
    for camera in ("noisy", "bent"):
        rows = np.loadtxt(root / f"mot/{camera}/gt/gt.txt", delimiter=",")
        assert set(rows[:, 0]) == {1, 2, 3} and (rows[:, 6:8] == 1).all()
        second = {int(row[1]): row for row in rows if row[0] == 2}
        for name, label in (("anna", 1), ("bert", 2)):
            box = frame.truth[camera].boxes[name]
            left, top, width, height = second[label][2:6]
            # the first pixel begins at 1, its centre is at 0 for us
            np.testing.assert_allclose([left - 1.5, top - 1.5], box.whole[:2], atol=1e-3)
            np.testing.assert_allclose([width, height], box.whole[2:] - box.whole[:2], atol=2e-3)
            assert second[label][8] == pytest.approx(box.visible_fraction * (1 - box.truncation), abs=1e-5)


def test_the_sequence_is_described(root: Path) -> None:
    info = configparser.ConfigParser()
    info.read(root / "mot/bent/seqinfo.ini")
    section = info["Sequence"]
    assert (section["name"], section["imDir"], section["imExt"]) == ("bent", "img1", ".png")
    numbers = [int(section[key]) for key in ("frameRate", "seqLength", "imWidth", "imHeight")]
    assert numbers == [20, 3, 80, 64]
    assert (root / "mot/seqmap.txt").read_text().split() == ["name", "noisy", "bent"]
    camera = read_calibration(root / "mot/bent/calibration.yaml")["bent"]
    assert camera.distortion[:2] == (-0.2, 0.05)


def test_images_are_links_that_count_from_1(root: Path) -> None:
    links = sorted((root / "mot/noisy/img1").iterdir())
    assert [link.name for link in links] == ["000001.png", "000002.png", "000003.png"]
    assert all(link.is_symlink() for link in links)
    assert links[0].resolve() == root / "images/noisy/000003.png" and links[0].exists()


@pytest.mark.nightly
def test_a_person_outside_of_the_image_has_no_box(tmp_path: Path) -> None:
    config = yaml.safe_load(SCENE)
    config["cameras"]["bent"]["look_at"] = [0, 6, 1.2]  # away from the people
    root = exported(tmp_path / "out", "mot", Scene.from_dict(config))
    assert (root / "mot/bent/gt/gt.txt").read_text() == ""
    assert (root / "mot/noisy/gt/gt.txt").read_text() != ""


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
    assert len(listed) == 6
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
    other = keypoints.mirrored
    assert [other[number] for number in other] == list(range(len(keypoints)))
    for number, point in enumerate(keypoints.points):
        has_side = point.startswith(("l_", "r_", "left_", "right_"))
        # the right back of Plug-in Gait has a marker by which programs tell the sides
        is_hand = name in ("left_hand21", "right_hand21")  # of one side alone
        assert (other[number] != number) == (has_side and point != "right_scapula" and not is_hand), point
