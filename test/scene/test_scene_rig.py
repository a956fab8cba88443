"""The rig of a scene: cameras of a calibration file, and their place in ``map``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, write_calibration
from humansim_ros.camera.rigs import Optics, ring
from humansim_ros.errors import SceneError

RIG = ring(3, 3, 1.5, (0, 0, 1), Optics())


def scene_with(tmp_path: Path, rig: str) -> Scene:
    write_calibration(tmp_path / "rig.yaml", RIG, "scene")
    (tmp_path / "scene.yaml").write_text(f"room: null\nrig: {{file: rig.yaml, {rig}}}\n")
    return Scene.load(tmp_path / "scene.yaml")


def test_position_and_rotation_move_the_world_of_the_file(tmp_path: Path) -> None:
    scene = scene_with(tmp_path, "position: [1, 2, 3], rotation_deg: [20, -30, 40]")
    # about the fixed axes x, then y, then z: three matrices from the formula
    x, y, z = (
        Rotation.from_rotvec(np.radians(a) * e).as_matrix()
        for a, e in zip((20, -30, 40), np.eye(3), strict=True)
    )
    for name, camera in RIG.items():
        assert_allclose(scene.cameras[name].center, z @ y @ x @ camera.center + [1, 2, 3], atol=1e-12)
        assert_allclose(scene.cameras[name].R, camera.R @ (z @ y @ x).T, atol=1e-12)


def test_look_at_places_the_point_that_all_cameras_see(tmp_path: Path) -> None:
    scene = scene_with(tmp_path, "look_at: [4, -1, 0.9], rotation_deg: [0, 0, 90]")
    for camera in scene.cameras.values():
        assert_allclose(camera.project([[4, -1, 0.9]])[0], [[319.5, 239.5]], atol=1e-6)


def test_one_of_position_and_look_at_is_given(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="placed by position and by look_at") as caught:
        scene_with(tmp_path, "look_at: [0, 0, 1], position: [0, 0, 1]")
    assert caught.value.line == 2
