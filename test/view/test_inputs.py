"""What humansim view opens, told by its content."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import SHARED_DATA, needs_shared_data

from humansim_ros.errors import HumansimError
from humansim_ros.files.reading.assets import resource_path
from humansim_ros.view.sources.inputs import open_source

pytest.importorskip("viser")

SCENE = """\
room: null
humans:
  anna: {body: child}
cameras:
  front: {position: [3, 0, 1], look_at: [0, 0, 0.6]}
"""
CALIBRATION = """\
%YAML:1.0
---
cam0:
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [458.0, 457.0, 367.0, 248.0]
  resolution: [752, 480]
"""


def test_a_folder_with_a_scene_and_a_recipe_is_the_scene(tmp_path: Path) -> None:
    (tmp_path / "room.yaml").write_text(SCENE)
    (tmp_path / "recipe.yaml").write_text("recipe: many\nscene: {}\n")
    opened = open_source(tmp_path)
    assert opened.path == tmp_path / "room.yaml"
    opened.source.close()
    (tmp_path / "room.yaml").unlink()
    opened = open_source(tmp_path)
    assert opened.document is not None and opened.path is None  # a new scene
    opened.source.close()


@pytest.mark.parametrize("name", ["walk", "wave", "child", "adult_man"])
def test_names_of_built_ins_are_opened(name: str) -> None:
    opened = open_source(Path(name))
    assert list(opened.source.people) == ["person"] and len(opened.source.cameras) == 4
    assert opened.document is None and opened.path is None
    opened.source.close()


def test_files_of_motions_and_humans_are_opened(tmp_path: Path) -> None:
    for source in ("assets/motions/walk.bvh", "assets/humans/child.npz"):
        path = resource_path(source)
        opened = open_source(path)
        assert list(opened.source.people) == ["person"] and opened.path == path
        opened.source.close()


def test_a_scene_is_opened_with_its_document_and_a_calibration_without_problems(tmp_path: Path) -> None:
    cameras = "cameras:\n  front: {position: [3, 0, 1], look_at: [0, 0, 0.6]}\n"
    for name, text, people, seen in (
        ("lab.yaml", SCENE, ["anna"], None),
        ("rig.yaml", cameras, [], ["front"]),  # a scene of cameras alone
        ("camchain.yaml", CALIBRATION, [], ["cam0"]),  # a dialect of YAML
    ):
        path = tmp_path / name
        path.write_text(text)
        opened = open_source(path)
        assert list(opened.source.people) == people and opened.problem is None
        assert seen is None or list(opened.source.cameras) == seen
        assert (opened.document is not None) == (text != CALIBRATION)
        opened.source.close()


def test_a_broken_scene_is_opened_with_its_problem(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(SCENE.replace("child", "chlid"))
    opened = open_source(path)
    assert opened.problem is not None and "lab.yaml:3" in opened.problem and "'child'" in opened.problem
    assert opened.source.frame(0).joints == {}
    path.write_text(SCENE)
    assert opened.reload is not None
    mended = opened.reload()
    assert list(mended.people) == ["anna"]


@pytest.mark.parametrize("name", ["no_such_thing", "walkk"])
def test_an_unknown_name_is_told(name: str) -> None:
    with pytest.raises(HumansimError, match=name) as told:
        open_source(Path(name))
    assert ("did you mean 'walk'" in str(told.value)) == (name == "walkk")


def test_a_file_of_no_kind_is_told_with_what_was_tried(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("milk, bread")
    with pytest.raises(HumansimError, match="as a calibration") as told:
        open_source(path)
    assert "as a human" in str(told.value) and "as a motion" in str(told.value)


@needs_shared_data
@pytest.mark.parametrize(
    ("name", "first"),
    [
        ("shelf_voxelpose.json", "camera_0"),
        ("openvins_euroc_radtan_kalibr.yaml", "cam0"),
        ("usb_cam_camera_info.yaml", None),
        ("templeSR_par.txt", None),
    ],
)
@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
def test_calibrations_of_others_are_opened(name: str, first: str | None) -> None:
    opened = open_source(SHARED_DATA / "calib" / name)
    assert opened.source.cameras and first in (None, next(iter(opened.source.cameras)))
    opened.source.close()
