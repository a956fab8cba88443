"""The rig of a scene: cameras of a calibration file, and their place in ``map``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, write_calibration
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.errors import CameraError, HumansimWarning, SceneError

RIG = Rig((0, 0, 1), 3, 1.5, Optics()).ring(3)


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


K = "[700, 0, 310, 0, 690, 245, 0, 0, 1]"


def easymocap(tmp_path: Path, posed: str) -> None:
    (tmp_path / "intri.yml").write_text("%YAML:1.0\n---\n" + "".join(f"K_{n}: {K}\n" for n in "ab"))
    if posed:
        poses = "".join(f"R_{n}: [0, 0, 0]\nT_{n}: [0, 0, 3]\n" for n in posed)
        (tmp_path / "extri.yml").write_text("%YAML:1.0\n---\n" + poses)
    (tmp_path / "scene.yaml").write_text("room: null\nrig: {file: intri.yml, size: [640, 480]}\n")


def test_cameras_without_extrinsics_are_not_put_at_the_origin(tmp_path: Path) -> None:
    easymocap(tmp_path, posed="b")
    with pytest.warns(HumansimWarning, match="no extrinsics of them: a"):
        assert list(Scene.load(tmp_path / "scene.yaml").cameras) == ["b"]


def test_a_camera_without_extrinsics_can_have_its_pose_in_the_scene(tmp_path: Path) -> None:
    easymocap(tmp_path, posed="b")
    camera = "{calibration: intri.yml, camera: a, size: [640, 480], position: [3, 0, 1], look_at: [0, 0, 1]}"
    (tmp_path / "scene.yaml").write_text(f"room: null\ncameras: {{one: {camera}}}\n")
    assert_allclose(Scene.load(tmp_path / "scene.yaml").cameras["one"].center, [3, 0, 1], atol=1e-12)


def test_a_rig_without_any_extrinsics_is_refused(tmp_path: Path) -> None:
    easymocap(tmp_path, posed="")
    with pytest.warns(HumansimWarning), pytest.raises(CameraError) as caught:
        Scene.load(tmp_path / "scene.yaml")
    assert "rig.file: intri.yml has no extrinsics: give each of its cameras in 'cameras'" in str(caught.value)
    assert caught.value.line == 2


def test_a_single_camera_without_extrinsics_can_be_placed(tmp_path: Path) -> None:
    (tmp_path / "one.yml").write_text(f"%YAML:1.0\n---\nK: {K}\n")
    rig = "rig: {file: one.yml, size: [640, 480], position: [0, -3, 1], rotation_deg: [-90, 0, 0]}"
    (tmp_path / "scene.yaml").write_text(f"room: null\n{rig}\n")
    # it looked along z of the file, which is now y of map
    (camera,) = Scene.load(tmp_path / "scene.yaml").cameras.values()
    assert_allclose(camera.project([[0, 0, 1]])[0], [[310, 245]], atol=1e-9)
