"""Activities: built-in motions one after the other, by seed, with feet that do not slide."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from humansim_ros import Scene, load_human, read_motion
from humansim_ros.errors import HumansimError
from humansim_ros.motion import Motion, Retargeter, load_limits, to_world
from humansim_ros.motion.files.activity import PARTS, ActivityStep, joined, plan_activity

SEEDS = range(12)


@cache
def activity(name: str) -> Motion:
    return read_motion(name)


def soles(motion: Motion) -> np.ndarray:
    """Heel and ball (F, 4, 3) of both feet, metres."""
    rest = motion.rest_positions()
    stand = read_motion("t_to_a_pose").world_positions(0)
    frames = motion.world_transforms()
    points = []
    for side in ("Left", "Right"):
        ankle, end = motion.joint(f"{side}Ankle"), motion.joint(f"{side}Ankle_end")
        for ahead in (-5.0, 0.7 * (rest[end] - rest[ankle])[2]):
            point = np.array([0.0, -stand[ankle, 1], ahead])
            points.append(frames[:, ankle, :3, :3] @ point + frames[:, ankle, :3, 3])
    return 0.01 * np.stack(points, axis=1)


def test_the_same_seed_gives_the_same_activity_and_another_seed_another() -> None:
    plans = [plan_activity(seed, 60) for seed in range(30)]
    assert plans == [plan_activity(seed, 60) for seed in range(30)]
    assert len({tuple(plan) for plan in plans}) > 25
    np.testing.assert_array_equal(read_motion("activity#3").values, read_motion("activity#3").values)


def test_an_activity_has_the_duration_that_is_asked_for() -> None:
    assert 60 <= activity("activity#1").duration < 100
    assert 20 <= read_motion("activity#1,desk,20").duration < 29
    assert read_motion("activity").duration == pytest.approx(activity("activity#1").duration)


@pytest.mark.parametrize("seed", SEEDS)
def test_postures_match_from_part_to_part(seed: int) -> None:
    parts = [PARTS[step.part] for step in plan_activity(seed, 60)]
    for one, other in zip(parts, parts[1:] + parts[:1], strict=True):
        assert one.after == other.before


@pytest.mark.parametrize("seed", SEEDS)
def test_nobody_slides_jumps_or_drifts_away(seed: int) -> None:
    motion = activity(f"activity#{seed}")
    points = soles(motion)
    # a part of the sole that stays on the floor from frame to frame
    low = points[..., 1] < 0.002
    step = np.linalg.norm(np.diff(points[..., [0, 2]], axis=0), axis=-1)
    lasting = low[1:] & low[:-1]
    lasting[1:-1] &= lasting[2:] & lasting[:-2]
    lasting[[0, -1]] = False
    assert step[lasting].max() < 0.004
    positions = 0.01 * motion.world_positions()
    assert np.linalg.norm(np.diff(positions, axis=0), axis=-1).max() < 0.25
    assert np.abs(positions[-1] - positions[0]).max() < 0.05  # it ends where it starts, and can repeat
    assert points[..., 1].min() > -0.012


def test_joints_stay_within_their_limits_where_parts_meet() -> None:
    skeleton = load_human("adult_man").skeleton
    limits = load_limits().for_skeleton(skeleton)
    for seed in (0, 5):
        world = to_world(activity(f"activity#{seed}"))
        rotations, _ = Retargeter.fit(world, skeleton).apply(world.sample(world.frame_times))
        assert [(each.bone, each.angle, each.worst) for each in limits.report(rotations)] == []


def test_an_errand_leads_away_and_back() -> None:
    away = [
        ActivityStep("walk_start"),
        ActivityStep("walk"),
        ActivityStep("walk_half"),
        ActivityStep("walk_stop", mirror=True),
    ]
    turn = [ActivityStep("turn_left")] * 2
    hips = 0.01 * joined([*away, *turn, *away, *turn]).world_positions()[:, 0]
    assert np.linalg.norm(hips[:, [0, 2]] - hips[0, [0, 2]], axis=-1).max() == pytest.approx(2.5, abs=0.06)
    assert np.linalg.norm(hips[-1, [0, 2]] - hips[0, [0, 2]]) < 0.02


def test_each_part_of_a_plan_begins_in_the_posture_in_which_the_part_before_it_ends() -> None:
    for seed in range(100):
        parts = [PARTS[step.part] for step in plan_activity(seed, 60)]
        assert parts and all(one.after == other.before for one, other in pairwise(parts))


@pytest.mark.parametrize(
    "name",
    [
        "activity#",
        "activity#x",
        "activity#-1",
        "activity#1,juggle",
        "activity#1,desk,0.5",
        "activity#1,desk,601",
        "activity#1,nan",
    ],
)
def test_a_wrong_name_of_an_activity_tells_what_to_give(name: str) -> None:
    with pytest.raises(
        HumansimError, match=r"give a seed, .*activity#4,desk,120; the kinds are around, desk"
    ):
        read_motion(name)


def test_a_scene_plays_activities() -> None:
    scene = Scene.from_dict(
        {
            "room": None,
            "humans": {"anna": {"body": "adult_woman", "motion": "activity#2,standing,20"}},
            "cameras": {"front": {"position": [4, 0, 1.5], "look_at": [0, 0, 1]}},
        }
    )
    assert scene.actors["anna"].motion.duration >= 20
    with pytest.raises(HumansimError, match=r"humans\.anna\.motion\.file: .*give a seed"):
        Scene.from_dict(
            {
                "humans": {"anna": {"motion": "activity#two"}},
                "cameras": {"front": {"position": [4, 0, 1], "look_at": [0, 0, 1]}},
            }
        )
