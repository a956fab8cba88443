"""The topics of what a camera sees: which channel goes where, in which encoding, and who wants it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from sensor_msgs.msg import Image, PointCloud2

from humansim_ros.camera import Camera
from humansim_ros.render import View
from humansim_ros.ros import messages
from humansim_ros.ros.compressed import CompressedDepthPublisher, CompressedImagePublisher
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA
from humansim_ros.scene.state import SceneState
from humansim_ros.truth.boxes import view_boxes
from humansim_ros.truth.joints import joint_surfaces, view_joints
from humansim_ros.truth.vertices import visible_vertices

#: Topic of each channel below the camera's name.
TOPICS = {
    "rgb": "image_raw",
    "depth": "depth/image",
    "instance": "instance/image",
    "part": "part/image",
    "face": "face/image",
    "normal": "normal/image",
    "uv": "uv/image",
    "flow": "flow/image",
    "flow_hidden": "flow/hidden",
    "flow_back": "flow_back/image",
    "flow_back_hidden": "flow_back/hidden",
    "shadow": "shadow/image",
}
#: Channels that have a topic for each human and labelled object.
BY_LABEL = ("alpha", "amodal")


class ImagePublishers:
    """Publishers of a camera's images. ``labels``: instance labels by name; ``drawn``: the channels that its
    renderer can draw, others have no topic.
    """

    def __init__(
        self, node: SceneNode, camera: str, encoding: str, labels: Mapping[str, int], drawn: Collection[str]
    ) -> None:
        self._frame = messages.optical_frame(camera)
        self._encodings = {**messages.ENCODINGS, "rgb": encoding}
        self._images = {
            channel: node.create_publisher(Image, f"{camera}/{topic}", DATA)
            for channel, topic in TOPICS.items()
            if channel in drawn
        }
        self._compressed: dict[str, CompressedImagePublisher | CompressedDepthPublisher] = {
            "rgb": CompressedImagePublisher(node, camera, TOPICS["rgb"], encoding),
            "depth": CompressedDepthPublisher(node, camera, TOPICS["depth"]),
        }
        self._by_label = {
            channel: {
                instance: node.create_publisher(Image, f"{camera}/{channel}/{name}/image", DATA)
                for name, instance in labels.items()
            }
            for channel in BY_LABEL
            if channel in drawn
        }

    def wanted(self) -> set[str]:
        """The channels that somebody subscribes to."""
        wanted = {name for name, publisher in self._images.items() if publisher.get_subscription_count()}
        wanted |= {name for name, outlet in self._compressed.items() if outlet.wanted}
        for name, publishers in self._by_label.items():
            if any(publisher.get_subscription_count() for publisher in publishers.values()):
                wanted.add(name)
        return wanted

    def send(self, view: View, channels: Collection[str], stamp: int) -> None:
        """Publish some channels of a view, colour first."""
        for channel in (name for name in (*TOPICS, *BY_LABEL) if name in channels):
            if channel in self._images:
                self._send_image(channel, getattr(view, channel), stamp)
                continue
            for instance, image in getattr(view, channel).items():
                publisher = self._by_label[channel][instance]
                if publisher.get_subscription_count():
                    mask = image if image.dtype == np.uint8 else image.astype(np.uint8) * np.uint8(255)
                    self._publish(publisher, channel, mask, stamp)

    def _send_image(self, channel: str, image: Any, stamp: int) -> None:
        compressed = self._compressed.get(channel)
        if compressed is None or self._images[channel].get_subscription_count():
            self._publish(self._images[channel], channel, image, stamp)
        if compressed is not None and compressed.wanted:
            compressed.send(image, stamp)

    def _publish(self, publisher: Any, channel: str, image: Any, stamp: int) -> None:
        publisher.publish(messages.image_message(image, self._encodings[channel], stamp, self._frame))


class TruthPublishers:
    """Publishers of what a camera knows of each person: joints, boxes, and which vertices it sees; the last
    two of labelled objects, too.
    """

    def __init__(self, node: SceneNode, camera: str) -> None:
        self._frame = messages.optical_frame(camera)
        self._actors, self._objects = node.scene.actors, list(node.scene.object_labels.values())
        self._surfaces = {name: joint_surfaces(actor.human) for name, actor in self._actors.items()}
        self._topics = {
            topic: node.create_publisher(PointCloud2, f"{camera}/{topic}", DATA) for topic in _NEEDED
        }

    def wanted(self) -> set[str]:
        """The topics that somebody subscribes to."""
        return {topic for topic, publisher in self._topics.items() if publisher.get_subscription_count()}

    def send(self, topics: Collection[str], instant: SceneState, view: View, camera: Camera) -> None:
        """Publish some topics of an instant, as the camera where it stands sees it."""
        make = {"joints": self._joints, "boxes": self._boxes, "visible_vertices": self._vertices}
        for topic in topics:
            self._topics[topic].publish(make[topic](instant, view, camera))

    def _joints(self, instant: SceneState, view: View, camera: Camera) -> PointCloud2:
        seen = []
        for name, actor in self._actors.items():
            positions = instant.joints_of(name).positions
            skin = self._surfaces[name]
            joints = view_joints(camera, positions, view, actor.instance, skin, self._objects)
            seen.append((actor.instance, joints))
        return messages.joint_view_message(seen, instant.stamp, self._frame)

    def _boxes(self, instant: SceneState, view: View, camera: Camera) -> PointCloud2:
        boxes = view_boxes(camera, instant.bodies, view)
        return messages.boxes_message(list(boxes.items()), instant.stamp, self._frame)

    def _vertices(self, instant: SceneState, view: View, camera: Camera) -> PointCloud2:
        seen = visible_vertices(camera, instant.bodies, view)
        return messages.visible_vertices_message(list(seen.items()), instant.stamp, self._frame)


def needed(topics: Collection[str]) -> set[str]:
    """The channels that topics on people follow from."""
    return {channel for topic in topics for channel in _NEEDED[topic]}


#: Channels that the topics on people need.
_NEEDED = {
    "joints": ("depth", "instance", "part"),
    "boxes": ("instance", "amodal"),
    "visible_vertices": ("depth", "instance"),
}
