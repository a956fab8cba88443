"""Publishers of a camera's images and ground truth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from humansim_ros.render import View
from humansim_ros.render.channels import CHANNEL_TABLE
from humansim_ros.ros import messages
from humansim_ros.ros.compressed import CompressedDepthPublisher, CompressedImagePublisher
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA
from humansim_ros.scene.camera import SceneCamera
from humansim_ros.truth import CameraTruth
from humansim_ros.truth.camera_truth import REQUIRED_CHANNELS


class ImagePublishers:
    """Publishers of a camera's channels: raw, compressed and rectified.

    Args:
        node: Node of the camera.
        camera: The camera.
        frame: Optical frame of the camera.
        labels: Instance labels by name.
        channels: Channels that the renderer supports; other channels have no topic.
    """

    def __init__(
        self,
        node: SceneNode,
        camera: SceneCamera,
        frame: str,
        labels: Mapping[str, int],
        channels: Collection[str],
    ) -> None:
        self._camera, self._frame = camera, frame
        name = camera.name
        self._images = {
            channel.name: node.create_publisher(Image, f"{name}/{channel.topic}", DATA)
            for channel in CHANNEL_TABLE.values()
            if channel.name in channels and not channel.per_body
        }
        self._rectified = {
            channel.name: node.create_publisher(Image, f"{name}/{channel.rectified_topic}", DATA)
            for channel in CHANNEL_TABLE.values()
            if channel.rectified_topic and camera.rectified is not None
        }
        self._compressed: dict[str, CompressedImagePublisher | CompressedDepthPublisher] = {
            "rgb": CompressedImagePublisher(node, name, CHANNEL_TABLE["rgb"].topic, frame, camera.encoding),
            "depth": CompressedDepthPublisher(node, name, CHANNEL_TABLE["depth"].topic, frame),
        }
        self._by_label = {
            channel.name: {
                instance: node.create_publisher(Image, f"{name}/{channel.topic.format(body=body)}", DATA)
                for body, instance in labels.items()
            }
            for channel in CHANNEL_TABLE.values()
            if channel.name in channels and channel.per_body
        }

    def subscribed(self) -> set[str]:
        """Channels with subscribers."""
        subscribed = {name for name, publisher in self._images.items() if publisher.get_subscription_count()}
        subscribed |= {name for name, publisher in self._compressed.items() if publisher.subscribed}
        for name, publishers in self._by_label.items():
            if any(publisher.get_subscription_count() for publisher in publishers.values()):
                subscribed.add(name)
        return subscribed

    def rectified_subscribed(self) -> set[str]:
        """Channels whose rectified images have subscribers."""
        return {name for name, publisher in self._rectified.items() if publisher.get_subscription_count()}

    def publish_rectified(self, channel: str, image: NDArray[Any], stamp: int) -> None:
        """Publish the rectified image of a channel."""
        encoding = CHANNEL_TABLE[channel].encoding or self._camera.encoding.replace("bayer_rggb8", "rgb8")
        self._rectified[channel].publish(messages.image_message(image, encoding, stamp, self._frame))

    def publish(self, view: View, channels: Collection[str], stamp: int) -> None:
        """Publish some channels of a view, colour first."""
        for channel in (name for name in CHANNEL_TABLE if name in channels):
            if channel in self._images:
                self._publish_raw_and_compressed(channel, getattr(view, channel), stamp)
                continue
            for instance, image in getattr(view, channel).items():
                publisher = self._by_label[channel][instance]
                if publisher.get_subscription_count():
                    mask = image if image.dtype == np.uint8 else image.astype(np.uint8) * np.uint8(255)
                    self._publish(publisher, channel, mask, stamp)

    def _publish_raw_and_compressed(self, channel: str, image: Any, stamp: int) -> None:
        compressed = self._compressed.get(channel)
        if compressed is None or self._images[channel].get_subscription_count():
            self._publish(self._images[channel], channel, image, stamp)
        if compressed is not None and compressed.subscribed:
            compressed.publish(image, stamp)

    def _publish(self, publisher: Any, channel: str, image: Any, stamp: int) -> None:
        encoding = CHANNEL_TABLE[channel].encoding or self._camera.encoding
        publisher.publish(messages.image_message(image, encoding, stamp, self._frame))


class InfoPublishers:
    """Publishers of a camera's calibration: ``<camera>/camera_info``, and one beside each image.

    image_transport takes the calibration of an image from ``camera_info`` in the namespace of the image.
    Images of single bodies have none: there are two for each body of the scene.
    """

    def __init__(self, node: SceneNode, camera: str) -> None:
        topics = (channel.topic for channel in CHANNEL_TABLE.values() if not channel.per_body)
        namespaces = dict.fromkeys(f"{camera}/{topic}".rpartition("/")[0] for topic in topics)
        self._publishers = [
            node.create_publisher(CameraInfo, f"{namespace}/camera_info", DATA) for namespace in namespaces
        ]

    def publish(self, build: Callable[[], CameraInfo]) -> None:
        """Publish the message of ``build`` on all topics with subscribers."""
        subscribed = [publisher for publisher in self._publishers if publisher.get_subscription_count()]
        message = build() if subscribed else None
        for publisher in subscribed:
            publisher.publish(message)


class TruthPublishers:
    """Publishers of a camera's ground truth: joints of humans; boxes and visible vertices of humans and
    labelled objects.

    ``camera``: name of the camera. ``frame``: its optical frame.
    """

    def __init__(self, node: SceneNode, camera: str, frame: str) -> None:
        self._frame = frame
        self._labels = node.scene.labels
        _ = node.scene.joint_surfaces  # computed now: later it would delay a frame
        self._publishers = {
            topic: node.create_publisher(PointCloud2, f"{camera}/{topic}", DATA)
            for topic in REQUIRED_CHANNELS
        }

    def subscribed(self) -> set[str]:
        """Topics with subscribers."""
        return {topic for topic, publisher in self._publishers.items() if publisher.get_subscription_count()}

    def publish(self, topics: Collection[str], truth: CameraTruth, stamp: int) -> None:
        """Publish the ground truth of one frame on some topics."""
        builders: dict[str, Callable[..., PointCloud2]] = {
            "joints": messages.joint_view_message,
            "boxes": messages.boxes_message,
            "visible_vertices": messages.visible_vertices_message,
        }
        for topic in topics:
            by_label = [(self._labels[name], value) for name, value in getattr(truth, topic).items()]
            self._publishers[topic].publish(builders[topic](by_label, stamp, self._frame))


def needed(topics: Collection[str]) -> set[str]:
    """Channels that topics of :class:`TruthPublishers` are computed from."""
    return {channel for topic in topics for channel in REQUIRED_CHANNELS[topic]}
