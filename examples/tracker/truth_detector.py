"""Detector that takes the 2D joints of the truth, ``<camera>/joints``, and adds the faults of a detector."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
from detectors import Array, Faults, noisy_people
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from humansim_ros import HumansimError
from humansim_ros.data import messages
from humansim_ros.scene import VISIBLE

LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


class TruthDetector:
    """Takes the visible joints of ``<camera>/joints``, adds faults, and forgets who is who."""

    message = PointCloud2
    topic = "{camera}/joints"

    def __init__(self, faults: Faults) -> None:
        self._faults = faults
        self._names: tuple[str, ...] = ()
        #: By label of a human, the index of each of its joints.
        self._indices: dict[int, list[int]] = {}

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self._names

    def attach(self, node: Node, camera: str) -> None:
        node.create_subscription(String, f"{camera}/joints/legend", partial(self._on_legend, node), LATCHED)

    def _on_legend(self, node: Node, message: String) -> None:
        try:
            legend = json.loads(message.data)
            joints = {human: [str(name) for name in names] for human, names in legend["joint"].items()}
            labels = {int(label): human for label, human in legend["human"].items()}
            names = tuple(dict.fromkeys([*self._names, *(name for each in joints.values() for name in each)]))
            indices = {
                label: [names.index(name) for name in joints[human]] for label, human in labels.items()
            }
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as reason:
            node.get_logger().warning(f"joints/legend: {reason!r:.200}", throttle_duration_sec=1.0)
            return
        self._names, self._indices = names, indices

    def detect(self, camera: str, message: PointCloud2, size: tuple[int, int]) -> Array:
        try:
            points = messages.read_joint_view(message)
        except HumansimError as error:
            raise ValueError(str(error)) from None
        people = []
        for label in np.unique(points["human"]):
            own = points[(points["human"] == label) & (points["visible"] == VISIBLE)]
            indices = self._indices.get(int(label), ())
            if own["joint"].max(initial=0) >= len(indices):
                raise ValueError(f"the legend has no human {label} with so many joints")
            pixels = np.full((len(self._names), 2), np.nan)
            pixels[np.array(indices, dtype=int)[own["joint"]]] = np.column_stack([own["u"], own["v"]])
            people.append(pixels)
        return noisy_people(people, size, self._faults, camera, messages.to_nanoseconds(message.header.stamp))
