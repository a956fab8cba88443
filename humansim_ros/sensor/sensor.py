"""The sensor: from ideal pictures to what a driver would publish.

In the order of the light: it comes through the lens (chromatic aberration, vignetting) while the shutter is
open (motion blur, rolling shutter), passes the colour filters and frees electrons (exposure, shot noise, dark
current) until the pixel is full. These are read (read noise), amplified (gain, white balance), converted to
numbers through the response curve, and compressed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache, cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.sensor.config import SensorConfig
from humansim_ros.sensor.noise import generator, noisy
from humansim_ros.sensor.optics import Light, aberrate, corner_distance, transmission
from humansim_ros.sensor.response import LEVELS, luminance, mosaic, response_table, srgb_to_light
from humansim_ros.sensor.shutter import row_weights, sample_times
from humansim_ros.types import Array, Image

#: Samples that are worked on at a time: they stay in the processor's cache.
_BLOCK = 1 << 16
#: What changes no light.
_NOT_LIGHT = {"encoding", "jpeg", "seed", "samples"}


class Sensor:
    """The sensor of one camera. ``name``: the camera's; cameras of different names have different noise.

    ``active``: whether it does anything at all. The random numbers of a picture depend on the seed, the name
    and the stamp only. Raises CameraError where the camera cannot have this sensor.
    """

    def __init__(self, config: SensorConfig, camera: Camera, name: str = "") -> None:
        self.config = config
        self.camera = camera
        self.name = name
        plain = SensorConfig()
        changed = {key for key in SensorConfig.model_fields if getattr(config, key) != getattr(plain, key)}
        self._changes_light = bool(changed - _NOT_LIGHT) or config.encoding == "mono8"
        self.active = self._changes_light or bool(changed & {"encoding", "jpeg"})
        aberration = config.chromatic_aberration
        if aberration and max(abs(aberration.red), abs(aberration.blue)) > corner_distance(camera) / 2:
            raise CameraError(
                f"a picture of {camera.size[0]}x{camera.size[1]} pixels is not stretched by more than half",
                key="sensor.chromatic_aberration",
            )

    def times(self) -> Array:
        """Times (T,) at which the scene must be rendered, seconds from the frame's stamp, which is the middle
        of the exposure of the middle row. One 0.0 where there is neither motion blur nor rolling shutter.
        """
        return sample_times(*self._shutter)

    def weights(self) -> Array:
        """Share (H, T) of each of these pictures in each row."""
        return row_weights(*self._shutter)

    def expose(self, pictures: Iterable[Image], stamp: int) -> Image:
        """What the sensor makes of pictures (H, W, 3) sRGB rendered at :meth:`times`: (H, W, 3), or (H, W)
        for mono8 and bayer_rggb8, encoded as ``config.encoding`` says. ``stamp``: nanoseconds.

        They are taken one by one, and no more than two are held. Without any effect the picture itself is
        returned. Raises CameraError where the pictures do not fit.
        """
        pictures = self._checked(pictures)
        if self._changes_light:
            image = self._develop(self._light(pictures), generator(self.config.seed, self.name, stamp))
        else:
            (picture,) = pictures
            image = self._filtered(picture)
        if self.config.jpeg is None:
            return _swapped(image) if self.config.encoding == "bgr8" else image
        if self._channels == 1:
            return _compressed(image, self.config.jpeg)
        image = _compressed(_swapped(image), self.config.jpeg)
        return image if self.config.encoding == "bgr8" else _swapped(image)

    def _checked(self, pictures: Iterable[Image]) -> Iterator[Image]:
        width, height = self.camera.size
        expected, count = len(self.times()), 0
        for count, picture in enumerate(pictures, 1):
            if picture.shape != (height, width, 3) or picture.dtype != np.uint8:
                raise CameraError(
                    f"the sensor needs pictures of {width}x{height} pixels, rgb8, "
                    f"not an array of shape {picture.shape}, {picture.dtype}"
                )
            if count <= expected:
                yield picture
        if count != expected:
            raise CameraError(f"the sensor needs {expected} pictures for a frame, not {count}")

    def _light(self, pictures: Iterator[Image]) -> Light:
        """Light (H, W, 3) behind the lens while the shutter was open, 1: white."""
        if self._weights.shape[1] == 1:
            (picture,) = pictures
            light = np.asarray(cv2.LUT(picture, _srgb_table()), dtype=np.float32)
        else:
            light = self._accumulated(pictures)
        aberration = self.config.chromatic_aberration
        return light if aberration is None else aberrate(light, self.camera, aberration)

    def _accumulated(self, pictures: Iterator[Image]) -> Light:
        width, height = self.camera.size
        light = np.zeros((height, width, 3), np.float32)
        for picture, share in zip(pictures, self._weights.T, strict=True):
            for rows in _blocks(light):
                if share[rows].any():
                    seen = _flat(np.asarray(cv2.LUT(picture[rows], _srgb_table()), dtype=np.float32))
                    seen *= share[rows, None]
                    _flat(light)[rows] += seen
        return light

    def _develop(self, light: Light, random: np.random.Generator) -> Image:
        """Numbers (H, W, 3) or (H, W) of light (H, W, 3) that reaches the colour filters."""
        config, noise = self.config, self.config.noise
        samples = self._filtered(light)
        well = 1.0 if noise is None else noise.full_well
        dark = 0.0 if noise is None else noise.dark_current * config.exposure_time
        offset = np.float32(LEVELS * config.black_level / 255 + 0.5)
        out = np.empty(samples.shape, np.uint8)
        flat, numbers = _flat(samples), _flat(out)
        for rows in _blocks(flat):
            charge = flat[rows] * np.float32(well * config.exposure)
            if self._transmission is not None:
                charge *= self._transmission[rows]
            charge += np.float32(dark)
            if noise is not None:
                charge = noisy(charge, noise.read_noise, random)
            np.minimum(charge, np.float32(well), out=charge)
            charge *= self._amplification[rows]
            charge += offset
            np.clip(charge, 0, LEVELS, out=charge)
            numbers[rows] = np.take(self._response, charge.astype(np.uint16))
        return out

    def _filtered(self, picture: NDArray[Any]) -> NDArray[Any]:
        """What of light (H, W, 3), or of a picture that only lacks the mosaic, passes the colour filters."""
        if self.config.encoding == "mono8":
            return luminance(picture)
        return mosaic(picture) if self.config.encoding == "bayer_rggb8" else picture

    @property
    def _shutter(self) -> tuple[int, float, float, int]:
        config = self.config
        return self.camera.size[1], config.exposure_time, config.rolling_shutter, config.samples

    @cached_property
    def _weights(self) -> Light:
        return self.weights().astype(np.float32)

    @cached_property
    def _response(self) -> Image:
        return response_table(self.config.response)

    @cached_property
    def _transmission(self) -> Light | None:
        """Share of the light that reaches each sample (H, N), None where all of it does."""
        if self.config.vignetting is None:
            return None
        share = transmission(self.camera, self.config.vignetting)
        return np.repeat(share, 3, axis=1) if self._channels == 3 else share

    @cached_property
    def _amplification(self) -> Light:
        """Levels (H, N) of the converter per electron, or per white where there is no noise."""
        config = self.config
        width, height = self.camera.size
        well = 1.0 if config.noise is None else config.noise.full_well
        gains = np.array(config.white_balance) * 10 ** (config.gain_db / 20) * LEVELS / well
        by_pixel = np.broadcast_to(gains.astype(np.float32), (height, width, 3))
        if self._channels == 3:
            return np.broadcast_to(_flat(by_pixel[:1]), (height, 3 * width))
        return np.asarray(mosaic(by_pixel), dtype=np.float32)

    @property
    def _channels(self) -> int:
        return 3 if self.config.encoding in ("rgb8", "bgr8") else 1


@cache
def _srgb_table() -> Light:
    return srgb_to_light(np.arange(256) / 255).astype(np.float32)


def _blocks(image: NDArray[Any]) -> Iterator[slice]:
    """The rows of an image, some at a time."""
    step = max(1, _BLOCK * len(image) // image.size)
    return (slice(top, top + step) for top in range(0, len(image), step))


def _flat(image: NDArray[Any]) -> NDArray[Any]:
    """The samples (H, N) of an image (H, W) or (H, W, 3): long rows are fast."""
    return image.reshape(len(image), -1)


def _swapped(image: Image) -> Image:
    """Red and blue (H, W, 3) in each other's place."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), dtype=np.uint8)


def _compressed(image: Image, quality: int) -> Image:
    """An image (H, W) or (H, W, 3) BGR after JPEG, as OpenCV writes and reads it."""
    done, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise CameraError(f"a picture of shape {image.shape} cannot be compressed", key="jpeg")
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
