"""CMU Panoptic and Human3.6M: units, axes, names of the files, and cameras that fit the joints."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from humansim_ros import Camera, Scene
from humansim_ros.data.formats.positions import Human36mWriter, PanopticWriter, human36m_text, panoptic_text
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, ExportScene, ExportSettings


@pytest.fixture
def settings() -> ExportSettings:
    human = {"body": "child", "motion": {"file": "wave"}}
    camera = {"position": [3, 1, 1.5], "look_at": [0, 0, 1], "distortion": [-0.1, 0.02, 0.001, 0.002, 0.003]}
    scene = Scene.from_dict({"humans": {"anna": human, "ben": human}, "cameras": {"hd_1": camera}})
    return ExportSettings(ExportScene.of(scene), range(4, 6))


def frames(settings: ExportSettings, name: str, count: int) -> list[Any]:
    """Frames with random keypoints of a set around the origin."""
    rng = np.random.default_rng(2)
    return [
        SimpleNamespace(
            index=index,
            scene_time=round(index * 1e9 / settings.rate),
            keypoint_positions={name: {p: rng.uniform(-1, 1, (count, 3)) for p in settings.scene.people}},
        )
        for index in settings.frames
    ]


def project(point: np.ndarray, K: Any, R: Any, t: Any, lens: Any, truth: Camera) -> np.ndarray:
    """Pixels of points of a data set by its own cameras: x = R X + t, then OpenCV's lens, then K."""
    camera = Camera(truth.size, np.array(K), np.array(R), np.array(t).ravel(), tuple(lens), "plumb_bob")
    return camera.project(point)[0]


def test_a_sequence_of_panoptic_has_centimetres_with_y_down(tmp_path: Path, settings: ExportSettings) -> None:
    writer, folder = PanopticWriter(settings), ExportFolder(tmp_path)
    made = frames(settings, "panoptic19", 19)
    writer.finish([(f.index, writer.frame(ExportFrame(f, settings), folder)) for f in made], folder)
    (camera,) = json.loads((tmp_path / "calibration_panoptic.json").read_text())["cameras"]
    assert camera["name"] == "hd_1"
    truth = settings.scene.cameras["hd_1"].camera
    for frame in made:
        path = tmp_path / "hdPose3d_stage1_coco19" / f"body3DScene_{frame.index:08d}.json"
        data = json.loads(path.read_text())
        assert data["univTime"] == pytest.approx(frame.index / 30 * 1000, abs=0.01)
        assert [body["id"] for body in data["bodies"]] == [0, 1]
        people = frame.keypoint_positions["panoptic19"].values()
        for body, positions in zip(data["bodies"], people, strict=True):
            joints = np.array(body["joints19"]).reshape(19, 4)
            assert (joints[:, 3] == 1).all()
            np.testing.assert_allclose(-joints[:, 1] / 100, positions[:, 2], atol=1e-6)  # y is down
            found = project(joints[:, :3], camera["K"], camera["R"], camera["t"], camera["distCoef"], truth)
            np.testing.assert_allclose(found, truth.project(positions)[0], atol=1e-4)


def test_missing_points_of_panoptic_have_a_score_of_minus_one() -> None:
    positions = np.ones((2, 3))
    positions[1, 2] = np.nan
    (body,) = json.loads(panoptic_text({7: positions}, 0.5))["bodies"]
    assert body == {"id": 7, "joints2": [100, -100, 100, 1, 0, 0, 0, -1]}


def test_human36m_has_millimetres_and_a_subject_for_each_person(
    tmp_path: Path, settings: ExportSettings
) -> None:
    writer, folder = Human36mWriter(settings), ExportFolder(tmp_path)
    made = frames(settings, "h36m17", 17)
    writer.finish([(f.index, writer.frame(ExportFrame(f, settings), folder)) for f in made], folder)
    cameras = json.loads((tmp_path / "camera-parameters.json").read_text())
    inner, outer = cameras["intrinsics"]["hd_1"], cameras["extrinsics"]["S1"]["hd_1"]
    truth = settings.scene.cameras["hd_1"].camera
    for number, person in enumerate(settings.scene.people, 1):
        joints = json.loads((tmp_path / f"Human36M_subject{number}_joint_3d.json").read_text())["1"]["1"]
        assert list(joints) == ["4", "5"]
        for frame in made:
            positions = frame.keypoint_positions["h36m17"][person]
            found = np.array(joints[str(frame.index)])
            np.testing.assert_allclose(found / 1000, positions, atol=1e-8)
            lens = inner["distortion"]
            pixels = project(found, inner["calibration_matrix"], outer["R"], outer["t"], lens, truth)
            np.testing.assert_allclose(pixels, truth.project(positions)[0], atol=1e-4)


def test_missing_points_of_human36m_are_null() -> None:
    positions = np.zeros((1, 2, 3))
    positions[0, 1] = np.nan
    assert json.loads(human36m_text(positions, 9)) == {"1": {"1": {"9": [[0, 0, 0], [None] * 3]}}}
