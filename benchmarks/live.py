"""How many images a second arrive, live: all nodes of the demo scene as processes, and one subscriber.

    python benchmarks/live.py [--seconds 10] [--processes 1 2 4] [--json FILE]

For each set of topics: the lowest rate at which a topic reached the subscriber's callback, the share of the
player's frames that did, how many frames came whole (all topics of all cameras with one stamp), the time from
a frame's stamp to the callback of image_raw, what nodes and subscriber took of the CPU per frame, and how
many cores others were using meanwhile: with those, the rest means little.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, MultiDOFJointState

from humansim_ros.resources import resource_path
from humansim_ros.ros.messages import serialised_stamp
from humansim_ros.ros.processes import cores, scene_processes
from humansim_ros.ros.qos import DATA
from humansim_ros.ros.runtime import prepare_transport
from humansim_ros.ros.supervisor import Supervisor
from humansim_ros.scene import Scene
from humansim_ros.scene.scene import DEMO_SCENE

#: What one subscriber listens to, per camera, and how many cameras there are.
CASES = {
    "rgb": (4, ("image_raw",)),
    "rgb + info": (4, ("image_raw", "camera_info")),
    "rgb + info + depth + part": (4, ("image_raw", "camera_info", "depth/image", "part/image")),
    "rgb, 8 cameras": (8, ("image_raw",)),
    "rgb as JPEG": (4, ("image_raw/compressed",)),
}
KINDS = {"camera_info": CameraInfo, "image_raw/compressed": CompressedImage}


@dataclass(frozen=True)
class Times:
    """Seconds of CPU that have been used: by some processes, and by all."""

    ours: float
    all: float

    @classmethod
    def now(cls, pids: list[int]) -> Times:
        tick = os.sysconf("SC_CLK_TCK")
        ours = [Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split() for pid in pids]
        everybody = [int(n) for n in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
        used = sum(everybody) - everybody[3] - everybody[4]  # idle, waiting for a disk
        return cls(sum(int(fields[11]) + int(fields[12]) for fields in ours) / tick, used / tick)


def with_cameras(scene: Path, number: int, folder: Path) -> Path:
    """The demo scene with so many of its cameras, or more of them around the same spot."""
    content = yaml.safe_load(scene.read_text())
    cameras = content["cameras"]
    for i in range(len(cameras), number):
        angle = 2 * np.pi * (i + 0.5) / (number - len(cameras))
        place = [round(float(x), 3) for x in (3.2 * np.cos(angle), 2.9 * np.sin(angle), 2.0)]
        cameras[f"camera_{i + 1}"] = {**next(iter(cameras.values())), "position": place}
    content["cameras"] = dict(list(cameras.items())[:number])
    changed = folder / f"{number}_cameras.yaml"
    changed.write_text(yaml.safe_dump(content, sort_keys=False))
    return changed


def measure(scene: Path, kinds: tuple[str, ...], seconds: float, processes: int | None) -> dict[str, Any]:
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
            topic = f"/{camera}/{kind}"
            message = KINDS.get(kind, Image)
            node.create_subscription(message, topic, keeper(topic), qos_profile_sensor_data, raw=True)
    node.create_subscription(MultiDOFJointState, "/humans/walker/motion", keeper("motion"), DATA, raw=True)
    topics = [f"/{camera}/{kind}" for camera in cameras for kind in kinds]
    with Supervisor(scene_processes(scene, processes)) as nodes:
        limit = time.monotonic() + 60
        while any(len(arrived[topic]) < 30 for topic in topics):
            executor.spin_once(timeout_sec=0.05)
            if nodes.dead() or time.monotonic() > limit:
                raise SystemExit(
                    f"no images on {[t for t in topics if not arrived[t]]}; dead node: {nodes.dead()}"
                )
        arrived.clear()
        pids = [os.getpid(), *nodes.pids]
        begin, before = time.monotonic(), Times.now(pids)
        while time.monotonic() < begin + seconds:
            executor.spin_once(timeout_sec=0.05)
        taken, after = time.monotonic() - begin, Times.now(pids)
    node.destroy_node()
    played = max(1, len(arrived["motion"]))
    counts = {topic: len(arrived[topic]) for topic in topics}
    whole = set.intersection(*(set(arrived[topic]) for topic in topics))
    late = np.array([ms for camera in cameras for ms in arrived[f"/{camera}/{kinds[0]}"].values()])
    ours = after.ours - before.ours
    return {
        "hz": {topic: round(count / taken, 1) for topic, count in counts.items()},
        "lowest_hz": min(counts.values()) / taken,
        "received": min(counts.values()) / played,
        "whole_frames": len(whole) / played,
        "latency_ms_median": float(np.median(late)),
        "latency_ms_p99": float(np.percentile(late, 99)),
        "cpu_ms_per_frame": 1e3 * ours / played,
        "cores_of_others": (after.all - before.all - ours) / taken,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--processes", type=int, nargs="+", help="share the cameras; one per core if absent")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    prepare_transport()
    rclpy.init()
    results = {}
    print(f"{cores()} cores, demo scene at 640x480, 30 Hz, {arguments.seconds:g} s each")
    head = ("subscribed, per camera", "processes", "Hz", "received", "whole", "median", "p99 ms", "CPU ms")
    print("{:27} {:>9} {:>6} {:>9} {:>8} {:>8} {:>8} {:>8} others".format(*head))
    with tempfile.TemporaryDirectory() as folder:
        for processes in arguments.processes or [None]:
            for name in arguments.cases:
                number, kinds = CASES[name]
                scene = with_cameras(resource_path(DEMO_SCENE), number, Path(folder))
                shared = min(number, processes or cores())
                r = measure(scene, kinds, arguments.seconds, processes)
                results[f"{name}, {shared} processes"] = r
                print(
                    f"{name:27} {shared:9} {r['lowest_hz']:6.1f} {r['received']:9.1%} "
                    f"{r['whole_frames']:8.1%} {r['latency_ms_median']:8.1f} {r['latency_ms_p99']:8.1f} "
                    f"{r['cpu_ms_per_frame']:8.1f} {r['cores_of_others']:6.2f}",
                    flush=True,
                )
    rclpy.try_shutdown()
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
