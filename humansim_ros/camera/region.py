"""Binning and region of interest of a sensor, as CameraInfo describes them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from humansim_ros.camera.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.types import Array


@dataclass(frozen=True)
class Region:
    """Part of a sensor that a driver publishes.

    ``roi``: x, y, width and height in sensor pixels, None for the whole sensor. ``binning``: sensor pixels
    along x and y per image pixel.
    """

    roi: tuple[int, int, int, int] | None = None
    binning: tuple[int, int] = (1, 1)

    @property
    def whole(self) -> bool:
        """Whether the image is the whole sensor without binning."""
        return self.roi is None and self.binning == (1, 1)

    def of(self, camera: Camera) -> Camera:
        """Camera of the image from the camera of the whole sensor.

        As in image_geometry, x = (x_sensor - roi.x_offset) / binning_x; the lens is unchanged.

        Raises:
            CameraError: The region is not on the sensor.
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
            raise CameraError(f"must be between 1 and the image size, not {across}, {down}", key="binning")
        rectified = camera.rectified_projection
        return replace(
            camera,
            size=(w // across, h // down),
            K=self._to_image(camera.K, x, y),
            rectified=self._to_image(rectified, x, y),
        )

    def _to_image(self, matrix: Array, x: int, y: int) -> Array:
        """K or P for pixels of the image."""
        out = matrix.copy()
        out[0] = (matrix[0] - x * matrix[2]) / self.binning[0]
        out[1] = (matrix[1] - y * matrix[2]) / self.binning[1]
        return out
