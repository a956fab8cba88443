"""Image messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from humansim_ros.errors import RosError
from humansim_ros.ros.messages.headers import header

#: Element type and number of channels of encodings.
_PIXELS = {
    **dict.fromkeys(("rgb8", "bgr8"), ("u1", 3)),
    **dict.fromkeys(("mono8", "8UC1", "bayer_rggb8"), ("u1", 1)),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", 1)),
    "32SC1": ("i4", 1),
    "32FC1": ("f4", 1),
    "32FC2": ("f4", 2),
    "32FC3": ("f4", 3),
}


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
    """Pixels (H, W) or (H, W, C) of an Image. Raises RosError for other encodings, and for damaged ones."""
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


def mask_pixels(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """Pixels (H, W) of a mask of one body: 255 where a mask of truth values is true; coverage as it is."""
    return mask if mask.dtype == np.uint8 else mask.astype(np.uint8) * np.uint8(255)


def set_data(message: Any, data: NDArray[Any]) -> None:
    """Set ``message.data`` to the bytes of an array. Assigning to ``data`` would check each byte."""
    message._data = np.ascontiguousarray(data).reshape(-1).view(np.uint8)
