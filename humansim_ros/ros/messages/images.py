"""Image messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from humansim_ros.ros.messages.headers import header


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


def mask_pixels(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """Pixels (H, W) of a mask of one body: 255 where a mask of truth values is true; coverage as it is."""
    return mask if mask.dtype == np.uint8 else mask.astype(np.uint8) * np.uint8(255)


def set_data(message: Any, data: NDArray[Any]) -> None:
    """Set ``message.data`` to the bytes of an array. Assigning to ``data`` would check each byte."""
    message._data = np.ascontiguousarray(data).reshape(-1).view(np.uint8)
