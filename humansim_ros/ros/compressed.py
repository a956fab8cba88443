"""Compressed images in the formats of image_transport's plugins ``compressed`` and ``compressedDepth``.

Parameters have the names, ranges and defaults of the plugins, below their topic
(``<camera>.image_raw.compressed.jpeg_quality``), and can be set at any time.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult
from sensor_msgs.msg import CompressedImage

from humansim_ros.errors import RosError
from humansim_ros.ros.messages import header
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA

#: Colour encodings, which OpenCV encodes as bgr8; others are encoded as they are.
_COLOR_ENCODINGS = ("rgb8", "bgr8")
#: ``INV_DEPTH`` of the plugin, and its header: format, then the two coefficients of the inverse depth.
_INVERSE_DEPTH = 0
_CONFIG_HEADER = struct.Struct("<iff")
_MAX_LEVEL = 65535


def encode_image(
    image: NDArray[np.uint8], encoding: str, form: str, jpeg_quality: int, png_level: int
) -> tuple[str, NDArray[np.uint8]]:
    """Encode an image with 8 bits per sample.

    Args:
        image: Pixels (H, W) or (H, W, 3).
        encoding: ROS encoding of the pixels.
        form: ``jpeg`` or ``png``.
        jpeg_quality: 1 to 100.
        png_level: Compression level, 0 to 9.

    Returns:
        ``format`` and ``data`` of a CompressedImage.
    """
    settings = {
        "jpeg": (".jpg", [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]),
        "png": (".png", [cv2.IMWRITE_PNG_COMPRESSION, png_level]),
    }
    if encoding == "rgb8":
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), dtype=np.uint8)
    color = "bgr8" if encoding in _COLOR_ENCODINGS else ""
    return f"{encoding}; {form} compressed {color}", _encode(image, *settings[form])


def encode_depth(
    depth: NDArray[np.float32], depth_max: float, depth_quantization: float, png_level: int
) -> tuple[str, NDArray[np.uint8]]:
    """Encode a depth image as a header of 12 bytes and a 16 bit PNG of inverse depth.

    A pixel is ``a / depth + b``, rounded, with a and b from the header; 0 from ``depth_max`` on. The decoded
    depth d has an error of at most d * d / (2 a), where a = q (q + 1) and q is ``depth_quantization``.

    Args:
        depth: Depth (H, W) in metres.
        depth_max: Metres from which on depth is not encoded.
        depth_quantization: q, metres at which the resolution is one metre.
        png_level: Compression level, 0 to 9.

    Returns:
        ``format`` and ``data`` of a CompressedImage.
    """
    a = np.float32(depth_quantization * (depth_quantization + 1))
    b = np.float32(1 - a / np.float32(depth_max))
    inverse = np.divide(a, depth) + b
    np.rint(inverse, out=inverse)
    levels = np.where(depth < depth_max, np.clip(inverse, 1, _MAX_LEVEL), 0).astype(np.uint16)
    png = _encode(levels, ".png", [cv2.IMWRITE_PNG_COMPRESSION, png_level])
    head = np.frombuffer(_CONFIG_HEADER.pack(_INVERSE_DEPTH, a, b), dtype=np.uint8)
    return "32FC1; compressedDepth png", np.concatenate([head, png])


def _encode(image: NDArray[Any], suffix: str, settings: Sequence[int]) -> NDArray[np.uint8]:
    success, data = cv2.imencode(suffix, image, list(settings))
    if not success:
        height, width = image.shape[:2]
        raise RosError(f"OpenCV cannot encode {width}x{height} pixels as {suffix[1:]}")
    return np.asarray(data, dtype=np.uint8).reshape(-1)


class _CompressedPublisher:
    """Publisher of compressed images, with its parameters.

    Args:
        node: Node of the camera.
        camera: Name of the camera.
        topic: Topic of the images below the name of the camera.
        frame: Optical frame of the camera.
        transport: Name of the plugin of image_transport, the last part of the topic.
    """

    def __init__(self, node: SceneNode, camera: str, topic: str, frame: str, transport: str) -> None:
        self._node = node
        self._frame = frame
        self._parameters = f"{camera}.{topic.replace('/', '.')}.{transport}."
        self._publisher = node.create_publisher(CompressedImage, f"{camera}/{topic}/{transport}", DATA)

    @property
    def subscribed(self) -> bool:
        """Whether the topic has subscribers."""
        return bool(self._publisher.get_subscription_count())

    def _declare(self, name: str, default: Any, limits: tuple[float, float] | None, description: str) -> None:
        self._node.described_parameter(self._parameters + name, default, description, limits)

    def _value(self, name: str) -> Any:
        return self._node.get_parameter(self._parameters + name).value

    def _restrict(self, name: str, *values: str) -> None:
        """Reject other values of a parameter, now and later."""
        full = self._parameters + name

        def check(parameters: Sequence[Any]) -> SetParametersResult:
            invalid = [p.value for p in parameters if p.name == full and p.value not in values]
            reason = f"{full}: no such format: {invalid[0]}; there are {', '.join(values)}" if invalid else ""
            return SetParametersResult(successful=not invalid, reason=reason)

        result = check([self._node.get_parameter(full)])
        if not result.successful:
            raise RosError(f"parameter {result.reason}")
        self._node.add_on_set_parameters_callback(check)

    def _publish(self, form: str, data: NDArray[np.uint8], stamp: int) -> None:
        message = CompressedImage(header=header(stamp, self._frame), format=form)
        message._data = data  # assigning to data would check every byte
        self._publisher.publish(message)


class CompressedImagePublisher(_CompressedPublisher):
    """Publisher of ``<camera>/image_raw/compressed``.

    Args:
        node: Node of the camera.
        camera: Name of the camera.
        topic: Topic of the images below the name of the camera.
        frame: Optical frame of the camera.
        encoding: ROS encoding of the images.
    """

    def __init__(self, node: SceneNode, camera: str, topic: str, frame: str, encoding: str) -> None:
        super().__init__(node, camera, topic, frame, "compressed")
        self._encoding = encoding
        self._declare("format", "jpeg", None, "jpeg or png")
        self._restrict("format", "jpeg", "png")
        self._declare("jpeg_quality", 95, (1, 100), "JPEG quality, 1 to 100")
        self._declare("png_level", 3, (0, 9), "PNG compression level, 0 to 9; lossless")

    def publish(self, image: NDArray[np.uint8], stamp: int) -> None:
        """Encode an image and publish it."""
        settings = (self._value(name) for name in ("format", "jpeg_quality", "png_level"))
        self._publish(*encode_image(image, self._encoding, *settings), stamp)


class CompressedDepthPublisher(_CompressedPublisher):
    """Publisher of ``<camera>/depth/image/compressedDepth``.

    Args:
        node: Node of the camera.
        camera: Name of the camera.
        topic: Topic of the images below the name of the camera.
        frame: Optical frame of the camera.
    """

    def __init__(self, node: SceneNode, camera: str, topic: str, frame: str) -> None:
        super().__init__(node, camera, topic, frame, "compressedDepth")
        self._declare("format", "png", None, "png")
        self._restrict("format", "png")
        self._declare("depth_max", 10.0, (1.0, 100.0), "Metres from which on depth is not encoded")
        self._declare(
            "depth_quantization", 100.0, (1.0, 150.0), "Metres at which the resolution is one metre"
        )
        self._declare("png_level", 3, (0, 9), "PNG compression level, 0 to 9; lossless")

    def publish(self, depth: NDArray[np.float32], stamp: int) -> None:
        """Encode a depth image and publish it."""
        settings = (self._value(name) for name in ("depth_max", "depth_quantization", "png_level"))
        self._publish(*encode_depth(depth, *settings), stamp)
