"""Conventions of R and t that a file does not state: what the views say, and what they cannot say."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from numpy.testing import assert_allclose

from humansim_ros.cameras import read_calibration
from humansim_ros.errors import HumansimWarning

sys.path.append(str(ROOT / "benchmarks"))

from conventions import MISSES, WORLDS, K, random_ring, verdict

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("miss", MISSES)
def test_no_random_ring_is_read_wrong_without_a_doubt(tmp_path: Path, world: str, miss: float) -> None:
    rng = np.random.default_rng(7)
    for number in range(16):
        ring = random_ring(rng, miss, WORLDS[world])
        wrong, doubtful = verdict(ring, bool(number % 2), tmp_path / "rig.json")
        assert doubtful or not wrong
        assert world != "z up" or not wrong


def even_ring(count: int) -> Any:
    """Poses (N, 4, 4) of equal cameras around a person; the world has the axes of the first camera."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, 2 * np.pi * np.arange(count) / count, strict=True):
        forward = -np.array([np.cos(angle), np.sin(angle), 0.2]) / np.hypot(1, 0.2)
        right = np.cross(forward, [0, 0, 1.0]) / np.hypot(*forward[:2])
        pose[:3, :3] = right, np.cross(forward, right), forward
        pose[2, 3] = 3.0
    return poses @ np.linalg.inv(poses[0])


def cameras_of(poses: Any) -> list[dict[str, Any]]:
    return [{"K": K, "size": [1280, 720], "pose": pose.tolist()} for pose in poses]


def test_a_ring_whose_readings_are_mirror_images_is_doubtful(tmp_path: Path) -> None:
    """Both readings meet in a point exactly: no view can tell them."""
    assert verdict(even_ring(6), False, tmp_path / "rig.json")[1]
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({"unit": "m", "cameras": cameras_of(even_ring(6))}))
    with pytest.warns(HumansimWarning, match="but perhaps they are") as caught:
        read_calibration(path)
    said = str(caught[0].message)
    for text, name in (
        ("from the camera to the world", "camera_to_world"),
        ("from the world", "world_to_camera"),
    ):
        assert text in said
        assert f'"{name}"' in said.partition('to state it, add "convention": ')[2]


READINGS = {
    "world_to_camera": lambda pose: pose,
    "camera_to_world": np.linalg.inv,
    "camera_center": lambda pose: np.vstack(
        [np.column_stack([pose[:3, :3], np.linalg.inv(pose)[:3, 3]]), pose[3]]
    ),
    "transposed": lambda pose: np.vstack([np.column_stack([pose[:3, :3].T, pose[:3, 3]]), pose[3]]),
    "opengl": lambda pose: np.linalg.inv(pose) @ FLIP,
}


@pytest.mark.parametrize("convention", READINGS)
@pytest.mark.parametrize("listed", [False, True])
def test_a_stated_convention_needs_no_views_and_no_warning(
    tmp_path: Path, convention: str, listed: bool
) -> None:
    ring = even_ring(5)
    cameras = cameras_of(READINGS[convention](pose) for pose in ring)
    for camera in cameras if listed else ():
        camera |= {"convention": convention, "unit": "m"}
    path = tmp_path / "rig.json"
    path.write_text(
        json.dumps(cameras if listed else {"convention": convention, "unit": "m", "cameras": cameras})
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = read_calibration(path, unit=1.0).values()
    for camera, pose in zip(read, ring, strict=True):
        assert_allclose(camera.optical_from_world, pose, atol=1e-9)
