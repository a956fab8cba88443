"""Topics whose messages are reports of lockstep: of any message type that begins with a stamp."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rclpy.qos import QoSProfile, QoSReliabilityPolicy

from humansim_ros.errors import RosError, printable
from humansim_ros.messages import serialised_stamp
from humansim_ros.messages.types import begins_with_stamp, message_type
from humansim_ros.ros.graph import Endpoint, GraphWatch
from humansim_ros.ros.guarded_node import GuardedNode

#: Queue of a subscription, messages.
_DEPTH = 50
#: Bytes of the longest message; only its stamp is read.
_MAX_BYTES = 1 << 30


class TopicMembers:
    """Subscribes to topics as soon as they have a publisher, with the type and reliability that it offers.

    Args:
        node: Node that subscribes.
        topics: Names of the topics.
        graph: Finds their publishers.
        on_stamp: Called with topic and stamp of each message.
    """

    def __init__(
        self,
        node: GuardedNode,
        topics: Iterable[str],
        graph: GraphWatch,
        on_stamp: Callable[[str, int], object],
    ) -> None:
        self._node, self._graph, self._on_stamp = node, graph, on_stamp
        # by topic: subscription, its type and whether it is reliable
        self._subscriptions: dict[str, tuple[Any, str, bool] | None] = dict.fromkeys(topics)

    def update(self) -> None:
        """Subscribe to topics that have a publisher now, or publishers of another type or reliability.

        Raises:
            RosError: The messages of a topic cannot be used.
        """
        for topic, held in self._subscriptions.items():
            publishers = list(self._graph.publishers(self._node.resolve_topic_name(topic)).values())
            if not publishers:
                continue
            # a reliable subscription gets nothing from a best-effort publisher
            reliable = all(each.reliable for each in publishers)
            kind = held[1] if held and any(each.type == held[1] for each in publishers) else None
            if kind is None or held is None or held[2] != reliable:
                self._subscribe(topic, *_usable(topic, publishers), reliable)

    def _subscribe(self, topic: str, name: str, kind: Any, reliable: bool) -> None:
        held = self._subscriptions[topic]
        if held is not None:
            self._node.destroy_subscription(held[0])
        policy = QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT
        subscription = self._node.create_subscription(
            kind,
            topic,
            lambda data: self._on_stamp(topic, serialised_stamp(data)),
            QoSProfile(depth=_DEPTH, reliability=policy),
            raw=True,
            max_bytes=_MAX_BYTES,
        )
        self._subscriptions[topic] = subscription, name, reliable


def _usable(topic: str, publishers: Iterable[Endpoint]) -> tuple[str, Any]:
    """Name and class of a message type of the publishers.

    Raises:
        RosError: None of their types can be used.
    """
    reasons = []
    for name in dict.fromkeys(each.type for each in publishers):
        try:
            kind = message_type(name)
        except RosError as error:
            reasons.append(str(error))
            continue
        if begins_with_stamp(kind):
            return name, kind
        reasons.append(f"{printable(name, 80)} does not begin with a header")
    raise RosError(
        f"wait_for {topic}: {'; '.join(reasons)}. Let its node report on frame_done in its place "
        "(docs/lockstep.md)"
    )
