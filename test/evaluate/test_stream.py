"""Messages of an estimate as they arrive: people, repeated messages, latency, rate, losses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from evaluate_support import NAMES, PERIOD, pose, walking

from humansim_ros.data.evaluation.evaluation import evaluate_poses
from humansim_ros.data.evaluation.live import LiveEvaluation, LiveOptions
from humansim_ros.data.evaluation.pose_sequence import PoseSequence
from humansim_ros.data.evaluation.report import show, to_data
from humansim_ros.data.evaluation.stream import MAX_JOINTS, EstimateStream
from humansim_ros.data.messages.people import Pose, PoseFrame
from humansim_ros.errors import EvaluationError, HumansimWarning

TRUTH = walking(20)


def frame(index: int, *people: str | None) -> PoseFrame:
    """The named people at a frame of the truth; None is anna without a name."""
    stamp = 1 + PERIOD * index
    seconds = PERIOD * index * 1e-9
    return PoseFrame(stamp, "map", [Pose(name, NAMES, pose(name or "anna", seconds)) for name in people])


def test_latency_rate_and_losses_of_messages() -> None:
    stream = EstimateStream("live")
    latencies = []
    for index in (2, 3, 5, 4, 4, 8, 9):  # 6 and 7 are lost, 4 comes late and twice
        latency = 0.1 if index < 9 else 0.3
        arrival = 1 + PERIOD * index + round(latency * 1e9)
        if stream.add(frame(index, "anna", "bert"), "/poses", arrival, latency=latency):
            latencies.append(latency)
    result = evaluate_poses(replace(TRUTH, arrivals=stream.sequence().arrivals), stream.sequence())
    live = result.live
    assert live is not None and live.latency is not None
    assert (live.messages, live.frames, live.duplicates, live.out_of_order) == (7, 6, 1, 2)
    assert (live.lost, live.lost_share, live.after) == (2, 2 / 8, 10)
    expected = np.percentile(latencies, [50, 99, 100])
    assert (live.latency.median, live.latency.p99, live.latency.worst) == pytest.approx(tuple(expected))
    assert live.rate == pytest.approx(5 / (7 * PERIOD * 1e-9 + 0.2))
    assert to_data(result)["live"]["latency"]["p99"] == live.latency.p99
    table = show(result)
    assert "2 frames (25.0 %), and 10 after the last estimate" in table and "1, 2 messages" in table
    computed = evaluate_poses(TRUTH, stream.sequence()).live
    assert computed is not None and computed.after is None
    assert evaluate_poses(TRUTH, TRUTH).live is None


def test_a_repeated_message_adds_nobody() -> None:
    stream = EstimateStream("live")
    assert stream.add(frame(0, None), "/poses", 1)
    assert not stream.add(frame(0, None), "/poses", 2)  # the same positions again
    moved = PoseFrame(1, "map", [Pose(None, NAMES, pose("bert", 0.0))])
    assert stream.add(moved, "/poses", 3)  # another person
    assert stream.add(frame(1, "anna"), "/poses", 4)
    changed = PoseFrame(1 + PERIOD, "map", [Pose("anna", NAMES, pose("bert", 0.0))])
    assert not stream.add(changed, "/poses", 5)
    sequence = stream.sequence()
    assert [len(each) for each in sequence.people] == [2, 1] and not sequence.has_identities
    np.testing.assert_array_equal(sequence.people[1]["anna"], pose("anna", PERIOD * 1e-9))


def test_frames_of_nobody_on_topics_of_several_people_are_not_repeated() -> None:
    stream = EstimateStream("live")
    assert stream.add(frame(0), "/tracker/anna", 1, "anna")
    assert stream.add(frame(0), "/tracker/bert", 2, "bert")
    assert not stream.add(frame(0), "/tracker/bert", 3, "bert")
    assert stream.add(frame(0, None), "/tracker/bert", 3, "bert")
    assert not stream.add(PoseFrame(None, "", []), "/tracker/bert", 4)
    assert list(stream.sequence().people[0]) == ["bert"]


def test_memory_is_bounded() -> None:
    frames = EstimateStream("live", max_frames=5)
    points = EstimateStream("live", max_points=5 * 2 * len(NAMES))
    for index in range(12):
        for stream in (frames, points):
            stream.add(frame(index, "anna", "bert"), "/poses", index)
    for stream in (frames, points):
        assert len(stream) == 5 and stream.forgotten == 7
        assert stream.sequence().times.tolist() == TRUTH.times[7:12].tolist()
        assert stream.sequence(since=int(TRUTH.times[10])).times.tolist() == TRUTH.times[10:12].tolist()
    many = [Pose("anna", tuple(f"j{i}" for i in range(MAX_JOINTS + 1)), np.zeros((MAX_JOINTS + 1, 3)))]
    with pytest.raises(EvaluationError, match="more than 1024 different joints"):
        frames.add(PoseFrame(1, "map", many), "/poses", 20)
    long = [Pose("a" * 300, NAMES, pose("anna", 0.0))]
    with pytest.raises(EvaluationError, match="a name is longer than 256 characters: aaaa"):
        frames.add(PoseFrame(1, "map", long), "/poses", 20)
    assert len(frames) == 5


def test_the_truth_of_a_scene_is_computed_for_all_frames_although_a_window_comes_first() -> None:
    class Walkers:
        """Truth of a scene, as of SceneTruth."""

        def poses(self, span: tuple[int, int], offset: float, keypoints: Any) -> PoseSequence:
            kept = (span[0] <= TRUTH.times) & (span[1] >= TRUTH.times)
            people = [each for each, is_kept in zip(TRUTH.people, kept, strict=True) if is_kept]
            return replace(TRUTH, times=TRUTH.times[kept], people=people)

    live = LiveEvaluation("live", LiveOptions(), Walkers())  # type: ignore[arg-type]
    for index in range(20):
        live.estimate.add(frame(index, "anna", "bert"), "/poses", index)
    assert live.window(5 * PERIOD * 1e-9).frames.compared < 10
    assert live.total().frames.compared == 20


def test_a_tracker_that_finds_nobody_is_evaluated() -> None:
    live = LiveEvaluation("live", LiveOptions())
    for index in range(10):
        live.truth.add(frame(index, "anna", "bert"), "/truth", index, None)
        live.estimate.add(frame(index), "/poses", index)
    with pytest.warns(HumansimWarning, match="nobody is in the estimate: everybody is missed"):
        total = live.total()
    assert total.people.missed == 20 and total.people.recall == 0
    assert total.live is not None and total.live.lost == 0 and total.live.frames == 10
