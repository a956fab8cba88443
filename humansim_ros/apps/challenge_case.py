"""Nodes of one case of a challenge after the other in this process, and what a tracker publishes meanwhile.

    python -m humansim_ros.apps.challenge_case

Each line of standard input is a case as JSON (:class:`CaseOrder`), or the word ``stop``, which ends the case
in progress. Each case is answered by a line of JSON on standard output, when its nodes are gone.
"""

from __future__ import annotations

import json
import os
import select
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import EvaluationError, HumansimError, show_warnings
from humansim_ros.evaluate.evaluation import evaluate_poses
from humansim_ros.evaluate.joint_names import set_of_names
from humansim_ros.evaluate.readers.pose_files import ReadOptions
from humansim_ros.evaluate.stream import EstimateStream
from humansim_ros.evaluate.truth import truth_at
from humansim_ros.keypoints import keypoint_set
from humansim_ros.messages.people import PoseFrame
from humansim_ros.scene import Scene

#: Most messages of a tracker for each frame, and for a case besides: more are a flood.
MAX_MESSAGES_PER_FRAME, MAX_MESSAGES = 50, 1000
#: Seconds without a message after which nothing of the last frames is expected.
_REST = 0.7


@dataclass(frozen=True)
class CaseOrder:
    """A case to run.

    Attributes:
        scene: Scene file.
        domain: ROS domain.
        topic: Topic of the estimate.
        frames: Number of frames.
        patience: Seconds that a frame in lockstep waits for the tracker.
        start_within: Seconds until the topic must have a publisher.
        is_realtime: Frames follow the wall clock.
        keypoints: Keypoint set of the estimate; None: as its names say.
        scale: Metres of a unit of the estimate.
        axes: Axes of the estimate; None: the axes of ``map``.
    """

    scene: str
    domain: int
    topic: str
    frames: int
    patience: float
    start_within: float
    is_realtime: bool
    keypoints: str | None
    scale: float = 1.0
    axes: str | None = None


class _Orders:
    """Lines of standard input, without waiting."""

    def __init__(self) -> None:
        self._rest = b""
        self.is_closed = False

    def next_line(self, wait: float = 0.0) -> str | None:
        """The next line; None if there is none within ``wait`` seconds."""
        while b"\n" not in self._rest:
            if self.is_closed or not select.select([0], [], [], wait)[0]:
                return None
            part = os.read(0, 65536)
            self.is_closed = not part
            self._rest += part
        line, self._rest = self._rest.split(b"\n", 1)
        return line.decode()

    @property
    def is_stopped(self) -> bool:
        """Whether the case in progress must end."""
        return self.next_line() is not None or self.is_closed


class _Collector:
    """Messages of a tracker, and times of the frames."""

    def __init__(self, order: CaseOrder, node: Any) -> None:
        from sensor_msgs.msg import TimeReference

        from humansim_ros.ros.estimate_topics import PoseTopics
        from humansim_ros.ros.qos import DATA, SCENE_TIME

        names = keypoint_set(order.keypoints).names if order.keypoints else None
        self.stream = EstimateStream(order.topic)
        #: Scene time and time of the first arrival by stamp; nanoseconds and seconds.
        self.frames: dict[int, int] = {}
        self.sent: dict[int, float] = {}
        self.messages = self.people = 0
        self.finite = False
        self.last = time.monotonic()
        self.fault = ""
        self.topics = PoseTopics(
            node, order.topic, ReadOptions(names, axes=order.axes, scale=order.scale), self._on_frame
        )
        node.create_subscription(TimeReference, SCENE_TIME, self._on_time, DATA)

    def _on_time(self, message: Any) -> None:
        from humansim_ros.messages import read_scene_time, to_nanoseconds

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


def run_case(order: CaseOrder, is_stopped: Callable[[], bool]) -> dict[str, Any]:
    """Run a case; keys of its result, as of ``CaseResult``.

    Raises:
        HumansimError: The scene cannot be played on this machine.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from humansim_ros.ros.guarded_node import GuardedNode
    from humansim_ros.ros.lockstep.settings import TOPIC_PREFIX
    from humansim_ros.ros.nodes.in_process import InProcessNodes
    from humansim_ros.ros.runtime import make_executor

    scene = Scene.load(Path(order.scene))
    os.environ["ROS_DOMAIN_ID"] = str(order.domain)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node, nodes = None, None
    try:
        node = GuardedNode("humansim_challenge", start_parameter_services=False)
        collector = _Collector(order, node)
        executor = make_executor()
        executor.add_node(node)
        player: dict[str, Any] = {"mode": "realtime"}
        if not order.is_realtime:
            player = {
                "mode": "lockstep",
                "wait_for": [f"{TOPIC_PREFIX}{order.topic}"],
                "timeout": order.patience,
                "on_timeout": "continue",
                "frames": order.frames,
                "clock_search": 0.0,
            }
        start = time.monotonic()
        while not collector.topics.found and time.monotonic() < start + order.start_within:
            executor.spin_once(0.05)
            if is_stopped():
                return {}
        nodes = InProcessNodes(scene, "", player, is_simulated=not order.is_realtime)
        for each in nodes.nodes:
            executor.add_node(each)
        start = time.monotonic()
        most = MAX_MESSAGES + MAX_MESSAGES_PER_FRAME * order.frames
        end = order.frames / scene.config.rate
        stopped = False
        while not (stopped or collector.messages > most):
            executor.spin_once(0.05)
            stopped = is_stopped()
            if order.is_realtime:
                first = min(collector.sent.values(), default=time.monotonic())
                is_over = time.monotonic() > first + end + _REST
            else:
                is_over = nodes.has_ended and time.monotonic() > collector.last + _REST
                is_over |= nodes.has_ended and len(collector.stream) >= order.frames
            if is_over:
                break
        seconds = time.monotonic() - start
        return {**measured(order, scene, collector, most), "seconds": seconds}
    finally:
        if nodes is not None:
            nodes.close()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def measured(order: CaseOrder, scene: Scene, collector: Any, most: int) -> dict[str, Any]:
    """Keys of the result of a case, as of ``CaseResult``.

    Args:
        order: The case.
        scene: Its scene.
        collector: Messages of the tracker, and times of the frames.
        most: Number of messages beyond which it floods.
    """
    frames = dict(sorted(collector.frames.items()))
    result: dict[str, Any] = {"frames": len(frames), "estimates": len(collector.stream)}
    if collector.messages > most:
        result["failure"] = f"the tracker floods its topic: {collector.messages} messages"
        return result
    if not collector.messages:
        found = collector.topics.found
        result["failure"] = (
            f"the tracker published nothing that can be read on {order.topic}"
            if found
            else f"nobody published {order.topic} with a type that holds poses"
        )
        return result
    if not frames:
        result["failure"] = "no frame was sent"
        return result
    if collector.fault:
        result["failure"] = collector.fault
    if not collector.people:  # the tracker runs, and finds nobody
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
    # everybody is missed in a frame without an estimate, at the end, too
    own = estimate.times
    for stamp in stamps.tolist():
        if not (np.abs(own - stamp) <= half).any():
            stream.add(PoseFrame(stamp, "map", ()), "", 0)
    estimate = stream.sequence()
    points = keypoint_set(order.keypoints) if order.keypoints else set_of_names(estimate.names)
    truth = truth_at(scene, np.array(list(frames.values()), np.int64), stamps, points)
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


def main() -> int:
    """Run the cases of standard input until it is closed."""
    from humansim_ros.ros.runtime import prepare_transport

    show_warnings()
    prepare_transport(network=False)
    orders = _Orders()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # libraries print to standard output
    while not orders.is_closed:
        line = orders.next_line(1.0)
        if line is None or line == "stop":
            continue
        try:
            answer = run_case(CaseOrder(**json.loads(line)), lambda: orders.is_stopped)
        except HumansimError as error:
            answer = {"error": str(error)}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
