"""No callback ends a node: errors are logged and counted, requests are refused, and the node goes on."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from conftest import ROOT
from rclpy.qos import qos_profile_parameters
from ros_support import Client, rclpy

from humansim_ros.errors import RosError
from humansim_ros.ros.graph import guarded_node, requests
from humansim_ros.ros.graph.guarded_node import GuardedNode
from humansim_ros.ros.processes import runtime
from humansim_ros.ros.processes.runtime import make_executor


def recurse() -> Any:
    return recurse()


def endless(*_: Any) -> Any:
    return recurse()  # Python 3.13 does not count calls of functions with any number of arguments


def no_memory(*_: Any) -> Any:
    raise MemoryError


def own_error(*_: Any) -> Any:
    raise RosError("a peer said \x1b[2J" + 1000 * "x")


#: Callbacks that fail, and the beginning of the logged reason.
FAILING: dict[Callable[..., Any], str] = {
    endless: "RecursionError: maximum recursion depth exceeded",
    no_memory: "MemoryError",
    own_error: r"a peer said \x1b[2Jxxx",
}


@pytest.fixture(params=["events", "default"])
def guarded(request: pytest.FixtureRequest, ros: None) -> Iterator[Any]:
    """A guarded node, its log, and a client; in both executors of :func:`make_executor`."""
    from rclpy.executors import SingleThreadedExecutor

    executor = make_executor() if request.param == "events" else SingleThreadedExecutor()
    node = GuardedNode("guarded")
    lines: list[str] = []
    node.get_logger = lambda: SimpleNamespace(  # type: ignore[method-assign]
        error=lines.append, debug=lines.append, is_enabled_for=lambda _: True
    )
    client = Client("hostile", executor)
    client.executor.add_node(node)
    yield SimpleNamespace(node=node, client=client, lines=lines, errors=lambda: node._counts.get("errors", 0))
    node.destroy_node()
    client.close()


@pytest.mark.parametrize("failing", FAILING)
def test_a_failing_subscription_is_logged_once_and_counted_and_gets_the_next_message(
    guarded: Any, failing: Callable[..., Any]
) -> None:
    from std_msgs.msg import String

    calls: list[str] = []

    def on_message(message: String) -> None:
        calls.append(message.data)
        if message.data == "bad":
            failing()

    guarded.node.create_subscription(String, "words", on_message, 50)
    publisher = guarded.client.node.create_publisher(String, "words", 50)
    guarded.client.spin_until_matched(guarded.node)
    for word in [*20 * ["bad"], "good"]:
        publisher.publish(String(data=word))
    assert guarded.client.spin_until(lambda: "good" in calls)
    assert calls == [*20 * ["bad"], "good"]
    assert guarded.errors() == 20
    said = [line for line in guarded.lines if line.startswith("topic /words: ")]
    assert len(said) < 5  # one per second
    assert said[0].startswith(f"topic /words: {FAILING[failing]}") and "the message is ignored" in said[0]
    assert len(said[0]) < 500
    traces = [line for line in guarded.lines if line.startswith("Traceback")]
    assert len(traces) == (0 if failing is own_error else len(said))


@pytest.mark.parametrize(
    "data",
    [b"", b"\0", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\x7f", b"\0\1\0\0" + b"\xff" * 40, 300_000 * b"["],
    ids=["empty", "one byte", "no content", "a length beyond the end", "ones", "too long"],
)
@pytest.mark.parametrize("kind", ["String", "Header", "PointCloud2", "MultiDOFJointState"])
def test_bytes_that_are_no_message_are_counted_and_the_next_message_arrives(
    guarded: Any, kind: str, data: bytes
) -> None:
    import sensor_msgs.msg
    import std_msgs.msg

    message = getattr(std_msgs.msg, kind, None) or getattr(sensor_msgs.msg, kind)
    got: list[Any] = []
    guarded.node.create_subscription(message, "any", got.append, 50)
    publisher = guarded.client.node.create_publisher(message, "any", 50)
    guarded.client.spin_until_matched(guarded.node)
    publisher.publish(data)
    publisher.publish(message())
    assert guarded.client.spin_until(lambda: got)
    assert got == [message()] and guarded.errors() == 1
    assert guarded.lines[0].startswith("topic /any: ") and "bytes" in guarded.lines[0]


def test_a_point_cloud_with_many_fields_is_not_deserialised(guarded: Any) -> None:
    from sensor_msgs.msg import PointCloud2, PointField

    got: list[Any] = []
    guarded.node.create_subscription(PointCloud2, "cloud", got.append, 50)
    publisher = guarded.client.node.create_publisher(PointCloud2, "cloud", 50)
    guarded.client.spin_until_matched(guarded.node)
    for frame in ("", "a", "map", "four"):  # with every padding
        many = PointCloud2(fields=[PointField()] * 65)
        few = PointCloud2(fields=[PointField()] * 64)
        many.header.frame_id = few.header.frame_id = frame
        for message in (many, few):
            publisher.publish(message)
    assert guarded.client.spin_until(lambda: len(got) == 4)
    assert guarded.errors() == 4 and "65 fields" in guarded.lines[0]


@pytest.mark.parametrize("failing", FAILING)
def test_a_failing_timer_goes_on(guarded: Any, failing: Callable[..., Any]) -> None:
    guarded.node.create_timer(0.01, failing)
    assert guarded.client.spin_until(lambda: guarded.errors() >= 10)
    assert guarded.lines[0].startswith(f"timer {failing.__name__}: {FAILING[failing]}")


@pytest.mark.parametrize("failing", FAILING)
def test_a_failing_task_ends_alone(guarded: Any, failing: Callable[..., Any]) -> None:
    done: list[int] = []
    guarded.node.run_soon(failing)
    guarded.node.run_soon(lambda: done.append(1))
    assert guarded.client.spin_until(lambda: done and guarded.errors())
    assert guarded.errors() == 1


@pytest.mark.parametrize("failing", FAILING)
def test_a_failing_service_answers_with_a_refusal(guarded: Any, failing: Callable[..., Any]) -> None:
    from sensor_msgs.srv import SetCameraInfo
    from std_srvs.srv import Empty, SetBool, Trigger

    for kind, text in (
        (SetBool, "message"),
        (Trigger, "message"),
        (SetCameraInfo, "status_message"),
        (Empty, ""),
    ):
        name = kind.__name__.lower()
        guarded.node.create_service(kind, name, failing)
        answer = ask(guarded, kind, name, kind.Request())
        if text:
            assert answer.success is False and getattr(answer, text).startswith(FAILING[failing])


def ask(guarded: Any, kind: Any, name: str, request: Any) -> Any:
    """Response of a service of the node."""
    client = guarded.client.node.create_client(kind, name)
    assert guarded.client.spin_until(client.service_is_ready)
    future = client.call_async(request)
    assert guarded.client.spin_until(future.done)
    guarded.client.node.destroy_client(client)
    return future.result()


@pytest.mark.parametrize("failing", FAILING)
@pytest.mark.parametrize("stage", ["pre", "on", "post"])
def test_failing_parameter_callbacks_refuse(guarded: Any, stage: str, failing: Callable[..., Any]) -> None:
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters, SetParametersAtomically

    guarded.node.declare_parameter("number", 1)
    getattr(guarded.node, f"add_{stage}_set_parameters_callback")(failing)
    value = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=2)
    request = {"parameters": [Parameter(name="number", value=value)]}
    (result,) = ask(
        guarded, SetParameters, "guarded/set_parameters", SetParameters.Request(**request)
    ).results
    kind = SetParametersAtomically
    both = ask(guarded, kind, "guarded/set_parameters_atomically", kind.Request(**request)).result
    for answer in (result, both):
        assert answer.successful == (stage == "post")
        if stage == "on":
            assert answer.reason.startswith(FAILING[failing])
    assert guarded.node.get_parameter("number").value == (2 if stage == "post" else 1)
    assert guarded.errors() == 2
    assert guarded.lines[0].startswith(f"parameters: {FAILING[failing]}") and "number" in guarded.lines[0]


def test_parameters_of_no_known_type_are_refused(guarded: Any) -> None:
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import SetParameters, SetParametersAtomically

    parameters = [Parameter(name=name, value=ParameterValue(type=77)) for name in ("a", "b")]
    single = ask(
        guarded, SetParameters, "guarded/set_parameters", SetParameters.Request(parameters=parameters)
    )
    kind = SetParametersAtomically
    both = ask(guarded, kind, "guarded/set_parameters_atomically", kind.Request(parameters=parameters))
    for answer in (*single.results, both.result):
        assert not answer.successful and answer.reason
    assert len(single.results) == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_requests_to_stop_pass(guarded: Any, error: type[BaseException]) -> None:
    with pytest.raises(error), guarded.node.guard("test", "nothing"):
        raise error


class FailingExecutor:
    """Fails a number of times between two successes; asks to stop after ``limit`` calls."""

    def __init__(self, failures: int, limit: int, stop: list[int]) -> None:
        self.calls, self._failures, self._limit, self._stop = 0, failures, limit, stop

    def spin_once(self, _: float) -> None:
        self.calls += 1
        if self.calls >= self._limit:
            self._stop.append(1)
        if self.calls % (self._failures + 1):
            raise RuntimeError("failed to take a message")


def test_errors_of_the_executor_do_not_end_a_node_while_some_calls_succeed(
    guarded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime, "_MAX_SECONDS_OF_ERRORS", 60.0)
    stop: list[int] = []
    executor = FailingExecutor(3, 80, stop)
    runtime.spin(guarded.node, executor, lambda: bool(stop))
    assert executor.calls == 80 and guarded.errors() == 60
    assert guarded.lines[0] == "executor: RuntimeError: failed to take a message; it goes on"


def test_an_executor_that_only_fails_ends_the_node_without_using_a_core(
    guarded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime, "_MAX_SECONDS_OF_ERRORS", 0.5)
    executor = FailingExecutor(10**9, 10**9, [])
    with pytest.raises(RosError, match="failed to take a message"):
        runtime.spin(guarded.node, executor, lambda: False)
    assert executor.calls < 20  # pauses of 1, 2, 4 … 100 ms


def test_a_shutdown_of_the_context_ends_spinning(guarded: Any) -> None:
    class Shutdown:
        def spin_once(self, _: float) -> None:
            raise rclpy.executors.ExternalShutdownException

    runtime.spin(guarded.node, Shutdown(), lambda: False)
    assert guarded.errors() == 0


def test_a_service_answers_when_its_future_is_done_and_a_failing_one_is_counted(guarded: Any) -> None:
    from rclpy.task import Future
    from std_srvs.srv import Trigger

    begun: list[Future] = []

    def on_request(_: Any, __: Any) -> Future:
        begun.append(Future())
        return begun[-1]

    guarded.node.create_service(Trigger, "later", on_request)
    client = guarded.client.node.create_client(Trigger, "later")
    assert guarded.client.spin_until(client.service_is_ready)
    answers = [client.call_async(Trigger.Request()) for _ in range(2)]
    assert guarded.client.spin_until(lambda: len(begun) == 2)
    assert not any(answer.done() for answer in answers)
    begun[0].set_exception(RosError("no answer"))
    begun[1].set_result(Trigger.Response(message="now"))
    assert guarded.client.spin_until(answers[1].done)
    assert answers[1].result().message == "now"
    assert not answers[0].done() and guarded.errors() == 1


def test_requests_that_rclpy_cannot_read_soon_are_refused(ros: None) -> None:
    """It compares all names with all others, and fails at types of parameters that do not exist."""
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters

    node = GuardedNode("asked")
    services = {service.service_name: service for service in node.services}

    def ask(name: str, kind: Any, **fields: Any) -> Any:
        return services[f"/asked/{name}"].callback(kind.Request(**fields), kind.Response())

    assert ask("list_parameters", ListParameters, prefixes=["x"] * 1001).result.names == []
    assert ask("get_parameters", GetParameters, names=["use_sim_time"] * 20_000).values == []
    assert node._counts["errors"] == 2
    assert len(ask("get_parameters", GetParameters, names=["use_sim_time"] * 1000).values) == 1000
    result = ask("set_parameters", SetParameters, parameters=[Parameter(name="x")] * 301).results[0]
    assert result.reason == "301 parameters; at most 300 are read in one request"
    wrong = [Parameter(name="use_sim_time", value=ParameterValue(type=255))]
    (result,) = ask("set_parameters", SetParameters, parameters=wrong).results
    assert not result.successful
    assert result.reason == "255 is no type of a parameter"
    node.destroy_node()


def test_all_nodes_of_the_package_are_guarded() -> None:
    """But for the listener in tests of users, which is no part of a graph."""
    for path in (ROOT / "humansim_ros").rglob("*.py"):
        if path.name != "guarded_node.py" and path.parent.name != "testing":
            text = path.read_text()
            assert not re.search(r"create_node\(|\(Node\b|create_task\(", text), path


@pytest.mark.parametrize(("size", "releases"), [(100, 0), (5 << 20, 1)])
def test_memory_of_long_messages_that_are_refused_is_given_back(
    guarded: Any, monkeypatch: pytest.MonkeyPatch, size: int, releases: int
) -> None:
    from std_msgs.msg import Header

    released: list[int] = []
    monkeypatch.setattr(guarded_node, "release_memory", lambda: released.append(1))
    subscription = guarded.node.create_subscription(Header, "/header", endless, 10)
    subscription.callback(bytes(size))
    guarded.client.spin_until(lambda: len(released) >= releases)
    assert guarded.errors() == 1
    assert len(released) == releases


@pytest.mark.slow
def test_a_request_of_200000_parameters_is_refused_before_python_objects_are_made_of_it(
    guarded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """rclpy makes them before it calls the service: in ten seconds, with hundreds of megabytes."""
    from rcl_interfaces.msg import Parameter
    from rcl_interfaces.srv import SetParameters

    made: list[int] = []
    monkeypatch.setattr(
        guarded_node, "_check_request", lambda request: made.append(isinstance(request, RosError))
    )
    client = guarded.client.node.create_client(SetParameters, "guarded/set_parameters")
    assert guarded.client.spin_until(client.service_is_ready)
    many = SetParameters.Request(parameters=[Parameter(name="x")] * 200_000)
    answer = client.call_async(many)
    assert guarded.client.spin_until(answer.done)
    assert made == [True]
    monkeypatch.undo()
    for count, text in ((300, "Invalid access"), (301, "301 parameters; at most 300 are read")):
        request = SetParameters.Request(parameters=[Parameter(name="x")] * count)
        answer = client.call_async(request)
        assert guarded.client.spin_until(answer.done)
        assert answer.result().results[0].reason.startswith(text)


def test_services_have_a_queue_for_many_calls_at_once(guarded: Any) -> None:
    from std_srvs.srv import Trigger

    def succeed(_: Any, response: Any) -> Any:
        response.success = True
        return response

    guarded.node.create_service(Trigger, "often", succeed)
    # the queue of the client for answers is its own
    client = guarded.client.node.create_client(Trigger, "often", qos_profile=qos_profile_parameters)
    assert guarded.client.spin_until(client.service_is_ready)
    answers = [client.call_async(Trigger.Request()) for _ in range(200)]
    assert guarded.client.spin_until(lambda: all(answer.done() for answer in answers), 30)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rcl_interfaces.srv.SetParameters", [("parameters", 0)]),
        ("rcl_interfaces.srv.SetParametersAtomically", [("parameters", 0)]),
        ("rcl_interfaces.srv.GetParameters", []),
        ("sensor_msgs.srv.SetCameraInfo", []),
    ],
)
def test_lists_of_messages_are_found_in_requests(name: str, expected: list[tuple[str, int]]) -> None:
    package, _, kind = name.split(".")
    request = getattr(importlib.import_module(f"{package}.srv"), kind).Request
    found = [(field, at) for field, type_, at in requests._fields(request) if "/" in type_ and "<" in type_]
    assert found == expected


def test_requests_with_another_layout_in_c_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    from rcl_interfaces.srv import SetParameters

    fields = requests._fields
    monkeypatch.setattr(
        requests, "_fields", lambda kind: [(name, type_, at + 16) for name, type_, at in fields(kind)]
    )
    assert requests.limited(SetParameters, 300) is SetParameters
