"""RigPlacement of a rig: the pose of the world of a calibration file in ``map``.

The world of most calibrations is the first camera or a board. A placement moves all cameras of a file
together, so that ``map`` has its floor at z = 0.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from humansim_ros.camera.camera import Camera
from humansim_ros.types import Array

#: Largest condition number of the equations of optical axes that meet in a point.
_PARALLEL = 1e4


@dataclass(frozen=True)
class RigPlacement:
    """Pose of the world of a file in ``map``: x_map = rotation x_file + position.

    ``rotation`` (3, 3), ``position`` (3,) metres.
    """

    rotation: Array = field(default_factory=lambda: np.eye(3))
    position: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def from_degrees(cls, rotation_deg: ArrayLike, position: ArrayLike = (0.0, 0.0, 0.0)) -> RigPlacement:
        """RigPlacement from angles (3,) about the x axis of ``map``, then y, then z, in degrees."""
        rotation = scipy.spatial.transform.Rotation.from_euler(
            "xyz", np.asarray(rotation_deg, dtype=float), degrees=True
        )
        return cls(np.asarray(rotation.as_matrix()), np.asarray(position, dtype=float))

    @property
    def rotation_deg(self) -> Array:
        """Angles (3,) of :meth:`from_degrees`, degrees."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a quarter turn about y has many triples of angles: one is right
            angles = scipy.spatial.transform.Rotation.from_matrix(self.rotation).as_euler("xyz", degrees=True)
        return np.asarray(angles, dtype=float)

    def points(self, points: ArrayLike) -> Array:
        """Points (..., 3) of the file in ``map``."""
        return np.asarray(points, dtype=float) @ self.rotation.T + self.position

    def camera(self, camera: Camera) -> Camera:
        """Camera in ``map`` of a camera in the world of the file."""
        r = camera.R @ self.rotation.T
        return replace(camera, R=r, t=camera.t - r @ self.position)

    def moved(self, offset: ArrayLike) -> RigPlacement:
        """The same placement, moved by an offset (3,) in ``map``, metres."""
        return RigPlacement(self.rotation, self.position + np.asarray(offset, dtype=float))


def common_point(cameras: Iterable[Camera]) -> Array | None:
    """Point (3,) nearest to the optical axes of all cameras.

    None if the axes are parallel, or if the point is behind most cameras.
    """
    rig = list(cameras)
    axes = np.array([camera.R[2] for camera in rig])
    centers = np.array([camera.center for camera in rig])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(0)
    if np.linalg.cond(total) > _PARALLEL:
        return None
    point = np.linalg.solve(total, np.einsum("nij,nj->i", across, centers))
    in_front = np.einsum("ni,ni->n", point - centers, axes) > 0
    return np.asarray(point, dtype=float) if in_front.mean() > 0.5 else None
