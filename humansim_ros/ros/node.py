"""What our nodes have in common: described parameters, the scene, latched topics and diagnostics."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from statistics import median
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from humansim_ros.errors import HumansimWarning, RosError
from humansim_ros.ros.processes import TOLD
from humansim_ros.ros.qos import DATA, LATCHED
from humansim_ros.scene import Scene


class SceneNode(Node):
    """A node of a scene. Parameter ``scene``: the scene file, empty for the demo scene; unless the node is
    given a scene that others of its process have loaded.
    """

    def __init__(self, name: str, scene: Scene | None = None, **options: Any) -> None:
        super().__init__(name, **options)
        if scene is None:
            path = self.text_parameter("scene", "", "Scene file (YAML); empty for the demo scene")
            with warnings.catch_warnings():
                if TOLD in os.environ:
                    warnings.simplefilter("ignore", HumansimWarning)
                scene = Scene.load(path or None)
        self.scene = scene
        self._counts: dict[str, int] = {}
        self._late: dict[str, list[float]] = {}
        self._latched: list[Any] = []
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", DATA)
        self.create_timer(1.0, self._publish_diagnostics)

    @property
    def members(self) -> Sequence[SceneNode]:
        """The nodes to spin: itself, and those it has made."""
        return [self]

    def text_parameter(self, name: str, default: str, description: str) -> str:
        """Declare a string that is read once, at the start."""
        return str(self.described_parameter(name, default, description, read_only=True))

    def number_parameter(self, name: str, default: float, low: float, high: float, description: str) -> float:
        """Declare a number within a range that is read once, at the start."""
        return float(self.described_parameter(name, default, description, (low, high), read_only=True))

    def described_parameter(
        self,
        name: str,
        default: Any,
        description: str,
        limits: tuple[float, float] | None = None,
        constraints: str = "",
        read_only: bool = False,
    ) -> Any:
        """Declare a parameter and return its value. A type as ``default`` leaves it unset (None) unless it is
        given. Raises RosError where what is given is of the wrong type or out of its range.
        """
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        descriptor.additional_constraints = constraints
        if limits is not None:
            low, high = limits
            if isinstance(default, int):
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=low, to_value=high, step=0.0)
                ]
        try:
            return self.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as reason:
            raise RosError(f"parameter {name}: {reason}") from None

    def make_renderer(self) -> Any:
        """A renderer of the scene's kind. Parameter ``device``: which GPU it draws on."""
        what = "GPU to render on, as EGL counts them; -1: the first that works"
        device = int(self.described_parameter("device", -1, what, read_only=True))
        return self.scene.make_renderer(None if device < 0 else device)

    def publish_latched(self, message: Any, topic: str) -> None:
        """Send a message that late joiners get too."""
        publisher = self.create_publisher(type(message), topic, LATCHED)
        publisher.publish(message)
        self._latched.append(publisher)

    def now(self) -> int:
        """Nanoseconds of the node's clock."""
        return int(self.get_clock().now().nanoseconds)

    def count(self, what: str, number: int = 1) -> None:
        """Count something that diagnostics report, such as frames and drops."""
        self._counts[what] = self._counts.get(what, 0) + number

    def skipped(self, reason: str) -> None:
        """Say that a frame was skipped, and why."""
        self.count("drops")
        self.get_logger().error(f"frame skipped: {reason}", throttle_duration_sec=1.0)

    def report_lateness(self, stamp: int, what: str = "lateness") -> None:
        """Note how long after its stamp a frame has left this node, or come to ``what`` else."""
        self._late.setdefault(what, []).append((self.now() - stamp) * 1e-6)

    def close(self) -> None:
        """Free what the node holds besides its ROS entities."""

    def _publish_diagnostics(self) -> None:
        drops = self._counts.get("drops", 0)
        status = DiagnosticStatus(name=self.get_fully_qualified_name(), hardware_id="humansim_ros")
        status.level = DiagnosticStatus.WARN if drops else DiagnosticStatus.OK
        frames = self._counts.get("frames", 0)
        status.message = f"{frames} frames/s" + (f", {drops} dropped" if drops else "")
        values: dict[str, object] = {**self._counts}
        for what, times in self._late.items():
            values[f"{what}_ms"] = f"{max(times):.1f}"
            values[f"{what}_median_ms"] = f"{median(times):.1f}"
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)
        if drops:
            self.get_logger().warn(
                f"{drops} frames dropped in the last second", throttle_duration_sec=5.0, skip_first=True
            )
        self._counts = dict.fromkeys(self._counts, 0)
        self._late = {}
