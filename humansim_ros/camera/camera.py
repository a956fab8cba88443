"""The camera: the one place where world points become pixels.

Frames and pixels are those of OpenCV and ROS (REP-103): x_cam = R x_world + t in the optical frame (z
forward, x right, y down); a pixel is (x, y) = (column, row) and the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import rq

from humansim_ros.errors import CameraError
from humansim_ros.rotations import Array, transform

#: How far a given rotation may be from orthonormal before it is refused rather than mended.
_ROTATION_SLACK = 1e-3
#: Largest image side that is rendered.
MAX_SIZE = 8192


@dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera.

    ``size``: (width, height) pixels. ``K``: (3, 3) intrinsics. ``R`` (3, 3), ``t`` (3,): extrinsics, world to
    optical frame, metres. ``distortion``: coefficients; only zeros are supported so far (idealise the images
    and the calibration first). Raises CameraError, with the name of the wrong part as key, where these cannot
    be a camera.
    """

    size: tuple[int, int]
    K: Array
    R: Array
    t: Array
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        width, height = _checked_size(self.size)
        k, r = _matrix(self.K, (3, 3), "K"), _matrix(self.R, (3, 3), "R")
        t = _matrix(self.t, (3,), "t")
        if abs(k[2, 2]) <= 1e-12 * np.abs(k).max():
            raise CameraError("K is singular: its last element is zero", key="K")
        k = k / k[2, 2]
        # as a fraction of the principal point too, so that a focal length lost to rounding is found
        if min(k[0, 0], k[1, 1]) <= 1e-6 * np.abs(k).max():
            raise CameraError("K is singular or has a focal length that is not positive", key="K")
        if not np.allclose([k[1, 0], k[2, 0], k[2, 1]], 0, atol=1e-9 * k[0, 0]):
            raise CameraError("K must be upper triangular: [[fx, s, cx], [0, fy, cy], [0, 0, 1]]", key="K")
        if np.abs(r @ r.T - np.eye(3)).max() > _ROTATION_SLACK or np.linalg.det(r) < 0:
            raise CameraError("R is not a rotation matrix (orthonormal, determinant +1)", key="R")
        if np.any(np.asarray(self.distortion, dtype=float)):
            raise CameraError(
                "lens distortion is not rendered yet: give an undistorted calibration", key="distortion"
            )
        u, _, vt = np.linalg.svd(r)
        object.__setattr__(self, "size", (width, height))
        object.__setattr__(self, "K", k)
        # orthonormal to rounding, so that the published extrinsics are a rigid transform
        object.__setattr__(self, "R", u @ vt if np.abs(r @ r.T - np.eye(3)).max() > 1e-12 else r)
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "distortion", tuple(float(d) for d in self.distortion))

    @classmethod
    def look_at(
        cls,
        position: ArrayLike,
        target: ArrayLike,
        size: tuple[int, int] = (640, 480),
        fov: float = np.radians(60.0),
        up: ArrayLike = (0.0, 0.0, 1.0),
    ) -> Camera:
        """A camera at ``position`` that sees ``target`` (world, metres) in the middle of its image.

        ``fov``: horizontal field of view in radians. Square pixels; the principal point is the image's
        middle, ((width - 1) / 2, (height - 1) / 2).
        """
        width, height = _checked_size(size)
        if not 0 < fov < np.pi:
            raise CameraError(
                f"the field of view must be between 0 and 180 degrees, not {np.degrees(fov):g}", key="fov"
            )
        centre = _matrix(position, (3,), "position")
        forward = _matrix(target, (3,), "look_at") - centre
        right = np.cross(forward, _matrix(up, (3,), "up"))
        if np.linalg.norm(forward) < 1e-9:
            raise CameraError("position and look_at are the same point", key="look_at")
        if np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
            raise CameraError("the camera looks straight along its up direction: give another 'up'", key="up")
        z = forward / np.linalg.norm(forward)
        x = right / np.linalg.norm(right)
        rotation = np.stack([x, np.cross(z, x), z])
        f = width / 2 / np.tan(fov / 2)
        k = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])
        return cls(size, k, rotation, -rotation @ centre)

    @classmethod
    def from_projection_matrix(cls, P: ArrayLike, size: tuple[int, int]) -> Camera:
        """The camera of a 3x4 projection matrix P = K [R | t] of any scale and sign (thesis 9.8, RQ
        decomposition).
        """
        p = _matrix(P, (3, 4), "P")
        if abs(np.linalg.det(p[:, :3])) <= 1e-12 * np.abs(p[:, :3]).max() ** 3:
            raise CameraError("P is singular: its camera is at infinity or it is no projection", key="P")
        p = p * np.sign(np.linalg.det(p[:, :3]))
        k, r = rq(p[:, :3])
        signs = np.diag(np.sign(np.diag(k)))
        k, r = k @ signs, signs @ r
        return cls(size, k / k[2, 2], r, np.linalg.solve(k, p[:, 3]))

    @cached_property
    def P(self) -> Array:
        """(3, 4) projection matrix K [R | t] (thesis 9.3)."""
        return self.K @ np.column_stack([self.R, self.t])

    @property
    def center(self) -> Array:
        """(3,) camera centre in the world, C = -R^T t."""
        return -self.R.T @ self.t

    @property
    def optical_from_world(self) -> Array:
        """(4, 4) world to optical frame."""
        return transform(self.R, self.t)

    @property
    def world_from_optical(self) -> Array:
        """(4, 4) pose of the optical frame in the world."""
        return transform(self.R.T, self.center)

    def to_optical(self, points: ArrayLike) -> Array:
        """World points (..., 3) in the optical frame (..., 3), metres."""
        return np.asarray(points, dtype=float) @ self.R.T + self.t

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Pixels (N, 2) and depth (N,) along z of world points (N, 3).

        A point that is not in front of the camera (depth <= 0) has NaN pixels.
        """
        return self.project_optical(self.to_optical(points))

    def project_optical(self, points: ArrayLike) -> tuple[Array, Array]:
        """Pixels (N, 2) and depth (N,) of points (N, 3) in the optical frame."""
        p = np.asarray(points, dtype=float)
        depth = p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            image = p @ self.K[:2].T / depth[..., None]
        return np.where(depth[..., None] > 0, image, np.nan), depth

    def unproject(self, pixels: ArrayLike, depth: ArrayLike) -> Array:
        """World points (N, 3) of pixels (N, 2) at depths (N,) along z: the inverse of :meth:`project`."""
        uv = np.asarray(pixels, dtype=float)
        rays = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1) @ np.linalg.inv(self.K).T
        return (rays * np.asarray(depth, dtype=float)[..., None] - self.t) @ self.R

    def opengl_clip(self, near: float, far: float) -> Array:
        """(4, 4) optical frame to OpenGL clip coordinates: the one place that knows both pixel conventions.

        OpenGL's window has pixel centres at half-integers, so the principal point is moved by +0.5. The
        image's first row is the window's lowest, so that a read-back comes top row first. Depth is the
        standard perspective row, -1 at ``near``.
        """
        width, height = self.size
        k = self.K
        return np.array(
            [
                [2 * k[0, 0] / width, 2 * k[0, 1] / width, 2 * (k[0, 2] + 0.5) / width - 1, 0],
                [0, 2 * k[1, 1] / height, 2 * (k[1, 2] + 0.5) / height - 1, 0],
                [0, 0, (far + near) / (far - near), -2 * far * near / (far - near)],
                [0, 0, 1, 0],
            ]
        )


def _checked_size(size: tuple[int, int]) -> tuple[int, int]:
    """Width and height, if they are whole numbers that an image can have."""
    try:
        width, height = (int(n) for n in size)
        whole = (width, height) == tuple(size)
    except (TypeError, ValueError, OverflowError):
        whole = False
    if not whole:
        raise CameraError(
            f"the image size must be two whole numbers, width and height, not {size}", key="size"
        )
    if not (0 < width <= MAX_SIZE and 0 < height <= MAX_SIZE):
        raise CameraError(f"the image size must be 1 to {MAX_SIZE} pixels, not {width}x{height}", key="size")
    return width, height


def _matrix(value: ArrayLike, shape: tuple[int, ...], key: str) -> Array:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise CameraError(f"needs numbers of shape {shape}", key=key) from None
    if array.shape != shape:
        raise CameraError(f"needs numbers of shape {shape}, not {array.shape}", key=key)
    if not np.isfinite(array).all():
        raise CameraError("a number is not finite (NaN or infinity)", key=key)
    return array
