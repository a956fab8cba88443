"""Upright boxes against trimesh, and the smallest rectangle that contains the projection on the floor."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from humansim_ros.scene import upright_box

JOINTS = ("l_hip", "head", "r_hip")


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.9, 3.1])
def test_box_of_a_turned_brick_is_the_brick(yaw: float) -> None:
    brick = trimesh.creation.box((0.3, 0.5, 1.8)).subdivide()
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    pose[:3, 3] = (2.0, -1.0, 0.95)
    joints = trimesh.transform_points([[0, 0.1, 0], [0, 0, 0.8], [0, -0.1, 0]], pose)
    brick.apply_transform(pose)
    box = upright_box(np.asarray(brick.vertices), JOINTS, joints)
    np.testing.assert_allclose(box.center, (2.0, -1.0, 0.95), atol=1e-12)
    np.testing.assert_allclose(box.size, (0.3, 0.5, 1.8), atol=1e-12)
    np.testing.assert_allclose(box.bottom, (2.0, -1.0, 0.05), atol=1e-12)
    assert box.yaw == pytest.approx(yaw)
    np.testing.assert_allclose(Rotation.from_quat(box.quaternion).as_matrix(), pose[:3, :3], atol=1e-12)


def test_every_side_of_a_box_touches_the_body_and_none_cuts_it() -> None:
    points = np.random.default_rng(3).normal(size=(500, 3)) * (0.2, 0.3, 0.5)
    joints = np.array([[0.1, 0.2, 1.0], [0.0, 0.0, 1.6], [-0.1, 0.0, 1.0]])
    box = upright_box(points, JOINTS, joints)
    own = Rotation.from_quat(box.quaternion).inv().apply(points - box.center)
    np.testing.assert_allclose(own.max(axis=0), box.size / 2, atol=1e-12)
    np.testing.assert_allclose(own.min(axis=0), -box.size / 2, atol=1e-12)
    ahead = Rotation.from_quat(box.quaternion).apply([1, 0, 0])
    assert ahead @ (joints[0] - joints[2])[:3] == pytest.approx(0)  # the hips are across
