"""A tracker that is slower than real time: it sleeps at random, and takes part in lockstep.

    python tools/slow_tracker.py LOG CAMERA... [--report topic|done|none] [--sleep 0.05] [--ros-args ...]

It tracks a frame when the images of all cameras have one stamp: it sleeps, appends a line with stamp, time of
its clock in nanoseconds and number of timer calls to LOG, and reports. ``topic``: it publishes a PoseArray on
``/tracker/poses``, as a tracker that knows nothing of lockstep. ``done``: it publishes a Header on
``/frame_done``. Its timer has the period of ``--period`` seconds on its clock, which is simulated time with
``--ros-args -p use_sim_time:=true``. Used by ``benchmarks/lockstep.py``, ``tools/chaos.py`` and tests.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseArray
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header


class SlowTracker(Node):
    """Tracks each stamp of which all cameras have sent an image.

    Args:
        log: File to which stamps are appended.
        cameras: Names of the cameras.
        report: ``topic``, ``done`` or ``none``.
        sleep: Longest time for a frame, seconds.
        period: Period of the timer, seconds.
    """

    def __init__(self, log: Path, cameras: list[str], report: str, sleep: float, period: float) -> None:
        super().__init__("tracker" if report == "topic" else f"tracker_{report}")
        # unbuffered: lines are there after kill -9
        self.log = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        self.sleep, self.calls = sleep, 0
        self.arrived: dict[int, set[str]] = defaultdict(set)
        self.cameras = set(cameras)
        self.poses = self.create_publisher(PoseArray, "/tracker/poses", 10) if report == "topic" else None
        self.done = self.create_publisher(Header, "/frame_done", 10) if report == "done" else None
        for camera in cameras:
            self.create_subscription(Image, f"/{camera}/image_raw", self.listener(camera), 10)
        self.create_timer(period, self.on_timer)

    def on_timer(self) -> None:
        self.calls += 1

    def listener(self, camera: str) -> Callable[[Any], None]:
        def on_image(image: Image) -> None:
            stamp = image.header.stamp.sec * 1_000_000_000 + image.header.stamp.nanosec
            self.arrived[stamp].add(camera)
            if self.arrived[stamp] == self.cameras:
                del self.arrived[stamp]
                self.track(stamp, image.header)

        return on_image

    def track(self, stamp: int, header: Header) -> None:
        time.sleep(random.uniform(0.0, self.sleep))
        os.write(self.log, f"{stamp} {self.get_clock().now().nanoseconds} {self.calls}\n".encode())
        if self.poses is not None:
            # the same message if the frame is sent again: not the frame_id of the camera that came last
            self.poses.publish(PoseArray(header=Header(stamp=header.stamp, frame_id="map")))
        if self.done is not None:
            self.done.publish(Header(stamp=header.stamp, frame_id=self.get_name()))


def tracked_stamps(log: Path) -> list[int]:
    """Different stamps of a log, in order."""
    lines = log.read_text().splitlines() if log.exists() else []
    return sorted({int(line.split()[0]) for line in lines if line.count(" ") == 2})


def main() -> None:
    rclpy.init()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log", type=Path)
    parser.add_argument("cameras", nargs="+")
    parser.add_argument("--report", choices=["topic", "done", "none"], default="topic")
    parser.add_argument("--sleep", type=float, default=0.05)
    parser.add_argument("--period", type=float, default=0.05)
    options = parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])
    node = SlowTracker(options.log, options.cameras, options.report, options.sleep, options.period)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
