"""The sensor: from rendered images to the images that a driver publishes.

The effects come in the order of the light. The light passes the lens (chromatic aberration, vignetting) while
the shutter is open (motion blur, rolling shutter), passes the colour filters, and releases electrons
(exposure, shot noise, dark current) until the pixel saturates. The electrons are read (read noise), amplified
(gain, white balance), converted to numbers through the response curve, and compressed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from functools import cache, cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.sensor.config import ChromaticAberration, SensorConfig, Vignetting
from humansim_ros.errors import CameraError
from humansim_ros.files.reading import decode_srgb, encode_srgb
from humansim_ros.types import Array, Float32Array, Image

#: From this mean number of electrons on, a normal distribution replaces the Poisson distribution.
_NORMAL_FROM = 20.0


def generator(seed: int, camera: str, stamp: int) -> np.random.Generator:
    """Random generator of a frame. It depends only on the arguments, so that frames are reproducible."""
    digest = hashlib.sha256(f"{seed} {stamp} {camera}".encode()).digest()
    return np.random.Generator(np.random.SFC64(int.from_bytes(digest, "little")))


def add_noise(electrons: Float32Array, read_noise: float, random: np.random.Generator) -> Float32Array:
    """Draw random numbers of electrons. ``electrons``: (H, N) expected numbers. Shot noise is Poisson
    distributed; read noise is normal with standard deviation ``read_noise``. Results may be negative."""
    normal = normal_numbers(electrons.shape, random)
    out = np.sqrt(electrons + np.float32(read_noise**2))
    out *= normal
    out += electrons
    few = electrons < _NORMAL_FROM
    if few.any():
        out[few] = random.poisson(electrons[few]) + np.float32(read_noise) * normal[few]
    return np.asarray(out, dtype=np.float32)


def normal_numbers(shape: tuple[int, ...], random: np.random.Generator) -> Float32Array:
    """Random standard normal numbers, drawn from a table of quantiles. This is five times as fast as
    ``standard_normal``."""
    count = int(np.prod(shape))
    uniform = np.frombuffer(random.bytes(2 * count), "<u2")
    return np.take(_quantiles(), uniform).reshape(shape)


@cache
def _quantiles() -> Float32Array:
    """Table of 65536 equally likely standard normal numbers. The largest one is 4.3."""
    from scipy.special import ndtri  # imported here, since the import is slow and few cameras have noise

    values = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
    return np.asarray(values / values.std(), dtype=np.float32)


#: Largest value of the analog-to-digital converter.
LEVELS = 65535
#: Weights of red, green and blue in the luminance of linear sRGB (IEC 61966-2-1, ITU-R BT.709).
_LUMINANCE = np.array([[0.2126, 0.7152, 0.0722]], np.float32)


def response_table(response: str | float) -> Image:
    """8-bit value of each level (65536,) of the converter."""
    light = np.arange(LEVELS + 1) / LEVELS
    if response == "srgb":
        values = encode_srgb(light)
    else:
        values = light if response == "linear" else light ** (1 / float(response))
    return np.rint(255 * values).astype(np.uint8)


def luminance(light: Float32Array) -> Float32Array:
    """Luminance (H, W) of light (H, W, 3)."""
    return np.asarray(cv2.transform(light, _LUMINANCE), dtype=np.float32).reshape(light.shape[:2])


def bayer_mosaic(image: NDArray[Any]) -> NDArray[Any]:
    """Samples (H, W) of an image (H, W, 3) behind a Bayer filter with the rows red, green and green, blue."""
    out = np.array(image[..., 1], order="C")
    out[0::2, 0::2] = image[0::2, 0::2, 0]
    out[1::2, 1::2] = image[1::2, 1::2, 2]
    return out


#: Number of samples that are processed at a time, so that they fit into the processor cache.
_BLOCK = 1 << 16
#: Settings that do not change the light.
_NOT_LIGHT = {"encoding", "jpeg", "seed", "samples"}


class Sensor:
    """Sensor of one camera.

    Args:
        config: Settings of the sensor.
        camera: Camera that the images are rendered for.
        name: Name of the camera. Cameras with different names have different noise, since the random numbers
            of an image depend only on the seed, the name and the time of the frame.

    Attributes:
        active: Whether the sensor changes images.

    Raises:
        CameraError: The chromatic aberration is too large for the image.

    Example:
        >>> import numpy as np
        >>> from humansim_ros.cameras import Camera
        >>> from humansim_ros.cameras import Sensor, SensorConfig
        >>> camera = Camera.look_at((3, 0, 1), (0, 0, 1), size=(64, 48))
        >>> sensor = Sensor(SensorConfig(encoding="mono8", exposure=0.5), camera)
        >>> grey = np.full((48, 64, 3), 188, np.uint8)  # half of the light of white
        >>> image = sensor.expose([grey for time in sensor.times()], stamp=0)
        >>> image.shape, int(image[0, 0])
        ((48, 64), 137)
    """

    def __init__(self, config: SensorConfig, camera: Camera, name: str = "") -> None:
        self.config = config
        self.camera = camera
        self.name = name
        default = SensorConfig()
        changed = {key for key in SensorConfig.model_fields if getattr(config, key) != getattr(default, key)}
        self._changes_light = bool(changed - _NOT_LIGHT) or config.encoding == "mono8"
        self.active = self._changes_light or bool(changed & {"encoding", "jpeg"})
        aberration = config.chromatic_aberration
        if aberration and max(abs(aberration.red), abs(aberration.blue)) > corner_distance(camera) / 2:
            width, height = camera.size
            message = f"shifts by more than half of the distance to the corner of {width}x{height} pixels"
            raise CameraError(message, key="sensor.chromatic_aberration")

    def times(self) -> Array:
        """Times (T,) at which the scene must be rendered, seconds from the stamp of the frame. The stamp is
        the midpoint of the exposure of the middle row.

        With a global shutter, the times are the midpoints of equal parts of the exposure. With a rolling
        shutter, the times are spread evenly from the start of the first row to the end of the last row.
        Without motion blur and rolling shutter, there is a single time, 0.0.
        """
        exposure, row_time, samples = self._shutter
        span = exposure + (self.camera.size[1] - 1) * row_time
        if span < _SHORTEST or samples == 1:
            return np.zeros(1)
        if row_time == 0:
            return exposure * ((np.arange(samples) + 0.5) / samples - 0.5)
        return np.linspace(-span / 2, span / 2, samples, dtype=float)

    def weights(self) -> Array:
        """Weights (H, T) of the images of :meth:`times` in the light of each row. The sum of a row is 1.

        With a rolling shutter, the midpoint of the exposure of row y is (y - (H - 1) / 2) row_time. Light is
        interpolated linearly between samples, so that the mean time of each row is exact for any number of
        samples.
        """
        (exposure, row_time, _), times, height = self._shutter, self.times(), self.camera.size[1]
        if len(times) == 1 or row_time == 0:
            return np.full((height, len(times)), 1 / len(times))
        step = times[1] - times[0]
        middle = (np.arange(height) - (height - 1) / 2)[:, None] * row_time
        if exposure < _SHORTEST:
            weights = np.maximum(0.0, 1 - np.abs(middle - times) / step)
        else:
            weights = _triangle_integral((middle + exposure / 2 - times) / step)
            weights = weights - _triangle_integral((middle - exposure / 2 - times) / step)
        return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=float)

    def expose(self, images: Iterable[Image], stamp: int, light: Float32Array | None = None) -> Image:
        """Compute the image of the sensor.

        Rendered images are consumed one at a time; at most two are in memory. Without any effect, the
        rendered image itself is returned.

        Args:
            images: Images (H, W, 3) sRGB rendered at :meth:`times`.
            stamp: Time of the frame, nanoseconds. The noise depends on it. Scenes pass the scene time, so
                that the same frame always has the same noise.
            light: Factors of the light, (H, 1) or (H, W). If None, the light is not changed.

        Returns:
            Image in the encoding of the sensor: (H, W, 3), or (H, W) for mono8 and bayer_rggb8.

        Raises:
            CameraError: The number, size or type of the images is wrong.
        """
        images = self._checked(images)
        if self._changes_light or light is not None:
            image = self._digitize(self._light(images), generator(self.config.seed, self.name, stamp), light)
        else:
            (rendered,) = images
            image = self._filtered(rendered)
        if self.config.jpeg is None:
            return _swap_red_blue(image) if self.config.encoding == "bgr8" else image
        if self._channels == 1:
            return _compress(image, self.config.jpeg)
        image = _compress(_swap_red_blue(image), self.config.jpeg)
        return image if self.config.encoding == "bgr8" else _swap_red_blue(image)

    def _checked(self, images: Iterable[Image]) -> Iterator[Image]:
        width, height = self.camera.size
        expected, count = len(self.times()), 0
        for count, image in enumerate(images, 1):
            if image.shape != (height, width, 3) or image.dtype != np.uint8:
                raise CameraError(
                    f"the sensor needs images of {width}x{height} pixels, rgb8, "
                    f"not an array of shape {image.shape}, {image.dtype}"
                )
            if count <= expected:
                yield image
        if count != expected:
            raise CameraError(f"the sensor needs {expected} images for a frame, not {count}")

    def _light(self, images: Iterator[Image]) -> Float32Array:
        """Light (H, W, 3) behind the lens during the exposure. White is 1."""
        if self._weights.shape[1] == 1:
            (image,) = images
            light = srgb_to_light(image)
        else:
            light = self._accumulated(images)
        aberration = self.config.chromatic_aberration
        return light if aberration is None else aberrate(light, self.camera, aberration)

    def _accumulated(self, images: Iterator[Image]) -> Float32Array:
        width, height = self.camera.size
        light = np.zeros((height, width, 3), np.float32)
        for image, weight in zip(images, self._weights.T, strict=True):
            for rows in _blocks(light):
                if weight[rows].any():
                    part = _flat(srgb_to_light(image[rows]))
                    part *= weight[rows, None]
                    _flat(light)[rows] += part
        return light

    def _digitize(
        self, light: Float32Array, random: np.random.Generator, factors: Float32Array | None
    ) -> Image:
        """Digital values (H, W, 3) or (H, W). ``light``: (H, W, 3) in front of the colour filters.
        ``factors`` multiply the light."""
        if factors is not None:
            light = light * factors[..., None]
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
                charge = add_noise(charge, noise.read_noise, random)
            np.minimum(charge, np.float32(well), out=charge)
            charge *= self._amplification[rows]
            charge += offset
            np.clip(charge, 0, LEVELS, out=charge)
            numbers[rows] = np.take(self._response, charge.astype(np.uint16))
        return out

    def _filtered(self, light: NDArray[Any]) -> NDArray[Any]:
        """What the colour filters let through: of light, or of an 8-bit image, (H, W, 3)."""
        if self.config.encoding == "mono8":
            return luminance(light)
        return bayer_mosaic(light) if self.config.encoding == "bayer_rggb8" else light

    @property
    def _shutter(self) -> tuple[float, float, int]:
        config = self.config
        return config.exposure_time, config.rolling_shutter, config.samples

    @cached_property
    def _weights(self) -> Float32Array:
        return self.weights().astype(np.float32)

    @cached_property
    def _response(self) -> Image:
        return response_table(self.config.response)

    @cached_property
    def _transmission(self) -> Float32Array | None:
        """Fraction (H, N) of the light that reaches each sample; None if there is no vignetting."""
        if self.config.vignetting is None:
            return None
        fraction = transmission(self.camera, self.config.vignetting)
        return np.repeat(fraction, 3, axis=1) if self._channels == 3 else fraction

    @cached_property
    def _amplification(self) -> Float32Array:
        """Levels (H, N) of the converter per electron. If there is no noise, levels per unit of light."""
        config = self.config
        width, height = self.camera.size
        well = 1.0 if config.noise is None else config.noise.full_well
        gains = np.array(config.white_balance) * 10 ** (config.gain_db / 20) * LEVELS / well
        by_pixel = np.broadcast_to(gains.astype(np.float32), (height, width, 3))
        if self._channels == 3:
            return np.broadcast_to(_flat(by_pixel[:1]), (height, 3 * width))
        return np.asarray(bayer_mosaic(by_pixel), dtype=np.float32)

    @property
    def _channels(self) -> int:
        return 3 if self.config.encoding in ("rgb8", "bgr8") else 1


def srgb_to_light(image: Image) -> Float32Array:
    """Linear light of an image of sRGB values. White is 1."""
    return np.asarray(cv2.LUT(image, _srgb_table()), dtype=np.float32)


@cache
def _srgb_table() -> Float32Array:
    return decode_srgb(np.arange(256) / 255).astype(np.float32)


def _blocks(image: NDArray[Any]) -> Iterator[slice]:
    """Slices that divide the rows of an image into blocks of about ``_BLOCK`` samples."""
    step = max(1, _BLOCK * len(image) // image.size)
    return (slice(top, top + step) for top in range(0, len(image), step))


def _flat(image: NDArray[Any]) -> NDArray[Any]:
    """Samples (H, N) of an image (H, W) or (H, W, 3), since NumPy is faster on long rows."""
    return image.reshape(len(image), -1)


def _swap_red_blue(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), dtype=np.uint8)


def _compress(image: Image, quality: int) -> Image:
    """Compress an image (H, W) or (H, W, 3) BGR as JPEG by OpenCV, and return it decompressed."""
    done, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise CameraError(f"an image of shape {image.shape} cannot be compressed", key="jpeg")
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED), dtype=np.uint8)


#: The rays are computed for every fourth pixel, since the inverse of a distortion is slow.
_STEP = 4


def corner_distance(camera: Camera) -> float:
    """Distance in pixels from the principal point to the centre of the farthest corner pixel."""
    farthest = np.maximum(camera.K[:2, 2], np.array(camera.size) - 1 - camera.K[:2, 2])
    return float(np.hypot(*farthest))


def transmission(camera: Camera, vignetting: Vignetting) -> Float32Array:
    """Fraction (H, W) of the light that reaches each pixel."""
    width, height = camera.size
    x, y = np.arange(width) - camera.K[0, 2], np.arange(height)[:, None] - camera.K[1, 2]
    squared = ((x**2 + y**2) / corner_distance(camera) ** 2).astype(np.float32)
    a, b, c = vignetting.polynomial
    fraction = 1 + squared * (a + squared * (b + squared * c))
    fraction *= 1 - vignetting.corner * squared
    if vignetting.cos4:
        fraction *= _cos4_falloff(camera)
    return np.asarray(np.maximum(fraction, 0), dtype=np.float32)


def _cos4_falloff(camera: Camera) -> Float32Array:
    """cos^4 (H, W) of the angle between each pixel's ray and the optical axis. 0 for pixels without a ray. It
    is interpolated linearly between every fourth pixel, with an error below 16 / f^2."""
    width, height = camera.size
    columns, rows = (np.arange(0, n - 1 + _STEP, _STEP) for n in (width, height))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = camera.to_optical(camera.unproject(pixels, np.ones(len(pixels))))
    fraction = np.nan_to_num(np.linalg.norm(rays, axis=-1) ** -4.0, nan=0.0).reshape(len(rows), len(columns))
    across, down = (
        np.maximum(0, 1 - np.abs(np.arange(n)[:, None] - nodes) / _STEP)
        for n, nodes in ((width, columns), (height, rows))
    )
    return np.asarray(down @ fraction @ across.T, dtype=np.float32)


def aberrate(light: Float32Array, camera: Camera, aberration: ChromaticAberration) -> Float32Array:
    """Magnify red and blue of light (H, W, 3) about the principal point."""
    out = light.copy()
    for channel, pixels in ((0, aberration.red), (2, aberration.blue)):
        if pixels:
            # WARP_INVERSE_MAP: the matrix maps output pixels to input pixels
            scale = 1 / (1 + pixels / corner_distance(camera))
            input_from_output = np.column_stack([scale * np.eye(2), (1 - scale) * camera.K[:2, 2]])
            out[..., channel] = cv2.warpAffine(
                cv2.extractChannel(light, channel),
                input_from_output,
                camera.size,
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )
    return out


#: Shortest exposure, seconds, since stamps are whole nanoseconds.
_SHORTEST = 1e-9


def _triangle_integral(u: Array) -> Array:
    """Integral from -1 to ``u`` of the triangle function 1 - |u|."""
    u = np.clip(u, -1.0, 1.0)
    return np.where(u < 0, (1 + u) ** 2 / 2, 1 - (1 - u) ** 2 / 2)
