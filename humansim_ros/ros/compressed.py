"""Publishers of compressed images, as image_transport's plugins ``compressed`` and ``compressedDepth``.

Parameters have the names, ranges and defaults of the plugins, below their topic
(``<camera>.image_raw.compressed.jpeg_quality``), and can be set at any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult

from humansim_ros.errors import RosError
from humansim_ros.messages import DepthCompression, ImageCompression
from humansim_ros.messages.topics import CameraTopics, Topic
from humansim_ros.render import View
from humansim_ros.ros.camera_driver import CameraDriver
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import offered_profile


class _CompressedPublisher:
    """Publisher of compressed images, with its parameters.

    ``topic``: its name ends with the name of the plugin of image_transport.
    """

    def __init__(self, node: SceneNode, topic: Topic[View]) -> None:
        self._node = node
        self._parameters = topic.name.replace("/", ".") + "."
        self._publisher = node.create_publisher(topic.type, topic.name, offered_profile(topic))

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


class CompressedImagePublisher(_CompressedPublisher):
    """Publisher of ``<camera>/image_raw/compressed``."""

    def __init__(self, node: SceneNode, topics: CameraTopics, driver: CameraDriver) -> None:
        default = ImageCompression()
        self._topics = topics
        self._driver = driver
        super().__init__(node, topics.compressed(default))
        self._declare("format", default.format, None, "jpeg or png")
        self._restrict("format", "jpeg", "png")
        self._declare("jpeg_quality", default.jpeg_quality, (1, 100), "JPEG quality, 1 to 100")
        self._declare("png_level", default.png_level, (0, 9), "PNG compression level, 0 to 9; lossless")

    def publish(self, view: View, stamp: int) -> None:
        """Encode the image of a view and publish it."""
        settings = ImageCompression(*map(self._value, ("format", "jpeg_quality", "png_level")))
        self._driver.send(self._topics.compressed(settings), self._publisher, view, stamp)


class CompressedDepthPublisher(_CompressedPublisher):
    """Publisher of ``<camera>/depth/image/compressedDepth``."""

    def __init__(self, node: SceneNode, topics: CameraTopics) -> None:
        default = DepthCompression()
        self._topics = topics
        super().__init__(node, topics.compressed_depth(default))
        self._declare("format", "png", None, "png")
        self._restrict("format", "png")
        self._declare(
            "depth_max", default.depth_max, (1.0, 100.0), "Metres from which on depth is not encoded"
        )
        self._declare(
            "depth_quantization",
            default.depth_quantization,
            (1.0, 150.0),
            "Metres at which the resolution is one metre",
        )
        self._declare("png_level", default.png_level, (0, 9), "PNG compression level, 0 to 9; lossless")

    def publish(self, view: View, stamp: int) -> None:
        """Encode the depth of a view and publish it."""
        settings = DepthCompression(*map(self._value, ("depth_max", "depth_quantization", "png_level")))
        self._publisher.publish(self._topics.compressed_depth(settings).build(view, stamp))
