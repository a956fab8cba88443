"""RigPlacement of rigs in ``map``, judged by the rigid motion that took a known rig away from its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.placement import RigPlacement, common_point
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.types import Array


def moved_rig(seed: int, cameras: dict[str, Camera]) -> tuple[dict[str, Camera], Array]:
    """Cameras in the world of a file, and the pose (4, 4) of that world in ``map``."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(None, rng).as_matrix(), rng.uniform(-5, 5, 3)
    in_file = {}
    for name, camera in cameras.items():
        optical_from_file = camera.optical_from_world @ pose
        in_file[name] = replace(camera, R=optical_from_file[:3, :3], t=optical_from_file[:3, 3])
    return in_file, pose


@pytest.mark.parametrize("seed", range(5))
def test_a_placement_takes_cameras_back_to_their_place(seed: int) -> None:
    rig = Rig((0.3, 0.1, 1), 3, 2, Optics(distortion=(-0.2, 0.1, 0, 0))).ring(5)
    in_file, pose = moved_rig(seed, rig)
    placement = RigPlacement(pose[:3, :3], pose[:3, 3])
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
    again = RigPlacement.from_degrees(angles, pose[:3, 3])
    points = np.random.default_rng(seed).uniform([-1, -1, 0], [1, 1, 2], (20, 3))
    for name, camera in rig.items():
        for one in (placement, again):
            placed = one.camera(in_file[name])
            assert_allclose(placed.project(points)[0], camera.project(points)[0], atol=1e-8)
    assert_allclose(placement.points(points @ pose[:3, :3] - pose[:3, 3] @ pose[:3, :3]), points, atol=1e-12)
    assert_allclose(
        RigPlacement.from_degrees(placement.rotation_deg).rotation, placement.rotation, atol=1e-12
    )


@pytest.mark.parametrize("angles", [(0, 90, 0), (30, 90, 20), (10, -90, 0)])
def test_quarter_turns_about_y_have_angles(angles: tuple[float, float, float]) -> None:
    wanted = RigPlacement.from_degrees(angles).rotation
    found = RigPlacement(wanted, np.zeros(3)).rotation_deg
    assert_allclose(RigPlacement.from_degrees(found).rotation, wanted, atol=1e-9)


def test_the_optical_axes_of_a_ring_meet_at_its_target() -> None:
    target = (0.4, -0.2, 1.1)
    assert_allclose(common_point(Rig(target, 3, 2, Optics()).ring(4).values()), target, atol=1e-12)
    assert common_point(Rig(target, 3, 1, Optics()).stereo(0.2).values()) is None
    outward = [Camera.look_at((x, y, 1), (2 * x, 2 * y, 1)) for x, y in ((1, 0), (0, 1), (-1, 0))]
    assert common_point(outward) is None
