"""Coverage of a floor compared with projection by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from humansim_ros.cameras import Camera, Coverage
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.errors import CameraError

TARGET = np.array([0.5, -1.0, 1.1])
OPTICS = Optics((640, 480), np.radians(50))


def seen_by(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) are in the image by OpenCV's projection."""
    pixels, _ = cv2.projectPoints(
        points, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, np.array(camera.distortion)
    )
    ahead = (points @ camera.R.T + camera.t)[:, 2] > 0
    return ahead & ((pixels[:, 0] > -0.5) & (pixels[:, 0] < np.array(camera.size) - 0.5)).all(axis=1)


def test_coverage_counts_the_cameras_that_see_a_point_or_all_of_a_person() -> None:
    cameras = Rig(TARGET, 3, 2.2, OPTICS).ring(5) | {"side": OPTICS.camera((3, 3, 1), (0, 0, 1))}
    x, y = np.linspace(-3, 4, 15), np.linspace(-4, 2, 13)
    chest, whole = Coverage.of(cameras, x, y, 1.2), Coverage.of(cameras, x, y, 0.0, 1.8)
    heights = np.linspace(0, 1.8, 7)
    for row, column in np.ndindex(13, 15):
        upright = np.column_stack([np.tile([x[column], y[row]], (7, 1)), heights])
        point = np.array([[x[column], y[row], 1.2]])
        assert chest.counts[row, column] == sum(seen_by(camera, point)[0] for camera in cameras.values())
        assert whole.counts[row, column] == sum(seen_by(camera, upright).all() for camera in cameras.values())
    assert 0 < whole.counts.sum() < chest.counts.sum()
    assert chest.area(0, 6) == pytest.approx(15 * 13 * 0.5 * 0.5)
    with pytest.raises(CameraError, match="two positions"):
        Coverage.of(cameras, [0.0], y, 1.2)
    assert chest.area(6, 6) == (chest.counts == 6).sum() * 0.25
