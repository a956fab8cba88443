"""The ROS graph: choose topics, notice new endpoints, warn of other publishers of the same topics."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from rclpy.qos import QoSProfile, QoSReliabilityPolicy

from humansim_ros.data.messages import (
    TF_STATIC_TOPIC,
    TF_TOPIC,
    begins_with_stamp,
    message_type,
    serialised_stamp,
)
from humansim_ros.errors import RosError, did_you_mean, printable, some_of
from humansim_ros.ros.graph.guarded_node import GuardedNode
from humansim_ros.ros.graph.qos import CAMERA_ALIVE

#: Topics that every ROS node has. Patterns do not match these topics, since they carry no data.
_OF_EVERY_NODE = ("/rosout", "/parameter_events")


@dataclass(frozen=True)
class TopicChoice:
    """The topics that a user has chosen.

    Attributes:
        patterns: Absolute names of topics, or patterns with ``*``, ``?`` and ``[…]``; empty: all topics.
    """

    patterns: tuple[str, ...] = ()

    @classmethod
    def of(cls, names: Iterable[str], namespace: str = "/") -> TopicChoice:
        """Make a choice from names or patterns of a user. A name without the first / is in ``namespace``.

        Raises:
            RosError: A name is empty or has spaces.
        """
        patterns = []
        for name in (each.strip() for each in names):
            if not name.strip("/") or any(c.isspace() for c in name):
                raise RosError(f"{name!r} is no topic: give names such as /left/image_raw, or patterns")
            patterns.append(absolute(name, namespace))
        return cls(tuple(dict.fromkeys(patterns)))

    def has(self, topic: str) -> bool:
        """Whether a topic is chosen. Hidden topics (``/_`` in the name), and the topics that every node has
        (``/rosout``, ``/parameter_events``), are chosen only by their full names, not by patterns."""
        if topic in self.patterns:
            return True
        if topic in _OF_EVERY_NODE or "/_" in topic:
            return False
        return not self.patterns or any(fnmatchcase(topic, pattern) for pattern in self.patterns)

    def unmatched(self, topics: Collection[str]) -> list[str]:
        """Names and patterns of this choice that match none of ``topics``."""
        return [
            each for each in self.patterns if not any(TopicChoice((each,)).has(topic) for topic in topics)
        ]


def absolute(name: str, namespace: str) -> str:
    """Absolute name of a topic. A name without the first / is in ``namespace``."""
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"


def similar(name: str, topics: Sequence[str]) -> str:
    """Advice for the end of a message about a topic that does not exist: a similar name, or an empty text."""
    return "" if any(c in name for c in "*?[") else did_you_mean(name, topics)


@dataclass(frozen=True)
class Endpoint:
    """A publisher of a topic.

    Attributes:
        node: Full name of the node that publishes.
        type: Message type, such as ``std_msgs/msg/Header``.
        reliable: Whether the publisher offers reliable transport.
    """

    node: str
    type: str
    reliable: bool


class GraphWatch:
    """Compares the endpoints of the graph with those at the last call."""

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


def publishers_of(node: Any, topic: str) -> dict[bytes, Endpoint]:
    """Publishers of a topic that ``node`` knows, by id, without the publishers of ``node`` itself."""
    own = (node.get_name(), node.get_namespace())
    return {
        bytes(each.endpoint_gid): Endpoint(
            f"{each.node_namespace.rstrip('/')}/{each.node_name}",
            each.topic_type,
            each.qos_profile.reliability == QoSReliabilityPolicy.RELIABLE,
        )
        for each in node.get_publishers_info_by_topic(topic)
        if (each.node_name, each.node_namespace) != own
    }


#: Length of the queue of a subscription, messages.
_DEPTH = 50
#: Longest message that is accepted, bytes. Only the stamp of a message is read.
_MAX_BYTES = 1 << 30


class StampedTopics:
    """Reads stamps from topics. Subscribes as soon as a topic has a publisher, with its type and reliability.

    Args:
        node: Node that subscribes. Its own publishers do not count.
        topics: Names of the topics.
        on_stamp: Called with topic and stamp (nanoseconds) of each message.
    """

    def __init__(
        self, node: GuardedNode, topics: Iterable[str], on_stamp: Callable[[str, int], object]
    ) -> None:
        self._node, self._on_stamp = node, on_stamp
        # by topic: subscription, its type, and whether it is reliable
        self._subscriptions: dict[str, tuple[Any, str, bool] | None] = dict.fromkeys(topics)

    def update(self) -> None:
        """Subscribe to topics with a new publisher, or with a new type or reliability of publishers.

        Raises:
            RosError: The messages of a topic cannot be used.
        """
        for topic, held in self._subscriptions.items():
            publishers = list(publishers_of(self._node, self._node.resolve_topic_name(topic)).values())
            if not publishers:
                continue
            # a reliable subscription gets nothing from a best-effort publisher
            reliable = all(each.reliable for each in publishers)
            kind = held[1] if held and any(each.type == held[1] for each in publishers) else None
            if kind is None or held is None or held[2] != reliable:
                self._subscribe(topic, *_usable(topic, publishers), reliable)

    def is_connected(self, topic: str) -> bool:
        """Whether messages of a topic arrive: a publisher and the subscription have found each other."""
        held = self._subscriptions[topic]
        return held is not None and held[0].get_publisher_count() > 0

    def close(self) -> None:
        """End all subscriptions."""
        for topic, held in self._subscriptions.items():
            if held is not None:
                self._node.destroy_subscription(held[0])
            self._subscriptions[topic] = None

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
    """Name and class of a message type among those of the publishers.

    Raises:
        RosError: No type can be used.
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
    raise RosError(f"{topic}: {'; '.join(reasons)}")


#: Topics that many nodes may publish; and last parts of the names of such topics in any namespace.
_SHARED = ("/rosout", "/parameter_events", "/diagnostics", f"/{TF_TOPIC}", f"/{TF_STATIC_TOPIC}")
_SHARED_NAMES = ("frame_done", CAMERA_ALIVE)
#: The warning about another node comes when it has been in the graph for this time, seconds.
_SEEN_FOR = 1.5
#: The same for a node that may have been killed and started again, since the middleware forgets it after 20
#: s.
_DEAD_FOR = 25.0
#: Most topics that a log line names.
_MAX_NAMED = 3


class Neighbours:
    """Warns about other nodes, if their messages get mixed with those of this node. Each is named once.

    Such a node publishes a topic of this node, or has the same name, or is one of several senders of a topic
    that should have one sender.

    Args:
        node: The node.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._inputs: list[str] = []
        # by name of the other node: monotonic time since it has been seen, seconds
        self._since: dict[str, float] = {}
        self._named: set[str] = set()
        self._was_alone = False

    def expect_one_sender(self, topic: str) -> None:
        """From now on, also check that an input topic of the node has no more than one publisher."""
        self._inputs.append(topic)

    def check(self) -> None:
        """Check the graph. Call it about once a second."""
        now, own = time.monotonic(), self._node.get_fully_qualified_name()
        found = self._others(own)
        self._since = {name: self._since.get(name, now) for name in found}
        for name, topics in found.items():
            # a dead node has the name of the node that replaces it
            may_be_dead = (name == own and not self._was_alone) or topics.pop("", 0) > 0
            seen = now - self._since[name]
            if name not in self._named and seen >= (_DEAD_FOR if may_be_dead else _SEEN_FOR):
                self._named.add(name)
                self._node.get_logger().warn(_text(name, name == own, list(topics)))
        self._was_alone |= own not in found

    def _others(self, own: str) -> dict[str, Counter[str]]:
        """Conflicting topics by name of the other node. The topic "" means that this node may be dead."""
        others: dict[str, Counter[str]] = {}
        names = [_joined(name, space) for name, space in self._node.get_node_names_and_namespaces()]
        if names.count(own) > 1:
            others[own] = Counter()
        published = {publisher.topic_name for publisher in self._node.publishers}
        for topic in published:
            if topic in _SHARED or topic.rpartition("/")[2] in _SHARED_NAMES:
                continue
            senders = self._senders(topic)
            senders[own] -= 1
            for name in +senders:
                others.setdefault(name, Counter())[topic] += 1
        for topic in self._inputs:
            senders = self._senders(topic)
            if senders.total() < 2:
                continue
            for name, number in senders.items():
                others.setdefault(name, Counter())[topic] += 1
                if number > 1 and len(senders) == 1:
                    others[name][""] += 1
        return others

    def _senders(self, topic: str) -> Counter[str]:
        """Number of publishers by node name. Empty if there is only one."""
        if self._node.handle.get_count_publishers(topic) < 2:
            return Counter()
        found = self._node.get_publishers_info_by_topic(topic)
        return Counter(_joined(each.node_name, each.node_namespace) for each in found)


def _joined(name: str, namespace: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def _text(name: str, is_namesake: bool, topics: list[str]) -> str:
    named = some_of(sorted(topics), _MAX_NAMED, rest=" and {} more topics")
    subject = f"another node is called {name}" if is_namesake else f"another node, {name},"
    action = f"{' and' if is_namesake else ''} publishes {named}" if topics else ""
    return (
        f"{subject}{action}: its messages mix with this suite's. Stop it, or give one of the two "
        "another ROS_DOMAIN_ID or namespace"
    )
