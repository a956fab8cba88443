"""Run a case of a challenge: one process runs the nodes of its scene and collects the tracker's messages."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.data.evaluation import EstimateStream, ReadOptions, chosen_set, evaluate_poses, truth_at
from humansim_ros.data.messages import PoseFrame
from humansim_ros.errors import EvaluationError, show_warnings
from humansim_ros.ros.challenge.options import ChallengeOptions
from humansim_ros.ros.graph.transport import domain_environment
from humansim_ros.ros.processes.runtime import make_executor, prepare_transport
from humansim_ros.scene.core import Scene

#: Most messages of a tracker: this number per frame, plus this number per case. More messages are an error.
MAX_MESSAGES_PER_FRAME, MAX_MESSAGES = 50, 1000
#: If no message has arrived for this many seconds after the last frame, the tracker counts as finished.
_REST = 0.7
#: Seconds for which a case goes on after the tracker has ended, since its last messages still arrive.
_AFTER_END = 0.3
#: Seconds between two checks for subscribers of images.
_LOOK_EVERY = 0.5
#: Number of first frames that are not scored, to warm up; in a short case, a third of all frames.
_WARM_UP = 8


@dataclass(frozen=True)
class CaseOrder:
    """A case to run.

    Attributes:
        scene: Scene file.
        tracker: Process id of the tracker. The case ends when the tracker ends.
        frames: Number of frames.
        patience: Seconds that a frame in lockstep waits for the tracker.
        options: How the tracker is run.
    """

    scene: str
    tracker: int
    frames: int
    patience: float
    options: ChallengeOptions


class _Collector:
    """Collects the messages of a tracker, and the times at which frames were sent."""

    def __init__(self, order: CaseOrder, node: Any) -> None:
        from sensor_msgs.msg import TimeReference

        from humansim_ros.ros.graph.qos import DATA, SCENE_TIME
        from humansim_ros.ros.processes.estimate_topics import PoseTopics

        options = order.options
        points = chosen_set(options.keypoints, ())
        names = None if points is None else points.names
        self.stream = EstimateStream(options.topic)
        #: By stamp: scene time (nanoseconds), and time of the first arrival (seconds).
        self.frames: dict[int, int] = {}
        self.sent: dict[int, float] = {}
        self.messages = self.people = 0
        self.finite = False
        self.last = time.monotonic()
        self.fault = ""
        self.topics = PoseTopics(
            node,
            order.options.topic,
            ReadOptions(names, axes=order.options.axes, scale=order.options.scale),
            self._on_frame,
        )
        node.create_subscription(TimeReference, SCENE_TIME, self._on_time, DATA)

    def _on_time(self, message: Any) -> None:
        from humansim_ros.data.messages import read_scene_time, to_nanoseconds

        stamp = to_nanoseconds(message.header.stamp)
        self.frames[stamp] = read_scene_time(message)
        self.sent.setdefault(stamp, time.monotonic())

    def _on_frame(self, frame: PoseFrame, topic: str, person: str | None) -> None:
        self.messages += 1
        self.people += len(frame.people)
        self.finite = self.finite or any(np.isfinite(pose.positions).any() for pose in frame.people)
        self.last = time.monotonic()
        sent = None if frame.stamp is None else self.sent.get(frame.stamp)
        latency = None if sent is None else self.last - sent
        try:
            self.stream.add(frame, topic, time.monotonic_ns(), person, latency)
        except EvaluationError as error:
            self.fault = str(error)


def has_ended(process: int) -> bool:
    """Whether no process has this id. A zombie (dead, but not yet noticed by its parent) still counts."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except PermissionError:  # the process belongs to another user
        pass
    return False


def run_case(order: CaseOrder) -> dict[str, Any]:
    """Run a case. Returns values for its ``CaseResult`` by field name.

    Raises:
        HumansimError: The scene cannot be played on this machine.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from humansim_ros.ros.graph.guarded_node import GuardedNode
    from humansim_ros.ros.nodes.in_process import InProcessNodes
    from humansim_ros.ros.processes.lockstep_settings import TOPIC_PREFIX

    scene = Scene.load(Path(order.scene))
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node, nodes = None, None
    try:
        node = GuardedNode("humansim_challenge", start_parameter_services=False)
        collector = _Collector(order, node)
        executor = make_executor()
        executor.add_node(node)
        player: dict[str, Any] = {"mode": "realtime"}
        if not order.options.is_realtime:
            player = {
                "mode": "lockstep",
                "wait_for": [f"{TOPIC_PREFIX}{order.options.topic}"],
                "timeout": order.patience,
                "on_timeout": "continue",
                "frames": order.frames,
                "clock_search": 0.0,
            }
        start = time.monotonic()
        while not collector.topics.found and time.monotonic() < start + order.options.start_within:
            executor.spin_once(0.05)
            if has_ended(order.tracker):
                return {}
        nodes = InProcessNodes(scene, "", player, is_simulated=not order.options.is_realtime)
        for each in nodes.nodes:
            executor.add_node(each)
        start = time.monotonic()
        most = MAX_MESSAGES + MAX_MESSAGES_PER_FRAME * order.frames
        end = order.frames / scene.config.rate
        last, ended, next_look, sees = float("inf"), float("inf"), 0.0, False
        while time.monotonic() < last and collector.messages <= most:
            executor.spin_once(0.05)
            if not sees and time.monotonic() >= next_look:
                sees, next_look = _has_images(node), time.monotonic() + _LOOK_EVERY
            if has_ended(order.tracker):
                last = min(last, time.monotonic() + _AFTER_END)
            if order.options.is_realtime:
                first = min(collector.sent.values(), default=time.monotonic())
                is_over = time.monotonic() > first + end + _REST
            else:
                if nodes.has_ended:
                    ended = min(ended, time.monotonic())
                # the player may have read the last message before the collector does
                is_over = time.monotonic() > max(ended, collector.last) + _REST
                is_over |= nodes.has_ended and len(collector.stream) >= order.frames
            if is_over:
                break
        seconds = time.monotonic() - start
        return {**measured(order, scene, collector, most), "seconds": seconds, "sees": sees}
    finally:
        if nodes is not None:
            nodes.close()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _has_images(node: Any) -> bool:
    """Whether any node subscribes to a topic of images."""
    kinds = {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"}
    topics = (name for name, types in node.get_topic_names_and_types() if kinds & set(types))
    return any(node.count_subscribers(name) for name in topics)


def measured(order: CaseOrder, scene: Scene, collector: Any, most: int) -> dict[str, Any]:
    """Evaluate a case. Returns values for its ``CaseResult`` by field name.

    Args:
        order: The case.
        scene: Scene of the case.
        collector: Messages of the tracker, and times of the frames.
        most: Largest number of messages. With more, the case fails.
    """
    frames = dict(sorted(collector.frames.items()))
    result: dict[str, Any] = {"frames": len(frames), "estimates": len(collector.stream)}
    if collector.messages > most:
        result["failure"] = f"the tracker floods its topic: {collector.messages} messages"
        return result
    if not collector.messages:
        found = collector.topics.found
        result["failure"] = (
            f"the tracker published nothing that can be read on {order.options.topic}"
            if found
            else f"nobody published {order.options.topic} with a type that holds poses"
        )
        return result
    if not frames:
        result["failure"] = "no frame was sent"
        return result
    if collector.fault:
        result["failure"] = collector.fault
    if not collector.people:  # the tracker runs, but finds nobody
        return {**result, "pck": 0.0, "recall": 0.0}
    if not collector.finite:
        return {**result, "failure": "no position is finite: the tracker sends NaN"}
    try:
        result.update(_scores(order, scene, frames, collector.stream))
    except EvaluationError as error:
        result["failure"] = error.message
    return result


def _scores(order: CaseOrder, scene: Scene, frames: dict[int, int], stream: EstimateStream) -> dict[str, Any]:
    stamps = np.array(list(frames), np.int64)
    half = int(np.median(np.diff(stamps))) // 2 if len(stamps) > 1 else 0
    estimate = stream.sequence()
    latencies = estimate.arrivals.latencies if estimate.arrivals is not None else np.zeros(0)
    # everybody is missed in a frame without an estimate, also at the end
    own = estimate.times
    for stamp in stamps.tolist():
        if not (np.abs(own - stamp) <= half).any():
            stream.add(PoseFrame(stamp, "map", ()), "", 0)
    estimate = stream.sequence()
    # in the first frames, trackers load models, find the topics and confirm people; this varies between runs
    kept = stamps[min(_WARM_UP, len(stamps) // 3) :]
    estimate = estimate.since(int(kept[0]) - half)
    points = chosen_set(order.options.keypoints, estimate.names)
    times = np.array([frames[stamp] for stamp in kept.tolist()], np.int64)
    truth = truth_at(scene, times, kept, points)
    found = evaluate_poses(truth, estimate)
    return {
        "mpjpe": found.position.mpjpe,
        "pck": found.position.pck,
        "recall": found.people.recall,
        "precision": found.people.precision,
        "idf1": found.tracking.idf1 if found.tracking is not None else None,
        "switches": found.tracking.switches if found.tracking is not None else None,
        "latency": float(np.median(latencies)) if len(latencies) else None,
    }


@dataclass(frozen=True)
class CaseNodes:
    """The job of the process that runs the nodes of cases, one case after the other.

    Attributes:
        log: File for the output of the nodes.
        domain: ROS domain.
    """

    log: Path
    domain: int

    def start(self) -> CaseNodes:
        """Prepare this process. Raises HumansimError if ROS cannot be used."""
        with self.log.open("ab") as output:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
        os.environ.update(domain_environment(self.domain))
        show_warnings()
        prepare_transport(network=False)
        return self

    def work(self, order: CaseOrder | None) -> dict[str, Any]:
        """Run a case. Returns values for its ``CaseResult`` by field name; nothing for None."""
        return {} if order is None else run_case(order)

    def close(self) -> None:
        """Do nothing: each case ends its nodes."""
