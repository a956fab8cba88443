"""Node ``evaluator``: compares the estimate of a tracker with the truth while both are published.

Subscribes to the topic of the estimate (docs/evaluation.md) and to the truth: the topics
``humans/<id>/joints`` or ``humans/<id>/keypoints/<set>``, unless parameter ``scene`` names a scene with a
truth that is computed. Publishes the errors of the last seconds and of the whole run on ``evaluation``, and
writes the errors of the run to a JSON file when it is stopped. Frames in lockstep do not wait for it:
messages wait in the queues of its subscriptions.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import TimeReference

from humansim_ros.data.evaluation import (
    DEFAULT_GATE,
    Evaluation,
    LiveEvaluation,
    LiveOptions,
    ReadOptions,
    SceneTruth,
    show,
)
from humansim_ros.data.messages import PoseFrame, to_nanoseconds
from humansim_ros.errors import EvaluationError, RosError, printable
from humansim_ros.files.reading import write_file
from humansim_ros.ros.graph.qos import DATA, SCENE_TIME, subscription_profile
from humansim_ros.ros.processes.estimate_topics import PoseTopics
from humansim_ros.ros.processes.node import SuiteNode, loaded_scene
from humansim_ros.scene.core import Scene

#: While frames arrive, a tracker counts as silent after this time without an estimate, seconds.
_SILENT_AFTER = 2.0
#: After each computation, the pause is this many times as long: for the window, and for the whole run.
_WINDOW_REST, _TOTAL_REST = 4.0, 20.0
#: A stamp that differs from the clock by more than this, nanoseconds, comes from another clock.
_SAME_CLOCK = 3600 * 10**9
#: Most frames for which the time of sending is stored.
_MAX_SENT = 10_000
#: Longest time that a stopped node waits for estimates of the last frames, seconds.
_MAX_TAKING = 1.0


class EvaluatorNode(SuiteNode):
    """Compares an estimate with the truth. ``scene``: scene that its parameter names, if loaded already."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        super().__init__("evaluator", **options)
        path = self.text_parameter(
            "scene", "", "Scene file whose truth is computed; empty: the truth of topics"
        )
        topic = self.text_parameter(
            "topic", "", "Topic of the estimate; * stands for the name of a person, as in /tracker/*/joints"
        )
        keypoints = self.text_parameter("keypoints", "", "Keypoint set such as coco17; empty: joints")
        names = self.text_parameter("names", "", "YAML file: names of joints, as humansim evaluate --names")
        scale = self.number_parameter("scale", 1.0, 1e-9, 1e9, "Metres of a unit of the estimate")
        axes = self.text_parameter("axes", "", "Axes of the estimate, such as y-up; empty: the axes of map")
        description = "Largest mean joint distance at which a person counts as found, metres"
        gate = self.number_parameter("gate", DEFAULT_GATE, 0.001, 1000.0, description)
        self._window = self.number_parameter("window", 5.0, 0.1, 3600.0, "Seconds of the sliding window")
        output = self.text_parameter("output", "", "JSON file for the result at the end; empty: none")
        self._output = _checked_output(output) if output else None
        if not topic:
            raise RosError("name the topic: --ros-args -p topic:=/tracker/poses", key="parameter topic")
        live_options = LiveOptions.of(keypoints, names, scale, axes, gate)
        if path and scene is None:
            scene = loaded_scene(path)
        computed = SceneTruth(scene) if path and scene else None
        #: Monotonic time at which each frame was sent, by stamp, in the order of sending.
        self._sent: dict[int, float] = {}
        self._heard = time.monotonic()
        #: Time of the next computation; and newest results; both by name (window, whole run).
        self._next: dict[str, float] = {}
        self._results: dict[str, Evaluation | EvaluationError] = {}
        self._thread = ThreadPoolExecutor(1)
        self._work: Future[None] | None = None
        # a long queue, as for the other topics: the time of each frame is needed
        self.create_subscription(TimeReference, SCENE_TIME, self._on_scene_time, subscription_profile([]))
        truth_topic = f"humans/*/{f'keypoints/{keypoints}' if keypoints else 'joints'}"
        self._truth = None if computed else PoseTopics(self, truth_topic, ReadOptions(), self._on_truth)
        self._estimate = PoseTopics(self, topic, live_options, self._on_estimate)
        self._new_evaluation = lambda: LiveEvaluation(self._estimate.topic, live_options, computed)
        self.evaluation = self._new_evaluation()
        self._publisher = self.create_publisher(DiagnosticArray, "evaluation", DATA)
        self.create_timer(1.0, self._on_timer, clock=self._steady_clock)
        self.get_logger().info(f"evaluating {self._estimate.topic}")

    # --- messages

    def _on_scene_time(self, message: TimeReference) -> None:
        stamp = to_nanoseconds(message.header.stamp)
        if stamp in self._sent:  # a frame may be sent again
            return
        if stamp < next(reversed(self._sent), 0):
            self._restart()
        self._sent[stamp] = time.monotonic()
        self.evaluation.add_time(stamp)
        if len(self._sent) > _MAX_SENT:
            del self._sent[next(iter(self._sent))]

    def _restart(self) -> None:
        self.get_logger().info("stamps have gone back: a new run begins, and the evaluation begins again")
        self.evaluation = self._new_evaluation()
        self._sent.clear()
        self._results.clear()

    def _on_truth(self, frame: PoseFrame, topic: str, person: str | None) -> None:
        self.evaluation.truth.add(frame, topic, time.monotonic_ns(), person)
        self.count("truths")

    def _on_estimate(self, frame: PoseFrame, topic: str, person: str | None) -> None:
        latency = None if frame.stamp is None else self._latency(frame.stamp)
        self.evaluation.estimate.add(frame, topic, time.monotonic_ns(), person, latency)
        self._heard = time.monotonic()
        self.count("frames")
        if latency is not None:
            self.report_time(latency * 1e3, "latency")

    def _latency(self, stamp: int) -> float | None:
        """Seconds since a stamp or, in simulated time, since the frame was sent. None if unknown."""
        late = self.now() - stamp
        if not self.has_simulated_time() and abs(late) < _SAME_CLOCK:
            return late * 1e-9
        sent = self._sent.get(stamp)
        return None if sent is None else time.monotonic() - sent

    # --- results

    def _on_timer(self) -> None:
        """Publish the newest results, and start a thread that computes new ones while latencies are
        measured."""
        if self._work is None or self._work.done():
            if self._work is not None:
                with self.guard("evaluation", "it is repeated"):
                    self._work.result()
            self._work = self._thread.submit(self.compute_results)
        self.publish_results()

    def compute_results(self) -> None:
        """Evaluate the window and the whole run, unless this would take too much of the time."""
        evaluation = self.evaluation
        computations = (
            ("window", lambda: evaluation.window(self._window), _WINDOW_REST),
            ("total", evaluation.total, _TOTAL_REST),
        )
        for name, compute, rest in computations:
            begin = time.monotonic()
            if begin < self._next.get(name, begin) or not len(evaluation.estimate):
                continue
            try:
                result: Evaluation | EvaluationError = compute()
            except EvaluationError as error:
                result = error
                self.get_logger().warn(f"cannot evaluate: {error}", throttle_duration_sec=5.0)
            if evaluation is self.evaluation:  # no new run has begun
                self._results[name] = result
            now = time.monotonic()
            self._next[name] = now + rest * (now - begin)

    def publish_results(self) -> None:
        """Publish the newest results."""
        message = DiagnosticArray(status=[self._status(name) for name in ("window", "total")])
        message.header.stamp = self.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _status(self, name: str) -> DiagnosticStatus:
        status = DiagnosticStatus(name=f"{self.get_fully_qualified_name()}: {name}")
        status.hardware_id = self._estimate.topic
        result = self._results.get(name)
        status.level, status.message = DiagnosticStatus.OK, "evaluated"
        if result is None:
            status.level, status.message = DiagnosticStatus.WARN, self._waiting_for()
        elif isinstance(result, EvaluationError):
            status.level, status.message = DiagnosticStatus.ERROR, printable(str(result))
        else:
            status.values = [KeyValue(key=key, value=value) for key, value in _values(result)]
            if not result.people.found:
                status.level, status.message = DiagnosticStatus.WARN, "nobody is within the gate"
        if result is not None and (silence := self._silence()):
            status.level = DiagnosticStatus.ERROR
            status.message = f"no estimate for {silence:.0f} s on {self._estimate.topic}"
        status.values.append(KeyValue(key="ignored", value=str(self._estimate.ignored)))
        return status

    def _waiting_for(self) -> str:
        if not self._estimate.found:
            return f"nothing publishes {self._estimate.topic}"
        if self._truth is not None and not self._truth.found:
            return f"nothing publishes the truth, {self._truth.topic}"
        return f"no estimate has arrived on {self._estimate.topic}"

    def _silence(self) -> float:
        """Seconds since the last estimate, if frames were sent since then; otherwise 0."""
        silence = time.monotonic() - self._heard
        newest = next(reversed(self._sent.values()), 0.0)
        return silence if silence > _SILENT_AFTER and newest > self._heard else 0.0

    # --- end

    def complete(self) -> None:
        """Read all messages that have arrived; compute, print and write the result of the whole run.

        Raises:
            EvaluationError: There is nothing to write, or truth and estimate cannot be compared.
            HumansimError: The file cannot be written.
        """
        deadline = time.monotonic() + _MAX_TAKING
        while True:
            for topics in filter(None, (self._truth, self._estimate)):
                topics.take_waiting(deadline)
            is_whole = self.evaluation.estimate.newest >= self.evaluation.newest_frame
            if is_whole or time.monotonic() > deadline:
                break
            time.sleep(0.01)
        self._thread.shutdown(cancel_futures=True)
        if not len(self.evaluation.estimate):
            if self._output is not None:
                raise EvaluationError(f"nothing to evaluate: {self._waiting_for()}")
            self.get_logger().warn(f"nothing to evaluate: {self._waiting_for()}")
            return
        total = self.evaluation.total()
        print(show(total), flush=True)
        if self._output is not None:
            text = json.dumps(self.evaluation.to_data(total, self._estimate.ignored), allow_nan=False)
            write_file(self._output, f"{text}\n")
            self.get_logger().info(f"wrote {self._output}")

    def close(self) -> None:
        """End the thread that computes results."""
        self._thread.shutdown(cancel_futures=True)


def _checked_output(text: str) -> Path:
    path = Path(text).absolute()
    if path.is_dir() or not path.parent.is_dir():
        raise RosError("this is a folder, or its folder does not exist", path=path, key="parameter output")
    return path


def _values(result: Evaluation) -> Iterator[tuple[str, str]]:
    """Yield the keys and values of a diagnostic status."""
    tracking, live = result.tracking, result.live
    latency = live.latency if live else None
    lengths = {
        "mpjpe_mm": result.position.mpjpe,
        "pa_mpjpe_mm": result.position.pa_mpjpe,
        "p99_mm": result.position.p99,
        "latency_median_ms": latency.median if latency else None,
        "latency_p99_ms": latency.p99 if latency else None,
        "late_by_ms": result.offset.measured,
    }
    others = {
        "pck_150": result.position.pck,
        "recall": result.people.recall,
        "precision": result.people.precision,
        "velocity_error": result.motion.velocity,
        "hota": tracking and tracking.hota,
        "mota": tracking and tracking.mota,
        "idf1": tracking and tracking.idf1,
        "rate": live and live.rate,
        "lost_share": live and live.lost_share,
    }
    numbers = {
        "frames": result.frames.compared,
        "people": result.people.present,
        "missed": result.people.missed,
        "false": result.people.false,
        "switches": tracking and tracking.switches,
        "lost": live and live.lost,
        "duplicates": live and live.duplicates,
        "out_of_order": live and live.out_of_order,
    }
    yield from ((key, f"{value * 1000:.2f}") for key, value in lengths.items() if value is not None)
    yield from ((key, f"{value:.4f}") for key, value in others.items() if value is not None)
    yield from ((key, str(value)) for key, value in numbers.items() if value is not None)
