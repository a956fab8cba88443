"""Support of the ROS tests: a separate ROS domain, and a client that collects messages by stamp."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

# a domain per test process, before anything imports rclpy
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed (pip install '.[ros]')")

#: Two people and two small cameras, one with an off-centre principal point and non-square pixels.
SMALL_SCENE = """
rate: 20
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
        from rclpy.qos import qos_profile_sensor_data

        for topic in topics:
            self.node.create_subscription(kind, topic, self._callback(topic), qos or qos_profile_sensor_data)

    def _callback(self, topic: str) -> Callable[[Any], None]:
        def on_message(message: Any) -> None:
            from humansim_ros.ros.messages import to_nanoseconds

            stamp = to_nanoseconds(message.header.stamp) if hasattr(message, "header") else 0
            self.received[topic][stamp] = message

        return on_message

    def common_stamps(self) -> list[int]:
        """Stamps at which every topic with messages has one."""
        return sorted(set.intersection(*(set(messages) for messages in self.received.values())))

    def spin_until(self, done: Callable[[], bool], limit: float = 30.0) -> bool:
        """Spin until ``done`` is true; False after ``limit`` seconds."""
        end = time.monotonic() + limit
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
            if done():
                return True
        return False

    def close(self) -> None:
        self.node.destroy_node()


@contextmanager
def whole_flow(
    scene: Path, namespace: str, topics: Mapping[Any, Sequence[str]], frames: int
) -> Iterator[Client]:
    """Run a player, a skinner and a camera of a scene, and yield a client with ``frames`` complete frames.

    ``topics``: topics of a complete frame, by message type.
    """
    from rclpy.parameter import Parameter
    from rclpy.qos import QoSProfile

    from humansim_ros.ros.nodes.camera import CameraNode
    from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
    from humansim_ros.ros.nodes.skinner import SkinnerNode

    given = [Parameter("scene", value=str(scene))]
    nodes = [
        kind(parameter_overrides=given, namespace=namespace)
        for kind in (MotionPlayerNode, SkinnerNode, CameraNode)
    ]
    client = Client(f"client_of_{namespace}")
    for node in nodes:
        client.executor.add_node(node)
    for message, names in topics.items():
        client.subscribe(message, names, QoSProfile(depth=500))
    number = sum(len(names) for names in topics.values())

    def enough() -> bool:
        return len(client.received) == number and len(client.common_stamps()) >= frames

    done = client.spin_until(enough, 60)
    assert done, f"received {sorted(client.received)}, {len(client.common_stamps())} common stamps"
    yield client
    for node in nodes:
        node.close()
        node.destroy_node()
    client.close()
