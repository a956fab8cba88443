"""Base classes of the nodes: parameters with descriptions, the scene, latched topics and diagnostics."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from statistics import median
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.parameter import Parameter

from humansim_ros.errors import HumansimError, HumansimWarning, RosError, printable
from humansim_ros.ros.graph.graph import Neighbours
from humansim_ros.ros.graph.guarded_node import GuardedNode
from humansim_ros.ros.graph.qos import DATA, LATCHED, offered_profile
from humansim_ros.ros.processes.lockstep_settings import check_choice
from humansim_ros.ros.processes.node_processes import WARNINGS_SHOWN
from humansim_ros.scene.core import Scene

if TYPE_CHECKING:
    from humansim_ros.data.messages import Topic

#: A warning is logged if more than this share of frames is dropped in each of so many seconds in a row. The
#: delay is for the start, when cameras are slow.
_MAX_LOST, _LATE_AFTER = 0.05, 5
#: Seconds between two checks whether simulated time has started. Even a busy machine starts all nodes in less
#: time.
_CLOCK_CHECK_EVERY = 10.0


class SuiteNode(GuardedNode):
    """Base class of the nodes of the package: parameters with descriptions, latched topics, diagnostics, and
    timers that keep running when the system clock is set back."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        #: Clock for timers. It cannot be set, so that timers go on when the system clock is set back.
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._lateness: dict[str, list[float]] = {}
        self._late_seconds = 0
        #: Why frames are dropped, for the log.
        self.drop_reason = ""
        self._latched_publishers: list[Any] = []
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", DATA)
        self.create_timer(1.0, self._publish_diagnostics)
        self.create_timer(_CLOCK_CHECK_EVERY, self._check_clock, clock=self._steady_clock)
        self.neighbours = Neighbours(self)
        self.create_timer(1.0, self.neighbours.check, clock=self._steady_clock)

    @property
    def nodes(self) -> Sequence[SuiteNode]:
        """Nodes to spin: this node, and nodes that it has created."""
        return [self]

    def text_parameter(self, name: str, default: str, description: str) -> str:
        """Declare a read-only string parameter and return its value."""
        return str(self.described_parameter(name, default, description, read_only=True))

    def number_parameter(self, name: str, default: float, low: float, high: float, description: str) -> float:
        """Declare a read-only number from ``low`` to ``high`` and return its value.

        Args:
            name: Name of the parameter.
            default: Value unless it is overridden.
            low: Smallest value.
            high: Largest value.
            description: Text of the parameter descriptor.
        """
        return float(self.described_parameter(name, default, description, (low, high), read_only=True))

    def choice_parameter(self, name: str, default: str, values: Sequence[str], description: str) -> str:
        """Declare a read-only parameter with a fixed set of values, and return its value.

        Args:
            name: Name of the parameter.
            default: Value unless it is overridden.
            values: Possible values.
            description: Text of the parameter descriptor.

        Raises:
            RosError: The value is not in the set.
        """
        constraints = " or ".join(values)
        value = self.described_parameter(name, default, description, None, constraints, read_only=True)
        check_choice(f"parameter {name}", str(value), values)
        return str(value)

    def described_parameter(
        self,
        name: str,
        default: Any,
        description: str,
        limits: tuple[float, float] | None = None,
        constraints: str = "",
        read_only: bool = False,
    ) -> Any:
        """Declare a parameter and return its value.

        An integer is accepted for a floating-point parameter, at the start and later.

        Args:
            name: Name of the parameter.
            default: Value unless the user sets another one. If this is a parameter type, the default is no
                value (None).
            description: Text of the parameter descriptor.
            limits: Smallest and largest value of a number.
            constraints: Text on allowed values, if ``limits`` cannot express them.
            read_only: Whether the parameter cannot be set after the start.

        Raises:
            RosError: The override has the wrong type or is out of range.
        """
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        descriptor.additional_constraints = constraints
        if limits is not None:
            low, high = limits
            # from rclpy 9 (Kilted) on, a type is an integer
            if isinstance(default, int) and not isinstance(default, Parameter.Type):
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=low, to_value=high, step=0.0)
                ]
        override = self._parameter_overrides.get(name)
        if override is not None and (isinstance(default, float) or default is Parameter.Type.DOUBLE):
            self._parameter_overrides[name] = _as_float(override)
        try:
            return self.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as reason:
            raise RosError(f"parameter {name}: {reason}") from None

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters all at once, as the services do. An integer for a floating-point parameter is
        converted.
        """
        given = []
        for parameter in parameter_list:
            known = self.has_parameter(parameter.name)
            wanted = (
                Parameter.Type(self.describe_parameter(parameter.name).type) if known else parameter.type_
            )
            given.append(_as_float(parameter) if wanted == Parameter.Type.DOUBLE else parameter)
            # different versions of rclpy say this in words or numbers
            if wanted != given[-1].type_ and Parameter.Type.NOT_SET not in (wanted, parameter.type_):
                reason = f"{parameter.name}: the type is {parameter.type_.name}, expecting type {wanted.name}"
                return SetParametersResult(successful=False, reason=reason)
        return super().set_parameters_atomically(given)

    def topic_publisher(self, topic: Topic[Any]) -> Any:
        """Create a publisher of a topic of the scene."""
        name = f"/{topic.name}" if topic.absolute else topic.name
        return self.create_publisher(topic.type, name, offered_profile(topic))

    def publish_latched(self, message: Any, topic: str) -> None:
        """Publish a message that also nodes get which join later."""
        publisher = self.create_publisher(type(message), topic, LATCHED)
        publisher.publish(message)
        self._latched_publishers.append(publisher)

    def create_timer(
        self, timer_period_sec: float, callback: Any, *arguments: Any, clock: Any = None, **options: Any
    ) -> Any:
        """Create a timer on the steady clock, or on simulated time if the node uses it.

        Args:
            timer_period_sec: Seconds between calls.
            callback: Function without parameters.
            *arguments: Further arguments of rclpy.
            clock: Clock to use instead. **options: Further arguments of rclpy.
        """
        if clock is None and not self.has_simulated_time():
            clock = self._steady_clock
        return super().create_timer(timer_period_sec, callback, *arguments, clock=clock, **options)

    def now(self) -> int:
        """Nanoseconds of the node's clock."""
        return int(self.get_clock().now().nanoseconds)

    def has_simulated_time(self) -> bool:
        """Whether the node's clock follows ``/clock`` (parameter ``use_sim_time``)."""
        return bool(self.get_clock().ros_time_is_active)

    def report_skipped(self, reason: str) -> None:
        """Log that a frame was skipped, and count it as a drop."""
        self.count("drops")
        self.get_logger().error(f"frame skipped: {printable(reason)}", throttle_duration_sec=1.0)

    @contextmanager
    def skip_frame_on_error(self) -> Iterator[None]:
        """Context manager. It reports an error in the block as a skipped frame, and the node goes on."""
        with self.guard("frame", "it is skipped") as fault:
            try:
                yield
            except HumansimError as error:
                self.report_skipped(str(error))
        if fault.reason:
            self.count("drops")

    def report_other_clock(self, topics: Iterable[str], seconds: float, others: str) -> None:
        """Log that the stamps of some topics come from another clock. ``seconds``: by how much these stamps
        are ahead of the stamps of ``others``."""
        names = ", ".join(map(self.resolve_topic_name, topics))
        side = "ahead of" if seconds > 0 else "behind"
        self.get_logger().warn(
            f"{names}: stamps are {abs(seconds):.1f} s {side} the {others}: are the clocks of the hosts "
            "synchronised (chrony, NTP), and has every node the same use_sim_time?",
            throttle_duration_sec=5.0,
        )

    def report_lateness(self, stamp: int, event: str = "lateness") -> None:
        """Record for the diagnostics how much time has passed since the stamp of a frame.

        ``event``: ``lateness`` when the frame is sent, or another name.
        """
        self.report_time((self.now() - stamp) * 1e-6, event)

    def report_time(self, milliseconds: float, event: str) -> None:
        """Record a time for the diagnostics, which show its maximum and median per second."""
        self._lateness.setdefault(event, []).append(milliseconds)

    def close(self) -> None:
        """Free resources that are not ROS entities of the node."""

    def _check_clock(self) -> None:
        """Log if simulated time does not start, since timers stand still until then."""
        if self.now() or not self.has_simulated_time():
            return
        publishers = self.count_publishers("/clock")
        self.get_logger().warn(
            "use_sim_time is true, but "
            + ("no time has arrived on /clock" if publishers else "nothing publishes /clock")
            + ": start the simulator, or ros2 bag play --clock; or leave use_sim_time false"
        )

    def _publish_diagnostics(self) -> None:
        drops, errors = self._counts.get("drops", 0), self._counts.get("errors", 0)
        status = DiagnosticStatus(name=self.get_fully_qualified_name(), hardware_id="humansim_ros")
        status.level = DiagnosticStatus.WARN if drops or errors else DiagnosticStatus.OK
        frames = self._counts.get("frames", 0)
        status.message = (
            f"{frames} frames/s"
            + (f", {drops} dropped" if drops else "")
            + (f", {errors} errors" if errors else "")
        )
        values: dict[str, object] = {**self._counts}
        for event, times in self._lateness.items():
            values[f"{event}_ms"] = f"{max(times):.1f}"
            values[f"{event}_median_ms"] = f"{median(times):.1f}"
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)
        self._late_seconds = self._late_seconds + 1 if drops > _MAX_LOST * (drops + frames) else 0
        if self._late_seconds >= _LATE_AFTER:
            reason = f": {printable(self.drop_reason)}" if self.drop_reason else ""
            self.get_logger().warn(
                f"{drops} of {drops + frames} frames dropped in the last second{reason}",
                throttle_duration_sec=10.0,
            )
        self._counts = dict.fromkeys(self._counts, 0)
        self._lateness = {}


def loaded_scene(path: str) -> Scene:
    """Load a scene for a node; the demo scene if ``path`` is empty. Warnings about the scene are not shown
    again if the parent process has shown them.
    """
    with warnings.catch_warnings():
        if WARNINGS_SHOWN in os.environ:
            warnings.simplefilter("ignore", HumansimWarning)
        return Scene.load(path or None)


class SceneNode(SuiteNode):
    """Node with a scene: the given scene, or the scene that parameter ``scene`` names."""

    def __init__(self, name: str, scene: Scene | None = None, **options: Any) -> None:
        super().__init__(name, **options)
        path = self.text_parameter("scene", "", "Scene file (YAML); empty: the demo scene")
        self.scene = loaded_scene(path) if scene is None else scene

    def make_renderer(self) -> Any:
        """Create the renderer of the scene on the GPU of parameter ``device``."""
        description = "EGL device index of the GPU to render on; -1: the first that works"
        device = int(self.described_parameter("device", -1, description, read_only=True))
        return self.scene.make_renderer(None if device < 0 else device)


def _as_float(parameter: Parameter) -> Parameter:
    """Copy of a parameter, with an integer converted to a floating-point number."""
    if parameter.type_ != Parameter.Type.INTEGER:
        return parameter
    return Parameter(parameter.name, Parameter.Type.DOUBLE, float(parameter.value))
