"""Ideal cameras of real cameras [thesis §9.8]: no distortion, no skew, a centred principal point.

An ideal camera has the same R and t as the real camera. Only K differs. A single call of cv2.remap converts
an image of one camera to the other camera, without approximation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from humansim_ros.cameras.camera.camera import Camera, ideal_matrix
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: Part of the real image that the ideal image shows: ``focal`` keeps the focal lengths; ``all`` shows all of
#: it, with black borders; ``no_black`` shows only a part without black pixels.
Fit = Literal["focal", "all", "no_black"]

#: Coordinate in maps for pixels without a counterpart. It is outside any image, but in the range of
#: cv2.remap.
_OUTSIDE = 16384.0
#: Number of pixels that are mapped at once, so that they fit into the processor cache.
_BLOCK = 1 << 16
#: Number of points along each side of an image that are tested to find the scale of a fit.
_BORDER_POINTS = 400
#: Smallest factor by which a fit may multiply the focal lengths.
_SMALLEST_SCALE = 0.02


@dataclass(frozen=True)
class Ideal:
    """A real camera and the ideal camera made from it. Both have images of the same size (width, height).

    For stereo rectification, the ideal camera is rotated against the real camera.
    """

    real: Camera
    camera: Camera

    @cached_property
    def real_from_ideal(self) -> NDArray[np.float32]:
        """Map (H, W, 2) for cv2.remap: x, y in the real image for each pixel of the ideal image. A pixel that
        no ray reaches through the real lens has the coordinate 16384, which is outside any image. Larger
        coordinates are clipped to 16384."""
        return _map(self.points_to_real, self.camera.size)

    @cached_property
    def ideal_from_real(self) -> NDArray[np.float32]:
        """Map (H, W, 2) for cv2.remap: x, y in the ideal image for each pixel of the real image."""
        return _map(self.points_to_ideal, self.real.size)

    def points_to_real(self, pixels: ArrayLike) -> Array:
        """Convert pixels (N, 2) of the ideal image to the real image. Pixels outside the lens become NaN."""
        return self.real.project_optical(self.camera.rays(pixels) @ self._real_from_ideal_frame.T)[0]

    def points_to_ideal(self, pixels: ArrayLike) -> Array:
        """Convert pixels (N, 2) of the real image to the ideal image. Pixels outside the lens become NaN."""
        return self.camera.project_optical(self.real.rays(pixels) @ self._real_from_ideal_frame)[0]

    @cached_property
    def _real_from_ideal_frame(self) -> Array:
        """Rotation (3, 3) from the optical frame of the ideal camera to the frame of the real one."""
        if self.real.R is self.camera.R:
            return np.eye(3)
        return np.asarray(self.real.R @ self.camera.R.T, dtype=float)

    def to_ideal(self, image: NDArray[Any], interpolation: int = cv2.INTER_LINEAR) -> NDArray[Any]:
        """Convert a real image (H, W) or (H, W, C) to the ideal camera. Pixels outside the real image are
        black.

        ``interpolation``: interpolation flag of OpenCV. Use cv2.INTER_NEAREST for labels.

        Raises:
            CameraError: The image does not have the size of the camera.
        """
        return _remap(image, self.real_from_ideal, self.real.size, interpolation)

    def without_border(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Copy of an ideal image (H, W) as floats. Pixels outside the real image are NaN."""
        return np.where(self._inside, image, np.float32(np.nan))

    @cached_property
    def _inside(self) -> NDArray[np.bool_]:
        """Mask (H, W) of the pixels of the ideal image that have a counterpart in the real image."""
        width, height = self.real.size
        x, y = np.moveaxis(self.real_from_ideal, -1, 0)
        return (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)

    def to_real(self, image: NDArray[Any], interpolation: int = cv2.INTER_LINEAR) -> NDArray[Any]:
        """Convert an ideal image to the real camera. The arguments are those of :meth:`to_ideal`."""
        return _remap(image, self.ideal_from_real, self.camera.size, interpolation)


def idealize(camera: Camera, square: bool = False, center: bool = True, fit: Fit = "focal") -> Ideal:
    """Replace a real camera by an ideal one without distortion and skew [thesis §9.8].

    The image size does not change. A stereo rectification of the camera is ignored.

    Args:
        camera: Real camera.
        square: Whether pixels are made square, with the same area.
        center: Whether the principal point is moved to the image centre, ((w - 1) / 2, (h - 1) / 2) [thesis
            eq. 9.74].
        fit: ``focal`` keeps the focal lengths. ``all`` scales them so that all pixels of the real image are
            in the ideal image. ``no_black`` scales them so that all pixels of the ideal image are in the real
            image.

    Returns:
        The ideal camera, with maps between both images.

    Raises:
        CameraError: No focal length satisfies ``fit``.

    Example:
        >>> from humansim_ros.cameras import Camera, idealize
        >>> K = [[500, 0, 300], [0, 480, 250], [0, 0, 1]]
        >>> real = Camera((640, 480), K, np.eye(3), np.zeros(3), distortion=(-0.2,))
        >>> ideal = idealize(real, square=True).camera
        >>> ideal.distorted, ideal.K.round(1).tolist()
        (False, [[489.9, 0.0, 319.5], [0.0, 489.9, 239.5], [0.0, 0.0, 1.0]])
    """
    k = ideal_matrix(camera.K, camera.size, square, center)
    if fit != "focal":
        k[[0, 1], [0, 1]] *= _fitting_scale(camera, k, fit)
    return Ideal(camera, replace(camera, K=k, distortion=(), model=None, rectification=None, rectified=None))


def rectify(camera: Camera) -> Ideal:
    """Ideal camera of ``image_rect``, from R and P of the camera's CameraInfo. The baseline in the P of a
    stereo camera does not affect the image and is ignored."""
    rotation, k = camera.rectification_matrix, camera.rectified_projection[:, :3]
    if not camera.distorted and np.array_equal(rotation, np.eye(3)) and np.array_equal(k, camera.K):
        return Ideal(camera, camera)
    r, t = (
        (camera.R, camera.t) if camera.rectification is None else (rotation @ camera.R, rotation @ camera.t)
    )
    return Ideal(camera, Camera(camera.size, k, r, t))


def _fitting_scale(camera: Camera, k: Array, fit: Fit) -> float:
    """Factor by which the focal lengths of the ideal K must be multiplied for ``fit``. With this factor, the
    border of the real image touches the ideal image from inside (``all``) or outside (``no_black``)."""
    last, center = np.array(camera.size) - 1.0, k[:2, 2]
    outline = _outline(camera, inner=fit == "all") * k.diagonal()[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        # distance of each point from the image centre, divided by that of the image edge in the same
        # direction
        reach = np.where(outline > 0, outline / (last - center), -outline / center)
    reach = np.where(outline == 0, 0.0, reach).max(axis=1)
    axis = camera.K[:2, 2]
    inside = ((axis >= 0) & (axis <= last) & (center > 0) & (center < last)).all()
    extreme = reach.max(initial=0.0) if fit == "all" else reach.min(initial=np.inf)
    if not inside or not np.isfinite(extreme) or extreme <= 0:
        raise CameraError("the optical axis is not in the image: use fit 'focal'", key="K")
    if 1 / extreme < _SMALLEST_SCALE:
        message = "the field of view is too wide for one flat image: use fit 'focal' or 'no_black'"
        raise CameraError(message, key="distortion")
    return float(1 / extreme)


def _outline(camera: Camera, inner: bool) -> Array:
    """Points (N, 2) of the normalised image plane along the borders of a camera's image and lens. ``inner``:
    leave out points of the lens border that are outside the image."""
    width, height = (n - 1.0 for n in camera.size)
    along = np.linspace(0, 1, _BORDER_POINTS)
    zero, one = np.zeros(_BORDER_POINTS), np.ones(_BORDER_POINTS)
    sides = [(along, zero), (along, one), (zero, along), (one, along)]
    border = np.concatenate([np.column_stack(side) for side in sides]) * (width, height)
    rays = camera.rays(border)[:, :2]
    angles = np.linspace(0, 2 * np.pi, _BORDER_POINTS)
    # slightly inside, so that rounding does not move the point beyond the lens
    rim = camera.lens.valid_radius * (1 - 1e-9) * np.column_stack([np.cos(angles), np.sin(angles)])
    if inner:
        pixels = camera.lens.distort(rim) @ camera.K[:2, :2].T + camera.K[:2, 2]
        rim = rim[((pixels >= 0) & (pixels <= (width, height))).all(axis=1)]
    rays = np.concatenate([rays, rim])
    return np.asarray(rays[np.isfinite(rays).all(axis=1)])


def _map(points: Callable[[Array], Array], size: tuple[int, int]) -> NDArray[np.float32]:
    """Map (H, W, 2) for cv2.remap: the result of ``points`` for all pixels of an image of ``size``."""
    width, height = size
    out = np.empty((height, width, 2), np.float32)
    rows = max(1, _BLOCK // width)
    for first in range(0, height, rows):
        part = out[first : first + rows]
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(first, first + len(part))), axis=-1)
        mapped = points(grid.reshape(-1, 2).astype(float)).reshape(part.shape)
        part[:] = np.clip(np.nan_to_num(mapped, nan=_OUTSIDE), -_OUTSIDE, _OUTSIDE)
    return out


def _remap(
    image: NDArray[Any], mapping: NDArray[np.float32], size: tuple[int, int], interpolation: int
) -> NDArray[Any]:
    height, width = image.shape[:2]
    if (width, height) != size:
        message = f"the image is {width}x{height} pixels, but the camera has {size[0]}x{size[1]}"
        raise CameraError(message, key="size")
    no_second_map: Any = None  # the type stubs of OpenCV require this argument
    remapped = cv2.remap(image, mapping, no_second_map, interpolation, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(remapped)
