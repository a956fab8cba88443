"""Changes of the ROS graph: endpoints that have joined, and nodes that have left a topic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

#: Topics of every node: who has only these receives and sends no data.
_OF_EVERY_NODE = ("/rosout", "/parameter_events")


@dataclass(frozen=True)
class Endpoint:
    """A publisher of a topic.

    Attributes:
        node: Full name of its node.
        type: Message type, such as ``std_msgs/msg/Header``.
        reliable: Whether it offers reliable transport.
    """

    node: str
    type: str
    reliable: bool


class GraphWatch:
    """Compares the graph with that of the last look.

    ``node``: a node; its own endpoints are among those that it finds.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._known = self._endpoints()

    def has_grown(self) -> bool:
        """Whether endpoints have joined since the last call."""
        known, self._known = self._known, self._endpoints()
        return bool(self._known - known)

    def _endpoints(self) -> set[bytes]:
        found: set[bytes] = set()
        for topic, _ in self._node.get_topic_names_and_types():
            if topic in _OF_EVERY_NODE:
                continue
            for endpoints in (
                self._node.get_publishers_info_by_topic(topic),
                self._node.get_subscriptions_info_by_topic(topic),
            ):
                found.update(bytes(each.endpoint_gid) for each in endpoints)
        return found

    def publishers(self, topic: str) -> dict[bytes, Endpoint]:
        """Publishers of a topic by their ids, without those of the node itself."""
        from rclpy.qos import QoSReliabilityPolicy

        own = (self._node.get_name(), self._node.get_namespace())
        return {
            bytes(each.endpoint_gid): Endpoint(
                f"{each.node_namespace.rstrip('/')}/{each.node_name}",
                each.topic_type,
                each.qos_profile.reliability == QoSReliabilityPolicy.RELIABLE,
            )
            for each in self._node.get_publishers_info_by_topic(topic)
            if (each.node_name, each.node_namespace) != own
        }
