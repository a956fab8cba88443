"""Clocks: find other publishers of ``/clock``, and detect when the clock of a node has been set."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from humansim_ros.ros.graph.graph import publishers_of
from humansim_ros.ros.graph.guarded_node import GuardedNode
from humansim_ros.ros.graph.qos import ALIVE

#: Topic without messages. While its publisher is alive, a player in lockstep is alive, even if paused.
_LOCKSTEP_ALIVE = "/_lockstep_alive"
#: Longest time between two checks that counts towards the search, seconds.
_MAX_STEP = 0.1
#: For this time, seconds, a silent publisher may be of a dead node, which the middleware forgets after 20 s.
_DEAD_FOR = 25.0
_CLOCK = "/clock"


class ClockOwner:
    """Finds another publisher of ``/clock`` that is alive.

    A node that was killed stays in the graph for seconds: it counts only if it sends, or if it is a player
    that the middleware confirms to be alive.

    Args:
        node: Node that wants to publish.
        search: Length of the search, seconds: the time that nodes need to find each other.
    """

    def __init__(self, node: GuardedNode, search: float) -> None:
        self._node, self._search = node, search
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
        """Text about another publisher. Empty if there is no other; None if this is not known yet."""
        # without the time during which the executor has read no message
        now = time.monotonic()
        self._waited += min(now - self._last, _MAX_STEP)
        self._last = now
        if self._waited < self._search:
            return None
        publishers = publishers_of(self._node, _CLOCK)
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
        """Show other players that this player publishes ``/clock`` now."""
        for subscription in (self._others, self._clock):
            self._node.destroy_subscription(subscription)
        self._own = self._node.create_publisher(Header, _LOCKSTEP_ALIVE, ALIVE)


#: Smaller changes of the system clock than this, nanoseconds, do no harm and are ignored.
_SMALLEST = 10_000_000


class ClockSteps:
    """Measures by how much a clock has been set between two readings.

    The system clock is compared with the monotonic clock, which cannot be set. Simulated time may run at any
    rate, so only its start and a jump back count as steps.

    Args:
        now: Nanoseconds of the clock.
        is_simulated: Whether the clock is simulated time at present.
    """

    def __init__(self, now: Callable[[], int], is_simulated: Callable[[], bool]) -> None:
        self._now, self._is_simulated = now, is_simulated
        self._last: int | None = None
        self._was_simulated = False
        # system clock minus monotonic clock, and its uncertainty
        self._offset = self._doubt = 0

    def read(self) -> tuple[int, int]:
        """Read the clock. Returns its time, and by how much it was set since the last call, nanoseconds."""
        before = time.monotonic_ns()
        now, simulated = self._now(), self._is_simulated()
        doubt = time.monotonic_ns() - before  # the process may have waited between the two clocks
        last, offset = self._last, now - before
        step = 0
        if last is None:
            pass
        elif simulated != self._was_simulated or (simulated and (now < last or last == 0)):
            step = now - last
        elif not simulated and abs(offset - self._offset) > _SMALLEST + doubt + self._doubt:
            step = offset - self._offset
        self._last, self._was_simulated, self._offset, self._doubt = now, simulated, offset, doubt
        return now, step
