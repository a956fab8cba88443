"""Publishers of a camera's images and ground truth, raw and compressed, as a camera driver sends them."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import Any, NamedTuple

from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from sensor_msgs.srv import SetCameraInfo

from humansim_ros.data.messages import (
    CameraTopics,
    Content,
    DepthCompression,
    ImageCompression,
    PublishedCalibration,
    Topic,
    read_camera_info,
)
from humansim_ros.errors import HumansimError, RosError, printable
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.core import FOLLOWING, NO_FAULTS, Frame, FrameFaults


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


#: Limits and descriptions of the settings of compressed images, which are parameters of the camera node.
_SETTINGS: dict[str, tuple[tuple[float, float], str]] = {
    "jpeg_quality": ((1, 100), "JPEG quality, 1 to 100"),
    "png_level": ((0, 9), "PNG compression level, 0 to 9; lossless"),
    "depth_max": ((1.0, 100.0), "Metres from which on depth is not encoded"),
    "depth_quantization": ((1.0, 150.0), "Metres at which the resolution is one metre"),
}


class CompressedTopic:
    """A topic of compressed images with its settings as parameters. The names of the parameters are those of
    the plugin of image_transport, such as ``left.image_raw.compressed.jpeg_quality``.

    Args:
        node: Node of the camera.
        topic: Function that makes the topic for some settings.
        default: Default settings.
        formats: Values of parameter ``format``, the default first.
    """

    def __init__(
        self,
        node: SceneNode,
        topic: Callable[[Any], Topic[Any]],
        default: ImageCompression | DepthCompression,
        formats: Sequence[str],
    ) -> None:
        self._node, self._topic, self._default = node, topic, default
        self._prefix = topic(default).name.replace("/", ".") + "."
        node.described_parameter(f"{self._prefix}format", formats[0], " or ".join(formats), None)
        self._restrict_format(*formats)
        for name, value in asdict(default).items():
            if name != "format":
                limits, description = _SETTINGS[name]
                node.described_parameter(self._prefix + name, value, description, limits)

    def current(self) -> Topic[Any]:
        """Make the topic with the present values of the parameters."""
        values = {name: self._node.get_parameter(self._prefix + name).value for name in asdict(self._default)}
        return self._topic(replace(self._default, **values))

    def _restrict_format(self, *values: str) -> None:
        """Reject all values of the parameter ``format`` except ``values``, at the start and later."""
        full = f"{self._prefix}format"

        def check(parameters: Sequence[Any]) -> SetParametersResult:
            invalid = [p.value for p in parameters if p.name == full and p.value not in values]
            reason = f"{full}: no such format: {invalid[0]}; there are {', '.join(values)}" if invalid else ""
            return SetParametersResult(successful=not invalid, reason=reason)

        result = check([self._node.get_parameter(full)])
        if not result.successful:
            raise RosError(f"parameter {result.reason}")
        self._node.add_on_set_parameters_callback(check)


class CameraPublishers:
    """Publishers of all topics that are built from what a camera captures: images, ground truth, calibration,
    faults and measured depth."""

    def __init__(self, node: SceneNode, topics: CameraTopics, driver: CameraDriver) -> None:
        self._driver = driver
        self._topics: list[Topic[Any] | CompressedTopic] = [
            *topics.captured,
            CompressedTopic(node, topics.compressed, ImageCompression(), ("jpeg", "png")),
            CompressedTopic(node, topics.compressed, DepthCompression(), ("png",)),
        ]
        self._publishers = {topic.name: node.topic_publisher(topic) for topic in map(_current, self._topics)}

    def subscribed(self) -> list[Topic[Any]]:
        """Topics with subscribers."""
        counts = (publisher.get_subscription_count() for publisher in self._publishers.values())
        return [_current(topic) for topic, count in zip(self._topics, counts, strict=True) if count]

    def publish(self, topics: Collection[Topic[Any]], frame: Frame) -> None:
        """Publish some topics of a frame, as a recording has them."""
        for topic in topics:
            self._driver.send(topic, self._publishers[topic.name], topic.content(frame), frame.stamp)


def _current(topic: Topic[Any] | CompressedTopic) -> Topic[Any]:
    """The topic with its present settings."""
    return topic.current() if isinstance(topic, CompressedTopic) else topic
