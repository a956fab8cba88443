"""Rest frames at the origin, frames that are far away, and other jumps of a person."""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion_files import Array, stand_in, turns, walk

from humansim_ros.cli import main as cli
from humansim_ros.errors import HumansimWarning
from humansim_ros.motion import Motion
from humansim_ros.motion.pose.reports import describe_motion, read_with_warnings
from humansim_ros.motion.pose.world_motion import (
    Placement,
    WorldMotion,
    find_jumps,
    joint_path,
    leading_rest,
    playing_warnings,
    to_world,
)
from humansim_ros.scene import Scene

PERSON = stand_in("lafan1")
FRAMES = 60


def moving(root: Array, rest_frames: int = 0) -> Motion:
    """A walk with the root at (F, 3), centimetres; the first frames are a rest pose at the origin."""
    motion = PERSON.motion(walk(len(root)), root=root)
    values = motion.values.copy()
    values[:rest_frames] = 0.0
    values[:rest_frames, :3] = PERSON.offsets[0]
    return replace(motion, values=values)


def line(frames: int = FRAMES, speed: float = 140.0) -> Array:
    """A path along z, centimetres, at 30 frames per second."""
    return np.outer(np.arange(frames) / 30, (0.0, 0.0, speed))


def placed(motion: Motion, **options: object) -> WorldMotion:
    return to_world(motion, **options)


@pytest.mark.parametrize("rest_frames", [1, 3, 30])
@pytest.mark.parametrize("anchor", ["start", "center"])
def test_rest_frames_at_the_origin_do_not_count_for_anchor_and_floor(rest_frames: int, anchor: str) -> None:
    """The person walks 35 m from the origin, on a floor 2 m above it, as it would without rest frames."""
    away = line() + np.array([3500.0, 200.0, -250.0])
    plain = placed(
        replace(moving(away), values=moving(away).values[rest_frames:]), placement=Placement(anchor=anchor)
    )
    rest = placed(moving(away, rest_frames), placement=Placement(anchor=anchor))
    frames = np.arange(5, FRAMES - rest_frames - 1)
    step = rest.motion.frame_time
    expected, got = plain.sample(frames * step), rest.sample((frames + rest_frames) * step)
    np.testing.assert_allclose(got.positions, expected.positions, atol=1e-6)
    assert [jump.frame for jump in rest.jumps] == [rest_frames]
    assert rest.jumps[0].distance == pytest.approx(np.linalg.norm(away[rest_frames]) / 100, rel=0.01)


def test_continue_starts_again_where_the_person_is_not_at_the_rest_frame() -> None:
    away = line() + np.array([3500.0, 0.0, 0.0])
    world = placed(moving(away, 1), loop="continue")
    before, after = world.sample([world.cycle_length - 1e-3, world.cycle_length + 1 / 30]).positions[:, 0]
    assert np.linalg.norm(after - before) < 0.1


@pytest.mark.daily("20-200000.0")
@pytest.mark.parametrize("far", [2e5, 1e9])
@pytest.mark.parametrize("first", [0, 20, 57])
def test_frames_that_are_kilometres_away_do_not_count(far: float, first: int) -> None:
    root = line()
    root[first : first + 3] += far
    for anchor in ("start", "center"):
        world = placed(moving(root), placement=Placement(anchor=anchor))
        plain = placed(moving(line()), placement=Placement(anchor=anchor))
        times = np.arange(30, 50) / 30
        moved = world.sample(times).positions - plain.sample(times).positions
        assert np.abs(moved - moved[:1]).max() < 1e-6
        assert np.abs(moved).max() < 0.3  # three frames of the walk
    frames = [frame for frame in (first, first + 3) if 0 < frame < FRAMES]
    assert [jump.frame for jump in world.jumps] == frames


@pytest.mark.parametrize(
    ("path", "frames"),
    [
        (np.zeros((5, 3)), []),
        (np.array([[0.0, 0, 0], [35.0, 0, 0]]), [1]),
        (np.array([[0.0, 0, 0], [0.2, 0, 0]]), []),
        (np.outer(np.arange(50) * 1.2, (1.0, 0, 0)), []),  # a car at 36 m/s
        (np.outer(np.maximum(np.arange(50) - 25, 0) * 0.4, (1.0, 0, 0)), []),  # a sudden run at 12 m/s
        (np.outer(np.arange(50) >= 20, (2.0, 0, 0)), [20]),
        (np.outer(np.arange(50) == 20, (2.0, 0, 0)), [20, 21]),
        (np.outer(np.arange(50) * 0.04 + (np.arange(50) >= 20) * 1e4, (1.0, 0, 0)), [20]),
        (np.zeros((1, 3)), []),
    ],
)
def test_a_jump_is_a_step_unlike_those_beside_it(path: Array, frames: list[int]) -> None:
    assert [jump.frame for jump in find_jumps(path, 1 / 30)] == frames


def test_noise_at_a_high_rate_is_no_jump() -> None:
    noise = np.random.default_rng(2).normal(scale=0.03, size=(2000, 3))
    assert find_jumps(noise, 1 / 480) == ()


def test_the_path_of_a_joint_is_that_of_forward_kinematics() -> None:
    motion = moving(line())
    for joint in (0, 5, motion.n_joints - 1):
        np.testing.assert_allclose(joint_path(motion, joint), motion.world_positions()[:, joint], atol=1e-9)


def test_a_person_that_stands_still_and_then_jumps_late_has_no_rest_frames() -> None:
    """Two takes in one file: the first counts."""
    person, still = PERSON, np.zeros((FRAMES, 3))
    still[50:] += 500
    motion = person.motion({"LeftElbow": turns("y", np.full(FRAMES, 30.0))}, root=still)
    assert leading_rest(motion, to_world(motion).jumps) == 0


def test_jumps_are_in_the_summary_and_do_not_count_as_speed() -> None:
    away = line() + np.array([3500.0, 0.0, 0.0])
    info = describe_motion(moving(away, 1))
    assert [jump["frame"] for jump in info["jumps"] or []] == [1]
    assert info["speed"] == pytest.approx(1.4, abs=0.1)
    assert info["travel"] == pytest.approx([1.4 * 58 / 30, 0.0], abs=0.02)
    (warning,) = info["warnings"]
    assert "frame 0 is a rest pose, 35 m away from frame 1: start: 0.033333 leaves it out" in warning
    assert describe_motion(moving(line()))["warnings"] == []


def test_the_remedy_of_the_warning_removes_the_jump() -> None:
    away = line() + np.array([3500.0, 0.0, 0.0])
    motion = moving(away, 2)
    (text,) = playing_warnings(to_world(motion))
    start = float(text.split("start: ")[1].split()[0])
    points = placed(motion, start=start).sample(np.arange(0, 50) / 30).positions[:, 0]
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() < 0.1
    assert points[0, :2] == pytest.approx([0, 0], abs=1e-6)


def test_jumps_are_told_when_a_scene_loads(tmp_path: Path) -> None:
    root = line()
    root[20:23] += (1e5, 0, 0)
    (tmp_path / "walk.bvh").write_text(PERSON.text(walk(FRAMES), root=root))
    scene = {
        "humans": {"anna": {"motion": {"file": str(tmp_path / "walk.bvh")}}},
        "cameras": {"eye": {"size": [64, 48], "position": [3, 0, 1], "look_at": [0, 0, 1]}},
    }
    with pytest.warns(
        HumansimWarning, match=r"walk\.bvh: the person jumps 1000 m to frame 20, 1000 m to frame 23"
    ):
        Scene.from_dict(scene)


def test_a_calm_motion_loads_without_a_warning(tmp_path: Path) -> None:
    (tmp_path / "walk.bvh").write_text(PERSON.text(walk(FRAMES), root=line()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Scene.from_dict(
            {
                "humans": {"anna": {"motion": str(tmp_path / "walk.bvh")}},
                "cameras": {"eye": {"size": [64, 48], "position": [3, 0, 1], "look_at": [0, 0, 1]}},
            }
        )


@pytest.mark.parametrize(("stem", "metres"), [("loadbvh_test", 35.52), ("griebel_Example1", 2.38)])
def test_rest_frames_of_real_files_are_found(shared_data: Path, stem: str, metres: float) -> None:
    motion, _ = read_with_warnings(shared_data / "bvh" / f"{stem}.bvh")
    world = to_world(motion)
    assert leading_rest(motion, world.jumps) == 1
    assert world.jumps[0].distance == pytest.approx(metres, abs=0.01)
    # the person stands at the origin, on the floor, in the first frame after the rest frame
    points = world.sample(motion.frame_time).positions[0]
    assert points[world.match.roles["Hips"], :2] == pytest.approx([0, 0], abs=1e-6)
    assert -0.1 < points[:, 2].min() < 0.1


def test_commands_tell_jumps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "walk.bvh").write_text(
        PERSON.text(walk(4), root=line(4) + np.array([[50, 0, 50]] + [[950, 0, 50]] * 3))
    )
    monkeypatch.setattr(sys, "argv", ["humansim", "motion", "info", str(tmp_path / "walk.bvh"), "--json"])
    assert cli.main() == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["jumps"] == [{"frame": 1, "distance": pytest.approx(9.0, abs=0.01)}]
    monkeypatch.setattr(sys, "argv", ["humansim", "motion", "retarget", str(tmp_path / "walk.bvh")])
    assert cli.main() == 0
    assert "the person jumps 9.00 m to frame 1" in capsys.readouterr().err
