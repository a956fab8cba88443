"""Projection of points by OpenCV, the reference of our own projection."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from humansim_ros.cameras import Camera


def opencv_pixels(camera: Camera, points: ArrayLike) -> NDArray[np.float64]:
    """Pixels (N, 2) of world points (N, 3). OpenCV has no skew, so K is applied afterwards."""
    points = np.asarray(points, dtype=float)[:, None]
    rotation, d = cv2.Rodrigues(camera.R)[0], np.array(camera.distortion)
    project = cv2.fisheye.projectPoints if camera.model == "equidistant" else cv2.projectPoints
    plane = project(points, rotation, camera.t, np.eye(3), d)[0].reshape(-1, 2)
    return np.column_stack([plane, np.ones(len(plane))]) @ camera.K[:2].T
