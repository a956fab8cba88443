"""Adapters: they send ground truth as messages of other people stacks (docs/people_messages.md).

The table :data:`ADAPTERS` has a row for each adapter: its messages, its topics, and how messages are built
from a frame. A simulation makes such frames. Node ``bridge`` puts frames together from the topics of the
other nodes. The messages are the same in both cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from humansim_ros.data.messages.stacks.adapter import AdapterScene, AdapterTopic
from humansim_ros.data.messages.stacks.hri import hri_topics
from humansim_ros.data.messages.stacks.people_messages import (
    detections_2d_topics,
    detections_3d_topics,
    people_topics,
    tracked_persons_topics,
)
from humansim_ros.data.messages.types import MESSAGE_PACKAGES
from humansim_ros.files.yaml import Section
from humansim_ros.scene.core import Scene


class Adapter(NamedTuple):
    """An adapter: sends ground truth as messages of another people stack.

    Attributes:
        type: Name of the type of its messages.
        topic: Name of the topic if the scene sets no other. ``<camera>`` stands for the name of a camera.
        topics: Function that returns the topics of the adapter in a scene. Its arguments are the scene, the
            settings of the adapter, and ``topic``.
    """

    type: str
    topic: str
    topics: Callable[[AdapterScene, Any, str], Iterator[AdapterTopic]]


#: The table of all adapters by name, a key in section ``adapters`` of a scene file.
ADAPTERS = {
    "detections_2d": Adapter(
        "vision_msgs/msg/Detection2DArray", "<camera>/detections_2d", detections_2d_topics
    ),
    "detections_3d": Adapter("vision_msgs/msg/Detection3DArray", "detections_3d", detections_3d_topics),
    "people": Adapter("people_msgs/msg/People", "people", people_topics),
    "tracked_persons": Adapter(
        "spencer_tracking_msgs/msg/TrackedPersons",
        "spencer/perception/tracked_persons",
        tracked_persons_topics,
    ),
    "hri": Adapter("hri_msgs/msg/IdsList", "humans/bodies/tracked", hri_topics),
}


def adapter_topics(
    scene: Scene,
    frame_prefix: str = "",
    adapters: Mapping[str, Section] | None = None,
    installed: bool = False,
) -> list[AdapterTopic]:
    """Create the topics of the adapters of a scene.

    Args:
        scene: The scene.
        frame_prefix: Text before the names of the frames of cameras and scanners.
        adapters: Settings of the adapters by name. If None, those of the scene.
        installed: Whether it is an error if a message package is not installed. Nodes need them installed.

    Raises:
        SceneError: A setting names no camera or frame of the scene. The error names file, line and key.
        RosError: A message package is neither installed nor defined, or has another version.
    """
    topics: list[AdapterTopic] = []
    settings = scene.config.adapter_settings if adapters is None else adapters
    for name, row in ADAPTERS.items():
        if (config := settings.get(name)) is not None:
            MESSAGE_PACKAGES[row.type.partition("/")[0]].check(installed)
            with scene.source.locating_errors():
                own = row.topics(AdapterScene(scene, name, frame_prefix), config, row.topic)
                topics += [replace(topic, row=name) for topic in own]
    for package in dict.fromkeys(topic.type_name.partition("/")[0] for topic in topics):
        if package in MESSAGE_PACKAGES:
            MESSAGE_PACKAGES[package].check(installed)
    return topics
