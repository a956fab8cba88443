"""Find the topics of an estimate in a live ROS graph, subscribe to them, and read their messages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import QoSProfile

from humansim_ros.data.evaluation import ReadOptions, in_world, topic_pattern, topic_person
from humansim_ros.data.messages import (
    MESSAGE_PACKAGES,
    MESSAGE_TYPES,
    TF_STATIC_TOPIC,
    TF_TOPIC,
    WORLD_FRAME,
    PoseFrame,
    Transforms,
    deserialised,
    has_one_point,
    message_type,
    read_people,
)
from humansim_ros.errors import HumansimError, RosError, printable
from humansim_ros.ros.graph.graph import absolute
from humansim_ros.ros.graph.guarded_node import ANY_SIZE, GuardedNode
from humansim_ros.ros.graph.qos import LATCHED, subscription_profile
from humansim_ros.ros.processes.transforms import TFMessage

#: Seconds between two searches for topics and publishers.
_DISCOVERY_EVERY = 0.25
#: Most topics of one estimate, which may have a topic for each person.
_MAX_TOPICS = 100
#: Longest message that is read, bytes, except point clouds: 100 people with 40 joints.
_MAX_BYTES = 256 << 10
#: Seconds between two log lines about the same problem.
_LINE_EVERY = 5.0


class PoseTopics:
    """Subscriptions of a node to all topics with poses that match a name, including topics that appear later.

    Some messages are ignored, with an error in the log: those that are too long or cannot be read, and those
    for which ``on_frame`` raises HumansimError.

    Args:
        node: The node.
        topic: Name of the topic. ``*`` stands for the name of a person. A relative name is in the namespace
            of the node.
        options: Options for reading, such as names for points without names.
        on_frame: Called with the people of each message, its topic, and the person that the topic names (or
            None).

    Raises:
        RosError: ``topic`` is no valid name of a topic.

    Attributes:
        topic: Absolute name of the topic.
        ignored: Number of ignored messages.
    """

    def __init__(
        self,
        node: GuardedNode,
        topic: str,
        options: ReadOptions,
        on_frame: Callable[[PoseFrame, str, str | None], object],
    ) -> None:
        if not topic.strip("/") or any(letter.isspace() for letter in topic):
            raise RosError(f"'{printable(topic, 80)}' is no topic: give a name such as /tracker/poses")
        self.topic = absolute(topic, node.get_namespace())
        self._node, self._options, self._on_frame = node, options, on_frame
        self.ignored = 0
        self._pattern = topic_pattern(self.topic)
        #: Message type, profile and subscription by topic.
        self._subscriptions: dict[str, tuple[str, QoSProfile, Any]] = {}
        #: Transforms of tf, and subscriptions to tf. Both are created when the first message arrives that is
        #: not in ``map``.
        self._transforms: Transforms | None = None
        self._tf: list[Any] = []
        node.create_timer(_DISCOVERY_EVERY, self.discover, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.discover()

    @property
    def found(self) -> Sequence[str]:
        """Names of the topics that have been found."""
        return list(self._subscriptions)

    def discover(self) -> None:
        """Subscribe to topics that have appeared, and react to changes of their publishers."""
        for name, types in self._node.get_topic_names_and_types():
            if match := self._pattern.fullmatch(name):
                self._follow(name, types, topic_person(match))

    def _follow(self, name: str, types: Sequence[str], person: str | None) -> None:
        offers = [
            (each.topic_type, each.qos_profile) for each in self._node.get_publishers_info_by_topic(name)
        ]
        known = [kind for kind, _ in offers if kind in MESSAGE_TYPES]
        for kind in known:
            if package := MESSAGE_PACKAGES.get(kind.partition("/")[0]):
                package.check(installed=True)
        if not known:
            if offers:
                listed = ", ".join(printable(kind, 80) for kind in types[:3])
                self._warn(
                    f"{printable(name, 100)}: {listed} holds no poses; known are {', '.join(MESSAGE_TYPES)}"
                )
            return
        before, profile_before, old = self._subscriptions.get(name, ("", None, None))
        kind = before if before in known else known[0]
        profile = subscription_profile([offer for each, offer in offers if each == kind])
        if (kind, profile) == (before, profile_before):
            return
        if old is None and len(self._subscriptions) >= _MAX_TOPICS:
            self._warn(f"more than {_MAX_TOPICS} topics match {self.topic}: the others are ignored")
            return
        new = self._node.create_subscription(
            message_type(kind),
            name,
            partial(self._on_message, name, kind, person),
            profile,
            raw=True,
            max_bytes=ANY_SIZE,
        )
        if old is not None:
            self._node.destroy_subscription(old)
        self._subscriptions[name] = kind, profile, new

    def _on_message(self, name: str, kind: str, person: str | None, data: bytes) -> None:
        try:
            limit = None if kind.endswith("PointCloud2") else _MAX_BYTES
            message = deserialised(data, message_type(kind), limit)
            frame = read_people(kind, message, self._options.names)
            if frame.frame_id not in ("", WORLD_FRAME):
                frame = in_world(frame, self._known_transforms(), has_one_point(kind))
            self._on_frame(frame, name, person)
        except HumansimError:
            self.ignored += 1
            raise

    def _known_transforms(self) -> Transforms:
        """Transforms of tf. The first call subscribes to tf; from then on, transforms are added as they
        arrive."""
        if self._transforms is None:
            self._transforms = Transforms()
            if TFMessage is None:
                install = MESSAGE_PACKAGES["tf2_msgs"].install
                self._warn(f"/tf is not received: tf2_msgs is not installed here: {install}")
                return self._transforms
            for name, profile in ((TF_STATIC_TOPIC, LATCHED), (TF_TOPIC, subscription_profile([]))):
                add = partial(self._transforms.add, topic=name)
                self._tf.append(
                    self._node.create_subscription(
                        TFMessage, f"/{name}", add, profile, raw=True, max_bytes=ANY_SIZE
                    )
                )
        return self._transforms

    def _warn(self, text: str) -> None:
        self._node.get_logger().warn(text, throttle_duration_sec=_LINE_EVERY)

    def take_waiting(self, deadline: float) -> None:
        """Read the messages that have already arrived. Ends at ``deadline`` (monotonic seconds) at the
        latest."""
        for *_, subscription in self._subscriptions.values():
            self._node.take_waiting(subscription, deadline)

    def close(self) -> None:
        """End all subscriptions."""
        for *_, subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        for subscription in self._tf:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
