"""Messages of images: raw, or in image_transport's formats ``compressed`` and ``compressedDepth``."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.messages.headers import header
from humansim_ros.data.messages.types import CompressedImage, Image, set_unchecked
from humansim_ros.errors import RosError
from humansim_ros.files.reading import MAX_PIXELS, declared_size
from humansim_ros.render.interface import CHANNEL_TABLE

#: Element type and number of channels of an image, by encoding.
_PIXELS = {
    **dict.fromkeys(("rgb8", "bgr8"), ("u1", 3)),
    **dict.fromkeys(("mono8", "8UC1", "bayer_rggb8"), ("u1", 1)),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", 1)),
    "32SC1": ("i4", 1),
    "32FC1": ("f4", 1),
    "32FC2": ("f4", 2),
    "32FC3": ("f4", 3),
}
#: Colour encodings. OpenCV encodes them as bgr8. Other images are encoded unchanged.
_COLOR_ENCODINGS = ("rgb8", "bgr8")
#: Value ``INV_DEPTH`` of the plugin ``compressedDepth``. The header of its images is the format, then the two
#: coefficients of the inverse depth.
_INVERSE_DEPTH = 0
_CONFIG_HEADER = struct.Struct("<iff")
_MAX_LEVEL = 65535
#: The size of a compressed image is searched in this number of bytes at its start.
_MAX_HEAD = 1 << 20


@dataclass(frozen=True)
class ImageCompression:
    """Settings of compressed images, with the names and defaults of image_transport's plugin ``compressed``.

    Attributes:
        format: ``jpeg`` or ``png``.
        jpeg_quality: 1 to 100.
        png_level: Compression level, 0 to 9; lossless.
    """

    format: str = "jpeg"
    jpeg_quality: int = 95
    png_level: int = 3


@dataclass(frozen=True)
class DepthCompression:
    """Settings of compressed depth, with names and defaults of image_transport's ``compressedDepth``.

    Attributes:
        depth_max: Largest depth that is encoded, metres.
        depth_quantization: Depth at which the resolution is one metre; nearer depths are finer. Metres.
        png_level: Compression level, 0 to 9; lossless.
    """

    depth_max: float = 10.0
    depth_quantization: float = 100.0
    png_level: int = 3


def image_message(image: NDArray[Any], encoding: str, stamp: int, frame: str) -> Image:
    """Build an Image without a copy of the pixels.

    Args:
        image: Pixels (H, W) or (H, W, C). The array must not change afterwards.
        encoding: ROS encoding, such as ``rgb8``.
        stamp: Nanoseconds.
        frame: Optical frame of the camera.
    """
    message = Image(
        header=header(stamp, frame), height=image.shape[0], width=image.shape[1], encoding=encoding
    )
    message.is_bigendian = 0
    message.step = image.strides[0]
    set_data(message, image)
    return message


def read_image(message: Image) -> NDArray[Any]:
    """Pixels (H, W) or (H, W, C) of an Image. Raises RosError for unknown encodings and damaged images."""
    if message.encoding not in _PIXELS:
        raise RosError(
            f"images of encoding {message.encoding!r} are not read; known are {', '.join(_PIXELS)}"
        )
    kind, channels = _PIXELS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    used = message.width * channels * dtype.itemsize
    data = np.frombuffer(message.data, dtype=np.uint8)
    if not used or message.step < used or len(data) != message.height * message.step:
        raise RosError(
            f"{len(data)} bytes are not an image of {message.width}x{message.height} {message.encoding}"
        )
    rows = np.ascontiguousarray(data.reshape(message.height, message.step)[:, :used])
    pixels = rows.view(dtype).astype(kind, copy=False)
    return pixels.reshape(message.height, message.width, channels) if channels > 1 else pixels


def fits_channel(pixels: NDArray[Any], channel: str) -> bool:
    """Whether pixels (H, W) or (H, W, C) have the kind of numbers and the components of a channel."""
    row = CHANNEL_TABLE[channel]
    return pixels.shape[2:] == row.components and pixels.dtype.kind == np.dtype(row.dtype).kind


def mask_pixels(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert the mask of one body to pixels (H, W). False and true become 0 and 255. A mask of coverage
    (uint8) is unchanged."""
    return mask if mask.dtype == np.uint8 else mask.astype(np.uint8) * np.uint8(255)


def set_data(message: Any, data: NDArray[Any]) -> None:
    """Set ``message.data`` to the bytes of an array."""
    set_unchecked(message, "data", np.ascontiguousarray(data).reshape(-1).view(np.uint8))


def compressed_image_message(
    image: NDArray[np.uint8], encoding: str, settings: ImageCompression, stamp: int, frame: str
) -> CompressedImage:
    """Build ``<camera>/image_raw/compressed``, or the same topic of another channel.

    Args:
        image: Pixels (H, W) or (H, W, 3), 8 bits per sample; with PNG also (H, W) of 16 bits.
        encoding: ROS encoding of the pixels.
        settings: Format and its settings.
        stamp: Nanoseconds.
        frame: Optical frame of the camera.
    """
    options = {
        "jpeg": (".jpg", [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality]),
        "png": (".png", [cv2.IMWRITE_PNG_COMPRESSION, settings.png_level]),
    }
    if encoding == "rgb8":
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), dtype=np.uint8)
    color = "bgr8" if encoding in _COLOR_ENCODINGS else ""
    form = f"{encoding}; {settings.format} compressed {color}"
    return _message(form, _encode(image, *options[settings.format]), stamp, frame)


def compressed_depth_message(
    depth: NDArray[np.float32], settings: DepthCompression, stamp: int, frame: str
) -> CompressedImage:
    """Build ``<camera>/depth/image/compressedDepth``: a header of 12 bytes and a 16 bit PNG of inverse depth.

    A pixel is ``a / depth + b``, rounded, with a and b from the header. It is 0 from ``depth_max`` on. The
    decoded depth d has an error of at most d * d / (2 a), where a = q (q + 1) and q is
    ``depth_quantization``.

    Args:
        depth: Depth (H, W) in metres.
        settings: Range, resolution and compression level.
        stamp: Nanoseconds.
        frame: Optical frame of the camera.
    """
    a = np.float32(settings.depth_quantization * (settings.depth_quantization + 1))
    b = np.float32(1 - a / np.float32(settings.depth_max))
    inverse = np.divide(a, depth) + b
    np.rint(inverse, out=inverse)
    levels = np.where(depth < settings.depth_max, np.clip(inverse, 1, _MAX_LEVEL), 0).astype(np.uint16)
    png = _encode(levels, ".png", [cv2.IMWRITE_PNG_COMPRESSION, settings.png_level])
    head = np.frombuffer(_CONFIG_HEADER.pack(_INVERSE_DEPTH, a, b), dtype=np.uint8)
    return _message("32FC1; compressedDepth png", np.concatenate([head, png]), stamp, frame)


def read_compressed_image(message: CompressedImage) -> tuple[NDArray[Any], str]:
    """Decode a JPEG or PNG. Returns the pixels (H, W) or (H, W, 3), and their encoding. mono16 has 16 bits.

    Raises:
        RosError: The image is damaged, or neither JPEG nor PNG.
    """
    pixels = _decode(np.frombuffer(message.data, dtype=np.uint8))
    encoding = message.format.partition(";")[0].strip()
    if pixels.dtype == np.uint16 and pixels.ndim == 2 and encoding == "mono16":
        return pixels, encoding
    if pixels.dtype != np.uint8:
        raise RosError("a compressed image must have 8 bits per sample, or 16 as mono16")
    if pixels.ndim == 2:
        return pixels, encoding if encoding == "bayer_rggb8" else "mono8"
    if encoding == "rgb8":
        return np.ascontiguousarray(pixels[..., ::-1]), encoding
    return pixels, "bgr8"


def read_pixels(message: Image | CompressedImage) -> tuple[NDArray[Any], str]:
    """Return pixels and encoding of a message: a raw or compressed image, or compressed depth. Raises
    RosError if the message is damaged, or has an unknown encoding."""
    if hasattr(message, "encoding"):
        return read_image(message), str(message.encoding)
    if "compressedDepth" in message.format:
        return read_compressed_depth(message), "32FC1"
    return read_compressed_image(message)


def read_compressed_depth(message: CompressedImage) -> NDArray[np.float32]:
    """Decode a message of :func:`compressed_depth_message` to depth (H, W) in metres; inf is no depth.

    Raises:
        RosError: The message is damaged, or of another format.
    """
    data = np.frombuffer(message.data, dtype=np.uint8)
    if len(data) <= _CONFIG_HEADER.size or not message.format.startswith("32FC1"):
        raise RosError(f"compressed depth of format {message.format!r} is not read; known is 32FC1")
    _, a, b = _CONFIG_HEADER.unpack(data[: _CONFIG_HEADER.size].tobytes())
    levels = _decode(data[_CONFIG_HEADER.size :])
    if levels.dtype != np.uint16 or levels.ndim != 2:
        raise RosError("compressed depth must be a PNG of 16 bits")
    depth = np.full(levels.shape, np.inf, np.float32)
    np.divide(np.float32(a), levels - np.float32(b), out=depth, where=levels > 0)
    return depth


def _decode(data: NDArray[np.uint8]) -> NDArray[Any]:
    width, height = declared_size(data[:_MAX_HEAD].tobytes()) or (0, 0)
    if width * height > MAX_PIXELS:
        raise RosError(f"a compressed image of {width}x{height} pixels; at most {MAX_PIXELS} are read")
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:  # no data
        pixels = None
    if pixels is None:
        raise RosError("a compressed image cannot be decoded")
    return np.asarray(pixels)


def _message(form: str, data: NDArray[np.uint8], stamp: int, frame: str) -> CompressedImage:
    message = CompressedImage(header=header(stamp, frame), format=form)
    set_data(message, data)
    return message


def _encode(image: NDArray[Any], suffix: str, settings: Sequence[int]) -> NDArray[np.uint8]:
    success, data = cv2.imencode(suffix, image, list(settings))
    if not success:
        height, width = image.shape[:2]
        raise RosError(f"OpenCV cannot encode {width}x{height} pixels as {suffix[1:]}")
    return np.asarray(data, dtype=np.uint8).reshape(-1)
