"""Run the nodes of a scene for a test, in lockstep: a frame is sent when the test asks for it."""

from __future__ import annotations

import difflib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, overload

import rclpy
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Header

from humansim_ros.data.messages import (
    TimedTopics,
    header,
    message_type,
    read_frame_number,
    scene_topics,
    to_nanoseconds,
)
from humansim_ros.errors import RosError
from humansim_ros.ros.graph import (
    DATA,
    FRAME_DONE,
    REPORTS,
    SCENE_TIME,
    offered_profile,
    subscription_profile,
)
from humansim_ros.ros.nodes import InProcessNodes
from humansim_ros.ros.processes import TEST_NODE, relative_namespace
from humansim_ros.scene.core import Scene
from humansim_ros.testing.support import patience, running_rclpy

#: Longest wait for callbacks, seconds: with one rclpy context for all nodes, and with several contexts.
_STEP, _SHORT_STEP = 0.05, 0.002
#: Longest time for the nodes of the test to handle all received messages, seconds. It is limited, since
#: timers never end.
_MAX_REST = 1.0


class SceneGraph:
    """Motion player, skinners and cameras of a scene in lockstep, and a node that receives for the test.

    The nodes start with the first frame, so that nodes and subscriptions of the test come before it. Frame k
    has the stamp 1 ns + round(k * period), as in Simulation. It is sent when the test asks for a frame, and
    after all cameras and all subscriptions of the test have finished the previous frame. A camera with its
    own rate takes part only in its own frames, as do the nodes that answer it.

    Use it as a context manager. The fixture ``humansim_graph`` yields one for each test.

    Args:
        scene: The scene.
        namespace: ROS namespace of its nodes, and of relative topics of the test.
        processes: Whether to start the nodes with ``humansim run`` instead of in this process. The scene must
            then be a file.
        limit: Longest time of a frame, seconds. HUMANSIM_TEST_PATIENCE multiplies it.

    Attributes:
        scene: The scene.
        node: Node that subscribes for the test. The test may use it for publishers and services, too.
        limit: Longest time of a frame, seconds.

    Raises:
        RosError: The namespace is not valid, or the scene of processes is no file.
    """

    def __init__(
        self, scene: Scene, *, namespace: str = "", processes: bool = False, limit: float = 60.0
    ) -> None:
        self.scene = scene
        self._namespace = relative_namespace(namespace)
        self.limit = patience(limit)
        self._processes = processes
        if processes and scene.path is None:
            raise RosError(
                "a scene that is made in memory has no processes: write it to a file and load that"
            )
        self._running: InProcessNodes | NodeProcesses | None = None
        self._received: dict[str, ReceivedMessages] = {}
        self._subscriptions: dict[str, Any] = {}
        #: Number of the frame in flight: the frame that is sent and not finished.
        self._index: int | None = None
        #: Stamp of the frame in flight; and stamp of the newest frame that the test has released.
        self._frame = self._released = -1
        #: Number of frames that the test has played.
        self._frames = 0
        #: By camera or scanner: newest stamp that it has finished.
        self._finished = dict.fromkeys([*scene.cameras, *scene.scanners], -1)
        #: By topic: number of messages before the frame in flight.
        self._before: dict[str, int] = {}
        self._stack = ExitStack()
        self._stack.enter_context(running_rclpy())
        self._context = rclpy.get_default_context()
        self.node = rclpy.create_node(TEST_NODE, namespace=self._namespace, start_parameter_services=False)
        self._timed = TimedTopics(scene, self.node.get_namespace())
        self._executors: dict[Any, Any] = {}
        self.add_node(self.node)
        self.node.create_subscription(TimeReference, SCENE_TIME, self._on_frame, DATA)
        self.node.create_subscription(Header, FRAME_DONE, self._on_done, REPORTS)
        self._reports = self.node.create_publisher(Header, FRAME_DONE, DATA)

    def __enter__(self) -> SceneGraph:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- interface of tests

    @property
    def domain(self) -> int:
        """ROS domain of the nodes."""
        return int(self._context.get_domain_id())

    def add_node(self, node: Any) -> None:
        """Spin a node of the test with the nodes of the scene, in this thread.

        An exception in its callbacks ends the test. A node that waits in a callback, for example for a
        service, needs its own executor in its own thread.

        Raises:
            RosError: The node is in another ROS domain.
        """
        domain = node.context.get_domain_id()
        if domain != self.domain:
            raise RosError(
                f"the node {node.get_name()} is in ROS domain {domain}, the scene in {self.domain}: let the "
                "fixture that initialises its rclpy context use the fixture humansim_domain"
            )
        if node.context not in self._executors:
            self._executors[node.context] = SingleThreadedExecutor(context=node.context)
        self._executors[node.context].add_node(node)

    def remove_node(self, node: Any) -> None:
        """Stop spinning a node of the test."""
        self._executors[node.context].remove_node(node)

    def subscribe(
        self, topic: str, type: Any = None, qos: QoSProfile | None = None, every_frame: bool = True
    ) -> ReceivedMessages:
        """Keep the messages of a topic from now on.

        Args:
            topic: Name. A relative name is in the namespace of the scene.
            type: Message class. If None, that of the scene or of a publisher; the call waits for a publisher.
            qos: Quality of service. If None, all messages of all publishers arrive.
            every_frame: Whether each frame waits for a message of this topic with the stamp of the frame or a
                newer stamp. For messages without stamp, any message counts.

        Returns:
            The messages. Messages of later frames are added to them.

        Raises:
            RosError: No node publishes the topic within the limit.
        """
        name = self.node.resolve_topic_name(topic)
        if name in self._received:
            self._received[name].every_frame = every_frame
            return self._received[name]
        received = ReceivedMessages(name, every_frame)
        kind, offered = self._offer(name, type)
        self._subscriptions[name] = self.node.create_subscription(kind, name, received.add, qos or offered)
        self._received[name] = received
        return received

    def forget(self, topic: str) -> None:
        """End the subscription to a topic. Frames do not wait for it any more."""
        name = self.node.resolve_topic_name(topic)
        if name in self._received:
            del self._received[name]
            self.node.destroy_subscription(self._subscriptions.pop(name))

    def play(self, frames: int = 1) -> list[int]:
        """Play the next frames. Each frame waits for all cameras, and for subscriptions with ``every_frame``.

        Afterwards, nodes added by ``add_node`` have handled all messages of these frames that were sent in
        this process.

        Returns:
            Stamps of the frames, nanoseconds.

        Raises:
            RosError: A frame is not finished within the limit. The message names cameras and topics.
        """
        return [self._play_frame() for _ in range(frames)]

    def collect(
        self,
        topic: str,
        count: int,
        type: Any = None,
        qos: QoSProfile | None = None,
        every_frame: bool = True,
    ) -> list[Any]:
        """Play frames until a topic has received ``count`` more messages.

        Args:
            topic: Name. A relative name is in the namespace of the scene.
            count: Number of messages.
            type: Message class. If None, that of the scene or of a publisher; the call waits for a publisher.
            qos: Quality of service. If None, all messages of all publishers arrive.
            every_frame: Whether each frame waits for its message. With False, for nodes that do not answer
                each frame, frames wait only for the cameras.

        Returns:
            The messages, in the order of their arrival.

        Raises:
            RosError: No message arrives within the limit. The message names the topic.
        """
        received = self.subscribe(topic, type, qos, every_frame)
        before, first = len(received), None
        arrived, end = received.arrived, time.monotonic() + self.limit
        while True:
            (stamp,) = self.play()
            first = stamp if first is None else first
            new = [each for each in received[before:] if not every_frame or _is_of(each, first)]
            if len(new) >= count:
                return new[:count]
            if received.arrived > arrived:
                arrived, end = received.arrived, time.monotonic() + self.limit
            elif time.monotonic() > end:
                raise RosError(self._explanation(stamp, [received]))

    def wait_for(self, topic: str, type: Any = None, qos: QoSProfile | None = None) -> Any:
        """Return the newest message of a topic, such as a latched topic. Waits for the first message, without
        playing frames.

        Args:
            topic: Name. A relative name is in the namespace of the scene.
            type: Message class. If None, that of the scene or of a publisher; the call waits for a publisher.
            qos: Quality of service. If None, all messages of all publishers arrive.

        Raises:
            RosError: No message arrives within the limit.
        """
        name = self.node.resolve_topic_name(topic)
        received = self._received.get(name) or self.subscribe(topic, type, qos, every_frame=False)
        self._start()
        self._spin_until(lambda: received.arrived, lambda: self._explanation(self._frame, [received]))
        return received[-1]

    def spin_until(self, condition: Callable[[], object], text: str = "the condition is not true") -> None:
        """Let all nodes work until a condition is true. No further frame is sent. ``text``: what is missing,
        for the error. Raises RosError after the limit."""
        self._start()
        self._spin_until(condition, text)

    def close(self) -> None:
        """Stop the nodes of the scene, and rclpy unless the test has initialised it itself."""
        try:
            if self._running is not None:
                for node in self._running.nodes:
                    self.remove_node(node)
                self._running.close()
            for executor in self._executors.values():
                for node in executor.get_nodes():
                    executor.remove_node(node)
                executor.shutdown()
            self.node.destroy_node()
        finally:
            self._running = None
            self._stack.close()

    # --- frames

    def _start(self) -> None:
        if self._running is not None:
            return
        if self._processes:
            assert self.scene.path is not None
            self._running = NodeProcesses(self.scene.path, self._namespace, TEST_NODE)
        else:
            player = {"mode": "lockstep", "wait_for": [TEST_NODE], "timeout": NEVER, "clock_search": 0.0}
            self._running = InProcessNodes(self.scene, self._namespace, player)
        for node in self._running.nodes:
            self.add_node(node)

    def _play_frame(self) -> int:
        """Play the next frame, and return its stamp."""
        self._start()
        before = self._frame if self._frames else -1
        self._before = {name: received.arrived for name, received in self._received.items()}
        if self._frames:
            self._release()
        self._spin_until(lambda: self._frame > before, "the motion player sends no frame")
        self._frames += 1
        stamp = self._frame
        self._spin_until(lambda: not self._missing(stamp), lambda: self._explanation(stamp))
        self._handle_rest()
        return stamp

    def _on_frame(self, message: TimeReference) -> None:
        self._frame, self._index = to_nanoseconds(message.header.stamp), read_frame_number(message)
        if self._frame <= self._released:  # the player has not received the report yet
            self._report(self._frame)

    def _on_done(self, report: Header) -> None:
        stamp = to_nanoseconds(report.stamp)
        for name in report.frame_id.split(", "):
            camera = name.strip("/").removeprefix(f"{self._namespace}/")
            if camera in self._finished:
                self._finished[camera] = max(self._finished[camera], stamp)

    def _release(self) -> None:
        """Report that the frame in flight is finished, so that the next frame can be sent."""
        self._released = self._frame
        self._report(self._frame)

    def _report(self, stamp: int) -> None:
        self._reports.publish(header(stamp, TEST_NODE))

    def _missing(self, stamp: int) -> list[str]:
        """Topics and cameras that have not finished a frame."""
        resting = self._timed.resting(self._received, self._index)
        topics = [
            name
            for name, received in self._received.items()
            if received.every_frame
            and name not in resting
            and (
                received.arrived == self._before.get(name, 0)
                if received.newest < 0
                else received.newest < stamp
            )
        ]
        return [*topics, *(f"camera {name}" for name, done in self._finished.items() if done < stamp)]

    # --- waiting

    def _spin_until(self, condition: Callable[[], object], problem: str | Callable[[], str]) -> None:
        end = time.monotonic() + self.limit
        while not condition():
            if time.monotonic() > end:
                text = problem if isinstance(problem, str) else problem()
                output = self._running.output if self._running is not None else ""
                raise RosError(
                    f"{text} within {self.limit:g} s (ROS domain {self.domain})"
                    + (f"\noutput of the nodes: {output}" if output else "")
                )
            self._spin_once()

    def _spin_once(self) -> None:
        step = _STEP if len(self._executors) == 1 else _SHORT_STEP
        for executor in list(self._executors.values()):
            executor.spin_once(timeout_sec=step)
        if self._running is not None:
            self._running.check()

    def _handle_rest(self) -> None:
        """Call the callbacks that are ready, and those that become ready meanwhile."""
        end = time.monotonic() + _MAX_REST
        while any(map(_handles_one, self._executors.values())) and time.monotonic() < end:
            pass

    def _offer(self, name: str, kind: Any) -> tuple[Any, QoSProfile]:
        """Find message class and quality of service for a subscription that gets all messages of a topic."""
        for topic in scene_topics(self.scene):
            if topic.in_namespace(self.node.get_namespace()) == name:
                return kind or topic.type, subscription_profile([offered_profile(topic)])
        if kind is None:
            self._spin_until(lambda: self._publishers(name), lambda: self._silence(name))
        found = self._publishers(name)
        return kind or message_type(found[0].topic_type), subscription_profile(
            [each.qos_profile for each in found]
        )

    def _publishers(self, name: str) -> list[Any]:
        return list(self.node.get_publishers_info_by_topic(name))

    # --- errors

    def _explanation(self, stamp: int, topics: list[ReceivedMessages] | None = None) -> str:
        """Text of the error that a frame is not finished, or that topics have no messages."""
        missing = [each.topic for each in topics] if topics else self._missing(stamp)
        lines = [self._silence(name) for name in missing if name in self._received]
        cameras = [name for name in missing if name not in self._received]
        if cameras:
            lines.append(f"{', '.join(cameras)}: not finished")
        return f"frame {max(self._frames - 1, 0)}: " + "; ".join(lines)

    def _silence(self, name: str) -> str:
        """Text that says why a topic may have no message."""
        publishers = self._publishers(name)
        if not publishers:
            known = [topic for topic, _ in self.node.get_topic_names_and_types()]
            similar = difflib.get_close_matches(name, [each for each in known if each != name], 3)
            hint = f"similar topics: {', '.join(similar)}" if similar else "is its node added (add_node)?"
            return f"no node publishes {name}; {hint}"
        nodes = ", ".join(f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in publishers)
        received = self._received.get(name)
        text = f"no message on {name} from {nodes}"
        if received is not None and received.arrived:
            last = f", the last with stamp {received.newest} ns" if received.newest >= 0 else ""
            text += f" after {received.arrived} messages{last}"
        if received is not None and received.every_frame:
            text += " (every_frame=False is for nodes that do not answer each frame)"
        best_effort = any(
            each.qos_profile.reliability == QoSReliabilityPolicy.BEST_EFFORT for each in publishers
        )
        return f"{text}; it offers best effort: give the quality of service" if best_effort else text


def _handles_one(executor: Any) -> bool:
    """Call one callback that is ready. Returns False if no callback is ready."""
    try:
        handler, *_ = executor.wait_for_ready_callbacks(timeout_sec=0.0)
    except TimeoutException:
        return False
    handler()
    handler.result()  # raises the exception of the callback
    return True


def _is_of(message: Any, first: int) -> bool:
    """Whether a message may belong to the frame with the stamp ``first``, or to a later frame."""
    stamp = stamp_of(message)
    return stamp is None or stamp >= first


def stamp_of(message: Any) -> int | None:
    """Stamp of a message with a header, or of a header, in nanoseconds; None for other messages."""
    stamp = getattr(getattr(message, "header", message), "stamp", None)
    return None if stamp is None else to_nanoseconds(stamp)


class ReceivedMessages(Sequence[Any]):
    """Messages of one topic, one for each stamp, in the order of arrival.

    If a frame is sent again, its messages come again. The newest message of each stamp is kept.

    Attributes:
        topic: Full name of the topic.
        every_frame: Whether frames wait for a message of this topic.
        arrived: Number of messages that have arrived.
        newest: Newest stamp in nanoseconds; -1 before the first one.
    """

    def __init__(self, topic: str, every_frame: bool) -> None:
        self.topic, self.every_frame = topic, every_frame
        self.arrived = 0
        self.newest = -1
        #: By stamp, nanoseconds. Messages without a stamp have negative numbers instead.
        self._messages: dict[int, Any] = {}

    def add(self, message: Any) -> None:
        """Keep a message."""
        self.arrived += 1
        stamp = stamp_of(message)
        self._messages[-self.arrived if stamp is None else stamp] = message
        if stamp is not None:
            self.newest = max(self.newest, stamp)

    def at(self, moment: Any) -> Any:
        """Return the message with a stamp. ``moment``: nanoseconds, or another message with this stamp.

        Raises:
            RosError: There is no such message.
        """
        stamp = moment if isinstance(moment, int) else stamp_of(moment)
        if stamp is None or stamp not in self._messages:
            raise RosError(f"{self.topic}: no message with stamp {stamp} ns among {len(self)}")
        return self._messages[stamp]

    @property
    def stamps(self) -> list[int]:
        """Stamps in nanoseconds, in the order of their first arrival."""
        return [stamp for stamp in self._messages if stamp >= 0]

    def __len__(self) -> int:
        return len(self._messages)

    @overload
    def __getitem__(self, index: int) -> Any: ...
    @overload
    def __getitem__(self, index: slice) -> list[Any]: ...
    def __getitem__(self, index: int | slice) -> Any:
        return list(self._messages.values())[index]

    def __repr__(self) -> str:
        return f"ReceivedMessages({self.topic!r}, {len(self)} messages)"


#: Time after which a frame in lockstep stops waiting, seconds. It is very long, because the test has its own
#: limit.
NEVER = 1e6
#: ``humansim run`` must end within this time, seconds.
_END_WITHIN = 30.0
#: Most characters of the output of ``humansim run`` in an error.
_MAX_OUTPUT = 2000


class NodeProcesses:
    """Runs ``humansim run`` with a scene file.

    Args:
        path: Scene file.
        namespace: ROS namespace of the nodes.
        member: Name of the node that frames wait for, in addition to the cameras.
    """

    nodes: Sequence[Any] = ()

    def __init__(self, path: Path, namespace: str, member: str) -> None:
        self._output = tempfile.TemporaryFile("w+")  # noqa: SIM115  # closed with the processes
        command = [sys.executable, "-m", "humansim_ros", "run", str(path), "--lockstep", "--wait-for", member]
        command += ["--timeout", str(NEVER), *(["--namespace", namespace] if namespace else [])]
        self._process = subprocess.Popen(command, stdout=self._output, stderr=subprocess.STDOUT)

    def check(self) -> None:
        """Raise RosError with the last output if the run has ended."""
        if (code := self._process.poll()) is not None:
            raise RosError(f"humansim run has ended with exit code {code}: {self.output}")

    @property
    def output(self) -> str:
        """The end of the output of the processes."""
        self._output.seek(0)
        return self._output.read()[-_MAX_OUTPUT:].strip()

    def close(self) -> None:
        """Stop all processes."""
        self._process.terminate()  # it may ignore SIGINT, as a background job of a shell does
        try:
            self._process.wait(_END_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._output.close()
