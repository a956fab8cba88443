"""Rotations of calibration files: matrices, or rotation vectors as of cv2.Rodrigues."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.camera.formats.base import CalibrationFile, Key
from humansim_ros.types import Array


def rotation_of(file: CalibrationFile, *keys: Key) -> Array:
    """Matrix (3, 3) of 9 numbers in row order, or of a rotation vector of 3 numbers, radians."""
    values = file.some_numbers(*keys)
    if len(values) == 3:
        return np.asarray(Rotation.from_rotvec(values).as_matrix(), dtype=float)
    return file.numbers((3, 3), *keys)


def vector_of(rotation: Array) -> Array:
    """Rotation vector (3,) of a matrix (3, 3), radians."""
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec(), dtype=float)
