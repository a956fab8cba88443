"""Lockstep with real processes: a tracker that is slow, killed or stopped gets every frame."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from commands import humansim
from conftest import ROOT
from ros_support import write_scene
from waiting import PATIENCE, end_process

HUMANSIM = [sys.executable, "-m", "humansim_ros.cli"]
TOOLS = ROOT / "tools"
RATE = 20
SCENE = """
rate: 20
room: null
humans: {anna: {motion: {file: walk}}}
cameras:
  left: {size: [64, 48], position: [3, 0, 1.5], look_at: [0, 0, 1]}
  right: {size: [64, 48], position: [0, 3, 1.5], look_at: [0, 0, 1]}
"""


def stamps(frames: int) -> list[int]:
    return [1 + round(number * 1e9 / RATE) for number in range(frames)]


@contextmanager
def tracker(log: Path, *options: str, cameras: Sequence[str] = ("left", "right")) -> Iterator[Path]:
    """A tracker that sleeps up to 50 ms for each frame; yields its log."""
    command = [sys.executable, str(TOOLS / "slow_tracker.py"), str(log), *cameras, *options]
    with subprocess.Popen(command) as process:
        try:
            yield log
        finally:
            end_process(process)


def rows(log: Path) -> list[list[int]]:
    """Stamp, time of the tracker's clock, and calls of its timer, of each frame in order."""
    return [[int(each) for each in line.split()] for line in log.read_text().splitlines()]


def run(scene: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [*HUMANSIM, "run", str(scene), "--lockstep", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=3 * PATIENCE, check=False)


@pytest.mark.slow
@pytest.mark.nightly
def test_every_frame_is_tracked_by_trackers_of_three_kinds(ros: None, tmp_path: Path) -> None:
    """One knows nothing of lockstep, one reports on frame_done, and one has a timer on simulated time."""
    frames, timer = 100, 0.2
    simulated = ("--ros-args", "-p", "use_sim_time:=true")
    with (
        tracker(tmp_path / "topic") as unchanged,
        tracker(tmp_path / "done", "--report", "done", "--sleep", "0.01") as reporting,
        tracker(
            tmp_path / "none", "--report", "none", "--sleep", "0", "--period", "0.2", *simulated
        ) as timed,
    ):
        members = ("--wait-for", "topic:/tracker/poses", "--wait-for", "tracker_done")
        done = run(write_scene(tmp_path, SCENE), "--frames", str(frames), *members)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{frames} frames in lockstep" in done.stdout
    assert f"finished: left {frames}, right {frames}, tracker_done {frames}" in done.stdout
    for log in (unchanged, reporting):
        assert sorted({row[0] for row in rows(log)}) == stamps(frames)
    # /clock has the stamp of the frame while a frame is in flight; a member would never be ahead of it
    in_time = [row for row in rows(timed) if row[1] == row[0]]
    assert len(in_time) > 0.8 * len(rows(timed)) > 0
    calls, seconds = rows(timed)[-1][2], (rows(timed)[-1][0] - rows(timed)[0][0]) * 1e-9
    assert calls == pytest.approx(seconds / timer, abs=3)


@pytest.mark.slow
@pytest.mark.nightly
def test_frames_without_a_picture_wait_for_no_tracker(ros: None, tmp_path: Path) -> None:
    frames, scene = 20, SCENE.replace("0, 1]}", "0, 1], rate: 10}")
    with (
        tracker(tmp_path / "topic") as unchanged,
        tracker(tmp_path / "done", "--report", "done", "--sleep", "0.01") as reporting,
    ):
        members = ("--wait-for", "topic:/tracker/poses", "--wait-for", "tracker_done")
        done = run(write_scene(tmp_path, scene), "--frames", str(frames), *members)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"finished: left {frames}, right {frames}, tracker_done {frames // 2}" in done.stdout
    for log in (unchanged, reporting):
        assert sorted({row[0] for row in rows(log)}) == stamps(frames)[::2]


@pytest.mark.slow
@pytest.mark.nightly
def test_no_frame_is_lost_when_each_process_is_killed_or_stopped(ros: None, tmp_path: Path) -> None:
    """Player, skinner, camera rig and tracker once each; the stop is one of the five faults."""
    tool = [sys.executable, str(TOOLS / "chaos.py"), str(write_scene(tmp_path, SCENE)), "--processes", "1"]
    done = subprocess.run(
        [*tool, "--kills", "4", "--stops", "1", "--limit", str(PATIENCE)],
        capture_output=True,
        text=True,
        timeout=6 * PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "5 faults" in done.stdout and ", 0 lost []" in done.stdout
    assert done.stdout.count("SIGKILL") == 4 and done.stdout.count("SIGSTOP") == 1


@pytest.mark.nightly
@pytest.mark.slow
def test_a_member_that_never_comes_stops_the_run_with_its_name(ros: None, tmp_path: Path) -> None:
    done = run(write_scene(tmp_path, SCENE), "--frames", "9", "--wait-for", "nobody", "--timeout", "2")
    assert done.returncode == 1
    assert "error: frame 0: nobody did not finish it within 2 s" in done.stderr


@pytest.mark.slow
@pytest.mark.nightly
def test_a_run_goes_on_without_a_member_that_never_comes(ros: None, tmp_path: Path) -> None:
    options = ("--wait-for", "topic:/nobody", "--timeout", "2", "--on-timeout", "continue")
    done = run(write_scene(tmp_path, SCENE), "--frames", "9", *options)
    assert done.returncode == 0, done.stderr
    assert "/nobody did not finish it within 2 s; going on without until it reports again" in done.stderr
    assert "finished: left 9, right 9, /nobody 0" in done.stdout


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--frames", "0"), "--frames"),
        (("--frames", "-3"), "--frames"),
        (("--realtime", "--frames", "3"), "--frames goes with --lockstep only"),
        (("--wait-for", "a b"), "'a b' is neither the name of a node"),
        (("--wait-for", "topic:"), "is neither the name of a node"),
        (("--on-timeout", "explode"), "there are stop, continue"),
        (("--timeout", "0"), "--timeout"),
    ],
)
def test_a_wrong_option_of_lockstep_is_refused(
    ros: None, tmp_path: Path, options: tuple[str, ...], problem: str
) -> None:
    done = humansim("run", write_scene(tmp_path, SCENE), "--lockstep", *options)
    assert done.returncode == 2, done.stdout + done.stderr
    assert problem in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_the_tracker_of_the_documents_takes_part_and_the_scene_may_ask_for_lockstep(
    ros: None, tmp_path: Path
) -> None:
    """With the settings in the scene in place of options."""
    text = (ROOT / "docs" / "lockstep.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    time = "time: {mode: lockstep, wait_for: [tracker], frames: 20, rate: 100}"
    scene = write_scene(tmp_path, SCENE.replace("left:", "camera_1:") + time)
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        try:
            command = [*HUMANSIM, "run", str(scene)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=3 * PATIENCE, check=False)
        finally:
            process.kill()
    assert done.returncode == 0, done.stdout + done.stderr
    assert "finished: camera_1 20, right 20, tracker 20" in done.stdout
    assert "WARN" not in done.stderr
