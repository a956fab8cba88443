"""One publisher of ``/clock``: a motion player in lockstep looks for others before it publishes."""

from __future__ import annotations

import time
from typing import Any

from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from humansim_ros.ros.graph_watch import GraphWatch
from humansim_ros.ros.guarded_node import GuardedNode
from humansim_ros.ros.qos import ALIVE

#: Topic without messages: a player in lockstep that lives, also during a pause, has a live publisher of it.
_LOCKSTEP_ALIVE = "/_lockstep_alive"
#: Seconds in which nodes find each other.
CLOCK_SEARCH = 2.0
#: Most seconds between two calls that count.
_MAX_STEP = 0.1
#: Seconds in which a publisher that sends nothing may be a dead node: the middleware forgets it after 20 s.
_DEAD_FOR = 25.0
_CLOCK = "/clock"


class ClockOwner:
    """Finds another publisher of ``/clock`` that lives.

    A node that was killed stays in the graph for seconds: it counts only if it sends, or if it is a player
    whose liveliness the middleware confirms.

    Args:
        node: Node that wants to publish.
        graph: Finds publishers.
        search: Seconds of the search: those in which nodes find each other.
    """

    def __init__(self, node: GuardedNode, graph: GraphWatch, search: float = CLOCK_SEARCH) -> None:
        self._node, self._graph, self._search = node, graph, search
        self._waited, self._last = 0.0, time.monotonic()
        self._alive = 0
        self._has_time = False
        events = SubscriptionEventCallbacks(liveliness=self._on_liveliness)
        self._others = node.create_subscription(
            Header, _LOCKSTEP_ALIVE, lambda _: None, ALIVE, event_callbacks=events
        )
        self._clock: Any = node.create_subscription(Clock, _CLOCK, self._on_clock, 10)
        self._own: Any = None

    def _on_liveliness(self, change: QoSLivelinessChangedInfo) -> None:
        self._alive = change.alive_count

    def _on_clock(self, _: Clock) -> None:
        self._has_time = True

    def check(self) -> str | None:
        """Text on another publisher; empty if there is none; None if it is not known yet.

        Call it often: the executor must read messages between two calls.
        """
        # not the time in which the executor has read no message
        now = time.monotonic()
        self._waited += min(now - self._last, _MAX_STEP)
        self._last = now
        if self._waited < self._search:
            return None
        publishers = self._graph.publishers(_CLOCK)
        names = ", ".join(sorted({each.node for each in publishers.values()}))
        if self._alive or self._has_time:
            return (
                f"another node publishes /clock: {names or self._node.get_fully_qualified_name()}. "
                "Stop it, or give one of the two another ROS_DOMAIN_ID"
            )
        if publishers and self._waited < _DEAD_FOR:
            self._node.get_logger().info(
                f"{names} publishes /clock, or has been killed: waiting", throttle_duration_sec=5.0
            )
            return None
        if publishers:
            return f"another node publishes /clock: {names}. Stop it first"
        return ""

    def close(self) -> None:
        """Show other players that this one publishes ``/clock`` now."""
        for subscription in (self._others, self._clock):
            self._node.destroy_subscription(subscription)
        self._own = self._node.create_publisher(Header, _LOCKSTEP_ALIVE, ALIVE)
