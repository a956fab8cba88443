"""Backdrops: images behind a scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render.pixel_geometry import ray_grid
from humansim_ros.types import LinearColor

#: Columns that a panorama repeats at each side, to interpolate across the seam.
_WRAP = 2


@dataclass(frozen=True, eq=False)
class ImageBackdrop:
    """A photograph ``image`` (H, W, 3) uint8 sRGB, scaled to cover the camera's image."""

    image: NDArray[np.uint8]

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 sRGB of the image size of the camera."""
        (width, height), (h, w) = camera.size, self.image.shape[:2]
        scale = max(width / w, height / h)
        # the visible part, at the center of the photograph
        part_w, part_h = min(w, max(1, round(width / scale))), min(h, max(1, round(height / scale)))
        x, y = (w - part_w) // 2, (h - part_h) // 2
        part = self.image[y : y + part_h, x : x + part_w]
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(part, camera.size, interpolation=interpolation), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Panorama:
    """An equirectangular panorama at infinite distance.

    ``image``: (H, W, 3) uint8 sRGB; its center is in direction +x of ``map``, its first row is straight up.
    ``yaw``: rotation of the panorama to the left, radians.
    """

    image: NDArray[np.uint8]
    yaw: float = 0.0

    @cached_property
    def _wrapped(self) -> NDArray[np.uint8]:
        """The image with the columns of each side repeated at the other."""
        return np.pad(self.image, ((0, 0), (_WRAP, _WRAP), (0, 0)), mode="wrap")

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 sRGB of the image size of the camera."""
        height, width = self.image.shape[:2]
        with np.errstate(invalid="ignore"):  # beyond the field of view of the lens
            x, y, z = np.moveaxis(ray_grid(camera) @ camera.R, -1, 0)
            left = np.arctan2(y, x) - self.yaw
            up = np.arctan2(z, np.hypot(x, y))
        column = np.mod(0.5 - left / (2 * np.pi), 1.0) * width - 0.5 + _WRAP
        row = np.clip((0.5 - up / np.pi) * height - 0.5, 0, height - 1)
        across, down = (np.nan_to_num(axis, nan=-10.0).astype(np.float32) for axis in (column, row))
        image = cv2.remap(self._wrapped, across, down, interpolation=cv2.INTER_LINEAR)
        return np.asarray(image, dtype=np.uint8)


def ambient(radiance: NDArray[np.float32]) -> tuple[LinearColor, LinearColor]:
    """Compute the ambient light of a panorama (H, W, 3) of linear light.

    Returns:
        Colours that light level surfaces from above and from below.
    """
    rows = len(radiance)
    up = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)
    # per row: share of the sphere, and cosine to the vertical
    weight = np.cos(up) * np.abs(np.sin(up))
    means = radiance.mean(axis=1, dtype=float)
    sky, ground = (
        np.average(means[half], axis=0, weights=weight[half]).tolist() for half in (up > 0, up < 0)
    )
    return tuple(sky), tuple(ground)
