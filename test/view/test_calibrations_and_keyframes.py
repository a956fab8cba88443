"""Calibration files, ideal cameras and keyframes in an edited scene."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.scene import Scene
from humansim_ros.view.edit.document import SceneDocument
from humansim_ros.view.edit.edits import (
    add_calibration,
    is_ideal,
    keyframe_times,
    remove_keyframe,
    set_ideal,
    set_keyframe,
)

TEXT = """\
# my lab
room: null
humans:
  anna: {motion: wave}  # who
cameras:
  own: {position: [3, 0, 1.5], look_at: [0, 0, 1]}
"""


def distorted_ring() -> dict[str, Camera]:
    cameras = dict(Rig((0.0, 0.0, 1.0), 3.0, 2.0, Optics()).ring(4))
    return {
        name: Camera(one.size, np.add(one.K, [[0, 0, 5], [0, 0, -3], [0, 0, 0]]), one.R, one.t, (-0.2, 0.05))
        for name, one in cameras.items()
    }


@pytest.fixture
def document(tmp_path: Path) -> SceneDocument:
    path = tmp_path / "scene.yaml"
    path.write_text(TEXT)
    write_calibration(tmp_path / "lab.toml", distorted_ring(), "anipose")
    return SceneDocument.load(path)


def test_a_calibration_becomes_the_rig_on_the_floor(document: SceneDocument) -> None:
    names = add_calibration(document, "lab.toml")
    assert len(names) == 4 and document.value("rig.file") == "lab.toml"
    scene = document.scene()
    for name, camera in distorted_ring().items():
        assert scene.cameras[name].center[2] == pytest.approx(camera.center[2], abs=2e-3)
        np.testing.assert_allclose(scene.cameras[name].distortion[:2], (-0.2, 0.05))
    assert document.command().startswith("humansim camera place ")
    assert document.text().startswith(TEXT)
    document.set("rig.sensor.exposure_time", 0.01)
    add_calibration(document, "lab.toml", as_file=True)
    assert document.value("rig") == {"file": "lab.toml", "sensor": {"exposure_time": 0.01}} | (
        {"unit": document.value("rig.unit")} if document.has("rig.unit") else {}
    )
    np.testing.assert_allclose(
        document.scene().cameras[names[0]].center, distorted_ring()[names[0]].center, atol=1e-6
    )
    document.undo()
    document.undo()
    document.undo()
    assert document.text() == TEXT


def test_cameras_without_poses_are_added_one_by_one(document: SceneDocument, tmp_path: Path) -> None:
    camera = next(iter(distorted_ring().values()))
    write_calibration(tmp_path / "usb.yaml", {"usb": camera}, "camera_info")
    add_calibration(document, tmp_path / "usb.yaml")
    assert document.names("cameras")[0] == "own" and len(document.names("cameras")) == 2
    assert document.value(["cameras", document.names("cameras")[1], "calibration"]) == "usb.yaml"
    assert document.errors() == []


def test_a_rig_is_idealised_and_made_real_again(document: SceneDocument, tmp_path: Path) -> None:
    (name, *_) = add_calibration(document, "lab.toml")
    text, real = document.text(), document.scene().cameras[name]
    assert not is_ideal(document, "rig", "rig")
    set_ideal(document, "rig", "rig", True)
    ideal = document.scene().cameras[name]
    assert is_ideal(document, "rig", "rig") and not ideal.distorted
    np.testing.assert_allclose(ideal.center, real.center, atol=1e-5)
    np.testing.assert_allclose(ideal.K[:2, 2], (np.array(real.size) - 1) / 2, atol=1e-6)
    assert (tmp_path / "ideal" / "lab.toml").is_file()
    assert document.command().startswith("humansim camera idealize ")
    set_ideal(document, "rig", "rig", False)
    assert document.text() == text


def test_a_camera_with_k_loses_its_distortion(document: SceneDocument) -> None:
    document.set("cameras.own.K", [[500, 0, 330], [0, 490, 230], [0, 0, 1]])
    document.set("cameras.own.distortion", [-0.2, 0.05])
    assert not is_ideal(document, "cameras", "own")
    set_ideal(document, "cameras", "own", True)
    camera = document.scene().cameras["own"]
    assert not camera.distorted and camera.K[:2, 2].tolist() == [319.5, 239.5]
    with pytest.raises(SceneError, match="the real lens of this camera is not in the file"):
        set_ideal(document, "cameras", "own", False)
    document.undo()
    assert document.scene().cameras["own"].distorted


def test_wrong_calibrations_change_nothing(document: SceneDocument, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("a = [")
    for bad in ("bad.toml", "missing.toml", "\0", "scene.yaml/x"):
        with pytest.raises(HumansimError):
            add_calibration(document, bad)
    with pytest.raises(HumansimError):
        add_calibration(document, "lab.toml", floor_points="missing.yaml")
    assert document.text() == TEXT


def test_keys_put_a_person_and_an_object_where_they_should_be_at_their_times(document: SceneDocument) -> None:
    document.add_object("crate", near=(1, 1))
    text = document.text()
    turned = Rotation.from_euler("z", 170, degrees=True).as_quat()
    further = Rotation.from_euler("z", -170, degrees=True).as_quat()
    for kind, name in (("humans", "anna"), ("objects", "crate")):
        set_keyframe(document, kind, name, 0.0)  # type: ignore[arg-type]
        set_keyframe(document, kind, name, 2.0, (1, 2, 0.25), turned)  # type: ignore[arg-type]
        set_keyframe(document, kind, name, 3.0, (1, 2, 0.25), further)  # type: ignore[arg-type]
        assert keyframe_times(document, kind, name) == [0, 2, 3]  # type: ignore[arg-type]
        pose = document.pose(kind, name, 2.0)  # type: ignore[arg-type]
        np.testing.assert_allclose(pose.position, [1, 2, 0.25], atol=2e-4)
        assert (Rotation.from_matrix(pose.rotation) * Rotation.from_quat(turned).inv()).magnitude() < 1e-3
        between = Rotation.from_matrix(document.pose(kind, name, 2.5).rotation)  # type: ignore[arg-type]
        # the short way, by 180 degrees
        assert abs(between.as_euler("xyz", degrees=True)[2]) == pytest.approx(180, abs=0.1)
    pose = document.scene().objects["crate"].at(2.0)
    np.testing.assert_allclose(pose.position, [1, 2, 0.25], atol=2e-4)
    saved = document.save()
    np.testing.assert_allclose(Scene.load(saved).objects["crate"].at(2.0).position, [1, 2, 0.25], atol=2e-4)
    remove_keyframe(document, "objects", "crate", 2.9)
    assert keyframe_times(document, "objects", "crate") == [0, 2]
    document.undo()
    assert keyframe_times(document, "objects", "crate") == [0, 2, 3]
    for _ in range(6):
        document.undo()
    assert document.text() == text and not (saved.parent / "scene_crate.xml").exists()
    document.redo()
    assert keyframe_times(document, "humans", "anna") == [0]


def test_keys_of_the_users_file_are_copied_and_that_file_stays(tmp_path: Path) -> None:
    for name in ("moving_objects.yaml", "moving_objects.xml"):
        (tmp_path / name).write_bytes((ROOT / "config/scenes" / name).read_bytes())
    before = (tmp_path / "moving_objects.xml").read_bytes()
    document = SceneDocument.load(tmp_path / "moving_objects.yaml")
    last = keyframe_times(document, "humans", "rider")[-1]
    end = document.pose("humans", "rider", last)
    set_keyframe(document, "humans", "rider", 1.0, (0, 0, 0.5))
    assert (tmp_path / "moving_objects.xml").read_bytes() == before
    assert document.value("humans.rider.keyframes.file") == "moving_objects_rider.xml"
    np.testing.assert_allclose(document.pose("humans", "rider", 1.0).position, [0, 0, 0.5], atol=2e-4)
    np.testing.assert_allclose(document.pose("humans", "rider", last).position, end.position, atol=2e-4)
    assert document.errors() == []


def test_keys_that_cannot_be_are_refused(document: SceneDocument) -> None:
    for seconds in (-1, math.nan, math.inf, 1e9):
        with pytest.raises(SceneError):
            set_keyframe(document, "humans", "anna", seconds)
    with pytest.raises(SceneError, match="cameras have a trajectory"):
        set_keyframe(document, "cameras", "own", 1.0)
    with pytest.raises(SceneError, match="no keyframes"):
        remove_keyframe(document, "humans", "anna", 1.0)
    with pytest.raises(SceneError, match="save the scene first"):
        set_keyframe(SceneDocument(TEXT), "humans", "anna", 1.0)
    assert document.text() == TEXT


def test_all_cameras_of_a_written_ideal_file_can_be_read(document: SceneDocument, tmp_path: Path) -> None:
    add_calibration(document, "lab.toml")
    set_ideal(document, "rig", "rig", True)
    assert set(read_calibration(tmp_path / "ideal" / "lab.toml")) == set(distorted_ring())
