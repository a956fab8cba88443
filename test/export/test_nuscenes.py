"""nuScenes: tables whose transforms lead from points and boxes to the pixels and points of the simulation.

tools/exports/with_nuscenes.py opens an export with nuscenes-devkit.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_support import exported
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, Simulation
from humansim_ros.errors import ExportError
from humansim_ros.scene.features.scanners.feature import Sweep
from humansim_ros.types import Array

SCENE: dict[str, Any] = {
    "rate": 20,
    "room": None,
    "humans": {
        "anna": {"body": "child", "motion": {"file": "walk", "position": [0.0, -0.6]}},
        "ben": {"motion": {"file": "wave", "position": [0.6, 0.6]}},
    },
    "objects": {"box": {"mesh": "box", "size": [0.4, 0.4, 0.8], "position": [0.8, -0.6, 0.6], "label": True}},
    "robot": {"path": {"points": [[-2.2, 0.0], [0.0, 0.5]], "speed": 0.5}},
    "cameras": {
        "front": {"mount": "robot", "position": [0, 0, 1], "look_at": [2, 0, 0.9], "size": [96, 72]},
        "room": {"position": [2.5, 1, 1.8], "look_at": [0, 0, 0.8], "size": [80, 60]},
    },
    "scanners": {
        "lidar": {
            "pattern": {"elevations_deg": [-16, -8, 0, 8], "columns": 360},
            "rate": 10,
            "range": [0.2, 30],
            "mount": "robot",
            "position": [0.1, 0, 1.0],
            "stamp": "end",
        }
    },
}


def pose(row: dict[str, Any]) -> Array:
    """Matrix of a translation and a rotation wxyz."""
    matrix = np.eye(4)
    w, x, y, z = row["rotation"]
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    matrix[:3, 3] = row["translation"]
    return matrix


def tables(folder: Path) -> dict[str, Any]:
    """Rows of each table by token."""
    return {
        path.stem: {row["token"]: row for row in json.loads(path.read_text())}
        for path in (folder / "v1.0-humansim").iterdir()
    }


@pytest.mark.slow
def test_transforms_boxes_and_points_are_those_of_the_simulation(tmp_path: Path) -> None:
    scene = Scene.from_dict(SCENE)
    root = exported(tmp_path / "out", "nuscenes", scene, frames="0:7") / "nuscenes"
    known = tables(root)
    samples = list(known["sample"].values())
    assert [row["timestamp"] for row in samples] == [100_000, 200_000, 300_000]
    with Simulation(scene, ("instance",)) as simulation:
        frames = {index: simulation.frame(index) for index in range(7)}
    for row in known["sample_data"].values():
        calibrated = known["calibrated_sensor"][row["calibrated_sensor_token"]]
        channel = known["sensor"][calibrated["sensor_token"]]["channel"]
        assert row["filename"].startswith(f"{'samples' if row['is_key_frame'] else 'sweeps'}/{channel}/")
        index = int(Path(row["filename"]).name[:6])
        assert row["is_key_frame"] == (index in (2, 4, 6))
        in_map = pose(known["ego_pose"][row["ego_pose_token"]]) @ pose(calibrated)
        if channel == "LIDAR_TOP":
            sweep = frames[index].sweeps["lidar"][-1]
            cloud = np.fromfile(root / row["filename"], np.float32).reshape(-1, 5)
            np.testing.assert_allclose(cloud[:, :3], sweep.points, atol=1e-5)
            turn = Rotation.from_quat(sweep.rotation).as_matrix()
            expected = sweep.points @ turn.T + sweep.position
            np.testing.assert_allclose(cloud[:, :3] @ in_map[:3, :3].T + in_map[:3, 3], expected, atol=1e-4)
            assert set(cloud[:, 4].tolist()) <= {0, 1, 2, 3}
            if row["is_key_frame"]:
                check_labels(root, known, row["token"], sweep)
            continue
        camera = frames[index].cameras["front" if channel == "CAM_FRONT" else "room"]
        assert (row["width"], row["height"]) == camera.size
        assert cv2.imread(str(root / row["filename"])).shape[:2] == camera.size[::-1]
        point = np.array([0.2, 0.1, 0.9, 1.0])
        seen = np.array(calibrated["camera_intrinsic"]) @ (np.linalg.inv(in_map) @ point)[:3]
        np.testing.assert_allclose(seen[:2] / seen[2], camera.project(point[None, :3])[0][0], atol=1e-6)
    assert len(known["calibrated_sensor"]) == 2 + 7  # the robot moves under the camera of the room
    assert len(known["lidarseg"]) == 3
    check_people(known, frames)


def check_labels(root: Path, known: dict[str, Any], token: str, sweep: Sweep) -> None:
    """Points of anna (a child), ben and the box (instances 1 to 3) have the numbers of nuScenes-lidarseg."""
    row = known["lidarseg"][token]
    assert row["sample_data_token"] == token
    found = np.fromfile(root / row["filename"], np.uint8)
    np.testing.assert_array_equal(found, np.array([0, 3, 2, 29])[sweep.instances])
    names = {each["index"]: each["name"] for each in known["category"].values()}
    assert list(names) == list(range(32))
    assert {number: names[number] for number in set(found.tolist())} == {
        0: "noise",
        2: "human.pedestrian.adult",
        3: "human.pedestrian.child",
        29: "static.other",
    }


def check_people(known: dict[str, Any], frames: dict[int, Any]) -> None:
    people = dict(zip(known["instance"], ("anna", "ben"), strict=True))
    found: dict[str, list[str]] = {"anna": [], "ben": []}
    for row in known["sample_annotation"].values():
        name = people[row["instance_token"]]
        index = known["sample"][row["sample_token"]]["timestamp"] // 50_000
        frame = frames[index]
        own = (frame.humans[name].vertices - row["translation"]) @ pose(row)[:3, :3]
        np.testing.assert_allclose(np.abs(own).max(axis=0), np.array(row["size"])[[1, 0, 2]] / 2, atol=1e-5)
        assert row["num_lidar_pts"] == (frame.sweeps["lidar"][-1].instances == frame.labels[name]).sum()
        if row["prev"] and row["next"]:
            before, after = (known["sample_annotation"][row[side]] for side in ("prev", "next"))
            moved = np.subtract(after["translation"], before["translation"])
            boxes = [frames[near].humans[name].upright_box.center for near in (index - 2, index + 2)]
            np.testing.assert_allclose(moved, boxes[1] - boxes[0], atol=1e-9)
        assert row["visibility_token"] in known["visibility"]
        found[name].append(known["attribute"][row["attribute_tokens"][0]]["name"])
    assert found == {"anna": ["pedestrian.moving"] * 3, "ben": ["pedestrian.standing"] * 3}
    rows = known["instance"].values()
    categories = [known["category"][row["category_token"]]["name"] for row in rows]
    assert categories == ["human.pedestrian.child", "human.pedestrian.adult"]


def test_frames_without_a_sample_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="in none of these frames, a sweep of each scanner ends"):
        exported(tmp_path / "out", "nuscenes", Scene.from_dict(SCENE), frames="0:2")


def test_cameras_that_differ_in_case_are_refused(tmp_path: Path) -> None:
    cameras = {**SCENE["cameras"], "Room": SCENE["cameras"]["room"]}
    scene = Scene.from_dict({**SCENE, "cameras": cameras})
    with pytest.raises(ExportError, match="names that differ in case only"):
        exported(tmp_path / "out", "nuscenes", scene, frames="0:3")


@pytest.mark.nightly
def test_a_scene_without_scanners_has_a_sample_for_each_frame(tmp_path: Path) -> None:
    scene = Scene.from_dict({key: value for key, value in SCENE.items() if key != "scanners"})
    known = tables(exported(tmp_path / "out", "nuscenes", scene, frames="0:3") / "nuscenes")
    assert len(known["sample"]) == 3 and len(known["sample_data"]) == 6
    assert "lidarseg" not in known and not (tmp_path / "out" / "nuscenes" / "lidarseg").exists()
    assert {row["modality"] for row in known["sensor"].values()} == {"camera"}
    assert {row["num_lidar_pts"] for row in known["sample_annotation"].values()} == {0}
