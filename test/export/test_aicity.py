"""AI City: boxes and matrices of an export against the cameras of its scene, and scored by themselves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_support import exported, small_scene

from humansim_ros import Scene, evaluate
from humansim_ros.data.evaluation.boxes import scene_boxes
from humansim_ros.data.evaluation.readers.box_files import read_box_file
from humansim_ros.errors import EvaluationError, ExportError, HumansimWarning


@pytest.mark.slow
def test_an_export_has_the_boxes_of_its_scene(tmp_path: Path) -> None:
    scene = small_scene()
    with pytest.warns(HumansimWarning, match="lens distortion has no place there; calibration.yaml has it"):
        root = exported(tmp_path / "out", "aicity", scene, frames="3:6")
    path = root / "aicity" / "ground_truth.txt"
    found, truth = read_box_file(path), scene_boxes(scene, range(3, 6))
    for frame in range(3, 6):
        np.testing.assert_array_equal(found.at(frame)[0], truth.at(frame)[0])
        np.testing.assert_allclose(found.at(frame)[1], truth.at(frame)[1], atol=1e-6)
    result = evaluate(root, path)
    assert result.data["tracking"]["iou"]["hota"] == pytest.approx(1)
    assert list(result.data["by_person"]) == list(scene.actors)
    assert "3D IoU" in result.table and "3D IoU" in result.page()
    with pytest.raises(EvaluationError, match="is for 3D poses"):
        evaluate(root, path, axes="y-up")
    check_layout(root / "aicity", scene)


def check_layout(folder: Path, scene: Scene) -> None:
    """Corners of a box through the matrices of calibration.json are pixels of the camera."""
    people = json.loads((folder / "ground_truth.json").read_text())["4"]
    assert [person["object type"] for person in people] == ["Person", "Person"]
    sensors: dict[str, Any] = {
        sensor["id"]: sensor for sensor in json.loads((folder / "calibration.json").read_text())["sensors"]
    }
    point = np.array([*people[0]["3d location"], 1])
    for name, camera in scene.cameras.items():
        matrix = np.array(sensors[name]["cameraMatrix"])
        np.testing.assert_allclose(
            matrix, np.array(sensors[name]["intrinsicMatrix"]) @ sensors[name]["extrinsicMatrix"], atol=1e-9
        )
        for place, through in (
            (point, matrix @ point),
            ([0.3, -0.2, 0, 1], np.array(sensors[name]["homography"]) @ [0.3, -0.2, 1]),
        ):
            expected = replace(camera, distortion=()).project(np.array([place[:3]]))[0][0] + 0.5
            np.testing.assert_allclose(through[:2] / through[2], expected, atol=1e-6)
        left, top, right, bottom = people[0]["2d bounding box visible"][name]
        assert 0 <= left < right <= camera.size[0] and 0 <= top < bottom <= camera.size[1]


def test_a_camera_that_moves_has_no_place(tmp_path: Path) -> None:
    scene = Scene.from_dict(
        {
            "room": None,
            "humans": {"anna": {"body": "child", "motion": "walk"}},
            "robot": {"path": {"points": [[0, -2], [1, -2]]}},
            "cameras": {
                "front": {"size": [32, 24], "mount": "robot", "position": [0, 0, 1], "look_at": [2, 0, 1]}
            },
        }
    )
    with pytest.raises(ExportError, match="camera front moves"):
        exported(tmp_path / "out", "aicity", scene, frames="0:1")
