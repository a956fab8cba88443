"""The camera: the one place where world points become pixels.

A world point goes through the extrinsics to the optical frame, is divided by its depth, falls through the
lens (lens.py) and is put on the pixels by K.

Frames and pixels are those of OpenCV and ROS (REP-103): x_cam = R x_world + t in the optical frame (z
forward, x right, y down); a pixel is (x, y) = (column, row) and the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import rq

from humansim_ros.camera.lens import Lens
from humansim_ros.errors import CameraError, HumansimWarning
from humansim_ros.rotations import transform
from humansim_ros.types import Array

#: How far a given rotation may be from orthonormal before it is refused rather than mended.
_ROTATION_SLACK = 1e-3
#: What rounding to the digits of a file makes; beyond it a mended rotation is worth a warning.
_ROTATION_ROUNDING = 1e-5
#: Largest image side that is rendered.
MAX_SIZE = 8192


@dataclass(frozen=True)
class Camera:
    """A calibrated camera.

    ``size``: (width, height) pixels. ``K``: (3, 3) intrinsics, upper triangular; skew works after the lens.
    ``R`` (3, 3), ``t`` (3,): extrinsics, world to optical frame, metres. ``distortion``: coefficients of
    ``model``, one of :data:`humansim_ros.camera.lens.MODELS`; without one it is found by their number.
    ``rectification`` (3, 3) and ``rectified`` (3, 4): R and P of CameraInfo where a file or a stereo rig says
    them. Raises CameraError, with the name of the wrong part as key, where these cannot be a camera. A
    rotation that is off by less than 1e-3 is mended with a HumansimWarning.
    """

    size: tuple[int, int]
    K: Array
    R: Array
    t: Array
    distortion: tuple[float, ...] = ()
    model: str | None = None
    rectification: Array | None = None
    rectified: Array | None = None

    def __post_init__(self) -> None:
        width, height = _checked_size(self.size)
        k, r = _matrix(self.K, (3, 3), "K"), _rotation(self.R, "R")
        t = _matrix(self.t, (3,), "t")
        if abs(k[2, 2]) <= 1e-12 * np.abs(k).max():
            raise CameraError("K is singular: its last element is zero", key="K")
        k = k / k[2, 2]
        # as a fraction of the principal point too, so that a focal length lost to rounding is found
        if min(k[0, 0], k[1, 1]) <= 1e-6 * np.abs(k).max():
            raise CameraError("K is singular or has a focal length that is not positive", key="K")
        if not np.allclose([k[1, 0], k[2, 0], k[2, 1]], 0, atol=1e-9 * k[0, 0]):
            raise CameraError("K must be upper triangular: [[fx, s, cx], [0, fy, cy], [0, 0, 1]]", key="K")
        lens = Lens.of(self.distortion, self.model)
        object.__setattr__(self, "size", (width, height))
        object.__setattr__(self, "K", k)
        object.__setattr__(self, "R", r)
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "distortion", lens.coefficients)
        object.__setattr__(self, "model", lens.model)
        if self.rectification is not None:
            object.__setattr__(self, "rectification", _rotation(self.rectification, "rectification"))
        if self.rectified is not None:
            rectified = _matrix(self.rectified, (3, 4), "rectified")
            if min(rectified[0, 0], rectified[1, 1]) <= 0 or rectified[2, 2] <= 0:
                raise CameraError("the rectified P has a focal length that is not positive", key="rectified")
            object.__setattr__(self, "rectified", rectified)

    @classmethod
    def look_at(
        cls,
        position: ArrayLike,
        target: ArrayLike,
        size: tuple[int, int] = (640, 480),
        fov: float = np.radians(60.0),
        up: ArrayLike = (0.0, 0.0, 1.0),
    ) -> Camera:
        """An ideal camera at ``position`` that sees ``target`` (world, metres) in the middle of its image.

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
    def lens(self) -> Lens:
        """What distorts the image."""
        assert self.model is not None
        return _lens(self.model, self.distortion)

    @property
    def distorted(self) -> bool:
        """Whether straight lines are not straight in its images."""
        return not self.lens.ideal

    @property
    def rectification_matrix(self) -> Array:
        """(3, 3) R of CameraInfo: optical frame to that of image_rect."""
        return np.eye(3) if self.rectification is None else self.rectification

    @cached_property
    def rectified_projection(self) -> Array:
        """(3, 4) P of CameraInfo: the frame of image_rect to its pixels.

        Where nothing else is said, that of the idealised camera (thesis 9.8): without skew, and the principal
        point in the image's middle; a camera that has no distortion and no skew is ideal enough as it is.
        """
        if self.rectified is not None:
            return self.rectified
        as_it_is = not self.distorted and self.K[0, 1] == 0
        k = self.K if as_it_is else ideal_matrix(self.K, self.size)
        return np.column_stack([k, np.zeros(3)])

    @cached_property
    def P(self) -> Array:
        """(3, 4) projection matrix K [R | t] (thesis 9.3), of the image without the lens' distortion."""
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
        """Pixels (N, 2) of image_raw and depth (N,) along z of world points (N, 3).

        A point that is not in front of the camera (depth <= 0), or beyond what the lens can see, has NaN
        pixels.
        """
        return self.project_optical(self.to_optical(points))

    def project_optical(self, points: ArrayLike) -> tuple[Array, Array]:
        """Pixels (N, 2) and depth (N,) of points (N, 3) in the optical frame."""
        p = np.asarray(points, dtype=float)
        depth = p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            if self.distorted:
                plane = self.lens.distort(p[..., :2] / depth[..., None])
                image = plane @ self.K[:2, :2].T + self.K[:2, 2]
            else:
                image = p @ self.K[:2].T / depth[..., None]
        return np.where(depth[..., None] > 0, image, np.nan), depth

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions (..., 3) with z = 1 in the optical frame that pixels (..., 2) see; NaN for pixels that
        the lens leaves dark.
        """
        uv = np.asarray(pixels, dtype=float)
        homogeneous = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1)
        directions = homogeneous @ np.linalg.inv(self.K).T
        if not self.distorted:
            return directions
        return np.concatenate([self.lens.undistort(directions[..., :2]), homogeneous[..., 2:]], axis=-1)

    def unproject(self, pixels: ArrayLike, depth: ArrayLike) -> Array:
        """World points (N, 3) of pixels (N, 2) at depths (N,) along z: the inverse of :meth:`project`."""
        rays = self.rays(pixels)
        return (rays * np.asarray(depth, dtype=float)[..., None] - self.t) @ self.R

    def opengl_clip(self, near: float, far: float) -> Array:
        """(4, 4) optical frame to OpenGL clip coordinates: the one place that knows both pixel conventions.

        It knows no lens: of a distorted camera it takes points that have been through the lens, at their
        depth.
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


@lru_cache(maxsize=256)
def _lens(model: str, coefficients: tuple[float, ...]) -> Lens:
    """One lens for all cameras that have it: what was worked out of it is kept."""
    return Lens(model, coefficients)


def ideal_matrix(K: Array, size: tuple[int, int], square: bool = False, center: bool = True) -> Array:
    """(3, 3) intrinsics of the ideal camera (thesis 9.8): without skew.

    ``square``: pixels are square, both focal lengths become their geometric mean. ``center``: the principal
    point is moved to the image's middle.
    """
    fx, fy = float(K[0, 0]), float(K[1, 1])
    if square:
        fx = fy = float(np.sqrt(fx * fy))
    cx, cy = ((n - 1) / 2 for n in size) if center else K[:2, 2]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=float)


def _rotation(value: ArrayLike, key: str) -> Array:
    """A rotation matrix, mended where rounding or a careless file left it a little off."""
    r = _matrix(value, (3, 3), key)
    off = float(np.abs(r @ r.T - np.eye(3)).max())
    if off > _ROTATION_SLACK or np.linalg.det(r) < 0:
        raise CameraError(f"{key} is not a rotation matrix (orthonormal, determinant +1)", key=key)
    if off > _ROTATION_ROUNDING:
        message = f"{key} is a rotation matrix only to {off:.1g}: the nearest rotation is used"
        warnings.warn(message, HumansimWarning, stacklevel=4)
    if off <= 1e-12:
        return r
    # orthonormal to rounding, so that the published extrinsics are a rigid transform
    u, _, vt = np.linalg.svd(r)
    return np.asarray(u @ vt, dtype=float)


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
