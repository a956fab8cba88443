"""Publishers of a camera's images and ground truth, raw and compressed, as a camera driver sends them."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from sensor_msgs.srv import SetCameraInfo

from humansim_ros.data.messages import (
    CameraTopics,
    Content,
    DepthCompression,
    DepthContent,
    DepthSensorTopics,
    ImageCompression,
    PublishedCalibration,
    Topic,
    read_camera_info,
)
from humansim_ros.errors import HumansimError, RosError, printable
from humansim_ros.render.interface import CHANNEL_TABLE, View
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.core import FOLLOWING, NO_FAULTS, FrameFaults
from humansim_ros.scene.truth import CameraTruth


class CalibrationService:
    """Service ``<camera>/set_camera_info``, which replaces the published calibration and saves it as camera
    drivers do."""

    def __init__(self, node: SceneNode, calibration: PublishedCalibration) -> None:
        self._node, self._calibration = node, calibration
        node.create_service(SetCameraInfo, f"{calibration.name}/set_camera_info", self._on_set)

    def _on_set(self, request: Any, response: Any) -> Any:
        try:
            self._calibration.replace(read_camera_info(request.camera_info))
        except HumansimError as error:
            response.success, response.status_message = False, printable(str(error))
            return response
        try:
            path = self._calibration.save()
        except (OSError, HumansimError) as error:
            response.success, response.status_message = False, f"published, but not saved: {error}"
            return response
        response.success = True
        response.status_message = (
            f"camera_info is replaced and saved to {path}; images are rendered with the same lens as before"
        )
        self._node.get_logger().info(f"{self._calibration.name}: {response.status_message}")
        return response


#: Longest wait for subscribers to receive the last messages of a run, seconds.
_MAX_WAIT = 1.0


class _Held(NamedTuple):
    """A message that is sent later. ``in_turn``: send it at the end of a later frame, not by a timer."""

    due: int
    number: int
    stamp: int
    in_turn: bool
    publisher: Any
    message: Any


class CameraDriver:
    """Sends the messages of a camera that simulated faults may delay, repeat or drop. A message without a
    fault is sent at once, a delayed one when it is due. In lockstep, time stands still between frames, so
    delayed messages are sent with a later frame. In real time, a timer sends them."""

    def __init__(self, node: SceneNode) -> None:
        self._node = node
        self._held: list[_Held] = []
        self._number = 0
        self._timer: Any = None
        self._faults = NO_FAULTS

    @contextmanager
    def frame(self, stamp: int, faults: FrameFaults) -> Iterator[None]:
        """Context manager for the messages of one frame. ``stamp``: stamp of the frame, nanoseconds."""
        self._faults = faults
        if self._held:  # a frame that is shown again, or the clock was set back: its messages come again
            self._held = [held for held in self._held if held.stamp < stamp]
            heapq.heapify(self._held)
            self._send_due(stamp)
        try:
            yield
        finally:
            self._send_due(stamp + FOLLOWING)
            self._set_timer()

    def send(self, topic: Topic[Content], publisher: Any, content: Content, stamp: int) -> None:
        """Send a message of the frame.

        Args:
            topic: Topic of the message.
            publisher: Publisher of the topic.
            content: Content of the message.
            stamp: Stamp of the frame, nanoseconds.
        """
        faults = self._faults if topic.faulty else NO_FAULTS
        if not faults.sent:
            return
        message = topic.build(content, faults.stamp(stamp))
        for after in faults.sent:
            if after == 0:
                publisher.publish(message)
                continue
            self._number += 1
            held = _Held(stamp + after, self._number, stamp, faults.follows, publisher, message)
            heapq.heappush(self._held, held)

    def send_held(self) -> None:
        """Send all delayed messages at the end of a run, and wait until subscribers have received them."""
        if not self._held:
            return
        publishers = {id(held.publisher): held.publisher for held in self._held}
        self._send_due(max(held.due for held in self._held))
        deadline = time.monotonic() + _MAX_WAIT
        for publisher in publishers.values():
            left = max(0.0, deadline - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))

    def _send_due(self, time: int, in_turn: bool = True) -> None:
        """Send the messages that are due. Without ``in_turn``, stop at a message that waits for the end of a
        frame."""
        while self._held and self._held[0].due <= time and (in_turn or not self._held[0].in_turn):
            held = heapq.heappop(self._held)
            held.publisher.publish(held.message)

    def _set_timer(self) -> None:
        if not self._held or self._timer is not None or self._node.has_simulated_time():
            return
        seconds = max(1e-3, (self._held[0].due - self._node.now()) * 1e-9)
        self._timer = self._node.create_timer(seconds, self._on_timer)

    def _on_timer(self) -> None:
        self._node.destroy_timer(self._timer)
        self._timer = None
        self._send_due(self._node.now(), in_turn=False)
        if self._held and not self._held[0].in_turn:
            self._set_timer()


class _CompressedPublisher:
    """Publisher of compressed images, with its parameters. The name of ``topic`` ends with the name of the
    plugin of image_transport, such as ``compressed``."""

    def __init__(self, node: SceneNode, topic: Topic[View]) -> None:
        self._node = node
        self._parameters = topic.name.replace("/", ".") + "."
        self._publisher = node.topic_publisher(topic)

    @property
    def subscribed(self) -> bool:
        """Whether the topic has subscribers."""
        return bool(self._publisher.get_subscription_count())

    def _declare(self, name: str, default: Any, limits: tuple[float, float] | None, description: str) -> None:
        self._node.described_parameter(self._parameters + name, default, description, limits)

    def _value(self, name: str) -> Any:
        return self._node.get_parameter(self._parameters + name).value

    def _restrict_format(self, *values: str) -> None:
        """Reject all values of the parameter ``format`` except ``values``, at the start and later."""
        full = f"{self._parameters}format"

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
        self._restrict_format("jpeg", "png")
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
        self._restrict_format("png")
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


class ImagePublishers:
    """Publishers of a camera's channels: raw, compressed and rectified."""

    def __init__(self, node: SceneNode, topics: CameraTopics, driver: CameraDriver) -> None:
        self._driver = driver
        self._images = [(topic, node.topic_publisher(topic)) for topic in topics.images]
        self._rectified = {
            channel: (topic, node.topic_publisher(topic)) for channel, topic in topics.rectified.items()
        }
        self._compressed: dict[str, CompressedImagePublisher | CompressedDepthPublisher] = {
            "rgb": CompressedImagePublisher(node, topics, driver),
            "depth": CompressedDepthPublisher(node, topics),
        }

    def subscribed(self) -> set[str]:
        """Channels with subscribers."""
        subscribed = {name for name, publisher in self._compressed.items() if publisher.subscribed}
        return subscribed.union(*(t.channels for t, publisher in self._images if _has_subscribers(publisher)))

    def rectified_subscribed(self) -> set[str]:
        """Channels with rectified images that have subscribers."""
        return {name for name, (_, publisher) in self._rectified.items() if _has_subscribers(publisher)}

    def publish_rectified(self, channel: str, image: NDArray[Any], stamp: int) -> None:
        """Publish the rectified image of a channel."""
        topic, publisher = self._rectified[channel]
        self._driver.send(topic, publisher, image, stamp)

    def publish(self, view: View, channels: Collection[str], stamp: int) -> None:
        """Publish some channels of a view, the colour image first."""
        for channel in (name for name in CHANNEL_TABLE if name in channels):
            for topic, publisher in self._images:
                if channel in topic.channels and _has_subscribers(publisher):
                    self._driver.send(topic, publisher, view, stamp)
            compressed = self._compressed.get(channel)
            if compressed is not None and compressed.subscribed:
                compressed.publish(view, stamp)


def _has_subscribers(publisher: Any) -> bool:
    return bool(publisher.get_subscription_count())


class InfoPublishers:
    """Publishers of a camera's calibration: ``<camera>/camera_info``, and one in the namespace of each
    image."""

    def __init__(self, node: SceneNode, topics: CameraTopics, driver: CameraDriver) -> None:
        self._driver = driver
        infos: list[tuple[Topic[Any], Callable[[PublishedCalibration], Any]]] = [
            (topics.info, lambda each: each.published),
            *((topic, lambda each: each.beside_truth) for topic in topics.truth_infos),
        ]
        if (depth := topics.depth_sensor) is not None:
            infos.append((depth.info, lambda _: depth.optics))
            if depth.aligned_info is not None:
                infos.append((depth.aligned_info, lambda each: each.published))
        self._publishers = [(topic, node.topic_publisher(topic), camera) for topic, camera in infos]

    def publish(self, calibration: PublishedCalibration, stamp: int) -> None:
        """Publish the calibration of the whole sensor on all topics with subscribers."""
        for topic, publisher, camera in self._publishers:
            if _has_subscribers(publisher):
                self._driver.send(topic, publisher, camera(calibration), stamp)


class DepthSensorPublishers:
    """Publishers of the measurements of a camera's depth sensor."""

    def __init__(self, node: SceneNode, topics: DepthSensorTopics, driver: CameraDriver) -> None:
        self._driver = driver
        self._publishers = [(topic, node.topic_publisher(topic)) for topic in topics.measured]

    def subscribed(self) -> list[Topic[DepthContent]]:
        """Topics with subscribers."""
        return [topic for topic, publisher in self._publishers if _has_subscribers(publisher)]

    def publish(self, topics: Collection[Topic[DepthContent]], content: DepthContent, stamp: int) -> None:
        """Publish some topics of one frame."""
        for topic, publisher in self._publishers:
            if topic in topics:
                self._driver.send(topic, publisher, content, stamp)


class FaultsPublisher:
    """Publisher of ``<camera>/faults``; counts the faults for the diagnostics."""

    def __init__(self, node: SceneNode, topics: CameraTopics) -> None:
        self._node = node
        self._publishers = [(topic, node.topic_publisher(topic)) for topic in topics.faults]

    def publish(self, faults: FrameFaults, stamp: int) -> None:
        """Publish the faults of a frame."""
        for kind in faults.kinds:
            self._node.count(f"fault_{kind}")
        for topic, publisher in self._publishers:
            if _has_subscribers(publisher):
                publisher.publish(topic.build(faults, stamp))


class TruthPublishers:
    """Publishers of a camera's ground truth."""

    def __init__(self, node: SceneNode, topics: CameraTopics) -> None:
        _ = node.scene.joint_surfaces  # computed now: later it would delay a frame
        kinds = topics.truth | {f"keypoints/{name}": topic for name, topic in topics.keypoints.items()}
        kinds["overlay"] = topics.overlay
        self._publishers = {kind: (topic, node.topic_publisher(topic)) for kind, topic in kinds.items()}

    def subscribed(self) -> set[str]:
        """Kinds of ground truth with subscribers."""
        return {kind for kind, (_, publisher) in self._publishers.items() if _has_subscribers(publisher)}

    def publish(self, kinds: Collection[str], truth: CameraTruth, stamp: int) -> None:
        """Publish some kinds of the ground truth of one frame."""
        for kind in kinds:
            topic, publisher = self._publishers[kind]
            publisher.publish(topic.build(truth, stamp))

    def needed(self, kinds: Collection[str]) -> set[str]:
        """Image channels that are needed to compute some kinds of ground truth."""
        return {channel for kind in kinds for channel in self._publishers[kind][0].channels}
