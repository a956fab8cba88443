"""Trackers as processes: cases that run, break, and go on; what was finished stays."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import ros_support  # noqa: F401  # a ROS domain of this process
from challenge_support import SUITE, small_suite
from waiting import existing, has_ended, wait_until

from humansim_ros.data.evaluation.stream import EstimateStream
from humansim_ros.data.messages.people import Pose, PoseFrame
from humansim_ros.errors import ChallengeError, HumansimError
from humansim_ros.ros.challenge import run
from humansim_ros.ros.challenge.case import MAX_MESSAGES, CaseOrder, _scores, measured
from humansim_ros.ros.challenge.results import CaseResult, Report
from humansim_ros.ros.challenge.run import (
    CaseProcess,
    ChallengeOptions,
    TrackerProcess,
    command_words,
    open_report,
    patience_with,
    run_challenge,
)
from humansim_ros.ros.challenge.suite import Case, Suite
from humansim_ros.scene import Scene

FAKE = f"{sys.executable} {Path(__file__).with_name('fake_tracker.py')} {{topic}} {{scene}}"


def options(command: str = FAKE) -> ChallengeOptions:
    return ChallengeOptions(command, timeout=1.0, start_within=20.0)


def run_fake(suite: Suite, command: str, folder: Path, resume: bool = False) -> Report:
    chosen = options(command)
    report = open_report(suite, chosen, folder, resume)
    run_challenge(suite, chosen, report, folder, lambda *_: None)
    return report


@pytest.mark.process
def test_a_perfect_tracker_is_perfect_until_it_dies(tmp_path: Path) -> None:
    suite = small_suite(tmp_path)
    suite = replace(suite, cases=[suite.cases[0], suite.cases[3]])
    report = run_fake(suite, f"{FAKE} --fault dies --where '- 8'", tmp_path / "report")
    base = report.baseline
    assert base is not None and base.failure == ""
    assert base.frames == base.estimates == 4
    assert base.sees is False and report.is_blind
    assert base.score == 100 and base.mpjpe == pytest.approx(0, abs=1e-4)
    died = report.results["size_3"]
    assert "ended with exit code 3: the tracker has no camera" in died.failure
    assert report.is_broken(died)
    assert Report.read(tmp_path / "report").results == report.results


@pytest.mark.process
def test_a_tracker_that_fails_without_a_difficulty_is_an_error(tmp_path: Path) -> None:
    suite = small_suite(tmp_path, SUITE.replace("frames: 4", "frames: 2"))
    with pytest.raises(ChallengeError, match=r"--tracker.*without a difficulty.*published nothing"):
        run_fake(suite, f"{FAKE} --fault 'is silent'", tmp_path / "report")


def collected(tmp_path: Path, *frames: PoseFrame, messages: int | None = None) -> dict[str, Any]:
    """Result of a case of two frames in which a tracker has sent some messages."""
    case = small_suite(tmp_path).cases[0]
    scene = Scene.from_config(case.scene)
    order = CaseOrder("", 0, 2, 1.0, ChallengeOptions("tracker"))
    topic = order.options.topic
    stream = EstimateStream(topic)
    for frame in frames:
        stream.add(frame, topic, 0)
    collector = SimpleNamespace(
        stream=stream,
        frames={1: 0, 50_000_001: 50_000_000},
        messages=len(frames) if messages is None else messages,
        people=sum(len(frame.people) for frame in frames),
        finite=any(np.isfinite(pose.positions).any() for frame in frames for pose in frame.people),
        fault="",
        topics=SimpleNamespace(found=[topic]),
    )
    return measured(order, scene, collector, MAX_MESSAGES)


def wrists(stamp: int, *positions: tuple[float, float, float]) -> PoseFrame:
    return PoseFrame(stamp, "map", [Pose("anna", ("l_wrist",), np.array(positions))])


def test_a_tracker_that_sends_nan_has_failed(tmp_path: Path) -> None:
    result = collected(tmp_path, wrists(1, (np.nan,) * 3), wrists(50_000_001, (np.nan,) * 3))
    assert "no position is finite" in result["failure"]


def test_a_tracker_that_floods_has_failed(tmp_path: Path) -> None:
    result = collected(tmp_path, wrists(1, (0, 0, 1)), messages=MAX_MESSAGES + 1)
    assert "floods its topic" in result["failure"]


def test_a_tracker_that_finds_nobody_has_no_points_but_has_not_failed(tmp_path: Path) -> None:
    result = collected(tmp_path, PoseFrame(1, "map", ()))
    assert "failure" not in result and result["pck"] == 0


def test_frames_that_a_tracker_leaves_out_at_the_end_are_missed(tmp_path: Path) -> None:
    actor = Scene.from_config(small_suite(tmp_path).cases[0].scene).actors["anna"]
    pose = Pose("anna", tuple(actor.human.skeleton.joint_names), actor.joint_paths(np.zeros(1))[0])
    result = collected(tmp_path, PoseFrame(1, "map", [pose]))
    assert (result["recall"], result["pck"]) == (0.5, 0.5)
    assert result["mpjpe"] == pytest.approx(0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.process
def test_the_last_frame_of_a_slow_tracker_counts(tmp_path: Path) -> None:
    suite = small_suite(tmp_path)
    chosen = replace(options(f"{FAKE} --fault 'is slow'"), timeout=20.0)
    report = open_report(suite, chosen, tmp_path / "report", False)
    run_challenge(replace(suite, cases=suite.cases[:1]), chosen, report, tmp_path / "report", lambda *_: None)
    assert report.baseline is not None
    assert report.baseline.estimates == report.baseline.frames == 4


def test_the_first_frames_of_a_case_are_for_the_warm_up(tmp_path: Path) -> None:
    case = small_suite(tmp_path).cases[0]
    scene = Scene.from_config(case.scene)
    actor = scene.actors["anna"]
    order = CaseOrder("", 0, 24, 1.0, ChallengeOptions("tracker"))
    frames = {1 + 50_000_000 * number: 50_000_000 * number for number in range(24)}

    def scores(*lost: int) -> dict[str, Any]:
        stream = EstimateStream(order.options.topic)
        for number, (stamp, time) in enumerate(frames.items()):
            if number not in lost:
                joints = actor.joint_paths(np.array([time * 1e-9]))[0]
                pose = Pose("anna", tuple(actor.human.skeleton.joint_names), joints)
                stream.add(PoseFrame(stamp, "map", [pose]), order.options.topic, 0)
        return _scores(order, scene, frames, stream)

    # a tracker that needs three frames to confirm a person, and loses up to five of the first ones
    assert scores(*range(8)) == scores(0, 2) == scores()
    assert scores()["recall"] == 1.0
    assert scores(8)["recall"] == pytest.approx(15 / 16)


class FinishedCases:
    """In place of run_case: notes the cases, and gives each a result."""

    def __init__(self, failing: str = "") -> None:
        self.names: list[str] = []
        self._failing = failing

    def __call__(self, case: Case, *_: Any) -> CaseResult:
        self.names.append(case.name)
        if case.name == self._failing:
            raise ChallengeError("cannot be written: No space left on device", path="case.yaml")
        return CaseResult(case.axis, case.strength, case.label, pck=0.9, precision=1.0)


def test_a_challenge_that_ended_early_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite, folder = small_suite(tmp_path), tmp_path / "report"
    monkeypatch.setattr(run, "run_case", FinishedCases("size_2"))
    with pytest.raises(ChallengeError, match="No space left"):
        run_fake(suite, "tracker", folder)
    assert list(Report.read(folder).results) == ["baseline", "size_1"]
    with pytest.raises(ChallengeError, match="give --resume"):
        run_fake(suite, "tracker", folder)
    second = FinishedCases()
    monkeypatch.setattr(run, "run_case", second)
    run_fake(suite, "tracker", folder, resume=True)
    assert second.names == ["size_2", "size_3"]
    assert list(Report.read(folder).results) == ["baseline", "size_1", "size_2", "size_3"]


@pytest.mark.parametrize("other", ["tracker", "suite", "timeout"])
def test_results_of_something_else_are_not_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: str
) -> None:
    suite, chosen, folder = small_suite(tmp_path), options("one"), tmp_path / "report"
    monkeypatch.setattr(run, "run_case", FinishedCases())
    run_challenge(suite, chosen, open_report(suite, chosen, folder, False), folder, lambda *_: None)
    if other == "suite":
        suite = replace(suite, version="2")
    else:
        chosen = replace(chosen, **({"tracker": "two"} if other == "tracker" else {"timeout": 3.0}))
    with pytest.raises(
        ChallengeError, match=f"another challenge: {other}: .* there, .* now; give another folder"
    ):
        open_report(suite, chosen, folder, True)


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(HumansimError, match="file"):
        open_report(small_suite(tmp_path), options(), tmp_path / "file" / "report", False)


def test_the_command_gets_its_words_replaced() -> None:
    values = {"cameras": "a,b", "topic": "/poses", "scene": "/tmp/my scene.yaml"}
    assert command_words("run '{scene}' -t {topic} --cameras={cameras}", values) == [
        "run",
        "/tmp/my scene.yaml",
        "-t",
        "/poses",
        "--cameras=a,b",
    ]
    for command in ("", "run 'unclosed"):
        with pytest.raises(ChallengeError, match="--tracker"):
            command_words(command, {})


def test_a_command_that_cannot_be_started_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ChallengeError, match="no_such_program cannot be started: No such file"):
        TrackerProcess(["no_such_program"], {}, tmp_path / "log")


def test_children_of_a_tracker_end_with_it(tmp_path: Path) -> None:
    words = ["sh", "-c", "sleep 1000 & echo $!; wait"]
    with TrackerProcess(words, {}, tmp_path / "log") as tracker:
        assert wait_until(lambda: tracker.output_tail)
        child = int(tracker.output_tail)
    assert wait_until(lambda: has_ended(child))  # its parent is gone, so that it may stay as a zombie


def test_daemons_of_a_tracker_end_with_it_and_other_children_stay(tmp_path: Path) -> None:
    """It leaves the group and the session of the tracker, and clears its environment."""
    with subprocess.Popen(["sleep", "1000"]) as other:
        words = ["sh", "-c", "env -i setsid sh -c 'sleep 1000 & echo $!; wait' & sleep 1000"]
        with TrackerProcess(words, {}, tmp_path / "log") as tracker:
            assert wait_until(lambda: tracker.output_tail)
            child = int(tracker.output_tail)
        assert not existing([child])
        assert other.poll() is None
        other.kill()
    # orphans of other programs go to init again, which waits for them
    adopts = ctypes.c_int(-1)
    assert ctypes.CDLL(None).prctl(37, ctypes.byref(adopts), 0, 0, 0) == 0  # PR_GET_CHILD_SUBREAPER
    assert adopts.value == 0


def test_the_output_of_a_tracker_is_cut(tmp_path: Path) -> None:
    words = ["sh", "-c", "head -c 3000000 /dev/zero; sleep 1000"]
    with TrackerProcess(words, {}, tmp_path / "log") as tracker:
        assert wait_until(lambda: tracker.is_too_talkative)
    assert (tmp_path / "log").stat().st_size == 1 << 20


def test_a_challenge_has_a_domain_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "0")
    first, second = CaseProcess(tmp_path / "log"), CaseProcess(tmp_path / "log")
    assert first.domain == second.domain != 0  # one for each process


def test_a_tracker_that_prints_without_end_is_stopped(tmp_path: Path) -> None:
    with TrackerProcess(
        ["sh", "-c", "head -c 3000000 /dev/zero; sleep 1000"], {}, tmp_path / "log"
    ) as tracker:
        assert wait_until(lambda: tracker.is_too_talkative)


@pytest.mark.nightly
def test_nodes_of_a_case_whose_process_dies_are_an_error(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text("room: null\ncameras: {front: {position: [3, 0, 1.5], look_at: [0, 0, 1]}}\n")
    order = CaseOrder(str(scene), os.getpid(), 2, 100.0, ChallengeOptions("tracker", start_within=100.0))
    with CaseProcess(tmp_path / "log") as nodes:
        nodes.ask(order)
        nodes._processes.processes[0].kill()
        with pytest.raises(ChallengeError, match=r"nodes of the case have ended with an error; see .*log"):
            nodes.answer(100.0)
        nodes.ask(replace(order, scene=str(tmp_path / "nothing.yaml")))
        with pytest.raises(HumansimError, match=r"nothing\.yaml"):
            nodes.answer(100.0)


@pytest.mark.parametrize(
    ("own", "latency", "patience"),
    [(None, 3.0, 10.0), (1.0, 0.05, 1.0), (1.0, 0.9, 3.6), (1.0, 5.0, 10.0), (1.0, None, 1.0)],
)
def test_a_case_is_as_patient_as_a_slow_tracker_needs(
    tmp_path: Path, own: float | None, latency: float | None, patience: float
) -> None:
    case = replace(small_suite(tmp_path).cases[0], patience=own)
    assert patience_with(case, 10.0, CaseResult("baseline", 0, "", latency=latency)) == pytest.approx(
        patience
    )
    assert patience_with(case, 10.0, None) == (10.0 if own is None else own)
