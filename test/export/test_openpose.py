"""OpenPose files in a project of Pose2Sim: rows, order of people and cameras, calibration, configuration."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from humansim_ros import Scene, read_calibration
from humansim_ros.cameras.formats.syntax import tomllib
from humansim_ros.data.formats import openpose
from humansim_ros.data.formats.openpose import (
    AniposeWriter,
    OpenPoseWriter,
    calibration_text,
    openpose_file,
    openpose_keypoints,
    openpose_text,
    pose2sim_order,
)
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, ExportScene, ExportSettings
from humansim_ros.errors import ExportError
from humansim_ros.people import keypoint_set
from humansim_ros.scene import OCCLUDED, OUTSIDE, VISIBLE

CAMERA = {"position": [3, 0, 1.5], "look_at": [0, 0, 1]}


def scene(cameras: dict[str, Any], people: int = 2) -> Scene:
    human = {"body": "child", "motion": {"file": "wave"}}
    return Scene.from_dict({"humans": {f"person_{n}": human for n in range(people)}, "cameras": cameras})


def test_points_outside_the_image_are_zeros_and_occluded_ones_less_certain() -> None:
    pixels = np.array([[10.25, 20.5], [30.0, 40.0], [-100.0, 5.0], [np.nan, np.nan]])
    visible = np.array([VISIBLE, OCCLUDED, OUTSIDE, OUTSIDE], dtype=np.uint8)
    rows = openpose_keypoints(pixels, visible)
    np.testing.assert_array_equal(rows, [[10.25, 20.5, 1], [30, 40, 0.5], [0, 0, 0], [0, 0, 0]])


def test_a_file_lists_everybody_in_order() -> None:
    rows = np.array([[1.5, 2.25, 1.0], [0.0, 0.0, 0.0]])
    data = json.loads(
        openpose_text([rows, np.zeros((2, 3))], replace(keypoint_set("coco17"), names=("nose", "left_eye")))
    )
    assert data["version"] == 1.3
    assert [person["pose_keypoints_2d"] for person in data["people"]] == [[1.5, 2.25, 1, 0, 0, 0], [0] * 6]
    assert [person["person_id"] for person in data["people"]] == [[1], [2]]


def test_face_and_hands_of_openpose_have_fields_of_their_own() -> None:
    """The numbers of points of OpenPose's output format: BODY_25, 70 of the face, 21 of each hand."""
    keypoints = keypoint_set("openpose137")
    rows = np.column_stack([np.arange(137.0), np.zeros(137), np.ones(137)])
    (person,) = json.loads(openpose_text([rows], keypoints))["people"]
    first = {"pose": (25, "Nose"), "face": (70, "face-0")}
    first |= {f"hand_{side}": (21, f"{side}_hand_root") for side in ("left", "right")}
    for field, (count, name) in first.items():
        numbers = np.reshape(person[f"{field}_keypoints_2d"], (-1, 3))[:, 0].astype(int)
        assert len(numbers) == count and keypoints.names[numbers[0]] == name
        assert (np.diff(numbers) == 1).all()


def test_cameras_are_in_the_order_of_pose2sim() -> None:
    # as Pose2Sim.common.sort_stringlist_by_last_number sorts these names with "_json"
    names = ["zero", "cam10", "3d_cam2", "aaaa", "cam_2b1"]
    assert pose2sim_order(names) == ["cam_2b1", "3d_cam2", "cam10", "aaaa", "zero"]


def test_a_project_has_files_of_all_cameras_and_their_calibration(tmp_path: Path) -> None:
    lens = {**CAMERA, "position": [0, 3, 1.5], "distortion": [-0.1, 0.02, 0.001, 0.0, 0.0]}
    settings = ExportSettings(ExportScene.of(scene({"cam10": CAMERA, "cam2": lens})), range(5, 6), "coco17")
    rng = np.random.default_rng(1)
    views = {
        camera: {
            person: SimpleNamespace(pixels=rng.uniform(0, 400, (17, 2)), visible=np.full(17, VISIBLE))
            for person in settings.scene.people
        }
        for camera in settings.cameras
    }
    frame: Any = SimpleNamespace(index=5, keypoints={"coco17": views})
    writer, folder = OpenPoseWriter(settings), ExportFolder(tmp_path)
    records = [(5, writer.frame(ExportFrame(frame, settings), folder))]
    writer.finish(records, folder)
    for camera, people in views.items():
        file = tmp_path / "pose" / f"{camera}_json" / f"{camera}_000000000005_keypoints.json"
        assert file == tmp_path / openpose_file(camera, 5)
        for entry, person in zip(json.loads(file.read_text())["people"], people.values(), strict=True):
            found = np.array(entry["pose_keypoints_2d"]).reshape(17, 3)
            np.testing.assert_allclose(found[:, :2], person.pixels, atol=1e-6)
    cameras = read_calibration(tmp_path / "calibration" / "Calib.toml")
    assert list(cameras) == ["cam2", "cam10"]
    for name, camera in cameras.items():
        truth = settings.scene.cameras[name].camera
        for part in ("K", "R", "t"):
            np.testing.assert_allclose(getattr(camera, part), getattr(truth, part), atol=1e-9)
        np.testing.assert_allclose(camera.distortion, truth.distortion)
    config = tomllib.loads((tmp_path / "Config.toml").read_text())
    assert config["project"] == {"multi_person": True, "frame_rate": 30, "frame_range": [5, 6]}
    assert config["pose"] == {"pose_model": "COCO_17"}
    assert config["triangulation"]["undistort_points"] is True


def test_other_keypoint_sets_get_a_skeleton_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(openpose, "POSE2SIM_MODELS", {})
    settings = ExportSettings(ExportScene.of(scene({"cam": CAMERA}, people=1)), range(3), "coco17")
    OpenPoseWriter(settings).finish([], ExportFolder(tmp_path))
    config = tomllib.loads((tmp_path / "Config.toml").read_text())
    assert config["project"]["multi_person"] is False
    assert config["triangulation"]["undistort_points"] is False
    custom = config["pose"]["CUSTOM"]
    assert config["pose"]["pose_model"] == "CUSTOM" and custom["id"] == "None"
    children = [(child["name"], child["id"]) for child in custom["children"]]
    assert children == [(name, number) for number, name in enumerate(keypoint_set("coco17").names)]


def test_moving_cameras_are_refused_before_the_first_frame(tmp_path: Path) -> None:
    path = tmp_path / "flight.txt"
    path.write_text("0 3 0 1.5 0.5 0.5 -0.5 -0.5\n1 4 0 1.5 0.5 0.5 -0.5 -0.5\n")
    flying = {"trajectory": {"file": str(path)}}
    for writer in (OpenPoseWriter, AniposeWriter):
        with pytest.raises(ExportError, match="camera flying moves"):
            writer(ExportSettings(ExportScene.of(scene({"still": CAMERA, "flying": flying})), range(3)))


def test_a_lens_that_the_format_cannot_store_is_refused_before_the_first_frame() -> None:
    wide = {**CAMERA, "K": [[400, 5, 320], [0, 400, 240], [0, 0, 1]], "size": [640, 480]}
    with pytest.raises(ExportError, match=r"shelf: wide: .*skew"):
        calibration_text(ExportSettings(ExportScene.of(scene({"wide": wide})), range(3)), "shelf")
