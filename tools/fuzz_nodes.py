"""Fuzz the nodes: hostile messages, requests and parameters do not end or stall them, nor come out of them.

    python tools/fuzz_nodes.py [--messages 100000] [--seed 1] [--node camera] [--network]

All nodes of a small scene run in this process. Their subscriptions, services and parameters are taken from
the nodes themselves. Each gets messages of the running scene in which fields or bytes are replaced (see
message_mutations.py), some of them within an otherwise valid frame, so that they are rendered. Callbacks are
called as an executor does; with ``--network`` messages and requests go through ROS.

Findings: an exception that a reader has not foreseen, more than 100 ms of processor time of the node's thread
for one message, a published number that is not finite (NaN and infinity mean "unknown" in some topics),
memory that grows, and a node that does not process valid frames afterwards. They are written to the folder
``fuzz``, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import math
import os
import pickle
import random
import resource
import sys
import tempfile
import time
import traceback
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "test"), str(ROOT / "tools")]

from build_interfaces import built_interfaces  # noqa: E402
from geometry_msgs.msg import TwistStamped  # noqa: E402
from message_mutations import STRINGS, mutated, mutated_bytes  # noqa: E402
from rcl_interfaces.msg import Parameter as ParameterMessage  # noqa: E402
from rcl_interfaces.msg import ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.impl.rcutils_logger import RcutilsLogger  # noqa: E402
from rclpy.logging import LoggingSeverity  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.publisher import Publisher  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402
from ros_support import rclpy  # noqa: E402  claims a ROS domain, before the message packages are imported
from sensor_msgs.msg import CompressedImage, Image, PointCloud2  # noqa: E402
from sensor_msgs.srv import SetCameraInfo  # noqa: E402
from std_msgs.msg import Header, String  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

from humansim_ros.data import messages  # noqa: E402
from humansim_ros.data.messages.humans import joints_message, motion_message  # noqa: E402
from humansim_ros.ros.graph.guarded_node import GuardedNode  # noqa: E402
from humansim_ros.ros.graph.qos import CAMERA_ALIVE  # noqa: E402
from humansim_ros.ros.nodes.bridge import BridgeNode  # noqa: E402
from humansim_ros.ros.nodes.camera import CameraNode  # noqa: E402
from humansim_ros.ros.nodes.camera_rig import CameraRigNode  # noqa: E402
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode  # noqa: E402
from humansim_ros.ros.nodes.scanner import ScannerNode  # noqa: E402
from humansim_ros.ros.nodes.skinner import SkinnerNode  # noqa: E402

SCENE = """\
rate: 20
humans:
  anna: {motion: {file: walk, loop: continue}, face: {alive: true, keys: {gaze: left}}}
  bob: {body: adult_woman, motion: {file: live, position: [1.0, 0.5]}, face: {}}
objects:
  box: {size: [0.2, 0.4, 0.5], position: [0.5, 0, 0.3], keyframes: moves.xml}
cameras:
  alone: {size: [64, 48], position: [3.2, 0, 1.4], look_at: [0, 0, 1]}
  left: {size: [64, 48], position: [3.2, 0, 1.4], look_at: [0, 0, 1]}
  moving: {size: [64, 48], trajectory: way.txt, sensor: {exposure_time: 0.01, samples: 2}}
scanners:
  lidar: {pattern: {columns: 180}, rate: 20, range: [0.1, 20], position: [2, 0, 1]}
adapters:
  detections_2d: {}
  detections_3d: moving_optical_frame
  people: {}
  tracked_persons: {camera: left}
hri: {camera: left}
"""
#: Packages of the adapters, which are not on PyPI.
PACKAGES = ("vision_msgs", "people_msgs", "spencer_tracking_msgs", "hri_msgs", "tf2_msgs")
STATIC_SCENE = "cameras: {still: {size: [64, 48], position: [4, 0, 1.4], look_at: [0, 0, 1]}}"
MOVES = """\
<animation startframe="0" endframe="20" rate="10"><object name="box">
<frame number="0"><position x="0" y="-1" z="0"/></frame>
<frame number="20"><position x="0" y="1" z="0"/></frame></object></animation>
"""
#: Within the room, as all cameras: they see the people.
WAY = "0 3.2 0 1.4 0.5 0.5 -0.5 -0.5\n2 3.2 1 1.4 0.5 0.5 -0.5 -0.5\n"
#: Milliseconds of processor time of the node's thread for one message.
LIMIT_MS = 100.0
#: Megabytes by which the process may grow after the first tenth of the messages.
LIMIT_GROWTH = 100.0
#: Images that are rendered, as if somebody subscribed to them.
_RENDERED = ("image_raw", "depth/image", "flow/image", "cropped")
_PERIOD = 50_000_000
#: Seconds in which a camera must be able to show valid frames again.
_RECOVERY = 5.0
#: Share of messages to a camera that come within an otherwise valid frame, and of timers that are called.
_IN_FRAMES, _TIMERS = 0.15, 0.03
#: Nodes that join the messages of a frame.
_OF_FRAMES = ("camera", "camera_rig", "static_camera", "scanner", "bridge")
#: Topics of the bridge.
_BRIDGED = (
    *("/left/detections_2d", "/detections_3d", "/people", "/spencer/perception/tracked_persons"),
    *("/humans/bodies/tracked", "/humans/bodies/b_anna/skeleton2d", "/humans/bodies/b_anna/cropped"),
)
#: Topics and services that all nodes have, and that rclpy handles alone.
_OF_RCLPY = ("/parameter_events", "/rosout", "/clock")
#: Texts for parameters.
_TEXTS = [
    *(
        "walk",
        "walk_straight",
        "live",
        "",
        "none",
        "repeat",
        "continue",
        "nothing",
        "scene.yaml",
        "moves.xml",
    ),
    *("/etc/passwd", "/dev/zero", "/dev/null", "/dev/stdin", "..", "/", "fifo", "x" * 5000, "\0", "walk\n"),
]


@dataclass
class Endpoint:
    """Subscription or service of a node, and what its messages have cost.

    Attributes:
        name: Node and topic, or node and service.
        topic: Name of the topic or service.
        kind: Its message or service type.
        call: Gives it a message or a request; with bytes, a serialised message.
        make: Makes a valid message or request.
        takes_bytes: It is a subscription.
        in_frames: Some messages come within an otherwise valid frame.
        messages: Number of hostile ones.
        refused: Number of those with an error in the log or the response.
        unforeseen: Number of those with an exception that only the guard of all callbacks has caught.
        slowest: Milliseconds of processor time of the node's thread.
        megabytes: Largest growth of the peak of memory.
    """

    name: str
    topic: str
    kind: Any
    call: Callable[[Any], Any]
    make: Callable[[random.Random], Any]
    takes_bytes: bool
    in_frames: bool
    messages: int = 0
    refused: int = 0
    unforeseen: int = 0
    slowest: float = 0.0
    megabytes: float = 0.0


@dataclass
class Finding:
    """Message that has done harm. ``message``: the message, or its bytes."""

    endpoint: str
    what: str
    message: Any


class Watcher:
    """Watches everything that the nodes publish and log."""

    def __init__(self) -> None:
        self.newest: dict[str, Any] = {}
        self.stamps: dict[str, int] = {}
        self.not_finite: list[str] = []
        self.errors = 0
        self.last_error = ""
        self.unforeseen: list[str] = []
        # seconds of processor time of this class
        self.seconds = 0.0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Context manager that replaces publishing and logging of all nodes of the process."""
        publish, log_fault = Publisher.publish, GuardedNode._log_fault

        def watched_publish(publisher: Any, message: Any) -> None:
            self._watch(publisher.topic_name, message)
            publish(publisher, message)

        def watched_fault(node: Any, source: str, text: str, unexpected: bool) -> None:
            if unexpected:
                self.unforeseen.append(f"{source}: {text}\n{traceback.format_exc()}")
            log_fault(node, source, text, unexpected)

        def watched_log(_: Any, message: str, severity: Any, **options: Any) -> bool:
            if severity >= LoggingSeverity.ERROR:
                self.errors += 1
                self.last_error = message
            return True

        def subscribers(publisher: Any) -> int:
            images = publisher.msg_type in (Image, CompressedImage)
            return int(not images or publisher.topic_name.endswith(_RENDERED))

        with ExitStack() as patches:
            patches.enter_context(patch.object(Publisher, "publish", watched_publish))
            patches.enter_context(patch.object(Publisher, "get_subscription_count", subscribers))
            patches.enter_context(patch.object(RcutilsLogger, "log", watched_log))
            patches.enter_context(patch.object(GuardedNode, "_log_fault", watched_fault))
            yield

    def _watch(self, topic: str, message: Any) -> None:
        start = time.thread_time()
        self.newest[topic] = message
        if hasattr(message, "header"):
            self.stamps[topic] = messages.to_nanoseconds(message.header.stamp)
        # rclpy publishes all parameters that it has accepted
        reason = "" if topic == "/parameter_events" else not_finite(topic, message)
        if reason:
            self.not_finite.append(f"{topic}: {reason}")
        self.seconds += time.thread_time() - start

    def faults(self) -> list[str]:
        """Descriptions of all faults since the last call."""
        found = [f"only the guard caught {text}" for text in self.unforeseen]
        found += [f"not finite: {text}" for text in self.not_finite]
        self.unforeseen, self.not_finite = [], []
        return found


def not_finite(topic: str, message: Any) -> str:
    """Number of a published message that is not finite, and that no subscriber expects; or empty."""
    if isinstance(message, Image):
        if not message.encoding.startswith("32F"):
            return ""
        pixels = np.frombuffer(message.data, np.float32)
        # +inf: no surface; NaN: no flow
        allowed = pixels == np.inf if topic.endswith("depth/image") else np.isnan(pixels)
        return "" if (np.isfinite(pixels) | allowed).all() else "a pixel"
    if isinstance(message, PointCloud2):
        points = messages.read_points(message, ())
        for name in points.dtype.names or ():
            values = points[name].astype(float)
            # pixels of joints behind a camera are NaN, and there is no surface behind some joints
            if (
                name != "behind"
                and not (np.isfinite(values) | (np.isnan(values) & (not message.is_dense))).all()
            ):
                return name
        return ""
    if isinstance(message, TwistStamped):  # NaN: an unknown velocity
        return "infinite" if any(map(math.isinf, _numbers(message))) else ""
    if isinstance(message, String):
        return next((word for word in ("NaN", "Infinity") if word in message.data), "")
    if isinstance(message, MarkerArray):
        points = [(p.x, p.y, p.z) for marker in message.markers for p in marker.points]
        return "" if np.isfinite(points).all() else "a point"
    return "a number" if not all(map(math.isfinite, _numbers(message))) else ""


def _numbers(value: Any) -> Iterator[float]:
    """Floating-point numbers of a message."""
    if isinstance(value, float):
        yield value
    elif hasattr(value, "get_fields_and_field_types"):
        for name in value.get_fields_and_field_types():
            yield from _numbers(getattr(value, name))
    elif isinstance(value, np.ndarray):
        yield from value.ravel().tolist()
    elif isinstance(value, (list, array)) and value and not isinstance(value[0], (int, str)):
        for element in value:
            yield from _numbers(element)


class DirectExecutor(SingleThreadedExecutor):
    """Executor whose tasks are run by :meth:`run_tasks`, after each message."""

    def __init__(self) -> None:
        super().__init__()
        self._direct: list[Callable[[], Any]] = []

    def create_task(self, callback: Any, *arguments: Any, **options: Any) -> Any:
        self._direct.append(partial(callback, *arguments, **options))

    def run_tasks(self) -> None:
        while self._direct:
            self._direct.pop(0)()


class Stage:
    """All nodes of a scene, a static one, and valid messages for each of their topics."""

    def __init__(self, folder: Path, watcher: Watcher) -> None:
        self.watcher = watcher
        self.executor = DirectExecutor()
        files = {"moves.xml": MOVES, "way.txt": WAY, "scene.yaml": SCENE, "static.yaml": STATIC_SCENE}
        for name, text in files.items():
            (folder / name).write_text(text)
        os.mkfifo(folder / "fifo")
        os.environ["ROS_HOME"] = str(folder / "ros_home")
        scene, static = str(folder / "scene.yaml"), str(folder / "static.yaml")
        self.player = _node(MotionPlayerNode, scene)
        self.nodes: dict[str, Any] = {
            "motion_player": self.player,
            "skinner": _node(SkinnerNode, scene, "skinner_anna", human="anna", marker_rate=1.0),
            "live_skinner": _node(SkinnerNode, scene, "skinner_bob", human="bob", marker_rate=1.0),
            "camera": _node(CameraNode, scene, "alone", camera="alone"),
            "camera_rig": _node(CameraRigNode, scene, cameras=["left", "moving"]),
            "static_camera": _node(CameraNode, static, "still", camera="still"),
            "scanner": _node(ScannerNode, scene, "lidar", scanner="lidar"),
            "bridge": _node(BridgeNode, scene),
        }
        for node in self.all_nodes():
            self.executor.add_node(node)
            node.executor = self.executor
        # stamps far from the clock, so that skinners do not sleep until them
        self.stamp = self.player.now() + 1000 * 10**9
        self.seeds: dict[str, Any] = {}
        #: Milliseconds of processor time of a valid frame, by camera node.
        self.frame_ms: dict[str, float] = {}
        self._make_seeds()

    def all_nodes(self) -> list[Any]:
        """All nodes, with the cameras of the rig."""
        return [each for node in self.nodes.values() for each in node.nodes]

    def _make_seeds(self) -> None:
        """Messages of a running scene: the player's first, then those that they cause."""
        self.player.playing.work()
        actor, camera = self.player.scene.actors["bob"], self.player.scene.scene_cameras["moving"]
        pose = (
            camera.pose_at(0.0)
            if hasattr(camera, "pose_at")
            else messages.read_pose(self.newest("moving/pose"))
        )
        self.seeds = {
            "/alone/pose": messages.pose_message(pose, 0),
            "/left/pose": messages.pose_message(pose, 0),
            "/still/pose": messages.pose_message(pose, 0),
            "/humans/bob/motion": motion_message(_poses(actor), 0),
            "/frame_done": Header(frame_id="/alone"),
            f"/{CAMERA_ALIVE}": Header(),
            "/humans/anna/frame": Header(frame_id="map"),
            "/humans/bob/frame": Header(frame_id="map"),
        }
        self.seeds |= {
            topic: self.watcher.newest[topic] for topic in self.watcher.newest if topic not in self.seeds
        }
        for name, human in (("skinner", "anna"), ("live_skinner", "bob")):
            self.send(self.nodes[name], f"/humans/{human}/motion", self.valid(f"/humans/{human}/motion"))
            for part in ("joints", "vertices", "face"):
                self.seeds[f"/humans/{human}/{part}"] = self.newest(f"humans/{human}/{part}")

    def newest(self, topic: str) -> Any:
        """Newest published message of a topic."""
        return self.watcher.newest[f"/{topic}"]

    def valid(self, topic: str, stamp: int | None = None) -> Any:
        """Valid message of a topic with a stamp, by default the present one."""
        message = self.seeds[topic] if topic in self.seeds else self.watcher.newest[topic]
        stamp = self.stamp if stamp is None else stamp
        if isinstance(message, Header):
            message.stamp = messages.to_time(stamp)
        elif hasattr(message, "header"):
            message.header.stamp = messages.to_time(stamp)
        return message

    def send(self, node: Any, topic: str, message: Any) -> None:
        """Give a message to all subscriptions of a node to a topic."""
        data = serialize_message(message)
        for each in node.nodes:
            for subscription in each.subscriptions:
                if subscription.topic_name == topic:
                    _deliver(subscription, data)
        self.executor.run_tasks()

    def topics(self, name: str) -> list[str]:
        """Topics of a node, besides those of rclpy."""
        topics = (s.topic_name for node in self.nodes[name].nodes for s in node.subscriptions)
        return [topic for topic in dict.fromkeys(topics) if topic not in _OF_RCLPY]

    def endpoints(self, name: str) -> list[Endpoint]:
        """Subscriptions and services of a node."""
        found = []
        for node in self.nodes[name].nodes:
            for subscription in node.subscriptions:
                if subscription.topic_name not in _OF_RCLPY:
                    topic = subscription.topic_name
                    label = f"{node.get_name()} {topic}"
                    found.append(
                        Endpoint(
                            label,
                            topic,
                            subscription.msg_type,
                            partial(_deliver, subscription),
                            partial(self._message, topic),
                            True,
                            name in _OF_FRAMES,
                        )
                    )
            for service in node.services:
                label = f"{node.get_name()} {service.service_name} (service)"
                kind = service.srv_type
                make = partial(self._request, node, kind)
                call = partial(_serve, service)
                found.append(Endpoint(label, service.service_name, kind, call, make, False, False))
        return found

    def _message(self, topic: str, _: random.Random) -> Any:
        return self.valid(topic)

    def _request(self, node: Any, kind: Any, source: random.Random) -> Any:
        request = kind.Request()
        if kind is SetCameraInfo:
            request.camera_info = self.newest(f"{node.get_name()}/camera_info")
        elif hasattr(request, "parameters"):
            count = source.choice((1, 1, 1, 2, 5))
            request.parameters = [_parameter(node, source) for _ in range(count)]
        elif hasattr(request, "names"):
            request.names = [_parameter(node, source).name for _ in range(source.choice((1, 3)))]
        return request

    # --- valid use

    def next_frame(self) -> int:
        """Stamp of the next frame."""
        self.stamp += _PERIOD
        return self.stamp

    def send_frame(self, name: str, hostile: dict[str, Any] | None = None) -> int:
        """Give a camera all messages of a frame; returns its stamp.

        ``hostile``: serialised messages that replace valid ones, by topic.
        """
        stamp = self.next_frame()
        for topic in self.topics(name):
            if hostile and topic in hostile:
                for each in self.nodes[name].nodes:
                    for subscription in each.subscriptions:
                        if subscription.topic_name == topic:
                            _deliver(subscription, hostile[topic])
                self.executor.run_tasks()
            else:
                self.send(self.nodes[name], topic, self.valid(topic, stamp))
        return stamp

    def measure_frames(self) -> None:
        """Measure the processor time of a valid frame of each camera node."""
        for name in (name for name in self.nodes if name in _OF_FRAMES):
            times = []
            for _ in range(10):
                start, watched = time.thread_time(), self.watcher.seconds
                self.send_frame(name)
                times.append(1e3 * (time.thread_time() - start - self.watcher.seconds + watched))
            self.frame_ms[name] = min(times)

    def check(self, name: str) -> str:
        """Reason why a node does not process valid frames any more, or empty."""
        if name == "motion_player":
            return self._check_player()
        if "skinner" in name:
            return self._check_skinner(name)
        node = self.nodes[name]
        for each in node.nodes:
            _reset(each)
        cameras = [each.get_name() for each in node.nodes if isinstance(each, CameraNode)]
        answers = [f"/{camera}/image_raw" for camera in cameras] if name != "bridge" else list(_BRIDGED)
        end = time.monotonic() + _RECOVERY
        while True:
            stamp = self.send_frame(name)
            waiting = [topic for topic in answers if self.watcher.stamps.get(topic) != stamp]
            if not waiting or time.monotonic() > end:
                return f"no message of a valid frame on {', '.join(waiting)}" if waiting else ""
            time.sleep(0.01)

    def _check_player(self) -> str:
        _reset(self.player)
        services = {s.service_name.rpartition("/")[2]: s for s in self.player.services}
        self.watcher.newest.pop("/humans/anna/motion", None)
        _serve(services["pause"], SetBool.Request(data=True))
        response = _serve(services["step"], Trigger.Request())
        _serve(services["pause"], SetBool.Request(data=False))
        sent = self.watcher.newest.get("/humans/anna/motion")
        return "" if response.success and sent else f"no motion after a step: {response.message}"

    def _check_skinner(self, name: str) -> str:
        node, human = self.nodes[name], "bob" if name == "live_skinner" else "anna"
        _reset(node)
        topic = f"/humans/{human}"
        self.send(node, f"{topic}/motion/legend", self.valid(f"{topic}/motion/legend"))
        for _ in range(200):  # another person is accepted after up to 80 frames
            stamp = self.next_frame()
            self.send(node, f"{topic}/motion", self.valid(f"{topic}/motion"))
            if name == "live_skinner":
                self.send(node, f"{topic}/frame", self.valid(f"{topic}/frame"))
            if self.watcher.stamps.get(f"{topic}/joints") == stamp:
                return ""
        return "no joints after 200 valid motions"

    def close(self) -> None:
        for node in self.nodes.values():
            node.close()
            node.destroy_node()
        self.executor.shutdown()


def _node(kind: Callable[..., Any], scene: str, name: str = "", **parameters: Any) -> Any:
    given = [Parameter(key, value=value) for key, value in {"scene": scene, **parameters}.items()]
    rename = {"cli_args": ["--ros-args", "-r", f"__node:={name}"]} if name else {}
    return kind(parameter_overrides=given, **rename)


def _poses(actor: Any) -> Any:
    """Joints of a live human in a pose, as a motion capture system sends them."""
    return messages.read_joints(joints_message(actor.at(0.0), 0))


def _deliver(subscription: Any, data: bytes) -> None:
    """Give a serialised message to a subscription, as an executor does."""
    subscription.callback(data if subscription.raw else deserialize_message(data, subscription.msg_type))


def _serve(service: Any, request: Any) -> Any:
    return service.callback(request, service.srv_type.Response())


def _parameter(node: Any, source: random.Random) -> ParameterMessage:
    """Parameter of a node with a value that may be valid, out of range or of another type."""
    name = source.choice([*node._parameters, "nothing", ""])
    value = ParameterValue(type=source.randrange(10))
    if name in node._parameters and source.random() < 0.8:
        value.type = node._parameters[name].type_.value
    value.bool_value = source.random() < 0.5
    value.integer_value = source.choice((0, 1, -1, 5, 2**63 - 1, -(2**63)))
    value.double_value = source.choice((0.0, 0.5, 1.0, 20.0, 1e-9, 1e6, 1e300, -1.0, math.nan, math.inf))
    value.string_value = source.choice((*_TEXTS, source.choice(STRINGS)))
    value.string_array_value = ["left"] * source.choice((0, 1, 1000))
    return ParameterMessage(name=name, value=value)


def _reset(node: Any) -> None:
    """Set all parameters to the values of the start."""
    if not hasattr(node, "_fuzz_start"):
        return
    (service,) = (s for s in node.services if s.service_name.endswith("/set_parameters"))
    _serve(service, SetParameters.Request(parameters=node._fuzz_start))


def _remember_parameters(node: Any) -> None:
    read_only = {name for name in node._parameters if node.describe_parameter(name).read_only}
    node._fuzz_start = [
        parameter.to_parameter_msg()
        for name, parameter in node._parameters.items()
        if name not in read_only
        and parameter.type_.value != ParameterType.PARAMETER_NOT_SET
        and name != "seek"
    ]


@dataclass
class Fuzzer:
    """Gives hostile messages to a stage, and collects what they do."""

    stage: Stage
    source: random.Random
    findings: list[Finding] = field(default_factory=list)

    def run(self, name: str, count: int) -> list[Endpoint]:
        """Give ``count`` messages to a node; returns its endpoints with what they have cost."""
        endpoints = self.stage.endpoints(name)
        watched = self.stage.nodes[name].nodes
        weights = [_weight(endpoint) for endpoint in endpoints]
        warm_up = count // 10
        resident = 0.0
        for number in range(count):
            if number == warm_up:
                resident = _resident()
            self._one(name, self.source.choices(endpoints, weights)[0])
            if self.source.random() < _TIMERS:
                node = self.source.choice(watched)
                for timer in list(node.timers):
                    timer.callback()
                self.stage.executor.run_tasks()
            if number % 500 == 499:
                self._check(name)
        self._check(name)
        if (growth := _resident() - resident) > LIMIT_GROWTH:
            self.findings.append(Finding(name, f"memory grew by {growth:.0f} MB", None))
        return endpoints

    def run_network(self, name: str, count: int) -> list[Endpoint]:
        """As :meth:`run`, through ROS, while all nodes run."""
        client = rclpy.create_node("fuzzer")
        self.stage.executor.add_node(client)
        endpoints = self.stage.endpoints(name)
        for endpoint in endpoints:
            endpoint.call, endpoint.in_frames = self._sender(client, endpoint), False
        node = self.stage.nodes[name]
        for _ in range(count):
            self._one(name, self.source.choice(endpoints))
            for _ in range(8):
                with node.guard("executor", "it goes on"):
                    self.stage.executor.spin_once(timeout_sec=0.002)
        self._check(name)
        self.stage.executor.remove_node(client)
        client.destroy_node()
        return endpoints

    def _sender(self, client: Any, endpoint: Endpoint) -> Callable[[Any], None]:
        """Function that sends to an endpoint, which has been discovered."""
        if endpoint.takes_bytes:
            publisher = client.create_publisher(endpoint.kind, endpoint.topic, 10)
            self._wait(lambda: client.count_subscribers(endpoint.topic) > 0)
            return publisher.publish
        caller = client.create_client(endpoint.kind, endpoint.topic)
        self._wait(caller.service_is_ready)
        return lambda request: caller.call_async(request) and None

    def _wait(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + 30
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError("a topic or service of the nodes has not been discovered")
            self.stage.executor.spin_once(timeout_sec=0.01)

    def _check(self, name: str) -> None:
        try:
            reason = self.stage.check(name)
        except Exception:
            reason = traceback.format_exc()
        if reason:
            self.findings.append(
                Finding(name, f"is broken: {reason} ({self.stage.watcher.last_error})", None)
            )
        self.findings += [
            Finding(name, f"valid frames: {text}", None) for text in self.stage.watcher.faults()
        ]

    def _one(self, name: str, endpoint: Endpoint) -> None:
        """Give one hostile message to an endpoint."""
        if self.source.random() < 0.5:
            self.stage.next_frame()
        message = endpoint.make(self.source)
        if self.source.random() < 0.95 or endpoint.takes_bytes:
            try:
                message = mutated(message, self.source)
            except AssertionError:  # a value that the message type refuses
                return
        content: Any = message
        if endpoint.takes_bytes:
            content = serialize_message(message)
            if self.source.random() < 0.3:
                content = mutated_bytes(content, self.source)
        milliseconds = self._give(name, endpoint, content)
        if milliseconds > LIMIT_MS:  # once more: the first may have met a garbage collection
            milliseconds = min(milliseconds, self._give(name, endpoint, content))
        endpoint.messages += 1
        endpoint.slowest = max(endpoint.slowest, milliseconds)
        if milliseconds > LIMIT_MS:
            self.findings.append(Finding(endpoint.name, f"took {milliseconds:.0f} ms", content))

    def _give(self, name: str, endpoint: Endpoint, content: Any) -> float:
        """Give a message to an endpoint, and return milliseconds of processor time."""
        watcher = self.stage.watcher
        errors, watched, peak = watcher.errors, watcher.seconds, _peak()
        in_frame = endpoint.in_frames and self.source.random() < _IN_FRAMES
        response, faults = None, []
        start = time.thread_time()
        try:
            if in_frame:
                self.stage.send_frame(name, {endpoint.topic: content})
            else:
                response = endpoint.call(content)
            self.stage.executor.run_tasks()
        except Exception:
            faults.append(traceback.format_exc())
        took = 1e3 * (time.thread_time() - start - watcher.seconds + watched)
        if in_frame:
            took -= self.stage.frame_ms[name]
        endpoint.megabytes = max(endpoint.megabytes, _peak() - peak)
        endpoint.refused += watcher.errors > errors or _is_refused(response)
        faults += watcher.faults()
        endpoint.unforeseen += bool(faults)
        self.findings += [Finding(endpoint.name, text, content) for text in faults]
        return took


def _weight(endpoint: Endpoint) -> int:
    """Share of the messages for an endpoint: few for the services in which rclpy tells about parameters."""
    only_tells = endpoint.topic.rpartition("/")[2].startswith(("get_", "list_", "describe_"))
    return 1 if only_tells else 5


def _is_refused(response: Any) -> bool:
    if hasattr(response, "success"):
        return not response.success
    results = getattr(response, "results", None) or [getattr(response, "result", None)]
    return any(getattr(result, "successful", True) is False for result in results)


def _peak() -> float:
    """Largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _resident() -> float:
    """Present memory of this process, MB, without freed memory that the C library keeps."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


@contextmanager
def running_stage() -> Iterator[Stage]:
    """Context manager with all nodes. Packages of messages that are missing are built."""
    for package in PACKAGES:
        if find_spec(package) is None:
            sys.path.insert(0, str(built_interfaces(package)))
    watcher = Watcher()
    if not rclpy.ok():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    with tempfile.TemporaryDirectory(prefix="humansim_fuzz_") as folder, watcher.watching():
        stage = Stage(Path(folder), watcher)
        for node in stage.all_nodes():
            _remember_parameters(node)
        for name in stage.nodes:  # shaders and caches
            if reason := stage.check(name):
                raise RuntimeError(f"{name}, before the fuzzing: {reason}")
        if faults := watcher.faults():
            raise RuntimeError(f"before the fuzzing: {faults}")
        stage.measure_frames()
        gc.collect()
        gc.freeze()
        try:
            yield stage
        finally:
            stage.close()


def report(name: str, endpoints: Sequence[Endpoint]) -> str:
    """Table of the endpoints of a node."""
    lines = [f"{name}: {sum(e.messages for e in endpoints)} messages"]
    lines.append(f"  {'messages':>8} {'refused':>8} {'unforeseen':>10} {'slowest ms':>10} {'MB':>6}")
    for e in endpoints:
        lines.append(
            f"  {e.messages:8} {e.refused:8} {e.unforeseen:10} {e.slowest:10.1f} {e.megabytes:6.1f}  {e.name}"
        )
    return "\n".join(lines)


def save(findings: Sequence[Finding], folder: Path) -> None:
    """Write the first findings, each with its message, and print each kind once."""
    kinds: dict[tuple[str, str], int] = {}
    for number, finding in enumerate(findings):
        kind = (finding.endpoint, finding.what.strip().splitlines()[-1][:80])
        kinds[kind] = kinds.get(kind, 0) + 1
        if kinds[kind] == 1:
            folder.mkdir(exist_ok=True)
            (folder / f"nodes_{number}.pickle").write_bytes(pickle.dumps(finding))
            print(f"--- {finding.endpoint} ({folder / f'nodes_{number}.pickle'})\n{finding.what}")
    for (endpoint, what), count in kinds.items():
        print(f"{count} times: {endpoint}: {what}")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--messages", type=int, default=100_000, help="number for all nodes together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--node", action="append", help="only this node; default: all")
    parser.add_argument("--network", action="store_true", help="send through ROS; a tenth as fast")
    options = parser.parse_args()
    with running_stage() as stage:
        names = options.node or list(stage.nodes)
        fuzzer = Fuzzer(stage, random.Random(options.seed))
        for name in names:
            start, cpu = time.monotonic(), time.process_time()
            run = fuzzer.run_network if options.network else fuzzer.run
            print(report(name, run(name, options.messages // len(names))), flush=True)
            print(f"  {time.monotonic() - start:.0f} s, {time.process_time() - cpu:.0f} s of processor time")
    save(fuzzer.findings, Path("fuzz"))
    rclpy.try_shutdown()
    return int(bool(fuzzer.findings))


if __name__ == "__main__":
    sys.exit(main())
