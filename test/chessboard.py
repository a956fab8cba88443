"""A chessboard, its poses in front of a camera, and its calibration by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh

Floats = NDArray[np.floating[Any]]
#: Squares of the board along x and y, and pixels of a square's picture. A square is the unit of length.
COLUMNS, ROWS, CELL = 12, 9, 32
CORNERS = np.array(
    [(x - COLUMNS / 2, y - ROWS / 2, 0) for y in range(1, ROWS) for x in range(1, COLUMNS)], np.float32
)
VIEWS = 20
#: A real lens.
BARREL = (-0.361976, 0.110510, 0.001014, 0.000505, 0.0)


def board() -> Mesh:
    """A printed board with a white margin: a quad with a filtered texture."""
    row, column = np.indices(((ROWS + 2) * CELL, (COLUMNS + 2) * CELL)) // CELL - 1
    black = (row >= 0) & (row < ROWS) & (column >= 0) & (column < COLUMNS) & ((row + column) % 2 == 0)
    print_ = np.where(black[..., None], 0, 255).repeat(3, axis=2).astype(np.uint8)
    x, y = COLUMNS / 2 + 1, ROWS / 2 + 1
    corners = np.array([(-x, -y, 0), (-x, y, 0), (x, y, 0), (x, -y, 0)])
    face = np.array([[0, 1, 2, 3]], np.int32)
    return Mesh(corners, face, np.array([(0, 1), (0, 0), (1, 0), (1, 1.0)]), face, texture=print_)


def held_up(camera: Camera, rng: np.random.Generator) -> tuple[Rotation, Floats]:
    """A place of the board where it is leant, its corners fill half of the picture or more, and none comes so
    near to the next that both are in the window they are looked for in.
    """
    while True:
        turn, lean = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(10, 45))
        rotation = Rotation.from_rotvec([lean * np.cos(turn), lean * np.sin(turn), 0])
        rotation = rotation * Rotation.from_euler("z", rng.normal(0, 0.2))
        middle = camera.unproject(rng.uniform(0, 1, (1, 2)) * camera.size, rng.uniform(5, 30, 1))
        pixels = camera.project(rotation.apply(CORNERS) + middle)[0]
        inside = (pixels > 8).all() and (pixels < np.array(camera.size) - 9).all()  # NaN is not
        rows = pixels.reshape(ROWS - 1, COLUMNS - 1, 2)
        steps = [np.linalg.norm(np.diff(rows, axis=axis), axis=2).min() for axis in (0, 1)]
        if inside and np.ptp(pixels[:, 0]) > 0.45 * camera.size[0] and min(steps) > 14:
            return rotation, middle


def found(gray: NDArray[np.uint8]) -> Floats | None:
    """Corners (N, 2) detected by OpenCV, None without a board."""
    seen, corners = cv2.findChessboardCorners(gray, (COLUMNS - 1, ROWS - 1))
    if not seen:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    return cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), criteria).reshape(-1, 2)


@dataclass(frozen=True)
class Calibrated:
    rms: float
    K: Floats
    D: Floats


def calibrate(board: Floats, views: list[Floats], size: tuple[int, int], model: str) -> Calibrated:
    """Calibration by OpenCV from corners (N, 3) of a board and their pixels (N, 2) in each view."""
    if model != "equidistant":
        flags = cv2.CALIB_RATIONAL_MODEL if model == "rational_polynomial" else 0
        boards, corners = [board] * len(views), [v.astype(np.float32) for v in views]
        rms, k, d, *_ = cv2.calibrateCamera(boards, corners, size, None, None, flags=flags)
        return Calibrated(rms, k, d.ravel()[: 8 if flags else 5])
    # of cv2.fisheye in OpenCV 4, of cv2 in OpenCV 5
    names = ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW")
    flags = sum(getattr(cv2.fisheye, name, None) or getattr(cv2, name) for name in names)
    boards, corners = [board[None].astype(float)] * len(views), [v[None].astype(float) for v in views]
    rms, k, d, *_ = cv2.fisheye.calibrate(boards, corners, size, np.eye(3), np.zeros(4), flags=flags)
    return Calibrated(rms, k, d.ravel())


def assert_finds(found: Calibrated, k: Floats) -> None:
    np.testing.assert_allclose(np.diag(found.K)[:2], np.diag(k)[:2], rtol=1e-3)
    assert np.abs(found.K[:2, 2] - k[:2, 2]).max() < 0.3
    assert found.rms < 0.1
