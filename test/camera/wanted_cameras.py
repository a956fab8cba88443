"""Random cameras whose calibration files tests write, and the pixels of points by OpenCV."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera, read_calibration
from humansim_ros.types import Array

SIZE = (640, 480)
D = (-0.21, 0.09, 1.5e-3, -8e-4, 0.03)
FISHEYE = (-0.02, 0.01, 3e-3, -1e-3)
#: Half turn about the x axis: between the camera axes of OpenGL and of OpenCV.
FLIP = np.diag([1.0, -1.0, -1.0])
#: Largest error of a projection in pixels.
TOLERANCE = 1e-5


class Wanted:
    """A random camera at some metres from the origin: what its file says in other words."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.K = np.array([[700.0 + seed, 0, 310.4], [0, 690, 245.3], [0, 0, 1]])
        self.R = Rotation.random(None, rng).as_matrix()
        self.t = np.array([0.2, -0.1, 4.0]) + rng.uniform(-0.5, 0.5, 3)

    @property
    def center(self) -> Array:
        return -self.R.T @ self.t

    def points(self) -> Array:
        """Points (N, 3) in the world, metres, before the camera."""
        optical = np.random.default_rng(1).uniform([-0.9, -0.6, 2.5], [0.9, 0.6, 4], (40, 3))
        return np.asarray((optical - self.t) @ self.R)

    def pixels(self, d: tuple[float, ...] = D, fisheye: bool = False) -> Array:
        """Pixels of these points by OpenCV."""
        rvec, points = cv2.Rodrigues(self.R)[0], self.points()
        if fisheye:
            return np.asarray(
                cv2.fisheye.projectPoints(points[:, None], rvec, self.t, self.K, np.array(d))[0]
            )[:, 0]
        return np.asarray(cv2.projectPoints(points, rvec, self.t, self.K, np.array(d))[0])[:, 0]


CAMERAS = {f"cam{seed}": Wanted(seed) for seed in range(3)}


def read(tmp_path: Path, name: str, content: Any, **options: Any) -> dict[str, Camera]:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_calibration(path, **options)


def assert_same(cameras: dict[str, Camera], d: tuple[float, ...] = D, fisheye: bool = False) -> None:
    assert list(cameras) == list(CAMERAS)
    for name, wanted in CAMERAS.items():
        assert cameras[name].size == SIZE
        assert_allclose(cameras[name].project(wanted.points())[0], wanted.pixels(d, fisheye), atol=TOLERANCE)
