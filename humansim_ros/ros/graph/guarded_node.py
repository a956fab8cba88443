"""A node that goes on after errors in its callbacks. The errors are logged and counted."""

from __future__ import annotations

import ctypes
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_parameters
from rclpy.task import Future

from humansim_ros.data.messages import check_serialised, deserialised
from humansim_ros.errors import HumansimError, RosError, printable
from humansim_ros.ros.graph.requests import limited

#: Value of ``max_bytes`` for a subscription that passes on serialised messages of any size, unread.
ANY_SIZE = -1
#: After a refused message of at least this size, bytes, freed memory is given back to the system.
_LARGE = 1 << 22
#: Seconds between two log lines about errors in one callback.
_LINE_EVERY = 1.0
#: Most parameters in a request that sets parameters, since each is checked separately; and most elements of
#: all other lists in requests.
_MAX_PARAMETERS, _MAX_REQUESTED = 300, 1000
#: Most characters of the value of a parameter.
_MAX_TEXT = 100_000


@dataclass
class Fault:
    """What :meth:`GuardedNode.guard` has caught. ``reason``: type and text of the exception, or empty."""

    reason: str = ""


class GuardedNode(Node):
    """Node that survives any exception of its callbacks.

    Every subscription, timer, service and parameter callback is guarded, including those that rclpy makes for
    each node. A failed request is answered with a refusal. Subscriptions receive serialised messages, so that
    messages that are too long are not deserialised, which would take seconds and a multiple of their memory.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._counts: dict[str, int] = {}
        #: By source of errors: monotonic time of the next log line; and number of errors since the last line.
        self._next_line: dict[str, float] = {}
        self._unlogged: dict[str, int] = {}
        #: Exit code with which the process of the node shall end; None while the node goes on.
        self.exit_code: int | None = None
        super().__init__(name, **options)

    def complete(self) -> None:
        """Finish the work of the node before its process ends. This may take a long time.

        Raises:
            HumansimError: The work could not be finished.
        """

    def count(self, counter: str, number: int = 1) -> None:
        """Add to a counter of the diagnostics, such as frames or drops."""
        self._counts[counter] = self._counts.get(counter, 0) + number

    @contextmanager
    def guard(self, source: str, consequence: str) -> Iterator[Fault]:
        """Context manager that logs and counts an exception instead of passing it on.

        Each source has at most one line per second. The traceback is logged at debug level.

        Args:
            source: The failed part, such as ``topic /humans/first/motion``.
            consequence: The effect, such as ``the message is ignored``.
        """
        fault = Fault()
        try:
            yield fault
        except Exception as error:
            text = printable(str(error))
            kind = "" if isinstance(error, HumansimError) else type(error).__name__
            fault.reason = ": ".join(part for part in (kind, text) if part)
            self.count("errors")
            self._log_fault(source, f"{fault.reason}; {consequence}", bool(kind))

    def run_soon(self, callback: Callable[[], object]) -> None:
        """Run a callback in the executor after the present callback."""

        def run() -> None:
            with self.guard(f"task {_name(callback)}", "it is not repeated"):
                callback()

        self.executor.create_task(run)

    def _log_fault(self, source: str, text: str, unexpected: bool) -> None:
        now = time.monotonic()
        if now < self._next_line.get(source, now):
            self._unlogged[source] = self._unlogged.get(source, 0) + 1
            return
        self._next_line[source] = now + _LINE_EVERY
        more = self._unlogged.pop(source, 0)
        self.get_logger().error(f"{source}: {text}" + (f" ({more} more such errors)" if more else ""))
        if unexpected and self.get_logger().is_enabled_for(LoggingSeverity.DEBUG):
            lines = traceback.format_exc().splitlines()
            self.get_logger().debug("\n".join(printable(line) for line in lines))

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[[Any], object],
        qos_profile: Any,
        *,
        raw: bool = False,
        max_bytes: int | None = None,
        **options: Any,
    ) -> Any:
        """Create a subscription like ``Node.create_subscription``. Its callback cannot end the node.

        Args:
            msg_type: Message type.
            topic: Topic name.
            callback: Gets each message.
            qos_profile: Quality of service, or depth of the queue.
            raw: Pass serialised messages.
            max_bytes: Longest serialised message that is read, bytes. If None, the limit of the message type.
                With ANY_SIZE and ``raw``, messages are passed unchecked.
            options: Other options of ``Node.create_subscription``.
        """

        def on_data(data: bytes) -> None:
            with self.guard(f"topic {self.resolve_topic_name(topic)}", "the message is ignored") as fault:
                if raw and max_bytes != ANY_SIZE:
                    check_serialised(data, msg_type, max_bytes)
                callback(data if raw else deserialised(data, msg_type, max_bytes))
            if fault.reason and len(data) > _LARGE and self.executor is not None:
                self.run_soon(release_memory)  # when the message itself is freed

        return super().create_subscription(msg_type, topic, on_data, qos_profile, raw=True, **options)

    def take_waiting(self, subscription: Any, deadline: float) -> None:
        """Call the callback for messages that have arrived but were not read by the executor. Ends at
        ``deadline`` (monotonic seconds) at the latest, since publishers may go on."""
        handle = subscription.handle
        with handle:
            while time.monotonic() < deadline and (
                taken := handle.take_message(subscription.msg_type, subscription.raw)
            ):
                subscription.callback(taken[0])

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], object], *arguments: Any, **options: Any
    ) -> Any:
        """Create a timer like ``Node.create_timer``. Its callback cannot end the node."""

        def on_time() -> None:
            with self.guard(f"timer {_name(callback)}", "it goes on at its next time"):
                callback()

        return super().create_timer(timer_period_sec, on_time, *arguments, **options)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any], **options: Any
    ) -> Any:
        """Create a service like ``Node.create_service``. Its callback cannot end the node."""
        source = f"service {self.resolve_service_name(srv_name)}"

        def on_request(request: Any, response: Any) -> Any:
            with self.guard(source, "the request is refused") as fault:
                _check_request(request)
                return callback(request, response)
            if isinstance(request, RosError):
                self.run_soon(release_memory)
            return _refusal(request, srv_type.Response(), fault.reason)

        # a queue longer than rclpy's, like that of the services of parameters, since requests beyond it are
        # lost
        options.setdefault("qos_profile", qos_profile_parameters)
        service = super().create_service(srv_type, srv_name, on_request, **options)
        service.srv_type = limited(srv_type, _MAX_PARAMETERS)
        send = service.send_response

        # no coroutine, since the EventsExecutor does not await coroutines
        def send_when_done(response: Any, header: Any) -> None:
            def send_result(done: Future) -> None:
                with self.guard(source, "the request is not answered"):
                    send(done.result(), header)

            if isinstance(response, Future):
                response.add_done_callback(send_result)
            else:
                send(response, header)

        service.send_response = send_when_done
        return service

    def add_pre_set_parameters_callback(self, callback: Callable[[Any], Any]) -> None:
        """Add a callback that adds parameters to a request. If it fails, all parameters are refused."""

        def on_parameters(parameters: Sequence[Any]) -> Any:
            with self.guard("parameters", f"{_names(parameters)} refused"):
                return callback(parameters)
            return []  # rclpy refuses an empty list

        super().add_pre_set_parameters_callback(on_parameters)

    def add_on_set_parameters_callback(self, callback: Callable[[Any], Any]) -> None:
        """Add a callback that accepts or refuses parameters. If it fails, the parameters are refused."""

        def on_parameters(parameters: Sequence[Any]) -> Any:
            with self.guard("parameters", f"{_names(parameters)} refused") as fault:
                return callback(parameters)
            return SetParametersResult(successful=False, reason=fault.reason)

        super().add_on_set_parameters_callback(on_parameters)

    def add_post_set_parameters_callback(self, callback: Callable[[Any], Any]) -> None:
        """Add a callback that makes accepted parameters effective."""

        def on_parameters(parameters: Sequence[Any]) -> None:
            with self.guard("parameters", f"{_names(parameters)} perhaps without effect"):
                callback(parameters)

        super().add_post_set_parameters_callback(on_parameters)


def release_memory() -> None:
    """Give freed memory back to the system, since glibc keeps up to 100 MB after large messages."""
    with suppress(AttributeError, OSError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def _name(callback: Callable[..., object]) -> str:
    return getattr(callback, "__name__", type(callback).__name__).strip("_")


def _names(parameters: Sequence[Any]) -> str:
    return printable(", ".join(parameter.name for parameter in parameters))


def _refusal(request: Any, response: Any, reason: str) -> Any:
    """Fill the response of a failed service request with the reason. Knows std_srvs, SetCameraInfo, the
    parameter services and simulation_interfaces.
    """
    refused = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, "success"):
        response.success = False
    for text in ("message", "status_message"):
        if hasattr(response, text):
            setattr(response, text, reason)
    if hasattr(response, "results"):
        response.results = [refused] * len(getattr(request, "parameters", (None,)))
    elif isinstance(getattr(response, "result", None), SetParametersResult):
        response.result = refused
    elif hasattr(getattr(response, "result", None), "error_message"):
        response.result.result = response.result.RESULT_OPERATION_FAILED
        response.result.error_message = reason
    return response


def _check_request(request: Any) -> None:
    """Raise RosError for a service request that rclpy cannot read, or cannot read in a short time."""
    if isinstance(request, RosError):
        raise request
    for name in request.get_fields_and_field_types():
        value = getattr(request, name)
        limit = _MAX_PARAMETERS if name == "parameters" else _MAX_REQUESTED
        if isinstance(value, list) and len(value) > limit:
            raise RosError(f"{len(value)} {name}; at most {limit} are read in one request")
    for parameter in getattr(request, "parameters", ()):
        if parameter.value.type not in {each.value for each in Parameter.Type}:
            raise RosError(f"{parameter.value.type} is no type of a parameter")
        if (length := len(parameter.value.string_value)) > _MAX_TEXT:
            raise RosError(f"a value of {length} characters; at most {_MAX_TEXT} are read")
