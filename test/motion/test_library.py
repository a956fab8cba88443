"""The built-in motions: made by the scripts, on the floor, and as documented."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from capsules import fit_capsules, report_penetration
from conftest import ROOT
from scipy.spatial.transform import Rotation
from waiting import PATIENCE

from humansim_ros import load_human, read_motion
from humansim_ros.motion import Motion, Retargeter, load_limits, read_bvh, to_world

FOLDER = ROOT / "assets" / "motions"
LISTED = yaml.safe_load((FOLDER / "motions.yaml").read_text())
MADE = ("run", "sit_stand", "wave", "turn_in_place", "pick_up", "t_to_a_pose")
#: Begin and end standing, and seated.
STAND = ("stand", "talk", "phone", "squats", "jumping_jacks", "dance", "fall", "climb_step", "lift_box")
SIT = ("sit", "write", "eat")
WALKS = ("walk_slow", "walk_brisk", "limp", "crawl", "carry")
GAITS = ("walk", "walk_slow", "walk_brisk")
STEPS = tuple(f"{gait}_{part}" for gait in GAITS for part in ("start", "stop"))
EVERYDAY = (*STAND, *SIT, *WALKS, *STEPS, "lie", "turn_left")


@cache
def motion(name: str) -> Motion:
    return read_bvh(FOLDER / f"{name}.bvh")


def places(name: str, *joints: str) -> np.ndarray:
    """Metres (F, len(joints), 3), y up, z forward."""
    one = motion(name)
    return one.world_positions()[:, [one.joint(joint) for joint in joints]] * 0.01


def soles(name: str, side: str) -> np.ndarray:
    """Heel, ball and tip (F, 3, 3) of a foot, metres, fixed to the ankle as at rest."""
    one = motion(name)
    ankle, end = one.joint(f"{side}Ankle"), one.joint(f"{side}Ankle_end")
    height = 100 * places("t_to_a_pose", f"{side}Ankle")[0, 0, 1]  # standing flat
    link = one.offsets[end]
    points = np.array(
        [[0, -height, -5.0], [0.6 * link[0], -height, 0.6 * link[2]], [link[0], -height, link[2]]]
    )
    frames = one.world_transforms()[:, ankle]
    return 0.01 * (np.einsum("fij,kj->fki", frames[:, :3, :3], points) + frames[:, None, :3, 3])


def test_the_list_names_every_file() -> None:
    assert set(LISTED) == {path.stem for path in FOLDER.glob("*.bvh")}
    assert all((FOLDER / f"{name}.bvh").stat().st_size < 150_000 for name in LISTED)


@pytest.mark.daily("made")
@pytest.mark.parametrize("names", [(*MADE, "talk", "crawl"), EVERYDAY], ids=["made", "everyday"])
def test_the_files_are_what_the_script_makes(tmp_path: Path, names: tuple[str, ...]) -> None:
    script = ROOT / "tools" / "assets" / "make_motions.py"
    command = [sys.executable, str(script), *names, "--folder", str(tmp_path)]
    subprocess.run(command, check=True, timeout=10 * PATIENCE)
    for name in names:
        again = read_bvh(tmp_path / f"{name}.bvh")
        assert again.joint_names == motion(name).joint_names
        # other versions of SciPy may round the last digit otherwise
        np.testing.assert_allclose(again.world_positions(), motion(name).world_positions(), atol=0.01)


@pytest.mark.parametrize("name", MADE)
def test_soles_are_on_the_floor_and_not_below_it(name: str) -> None:
    lowest = np.stack([soles(name, side)[..., 1].min(1) for side in ("Left", "Right")])
    assert lowest.min() > -0.01
    assert np.percentile(lowest.min(0), 30) < 0.005


@pytest.mark.parametrize("name", ["sit_stand", "wave", "pick_up", "t_to_a_pose"])
def test_planted_feet_do_not_move_at_all(name: str) -> None:
    ankles = places(name, "LeftAnkle", "RightAnkle")
    assert np.ptp(ankles, axis=0).max() < 1e-4


@pytest.mark.parametrize("name", ["sit_stand", "wave", "pick_up", "t_to_a_pose", "turn_in_place"])
def test_repeated_motions_end_as_they_start(name: str) -> None:
    first, last = motion(name).world_positions([0, -1]) * 0.01
    assert np.abs(first - last).max() < 0.004


@pytest.mark.parametrize("name", [*MADE, "walk"])
def test_joint_speeds_are_plausible_and_smooth(name: str) -> None:
    """Human speeds, and no jump between frames."""
    one = motion(name)
    speed = np.linalg.norm(np.diff(one.world_positions(), axis=0), axis=-1) * 0.01 / one.frame_time
    assert speed.max() < {"run": 8.5, "walk": 6.5, "wave": 3.6}.get(name, 3.0)
    assert np.abs(np.diff(speed, axis=0)).max() / one.frame_time < (260 if name == "run" else 110)


def test_running_has_stances_that_stay_and_flights() -> None:
    hips = places("run", "Hips")[:, 0]
    assert np.ptp(hips[:, 2]) / motion("run").duration == pytest.approx(3.0, abs=0.01)
    height = np.stack([soles("run", side)[..., 1].min(1) for side in ("Left", "Right")])
    flying = (height > 0.006).all(0)
    assert 0.12 < flying.mean() < 0.45
    for side, delay in (("Left", 0.0), ("Right", 0.5)):
        phase = (np.arange(motion("run").n_frames) / 60 / 0.7 - delay) % 1.0
        standing = (phase > 0.06) & (phase < 0.34)
        tip = soles("run", side)[:, 2]
        steps = np.linalg.norm(np.diff(tip, axis=0), axis=-1)[standing[1:] & standing[:-1]]
        assert steps.max() < 0.008  # 0.5 m/s, of a foot that otherwise moves at 6
    knee = places("run", "LeftHip", "LeftKnee", "LeftAnkle")
    thigh, shin = knee[:, 0] - knee[:, 1], knee[:, 2] - knee[:, 1]
    bend = 180 - np.degrees(
        np.arccos((thigh * shin).sum(-1) / np.linalg.norm(thigh, axis=-1) / np.linalg.norm(shin, axis=-1))
    )
    assert 90 < bend.max() < 120
    assert bend.min() < 20


def test_sitting_is_on_a_seat_of_45_cm_with_the_trunk_upright() -> None:
    hip, knee, neck = places("sit_stand", "LeftHip", "LeftKnee", "Neck").transpose(1, 0, 2)
    middle = slice(85, 115)
    np.testing.assert_allclose(hip[middle, 1], 0.54, atol=0.02)
    np.testing.assert_allclose(hip[middle, 1], knee[middle, 1], atol=0.08)  # thighs level
    lean = np.degrees(np.arctan2((neck - hip)[:, 2], (neck - hip)[:, 1]))
    assert np.abs(lean[middle]).max() < 15
    assert 30 < lean.max() < 60  # on the way down and up


def test_waving_is_four_times_with_the_hand_above_the_shoulder_and_the_palm_ahead() -> None:
    wrist, shoulder, elbow = places("wave", "RightWrist", "RightShoulder", "RightElbow").transpose(1, 0, 2)
    up = (wrist - elbow)[:, 1] > 0.18
    assert 1.8 < up.sum() / 30 < 3.2
    assert wrist[up, 1].min() > shoulder[up, 1].max() + 0.03
    aside = (wrist - elbow)[up, 0]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(aside))))
    assert 6 <= len(turns) <= 10
    one = motion("wave")
    palm = one.world_transforms(60)[one.joint("RightWrist"), :3, :3] @ [0, -1, 0]
    assert palm[2] > 0.7


def test_turn_in_place_is_a_full_rotation_on_planted_feet() -> None:
    one = motion("turn_in_place")
    ahead = one.world_transforms()[:, one.joint("Hips"), :3, 2]
    yaw = np.degrees(np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2])))
    assert yaw[-1] - yaw[0] == pytest.approx(360, abs=0.5)
    assert np.diff(yaw).min() > -1
    standing = 0
    for side in ("Left", "Right"):
        sole = soles("turn_in_place", side)
        down = sole[..., 1].max(1) < 0.0005
        both = down[1:] & down[:-1]
        assert np.linalg.norm(np.diff(sole, axis=0), axis=-1)[both].max() < 0.004
        standing = standing + down
    assert (standing >= 1).all()  # never in the air


def test_the_hand_reaches_the_object_and_lifts_it() -> None:
    wrist = places("pick_up", "RightWrist")[:, 0]
    low = wrist[66]  # 2.2 s
    np.testing.assert_allclose(low, [-0.16, 0.23, 0.43], atol=0.02)
    assert np.argmin(wrist[:, 1]) == pytest.approx(66, abs=8)
    assert wrist[120, 1] > 1.0  # at the chest
    knees = places("pick_up", "LeftHip", "LeftKnee")[66]
    assert knees[0, 1] < knees[1, 1] + 0.25  # knees bent


def test_t_and_a_pose_are_exact() -> None:
    one = motion("t_to_a_pose")
    for frame, degrees in ((0, 0), (60, 45), (120, 0)):
        for side, sign in (("Left", 1), ("Right", -1)):
            turn = one.world_transforms(frame)[one.joint(f"{side}Shoulder"), :3, :3]
            rest = one.world_transforms(0)[one.joint(f"{side}Shoulder"), :3, :3]
            about = Rotation.from_matrix(turn @ rest.T).as_rotvec(degrees=True)
            np.testing.assert_allclose(about, [0, 0, -sign * degrees], atol=0.01)


@cache
def played(name: str) -> tuple[np.ndarray, Retargeter, object]:
    """Bones (F, B, 4, 4) of the default human in all frames, the retargeter, and the joint poses."""
    world = to_world(read_motion(name))
    retargeter = Retargeter.fit(world, load_human("adult_man").skeleton)
    poses = world.sample(world.frame_times)
    return retargeter.pose(poses), retargeter, poses


@pytest.mark.parametrize("name", EVERYDAY)
def test_joints_stay_within_their_published_limits(name: str) -> None:
    _, retargeter, poses = played(name)
    rotations, _ = retargeter.apply(poses)
    assert load_limits().for_skeleton(retargeter.skeleton).report(rotations) == []


@pytest.mark.parametrize("name", EVERYDAY)
def test_arms_and_legs_do_not_go_through_the_body(name: str) -> None:
    human = load_human("adult_man")
    capsules = fit_capsules(human.skeleton, human.mesh, human.weights)
    # thighs and belly press on each other in a squat
    most = 40 if name in ("fall", "lift_box") else 20
    assert report_penetration(played(name)[0], capsules).depth_mm < most


@pytest.mark.parametrize("name", EVERYDAY)
def test_a_foot_on_the_floor_does_not_slide(name: str) -> None:
    """A point of the sole while it stays within 3 mm of its lowest place, as stiff tips are pressed down."""
    most = 0.0
    for side in ("Left", "Right"):
        for point in soles(name, side).swapaxes(0, 1):
            on = np.concatenate([[False], point[:, 1] < point[:, 1].min() + 0.003, [False]]).astype(int)
            for first, last in zip(
                np.flatnonzero(np.diff(on) == 1), np.flatnonzero(np.diff(on) == -1), strict=True
            ):
                run = point[first : last - 1, [0, 2]]
                most = max(most, np.linalg.norm(run[:, None] - run[None], axis=-1).max(initial=0))
    # the stiff sole of a walk rolls over its tip, as in the normal walk
    assert most < (0.005 if name in (*SIT, "stand", "talk", "phone", "squats", "dance", "lie") else 0.02)


@pytest.mark.parametrize("name", [*STAND, *SIT, "lie"])
def test_everyday_motions_repeat_without_a_jump(name: str) -> None:
    first, last = motion(name).world_positions([0, -1]) * 0.01
    assert np.abs(first - last).max() < 0.004


@pytest.mark.parametrize("name", EVERYDAY)
def test_everyday_motions_have_human_speeds(name: str) -> None:
    one = motion(name)
    speed = np.linalg.norm(np.diff(one.world_positions(), axis=0), axis=-1) * 0.01 / one.frame_time
    assert speed.max() < (6.5 if name in WALKS or name in STEPS else 5.2)
    assert np.abs(np.diff(speed, axis=0)).max() / one.frame_time < (150 if name == "walk_brisk" else 110)


@pytest.mark.parametrize("name", [*STAND, "turn_left"])
def test_who_stands_begins_in_the_same_pose(name: str) -> None:
    """Any of these motions can follow any other: feet are in one place, knees hardly bent more."""
    first, wave = (places(one, *motion(one).joint_names)[0] for one in (name, "wave"))
    apart = dict(zip(motion(name).joint_names, np.abs(first - wave).max(-1), strict=True))
    assert max(apart["LeftAnkle"], apart["RightAnkle"]) < 1e-4
    assert max(apart.values()) < 0.035


@pytest.mark.parametrize("gait", GAITS)
def test_first_and_last_step_lead_into_the_walk_and_out_of_it(gait: str) -> None:
    """Poses and speeds are the same where the steps meet the walk."""
    walk = motion("walk_straight" if gait == "walk" else gait)
    step = round(1 / 30 / walk.frame_time)
    start, stop = motion(f"{gait}_start"), motion(f"{gait}_stop")
    first, second = walk.world_positions([0, step]) * 0.01
    end = start.world_positions([-2, -1]) * 0.01
    np.testing.assert_allclose(end[1] - end[1][0], first - first[0], atol=2e-3)
    np.testing.assert_allclose((end[1] - end[0])[0], (second - first)[0], atol=8e-3)
    begin = stop.world_positions([0, 1]) * 0.01
    np.testing.assert_allclose(begin[0] - begin[0][0], first - first[0], atol=2e-3)
    np.testing.assert_allclose((begin[1] - begin[0])[0], (second - first)[0], atol=8e-3)


def test_gaits_have_their_speeds() -> None:
    for name, speed in (("walk_slow", 0.8), ("walk_brisk", 1.65), ("limp", 0.6), ("crawl", 0.354)):
        hips = places(name, "Hips")[:, 0]
        assert np.ptp(hips[:, 2]) / motion(name).duration == pytest.approx(speed, abs=0.02)


def test_limping_spares_the_right_leg() -> None:
    down = {side: (soles("limp", side)[..., 1].min(1) < 0.004).mean() for side in ("Left", "Right")}
    assert down["Left"] > down["Right"] + 0.1


def test_hands_reach_table_mouth_and_ear() -> None:
    wrists = places("write", "LeftWrist", "RightWrist")[60:180]
    np.testing.assert_allclose(wrists[..., 1], 0.79, atol=0.03)
    mouth = places("eat", "RightWrist", "Head")
    assert np.linalg.norm(mouth[:, 0] - mouth[:, 1], axis=-1).min() < 0.26
    ear = places("phone", "RightWrist", "Head")[100:220]
    assert np.linalg.norm(ear[:, 0] - ear[:, 1], axis=-1).max() < 0.25


def test_who_falls_lies_on_the_floor_and_stands_up_again() -> None:
    hips, head = places("fall", "Hips", "Head").transpose(1, 0, 2)
    assert head[100, 1] < 0.25
    assert hips[100, 1] < 0.15
    assert hips[-1, 1] > 0.9


def test_a_built_in_motion_of_somebody_who_lies_has_no_doubt_about_the_up_axis() -> None:
    for name in ("lie", "crawl", "fall"):
        assert to_world(read_motion(name)).frame.warning is None
