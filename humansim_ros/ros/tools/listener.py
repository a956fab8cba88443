"""A node that listens to topics, for programs that watch the nodes of a scene."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions

from humansim_ros.errors import RosError, some_of
from humansim_ros.ros.graph.guarded_node import GuardedNode
from humansim_ros.ros.processes.runtime import make_executor
from humansim_ros.ros.processes.supervisor import Supervisor

#: Most topics that an error names.
_MAX_NAMES = 4


class Listener:
    """Subscribes to topics with sensor-data QoS, as a client does. A context manager, which ends ROS in this
    process at its end.

    Args:
        name: Name of the node.

    Attributes:
        node: The node.
        subscriptions: Subscriptions by topic.
        silent: Topics that have sent nothing yet.
    """

    def __init__(self, name: str) -> None:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self.node = GuardedNode(name)
        self.subscriptions: dict[str, Any] = {}
        self.silent: list[str] = []
        self._executor = make_executor()
        self._executor.add_node(self.node)

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()

    def listen(self, kind: Any, topic: str, callback: Callable[[bytes], object] = lambda _: None) -> None:
        """Subscribe to a topic.

        Args:
            kind: Message type.
            topic: Name of the topic.
            callback: Called with each serialised message.
        """

        def on_data(data: bytes) -> None:
            callback(data)
            if topic in self.silent:
                self.silent.remove(topic)

        self.silent.append(topic)
        self.subscriptions[topic] = self.node.create_subscription(
            kind, topic, on_data, qos_profile_sensor_data, raw=True
        )

    def spin(self, seconds: float) -> None:
        """Receive messages for some seconds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            # always the same timeout, since with another one rclpy's own executor restarts its round of
            # ready topics, and the last topics starve
            self._executor.spin_once(0.05)

    def wait_for_all(self, nodes: Supervisor, patience: float) -> None:
        """Wait until every topic has sent a message.

        Args:
            nodes: The nodes that publish.
            patience: Longest time in which no further topic sends its first message, seconds.

        Raises:
            RosError: A node has ended, or some topics send nothing.
        """
        count, limit = len(self.silent), time.monotonic() + patience
        while self.silent:
            self.spin(0.1)
            if dead := nodes.dead():
                raise RosError(str(dead))
            if len(self.silent) < count:
                count, limit = len(self.silent), time.monotonic() + patience
            if time.monotonic() > limit:
                raise RosError(
                    f"nothing arrived within {patience:.0f} s on {some_of(self.silent, _MAX_NAMES)}"
                )
