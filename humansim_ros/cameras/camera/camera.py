"""The camera: the only place that projects world points to pixels.

The extrinsics transform a world point to the optical frame. The point is divided by its depth, distorted by
the lens (``cameras/camera/lens.py``), and mapped to pixels by K.

Frames and pixels are as in OpenCV and ROS (REP-103): x_cam = R x_world + t in the optical frame (z
forward, x right, y down); a pixel is (x, y) = (column, row), and the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from humansim_ros.cameras.camera.lens import Lens
from humansim_ros.errors import CameraError, HumansimWarning
from humansim_ros.geometry import nearest_rotations, transform
from humansim_ros.pictures import Pictured
from humansim_ros.types import Array, ImageSize

#: A rotation is corrected up to this error of orthonormality. A matrix with a larger error is refused.
_ROTATION_TOLERANCE = 1e-3
#: An error of orthonormality up to this comes from rounded numbers in files. A larger one causes a warning.
_ROTATION_ROUNDING = 1e-5
#: Largest image side in pixels.
MAX_SIZE = 8192


@dataclass(frozen=True, repr=False)
class Camera(Pictured):
    """A calibrated camera.

    Args:
        size: Width and height of the image in pixels.
        K: Intrinsics, (3, 3), upper triangular. The skew acts on distorted points.
        R: Rotation from the world to the optical frame, (3, 3). An error of orthonormality below 1e-3 is
            corrected, with a HumansimWarning from 1e-5.
        t: Translation from the world to the optical frame, (3,) metres.
        distortion: Distortion coefficients of ``model``.
        model: One of :data:`humansim_ros.cameras.camera.lens.MODELS`. If None, the number of coefficients
            decides.
        rectification: R of CameraInfo, (3, 3). None unless a file or a stereo rig defines R.
        rectified: P of CameraInfo, (3, 4). None unless a file or a stereo rig defines P.

    Raises:
        CameraError: No camera can have these values. The key of the error is the name of the wrong argument.
    """

    size: ImageSize
    K: Array
    R: Array
    t: Array
    distortion: tuple[float, ...] = ()
    model: str | None = None
    rectification: Array | None = None
    rectified: Array | None = None
    #: Distortion model and coefficients. Equal cameras share one lens, so that values derived from the lens
    #: are computed once.
    lens: Lens = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        width, height = _checked_size(self.size)
        k, r = _matrix(self.K, (3, 3), "K"), _rotation(self.R, "R")
        t = _matrix(self.t, (3,), "t")
        if abs(k[2, 2]) <= 1e-12 * np.abs(k).max():
            raise CameraError("K is singular: its last element is zero", key="K")
        k = k / k[2, 2]
        # compared with the principal point too, to detect a focal length that rounding has destroyed
        if min(k[0, 0], k[1, 1]) <= 1e-6 * np.abs(k).max():
            raise CameraError("K is singular or has a focal length that is not positive", key="K")
        if not np.allclose([k[1, 0], k[2, 0], k[2, 1]], 0, atol=1e-9 * k[0, 0]):
            raise CameraError("K must be upper triangular: [[fx, s, cx], [0, fy, cy], [0, 0, 1]]", key="K")
        lens = _shared(Lens.of(self.distortion, self.model))
        own: dict[str, Any] = {"size": (width, height), "K": k, "R": r, "t": t, "lens": lens}
        own |= {"distortion": lens.coefficients, "model": lens.model}
        if self.rectification is not None:
            own["rectification"] = _rotation(self.rectification, "rectification")
        if self.rectified is not None:
            own["rectified"] = _matrix(self.rectified, (3, 4), "rectified")
            if min(own["rectified"][[0, 1, 2], [0, 1, 2]]) <= 0:
                raise CameraError("the rectified P has a focal length that is not positive", key="rectified")
        for name, value in own.items():
            object.__setattr__(self, name, value)

    def at(self, R: Array, t: Array) -> Camera:
        """Return a copy of the camera with another pose, ``R`` (3, 3) and ``t`` (3,), world to optical frame.

        The pose is not checked: R must be a rotation, and t finite.
        """
        camera = object.__new__(Camera)
        camera.__dict__.update({each.name: self.__dict__[each.name] for each in fields(self)}, R=R, t=t)
        return camera

    def __repr__(self) -> str:
        center = ", ".join(f"{value:.3f}" for value in self.center)
        lens = f", {self.model} lens" if self.distorted else ""
        return (
            f"Camera({self.size[0]}x{self.size[1]}, focal length {self.K[0, 0]:.1f} px, at ({center}){lens})"
        )

    @classmethod
    def look_at(
        cls,
        position: ArrayLike,
        target: ArrayLike,
        size: ImageSize = (640, 480),
        fov: float = math.radians(60),
        up: ArrayLike = (0.0, 0.0, 1.0),
    ) -> Camera:
        """Create an ideal pinhole camera that looks from one point at another.

        Args:
            position: Camera center, (3,) metres in ``map``.
            target: Point that appears at the image center, (3,) metres in ``map``.
            size: Image width and height in pixels.
            fov: Horizontal field of view in radians, between 0 and pi.
            up: Direction that points up in the image, (3,).

        Returns:
            Camera with square pixels and the principal point at ((width - 1) / 2, (height - 1) / 2).

        Raises:
            CameraError: ``position`` equals ``target``, ``up`` is parallel to the view direction, or ``fov``
                is out of range.

        Example:
            >>> camera = Camera.look_at((3, 3, 2), (0, 0, 0.8))
            >>> camera.size
            (640, 480)
            >>> camera.center.round(9).tolist()
            [3.0, 3.0, 2.0]
        """
        k = pinhole_of_fov(size, fov)
        return cls(size, k, *look_at_pose(position, target, up))

    @classmethod
    def from_projection_matrix(cls, P: ArrayLike, size: ImageSize) -> Camera:
        """Create a camera from a projection matrix P = K [R | t], (3, 4). P may have any scale and sign.

        P is decomposed by RQ decomposition [thesis §9.8].

        Raises:
            CameraError: P is singular, or its K or R is not valid for a camera.
        """
        p = _matrix(P, (3, 4), "P")
        if abs(np.linalg.det(p[:, :3])) <= 1e-12 * np.abs(p[:, :3]).max() ** 3:
            message = "P is singular: its camera is at infinity, or it is not a projection matrix"
            raise CameraError(message, key="P")
        p = p * np.sign(np.linalg.det(p[:, :3]))
        k, r = scipy.linalg.rq(p[:, :3])
        signs = np.diag(np.sign(np.diag(k)))
        k, r = k @ signs, signs @ r
        return cls(size, k / k[2, 2], r, np.linalg.solve(k, p[:, 3]))

    @property
    def distorted(self) -> bool:
        """Whether the lens bends straight lines."""
        return not self.lens.ideal

    @property
    def rectification_matrix(self) -> Array:
        """R of CameraInfo, (3, 3): rotation from the optical frame to the frame of the rectified image."""
        return np.eye(3) if self.rectification is None else self.rectification

    @cached_property
    def rectified_projection(self) -> Array:
        """P of CameraInfo, (3, 4): projection from the frame of the rectified image to its pixels. By
        default, P is [K | 0] of the ideal camera [thesis §9.8]: no skew, and a centred principal point. A
        camera without distortion and skew keeps its K."""
        if self.rectified is not None:
            return self.rectified
        unchanged = not self.distorted and self.K[0, 1] == 0
        k = self.K if unchanged else ideal_matrix(self.K, self.size)
        return np.column_stack([k, np.zeros(3)])

    @cached_property
    def P(self) -> Array:
        """Projection matrix K [R | t] without lens distortion, (3, 4) [thesis §9.3]."""
        return self.K @ np.column_stack([self.R, self.t])

    @property
    def center(self) -> Array:
        """Camera centre in the world, C = -R^T t, (3,) metres."""
        return -self.R.T @ self.t

    @property
    def optical_from_world(self) -> Array:
        """Transform from the world to the optical frame, (4, 4)."""
        return transform(self.R, self.t)

    @property
    def world_from_optical(self) -> Array:
        """Pose of the optical frame in the world, (4, 4)."""
        return transform(self.R.T, self.center)

    def to_optical(self, points: ArrayLike) -> Array:
        """Transform world points (..., 3) to the optical frame (..., 3), metres."""
        return np.asarray(points, dtype=float) @ self.R.T + self.t

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Project world points (N, 3) to pixels (N, 2) of image_raw and depths (N,) along z, metres.

        Pixels are NaN for points behind the camera (depth <= 0) and beyond the valid radius of the lens.

        Example:
            >>> camera = Camera.look_at((3, 0, 1), (0, 0, 1))
            >>> pixels, depth = camera.project([(0, 0, 1), (0, 0, 2), (9, 0, 1)])
            >>> pixels.round(1).tolist()
            [[319.5, 239.5], [319.5, 54.7], [nan, nan]]
            >>> depth.tolist()
            [3.0, 3.0, -6.0]
        """
        return self.project_optical(self.to_optical(points))

    def project_optical(self, points: ArrayLike) -> tuple[Array, Array]:
        """Project points (N, 3) in the optical frame to pixels (N, 2) and depths (N,)."""
        p = np.asarray(points, dtype=float)
        depth = p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            if self.distorted:
                plane = self.lens.distort(p[..., :2] / depth[..., None])
                image = plane @ self.K[:2, :2].T + self.K[:2, 2]
            else:
                image = p @ self.K[:2].T / depth[..., None]
        return np.where(depth[..., None] > 0, image, np.nan), depth

    def project_jacobian(self, points: ArrayLike) -> Array:
        """Derivatives (N, 2, 3) of the pixels of :meth:`project` with respect to world points (N, 3), pixels
        per metre.

        A derivative is valid only where :meth:`project` returns a pixel that is not NaN.

        Example:
            >>> camera = Camera.look_at((3, 0, 1), (0, 0, 1))
            >>> camera.project_jacobian([(0, 0, 1)]).round(1)[0, :, 2].tolist()
            [0.0, -184.8]
        """
        p = self.to_optical(points)
        with np.errstate(all="ignore"):
            plane = p[..., :2] / p[..., 2:]
            across = np.zeros((*p.shape[:-1], 2, 3))
            across[..., 0, 0] = across[..., 1, 1] = 1 / p[..., 2]
            across[..., 2] = -plane / p[..., 2:]
            return np.asarray(self.K[:2, :2] @ self.lens.jacobian(plane) @ across @ self.R)

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions (..., 3) of the rays through pixels (..., 2), in the optical frame, with z = 1. A
        direction is NaN if no ray reaches its pixel through the lens."""
        uv = np.asarray(pixels, dtype=float)
        homogeneous = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1)
        directions = homogeneous @ np.linalg.inv(self.K).T
        if not self.distorted:
            return directions
        return np.concatenate([self.lens.undistort(directions[..., :2]), homogeneous[..., 2:]], axis=-1)

    def unproject(self, pixels: ArrayLike, depth: ArrayLike) -> Array:
        """World points (N, 3) that pixels (N, 2) show at depths (N,) along z, metres. This is the inverse of
        :meth:`project`."""
        rays = self.rays(pixels)
        return (rays * np.asarray(depth, dtype=float)[..., None] - self.t) @ self.R

    def opengl_clip(self, near: float, far: float) -> Array:
        """Matrix (4, 4) from the optical frame to OpenGL clip coordinates.

        The matrix ignores the lens. For a camera with distortion, distort the points first, and keep their
        depth. OpenGL has pixel centres at half-integers, so the principal point is moved by +0.5. The first
        image row is the lowest row of the window, so that images are read back with the top row first. Depth
        is as in the standard perspective matrix, -1 at ``near``.
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
def _shared(lens: Lens) -> Lens:
    """Return a cached lens that equals ``lens``, so that equal cameras share one lens."""
    return lens


def ideal_matrix(K: Array, size: ImageSize, square: bool = False, center: bool = True) -> Array:
    """Intrinsics (3, 3), without skew, of the ideal camera that replaces a real camera [thesis §9.8].

    Args:
        K: Intrinsics of the camera, (3, 3).
        size: Width and height of the image in pixels.
        square: Whether pixels are made square. Both focal lengths become their geometric mean.
        center: Whether the principal point is moved to the image centre.
    """
    fx, fy = float(K[0, 0]), float(K[1, 1])
    if square:
        fx = fy = float(np.sqrt(fx * fy))
    cx, cy = ((n - 1) / 2 for n in size) if center else K[:2, 2]
    return pinhole(fx, fy, cx, cy)


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Make the intrinsics K (3, 3) of a camera without skew.

    Args:
        fx: Focal length along x, pixels.
        fy: Focal length along y, pixels.
        cx: Principal point, x in pixels.
        cy: Principal point, y in pixels.
    """
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=float)


def _rotation(value: ArrayLike, key: str) -> Array:
    """Check a rotation matrix, and return it with small errors of orthonormality corrected."""
    r = _matrix(value, (3, 3), key)
    error = float(np.abs(r @ r.T - np.eye(3)).max())
    if error > _ROTATION_TOLERANCE:
        raise CameraError(f"{key} is not a rotation matrix (orthonormal, determinant +1)", key=key)
    if np.linalg.det(r) < 0:
        raise CameraError(f"{key} is a reflection (its determinant is -1), not a rotation", key=key)
    if error > _ROTATION_ROUNDING:
        message = f"{key} is a rotation matrix only to {error:.1g}: the nearest rotation is used"
        warnings.warn(message, HumansimWarning, stacklevel=4)
    if error <= 1e-12:
        return r
    # exactly orthonormal, so that the published extrinsics are a rigid transform
    return nearest_rotations(r)


def _checked_size(size: ImageSize) -> ImageSize:
    """Check the width and height of an image, and return them as integers."""
    try:
        width, height = (int(n) for n in size)
        integers = (width, height) == tuple(size)
    except (TypeError, ValueError, OverflowError):
        integers = False
    if not integers:
        message = f"the image size must be two whole numbers, width and height, not {size}"
        raise CameraError(message, key="size")
    if not (0 < width <= MAX_SIZE and 0 < height <= MAX_SIZE):
        raise CameraError(f"the image size must be 1 to {MAX_SIZE} pixels, not {width}x{height}", key="size")
    return width, height


def pinhole_of_fov(size: ImageSize, fov: float) -> Array:
    """Intrinsics K (3, 3) of an ideal camera with a horizontal field of view ``fov``, radians.

    Raises:
        CameraError: ``fov`` is not between 0 and pi.
    """
    width, height = _checked_size(size)
    if not 0 < fov < np.pi:
        message = f"the field of view must be between 0 and 180 degrees, not {np.degrees(fov):g}"
        raise CameraError(message, key="fov")
    f = width / 2 / np.tan(fov / 2)
    return pinhole(f, f, (width - 1) / 2, (height - 1) / 2)


def look_at_pose(
    position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)
) -> tuple[Array, Array]:
    """R (3, 3) and t (3,) of a camera that looks from one point at another. See :meth:`Camera.look_at`.

    Raises:
        CameraError: ``position`` equals ``target``, or ``up`` is parallel to the view direction.
    """
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
    return rotation, -rotation @ centre


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


@dataclass(frozen=True)
class Region:
    """Part of a sensor that published images show. ``roi``: x, y, width and height in sensor pixels; None for
    the whole sensor. ``binning``: number of sensor pixels along x and y that make one image pixel."""

    roi: tuple[int, int, int, int] | None = None
    binning: tuple[int, int] = (1, 1)

    @property
    def whole(self) -> bool:
        """Whether the image is the whole sensor without binning."""
        return self.roi is None and self.binning == (1, 1)

    def of(self, camera: Camera) -> Camera:
        """Return the camera of the published image. ``camera``: camera of the whole sensor.

        As in image_geometry, x = (x_sensor - roi.x_offset) / binning_x. The lens is unchanged.

        Raises:
            CameraError: The region is not on the sensor.
        """
        if self.whole:
            return camera
        width, height = camera.size
        x, y, w, h = self.roi or (0, 0, width, height)
        if min(x, y) < 0 or min(w, h) < 1 or x + w > width or y + h > height:
            message = f"x, y, width, height of {x}, {y}, {w}, {h} is not within {width}x{height} pixels"
            raise CameraError(message, key="roi")
        across, down = self.binning
        if min(across, down) < 1 or across > w or down > h:
            raise CameraError(f"must be between 1 and the image size, not {across}, {down}", key="binning")
        rectified = camera.rectified_projection
        return replace(
            camera,
            size=(w // across, h // down),
            K=self._to_image(camera.K, x, y),
            rectified=self._to_image(rectified, x, y),
        )

    def _to_image(self, matrix: Array, x: int, y: int) -> Array:
        """Convert K or P from pixels of the sensor to pixels of the published image."""
        out = matrix.copy()
        out[0] = (matrix[0] - x * matrix[2]) / self.binning[0]
        out[1] = (matrix[1] - y * matrix[2]) / self.binning[1]
        return out
