"""How many images a second arrive, live: all nodes of the demo scene as processes, and one subscriber.

    python benchmarks/live.py [--seconds 10] [--json FILE]

For each set of topics: the lowest rate at which a topic reached the subscriber's callback, the share of the
player's frames that did, how many frames came whole (all topics of all cameras with one stamp), and the time
from a frame's stamp to the callback.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState

from humansim_ros.resources import resource_path
from humansim_ros.ros.messages import serialised_stamp
from humansim_ros.ros.processes import scene_processes
from humansim_ros.ros.qos import DATA
from humansim_ros.ros.runtime import prepare_transport
from humansim_ros.ros.supervisor import Supervisor
from humansim_ros.scene import Scene
from humansim_ros.scene.scene import DEMO_SCENE

#: What one subscriber listens to, per camera.
CASES = {
    "rgb": ("image_raw",),
    "rgb + info": ("image_raw", "camera_info"),
    "rgb + info + depth + part": ("image_raw", "camera_info", "depth/image", "part/image"),
}


def measure(scene: Path, kinds: tuple[str, ...], seconds: float) -> dict[str, Any]:
    cameras = list(Scene.load(scene).cameras)
    node = rclpy.create_node("live_benchmark")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    arrived: dict[str, dict[int, float]] = defaultdict(dict)

    def keeper(topic: str) -> Any:
        def keep(data: bytes) -> None:
            now = time.time_ns()
            stamp = serialised_stamp(data)
            arrived[topic][stamp] = (now - stamp) * 1e-6

        return keep

    for camera in cameras:
        for kind in kinds:
            message = CameraInfo if kind == "camera_info" else Image
            topic = f"/{camera}/{kind}"
            node.create_subscription(message, topic, keeper(topic), qos_profile_sensor_data, raw=True)
    node.create_subscription(MultiDOFJointState, "/humans/walker/motion", keeper("motion"), DATA, raw=True)
    topics = [f"/{camera}/{kind}" for camera in cameras for kind in kinds]
    with Supervisor(scene_processes(scene)) as nodes:
        limit = time.monotonic() + 60
        while any(len(arrived[topic]) < 30 for topic in topics):
            executor.spin_once(timeout_sec=0.05)
            if nodes.dead() or time.monotonic() > limit:
                raise SystemExit(
                    f"no images on {[t for t in topics if not arrived[t]]}; dead node: {nodes.dead()}"
                )
        arrived.clear()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
    node.destroy_node()
    played = sorted(arrived["motion"])
    counts = {topic: len(arrived[topic]) for topic in topics}
    pictures = [f"/{camera}/image_raw" for camera in cameras]
    whole = set.intersection(*(set(arrived[topic]) for topic in topics))
    late = np.array([ms for topic in pictures for ms in arrived[topic].values()])
    return {
        "hz": {topic: round(count / seconds, 1) for topic, count in counts.items()},
        "lowest_hz": min(counts.values()) / seconds,
        "received": min(counts.values()) / max(1, len(played)),
        "whole_frames": len(whole) / max(1, len(played)),
        "latency_ms_median": float(np.median(late)),
        "latency_ms_p99": float(np.percentile(late, 99)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--scene", type=Path, default=resource_path(DEMO_SCENE))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    prepare_transport()
    rclpy.init()
    results = {}
    print(f"{os.cpu_count()} cores, {arguments.scene.name}, {arguments.seconds:g} s each")
    head = ("subscribed, per camera", "Hz", "received", "whole", "median ms", "p99 ms")
    print("{:28} {:>6} {:>9} {:>10} {:>10} {:>8}".format(*head))
    for name, kinds in CASES.items():
        result = results[name] = measure(arguments.scene, kinds, arguments.seconds)
        print(
            f"{name:28} {result['lowest_hz']:6.1f} {result['received']:9.1%} {result['whole_frames']:10.1%} "
            f"{result['latency_ms_median']:10.1f} {result['latency_ms_p99']:8.1f}",
            flush=True,
        )
    rclpy.try_shutdown()
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
