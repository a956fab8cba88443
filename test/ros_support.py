"""Support of the ROS tests: a separate ROS domain, a client that collects messages by stamp, and a player
whose frames a test plays. Tests of whole scenes use ``SceneGraph`` of humansim_ros.testing.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from waiting import PATIENCE, children, wait_until

from humansim_ros.ros.graph.transport import claim_domain, domain_environment

# before anything imports rclpy
os.environ.update(domain_environment(claim_domain()))

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed (pip install '.[ros]')")

#: Two people and two small cameras, one with an off-centre principal point and non-square pixels.
SMALL_SCENE = """
rate: 20
room: null
humans:
  first:
    motion: {file: walk, position: [0.0, -1.59], loop: continue}
  second:
    motion: {file: walk_straight, position: [-0.5, 0.8], yaw_deg: -20, anchor: center, offset: 0.5}
cameras:
  left: {size: [160, 120], position: [3.0, 2.6, 2.0], look_at: [0, 0, 0.8], fov_deg: 65}
  right:
    size: [200, 150]
    K: [[150, 0, 90.25], [0, 160, 81.5], [0, 0, 1]]
    R: [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]
    t: [0.3, 1.1, 3.2]
"""


def write_scene(folder: Path, text: str = SMALL_SCENE) -> Path:
    path = folder / "scene.yaml"
    path.write_text(text)
    return path


class Client:
    """Subscribes to topics and stores all messages by topic and stamp. ``executor``: rclpy's default one if
    None.
    """

    def __init__(self, name: str = "client", executor: Any = None) -> None:
        from rclpy.executors import SingleThreadedExecutor

        self.node = rclpy.create_node(name)
        self.executor = executor or SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.received: dict[str, dict[int, Any]] = defaultdict(dict)

    def subscribe(self, kind: Any, topics: Iterable[str], qos: Any = None) -> None:
        """``qos``: by default reliable with a long queue, so that a late test process loses no message."""
        for topic in topics:
            self.node.create_subscription(kind, topic, self._callback(topic), qos or 500)

    def _callback(self, topic: str) -> Callable[[Any], None]:
        def on_message(message: Any) -> None:
            from humansim_ros.data.messages import to_nanoseconds

            stamp = to_nanoseconds(message.header.stamp) if hasattr(message, "header") else 0
            self.received[topic][stamp] = message

        return on_message

    def common_stamps(self) -> list[int]:
        """Stamps at which every topic with messages has one."""
        return sorted(set.intersection(*(set(messages) for messages in self.received.values())))

    def spin_until(self, done: Callable[[], object], limit: float = PATIENCE) -> bool:
        """Spin until ``done`` is true; False after ``limit`` seconds."""
        return wait_until(done, limit, lambda: self.executor.spin_once(timeout_sec=0.05))

    def spin_until_matched(self, *nodes: Any) -> None:
        """Spin until all publishers know all subscriptions to their topics: of the client and of ``nodes``.

        A message that is published earlier may not arrive, and images may not be rendered.
        """
        everyone = (self.node, *nodes)

        def unmatched() -> list[str]:
            wanted = Counter(s.topic_name for node in everyone for s in node.subscriptions)
            publishers = (p for node in everyone for p in node.publishers)
            return [p.topic_name for p in publishers if p.get_subscription_count() < wanted[p.topic_name]]

        assert self.spin_until(lambda: not unmatched()), f"no subscriber of {unmatched()}"

    def close(self) -> None:
        """Destroy the client. Its executor lets go of all nodes; an EventsExecutor would keep them."""
        for node in self.executor.get_nodes():
            self.executor.remove_node(node)
        self.executor.shutdown()
        self.node.destroy_node()


def node_pids(run: int) -> list[int]:
    """Processes of the nodes of a ``humansim run``: children of the process that starts them."""

    starters = [pid for pid, line in children(run).items() if "node_starter" in line]
    return [pid for starter in starters for pid in children(starter)]


def deliver(node: Any, topic: str, message: Any) -> None:
    """Give a message to the subscription of a node, as its executor does, without the network."""
    from rclpy.serialization import serialize_message

    name = node.resolve_topic_name(topic)
    (subscription,) = (s for s in node.subscriptions if s.topic_name == name)
    subscription.callback(serialize_message(message) if subscription.raw else message)


class Lockstep:
    """A motion player that plays the next frame only when it is told, whatever time it is.

    On a loaded machine no frame is dropped: frames are a period apart in stamp and scene time, not in time.
    """

    def __init__(self, player: Any) -> None:
        self._player = player
        player.playing.timer.cancel()
        self._time = player.now()

    def play(self) -> int:
        """Publish the next frame; returns its stamp."""
        clock = self._player.playback_clock
        tick = clock.due(self._time)
        self._time += round(clock.period)
        assert tick is not None and tick.dropped == 0
        self._player.playing.send_tick(tick)
        return int(tick.stamp)
