"""Measure a tracker against the truth: it triangulates joints from all cameras of a running scene.

    humansim run &
    python examples/tracker.py [HUMAN] [FRAMES] [--ros-args ...]

It finds the cameras by their topics, and subscribes to ``<camera>/projection``. In place of a detector it
takes the 2D joints of ``<camera>/joints``: put your own detections of ``<camera>/image_raw`` there. The error
to ``/humans/<HUMAN>/joints`` of the same stamp is the error of the tracker.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_msgs.msg import Float64MultiArray, String

from humansim_ros.data import messages

VISIBLE = 2
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Tracker(Node):
    """Direct linear transformation of the visible 2D joints of each stamp."""

    def __init__(self, human: str, frames: int) -> None:
        super().__init__("tracker")
        self.human, self.frames = human, frames
        self.cameras: set[str] = set()
        self.sending: set[str] = set()
        self.projections: dict[str, np.ndarray] = {}
        self.label: int | None = None
        self.pixels: dict[int, dict[str, np.ndarray]] = defaultdict(dict)
        self.truth: dict[int, np.ndarray] = {}
        self.errors: list[float] = []
        self.subscribe(MultiDOFJointState, f"humans/{human}/joints", self.on_truth, 10)

        self.create_timer(0.5, self.find_cameras)

    def subscribe(self, kind: type, topic: str, callback: Callable[[Any], None], qos: Any) -> None:
        """Subscribe to a topic. Messages that cannot be used are ignored: anybody may publish on it."""

        def on_message(message: Any) -> None:
            try:
                callback(message)
            except Exception as error:
                self.get_logger().warning(f"{topic}: {error!r:.200}", throttle_duration_sec=1.0)

        self.create_subscription(kind, topic, on_message, qos)

    def find_cameras(self) -> None:
        """Subscribe to cameras that have come."""
        topics = [name for name, _ in self.get_topic_names_and_types()]
        found = {name.split("/")[1] for name in topics if name.endswith("/projection")}
        for camera in sorted(found - self.cameras):
            self.subscribe(
                Float64MultiArray, f"{camera}/projection", partial(self.on_projection, camera), LATCHED
            )
            self.subscribe(
                PointCloud2, f"{camera}/joints", partial(self.on_pixels, camera), qos_profile_sensor_data
            )
            self.subscribe(String, f"{camera}/joints/legend", self.on_legend, LATCHED)
        self.cameras |= found

    def on_projection(self, camera: str, message: Float64MultiArray) -> None:
        self.projections[camera] = np.reshape(message.data, (3, 4))

    def on_legend(self, message: String) -> None:
        labels = {name: int(label) for label, name in json.loads(message.data)["human"].items()}
        self.label = labels.get(self.human, self.label)

    def on_pixels(self, camera: str, message: PointCloud2) -> None:
        self.sending.add(camera)
        points = messages.read_joint_view(message)
        points = points[points["human"] == self.label]
        pixels = np.stack([points["u"], points["v"]], axis=1)
        pixels[points["visible"] != VISIBLE] = np.nan
        self.pixels[stamp_of(message)][camera] = pixels
        self.measure(stamp_of(message))

    def on_truth(self, message: MultiDOFJointState) -> None:
        positions = [(t.translation.x, t.translation.y, t.translation.z) for t in message.transforms]
        self.truth[stamp_of(message)] = np.array(positions)
        self.measure(stamp_of(message))

    def measure(self, stamp: int) -> None:
        """Triangulate the joints of a stamp as soon as everything of it is there."""
        cameras = self.sending & self.projections.keys()  # others may be listed that send nothing
        if stamp not in self.truth or len(cameras) < 2 or not cameras <= self.pixels[stamp].keys():
            return
        pixels, truth = self.pixels.pop(stamp), self.truth.pop(stamp)
        for joint, expected in enumerate(truth):
            rows = [
                row
                for camera in cameras
                if np.isfinite(uv := pixels[camera][joint]).all()
                for row in uv[:, None] * self.projections[camera][2] - self.projections[camera][:2]
            ]
            if len(rows) >= 4:
                x = np.linalg.svd(np.array(rows))[2][-1]
                self.errors.append(float(np.linalg.norm(x[:3] / x[3] - expected)))
        self.frames -= 1


def stamp_of(message: PointCloud2 | MultiDOFJointState) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def main() -> None:
    rclpy.init()
    arguments = rclpy.utilities.remove_ros_args(sys.argv)[1:]
    node = Tracker((arguments or ["walker"])[0], int((arguments[1:] or ["30"])[0]))
    try:
        while node.frames > 0:
            rclpy.spin_once(node, timeout_sec=1.0)
        errors = 1000 * np.array(node.errors)
        print(f"{len(errors)} joints: error {errors.mean():.2f} mm mean, {errors.max():.2f} mm at most")
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
