"""Binning and region of interest: the part of a sensor that a driver sends, as CameraInfo describes it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from humansim_ros.camera.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.types import Array


@dataclass(frozen=True)
class Region:
    """``roi``: x, y, width, height in pixels of the whole sensor, None for all of it. ``binning``: pixels of
    the sensor along x and y that one pixel of the image stands for.
    """

    roi: tuple[int, int, int, int] | None = None
    binning: tuple[int, int] = (1, 1)

    @property
    def whole(self) -> bool:
        """Whether the image is all of the sensor, pixel by pixel."""
        return self.roi is None and self.binning == (1, 1)

    def of(self, camera: Camera) -> Camera:
        """The camera of the image, from that of the whole sensor.

        As image_geometry has it: x = (x_sensor - roi.x_offset) / binning_x; the lens stays the same. Raises
        CameraError where the region is not on the sensor.
        """
        if self.whole:
            return camera
        width, height = camera.size
        x, y, w, h = self.roi or (0, 0, width, height)
        if min(x, y) < 0 or min(w, h) < 1 or x + w > width or y + h > height:
            raise CameraError(
                f"x, y, width, height of {x}, {y}, {w}, {h} is not within {width}x{height} pixels", key="roi"
            )
        across, down = self.binning
        if min(across, down) < 1 or across > w or down > h:
            raise CameraError(f"must be 1 to the image's size, not {across}, {down}", key="binning")
        rectified = camera.rectified_projection
        return replace(
            camera,
            size=(w // across, h // down),
            K=self._moved(camera.K, x, y),
            rectified=self._moved(rectified, x, y),
        )

    def _moved(self, matrix: Array, x: int, y: int) -> Array:
        """K or P whose pixels are those of the image."""
        out = matrix.copy()
        out[0] = (matrix[0] - x * matrix[2]) / self.binning[0]
        out[1] = (matrix[1] - y * matrix[2]) / self.binning[1]
        return out
