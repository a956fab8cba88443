"""Real cameras made ideal (thesis 9.8): no lens distortion, no skew, the principal point where it should be.

An ideal camera stands where the real one stands and looks where it looks (same R and t); only K changes, and
the images with it. One remap in each direction carries images from one to the other, exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from humansim_ros.camera.camera import Camera, ideal_matrix
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: How much of the real image the ideal one shows: as much as the focal length says, all of it (with black
#: borders), or only what fills it.
Fit = Literal["focal", "all", "no_black"]

#: Where maps point that have nothing to point at: outside of any image, and a number that cv2.remap can hold.
_NOWHERE = 16384.0
#: Pixels that are mapped at once: they stay in the cache.
_BLOCK = 1 << 16
#: Steps along the border of an image by which a fit is judged.
_BORDER = 400
#: A focal length that shrinks to less than this fraction shows nothing.
_SMALLEST = 0.02


@dataclass(frozen=True)
class Ideal:
    """A real camera and the ideal one in its place. Images of both have the same size (width, height).

    The ideal one may look another way from there (stereo rectification).
    """

    real: Camera
    camera: Camera

    @cached_property
    def real_from_ideal(self) -> NDArray[np.float32]:
        """(H, W, 2) for each pixel of the ideal image the (x, y) of the real one, as cv2.remap takes it.

        What the real lens cannot see lies at 16384 pixels, outside of any image; so does all that is farther.
        """
        return _map(self.points_to_real, self.camera.size)

    @cached_property
    def ideal_from_real(self) -> NDArray[np.float32]:
        """(H, W, 2) for each pixel of the real image the (x, y) of the ideal one; else as the other."""
        return _map(self.points_to_ideal, self.real.size)

    def points_to_real(self, pixels: ArrayLike) -> Array:
        """Where (N, 2) pixels of the ideal image are in the real one, (N, 2); NaN beyond the lens."""
        return _seen_along(self.real, self.camera.rays(pixels) @ self._real_from_ideal_frame.T)

    def points_to_ideal(self, pixels: ArrayLike) -> Array:
        """Where (N, 2) pixels of the real image are in the ideal one, (N, 2); NaN beyond the lens."""
        return _seen_along(self.camera, self.real.rays(pixels) @ self._real_from_ideal_frame)

    @cached_property
    def _real_from_ideal_frame(self) -> Array:
        """(3, 3) optical frame of the ideal camera to that of the real one."""
        if self.real.R is self.camera.R:
            return np.eye(3)
        return np.asarray(self.real.R @ self.camera.R.T, dtype=float)

    def to_ideal(self, image: NDArray[Any], interpolation: int = cv2.INTER_LINEAR) -> NDArray[Any]:
        """The ideal camera's image of a real one (H, W) or (H, W, C), black where the real one shows nothing.

        ``interpolation``: one of OpenCV's; cv2.INTER_NEAREST for labels. Raises CameraError for an image of
        another size than the camera's.
        """
        return _remap(image, self.real_from_ideal, self.real.size, interpolation)

    def to_real(self, image: NDArray[Any], interpolation: int = cv2.INTER_LINEAR) -> NDArray[Any]:
        """The real camera's image of an ideal one; else as :meth:`to_ideal`."""
        return _remap(image, self.ideal_from_real, self.camera.size, interpolation)


def idealize(camera: Camera, square: bool = False, center: bool = True, fit: Fit = "focal") -> Ideal:
    """The ideal camera in place of a real one, and the maps between their images (thesis 9.8).

    No skew, no distortion; the size stays. ``square``: square pixels, of the same area. ``center``: the
    principal point is shifted to the middle of the image, ((w - 1) / 2, (h - 1) / 2) (9.74). ``fit``: "focal"
    keeps the focal lengths; "all" scales them so that every pixel that the lens can see is in the ideal
    image; "no_black" so that every pixel of the ideal image is in the real one. Raises CameraError where no
    focal length does that. The stereo rectification that a camera may have is left out.
    """
    k = ideal_matrix(camera.K, camera.size, square, center)
    if fit != "focal":
        k[[0, 1], [0, 1]] *= _fitting_scale(camera, k, fit)
    return Ideal(camera, replace(camera, K=k, distortion=(), model=None, rectification=None, rectified=None))


def rectify(camera: Camera) -> Ideal:
    """A camera and what its ``image_rect`` is the image of: R and P of its CameraInfo.

    The baseline in the P of a stereo camera is no part of its image and left out.
    """
    turn, k = camera.rectification_matrix, camera.rectified_projection[:, :3]
    if not camera.distorted and np.array_equal(turn, np.eye(3)) and np.array_equal(k, camera.K):
        return Ideal(camera, camera)
    r, t = (camera.R, camera.t) if camera.rectification is None else (turn @ camera.R, turn @ camera.t)
    return Ideal(camera, Camera(camera.size, k, r, t))


def _seen_along(camera: Camera, rays: Array) -> Array:
    """Pixels (N, 2) that rays (N, 3) of the optical frame fall on."""
    return camera.project_optical(rays)[0]


def _fitting_scale(camera: Camera, k: Array, fit: Fit) -> float:
    """What the focal lengths of an ideal K are multiplied by so that the real image's outline lies outside of
    the ideal image, or touches it from within.
    """
    last, middle = np.array(camera.size) - 1.0, k[:2, 2]
    outline = _outline(camera, inner=fit == "all") * k.diagonal()[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        # how far out each point is, as a fraction of the way from the middle to the edge of the image
        reach = np.where(outline > 0, outline / (last - middle), -outline / middle)
    reach = np.where(outline == 0, 0.0, reach).max(axis=1)
    axis = camera.K[:2, 2]
    seen = ((axis >= 0) & (axis <= last) & (middle > 0) & (middle < last)).all()
    extreme = reach.max(initial=0.0) if fit == "all" else reach.min(initial=np.inf)
    if not seen or not np.isfinite(extreme) or extreme <= 0:
        raise CameraError("the optical axis is not in the image: only fit 'focal' can idealise it", key="K")
    if 1 / extreme < _SMALLEST:
        raise CameraError(
            "the lens sees too wide an angle for one flat image to show all of it; fit 'focal' or 'no_black'",
            key="distortion",
        )
    return float(1 / extreme)


def _outline(camera: Camera, inner: bool) -> Array:
    """(N, 2) on the normalised image plane: the border of what a camera sees, its image's and its lens'.

    ``inner``: only those points of the lens' border that are in the image.
    """
    width, height = (n - 1.0 for n in camera.size)
    along = np.linspace(0, 1, _BORDER)
    none, full = np.zeros(_BORDER), np.ones(_BORDER)
    sides = [(along, none), (along, full), (none, along), (full, along)]
    border = np.concatenate([np.column_stack(side) for side in sides]) * (width, height)
    rays = camera.rays(border)[:, :2]
    turn = np.linspace(0, 2 * np.pi, _BORDER)
    # a little within, where rounding cannot put it beyond the lens
    rim = camera.lens.valid_radius * (1 - 1e-9) * np.column_stack([np.cos(turn), np.sin(turn)])
    if inner:
        pixels = _pixels(camera.K, camera.lens.distort(rim))
        rim = rim[((pixels >= 0) & (pixels <= (width, height))).all(axis=1)]
    rays = np.concatenate([rays, rim])
    return np.asarray(rays[np.isfinite(rays).all(axis=1)])


def _pixels(k: Array, plane: Array) -> Array:
    """Points (N, 2) of the normalised image plane in pixels."""
    return np.asarray(plane @ k[:2, :2].T + k[:2, 2])


def _map(points: Callable[[Array], Array], size: tuple[int, int]) -> NDArray[np.float32]:
    """(H, W, 2) where each pixel of an image goes."""
    width, height = size
    out = np.empty((height, width, 2), np.float32)
    rows = max(1, _BLOCK // width)
    for first in range(0, height, rows):
        part = out[first : first + rows]
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(first, first + len(part))), axis=-1)
        mapped = points(grid.reshape(-1, 2).astype(float)).reshape(part.shape)
        part[:] = np.clip(np.nan_to_num(mapped, nan=_NOWHERE), -_NOWHERE, _NOWHERE)
    return out


def _remap(
    image: NDArray[Any], mapping: NDArray[np.float32], size: tuple[int, int], interpolation: int
) -> NDArray[Any]:
    height, width = image.shape[:2]
    if (width, height) != size:
        raise CameraError(
            f"the image is {width}x{height} pixels, the camera {size[0]}x{size[1]}: no image of that camera",
            key="size",
        )
    no_second_map: Any = None  # OpenCV's stubs ask for one
    remapped = cv2.remap(image, mapping, no_second_map, interpolation, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(remapped)
