"""MOTChallenge: sequences, boxes, and links to the images."""

from __future__ import annotations

import configparser
from pathlib import Path

import numpy as np
import pytest
from export_support import exported, small_scene

from humansim_ros import Simulation, read_calibration


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("mot") / "out", "mot", frames="3:6")


@pytest.mark.nightly
def test_boxes_are_those_of_the_whole_people(root: Path) -> None:
    with Simulation(small_scene(), ("instance", "amodal")) as simulation:
        frame = simulation.frame(4)
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
    import yaml
    from export_support import SCENE

    from humansim_ros import Scene

    config = yaml.safe_load(SCENE)
    config["cameras"]["bent"]["look_at"] = [0, 6, 1.2]  # away from the people
    root = exported(tmp_path / "out", "mot", Scene.from_dict(config))
    assert (root / "mot/bent/gt/gt.txt").read_text() == ""
    assert (root / "mot/noisy/gt/gt.txt").read_text() != ""
