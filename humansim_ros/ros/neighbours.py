"""Other nodes that publish the topics of a node: a second suite in the domain, or a bag that is played."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

from humansim_ros.errors import some_of
from humansim_ros.ros.qos import CAMERA_ALIVE

#: Topics that many nodes publish, and names of topics that all camera processes publish.
_SHARED = ("/rosout", "/parameter_events", "/diagnostics", "/tf", "/tf_static")
_SHARED_NAMES = ("frame_done", CAMERA_ALIVE)
#: Seconds for which another node is seen before it is named.
_SEEN_FOR = 1.5
#: The same, if it may be a node that was killed and started again: the middleware forgets it after 20 s.
_DEAD_FOR = 25.0
#: Topics that a line names.
_MAX_NAMED = 3


class Neighbours:
    """Warns once of each other node whose messages mix with those of a node.

    It publishes a topic of the node, or has its name, or it is one of several senders of a topic that should
    have one.

    Args:
        node: The node.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._inputs: list[str] = []
        # by name of the other node: monotonic seconds since which it has been there
        self._since: dict[str, float] = {}
        self._named: set[str] = set()
        self._was_alone = False

    def expect_one_sender(self, topic: str) -> None:
        """Check an input of the node, too: it should have one publisher."""
        self._inputs.append(topic)

    def check(self) -> None:
        """Look at the graph; call it about once a second."""
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
        """Topics of other nodes by node name; the topic "" if it may be a dead node."""
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
        """Number of publishers by node name; empty if there is only one."""
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
        f"{subject}{action}: its messages mix with those of this suite. Stop it, or give one of the two "
        "another ROS_DOMAIN_ID or namespace"
    )
