"""The image topics of a camera: which channel goes where, in which encoding, and who wants it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from sensor_msgs.msg import Image

from humansim_ros.render import View
from humansim_ros.ros import messages
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA

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
}
#: Channels that have a topic for each human.
BY_HUMAN = ("alpha", "amodal")


class Outlets:
    """Publishers of a camera's images. ``humans``: instance labels by name."""

    def __init__(self, node: SceneNode, camera: str, encoding: str, humans: Mapping[str, int]) -> None:
        self._frame = messages.optical_frame(camera)
        self._encodings = {**messages.ENCODINGS, "rgb": encoding}
        self._images = {
            channel: node.create_publisher(Image, f"{camera}/{topic}", DATA)
            for channel, topic in TOPICS.items()
        }
        self._by_human = {
            channel: {
                instance: node.create_publisher(Image, f"{camera}/{channel}/{human}/image", DATA)
                for human, instance in humans.items()
            }
            for channel in BY_HUMAN
        }

    def wanted(self) -> set[str]:
        """The channels that somebody subscribes to."""
        wanted = {name for name, publisher in self._images.items() if publisher.get_subscription_count()}
        for name, publishers in self._by_human.items():
            if any(publisher.get_subscription_count() for publisher in publishers.values()):
                wanted.add(name)
        return wanted

    def send(self, view: View, channels: Collection[str], stamp: int) -> None:
        """Publish some channels of a view."""
        for channel in channels:
            if channel in self._images:
                self._publish(self._images[channel], channel, getattr(view, channel), stamp)
                continue
            for instance, image in getattr(view, channel).items():
                publisher = self._by_human[channel][instance]
                if publisher.get_subscription_count():
                    mask = image if image.dtype == np.uint8 else image.astype(np.uint8) * np.uint8(255)
                    self._publish(publisher, channel, mask, stamp)

    def _publish(self, publisher: Any, channel: str, image: Any, stamp: int) -> None:
        publisher.publish(messages.image_message(image, self._encodings[channel], stamp, self._frame))
