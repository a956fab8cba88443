"""Publishers of a camera's images and ground truth."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from numpy.typing import NDArray

from humansim_ros.messages.topics import CameraTopics, Topic
from humansim_ros.render import View
from humansim_ros.render.channels import CHANNEL_TABLE
from humansim_ros.ros.camera_calibration import PublishedCalibration
from humansim_ros.ros.camera_driver import CameraDriver
from humansim_ros.ros.compressed import CompressedDepthPublisher, CompressedImagePublisher
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import offered_profile
from humansim_ros.scene.faults import FrameFaults
from humansim_ros.truth import CameraTruth


def _publisher(node: SceneNode, topic: Topic[Any]) -> Any:
    return node.create_publisher(topic.type, topic.name, offered_profile(topic))


class ImagePublishers:
    """Publishers of a camera's channels: raw, compressed and rectified."""

    def __init__(self, node: SceneNode, topics: CameraTopics, driver: CameraDriver) -> None:
        self._driver = driver
        self._images = [(topic, _publisher(node, topic)) for topic in topics.images]
        self._rectified = {
            channel: (topic, _publisher(node, topic)) for channel, topic in topics.rectified.items()
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
        """Channels whose rectified images have subscribers."""
        return {name for name, (_, publisher) in self._rectified.items() if _has_subscribers(publisher)}

    def publish_rectified(self, channel: str, image: NDArray[Any], stamp: int) -> None:
        """Publish the rectified image of a channel."""
        topic, publisher = self._rectified[channel]
        self._driver.send(topic, publisher, image, stamp)

    def publish(self, view: View, channels: Collection[str], stamp: int) -> None:
        """Publish some channels of a view, colour first."""
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
    """Publishers of a camera's calibration: ``<camera>/camera_info``, and one beside each image."""

    def __init__(self, node: SceneNode, topics: CameraTopics, driver: CameraDriver) -> None:
        self._driver = driver
        self._own = topics.info
        self._publishers = [(topic, _publisher(node, topic)) for topic in (topics.info, *topics.truth_infos)]

    def publish(self, calibration: PublishedCalibration, stamp: int) -> None:
        """Publish the calibration of the whole sensor on all topics with subscribers."""
        for topic, publisher in self._publishers:
            if _has_subscribers(publisher):
                camera = calibration.published if topic is self._own else calibration.beside_truth
                self._driver.send(topic, publisher, camera, stamp)


class FaultsPublisher:
    """Publisher of ``<camera>/faults``; counts the faults for the diagnostics."""

    def __init__(self, node: SceneNode, topics: CameraTopics) -> None:
        self._node = node
        self._publishers = [(topic, _publisher(node, topic)) for topic in topics.faults]

    def publish(self, faults: FrameFaults, stamp: int) -> None:
        """Publish what is wrong with a frame."""
        for kind in faults.kinds:
            self._node.count(f"fault_{kind}")
        for topic, publisher in self._publishers:
            if _has_subscribers(publisher):
                publisher.publish(topic.build(faults, stamp))


class TruthPublishers:
    """Publishers of a camera's ground truth: joints and keypoints of humans; boxes and visible vertices of
    humans and labelled objects.
    """

    def __init__(self, node: SceneNode, topics: CameraTopics) -> None:
        _ = node.scene.joint_surfaces  # computed now: later it would delay a frame
        kinds = topics.truth | {f"keypoints/{name}": topic for name, topic in topics.keypoints.items()}
        kinds["overlay"] = topics.overlay
        self._publishers = {kind: (topic, _publisher(node, topic)) for kind, topic in kinds.items()}

    def subscribed(self) -> set[str]:
        """Kinds of ground truth with subscribers."""
        return {kind for kind, (_, publisher) in self._publishers.items() if _has_subscribers(publisher)}

    def publish(self, kinds: Collection[str], truth: CameraTruth, stamp: int) -> None:
        """Publish some kinds of the ground truth of one frame."""
        for kind in kinds:
            topic, publisher = self._publishers[kind]
            publisher.publish(topic.build(truth, stamp))

    def needed(self, kinds: Collection[str]) -> set[str]:
        """Channels that some kinds of the ground truth are computed from."""
        return {channel for kind in kinds for channel in self._publishers[kind][0].channels}
