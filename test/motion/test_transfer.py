"""Retargeting of whole rotations, clips, mirrored motions, live sources: by SciPy and by symmetry."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import if_shared
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from stand_ins import STAND_INS
from test_retarget import (
    SHARED,
    SKELETON,
    STANDING,
    at_frames,
    in_world,
    read,
    real_and_ours,
    some_frames,
    turned,
    unit_vectors,
    with_channels,
)

from humansim_ros.errors import MotionError
from humansim_ros.geometry import WORLD_FROM_BODY
from humansim_ros.motion import Motion
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.motion.matching.by_shape import match_motion
from humansim_ros.motion.matching.file_frame import detect_file_frame
from humansim_ros.motion.matching.joint_tables import opposite_joints
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.motion.pose.retarget import Retargeter, RetargetMode
from humansim_ros.motion.pose.world_motion import Placement, WorldMotion
from humansim_ros.types import Array

LIMBS = [f"{side}_{part}" for side in "lr" for part in ("shoulder", "elbow", "hip", "knee")]


def at_rest(motion: Motion) -> WorldMotion:
    """The file's skeleton with all rotations zero."""
    return in_world(replace(motion, channels=((),) * motion.n_joints, values=np.zeros((1, 0))))


def angle_between(a: Array, b: Array) -> Array:
    """Degrees between rotation matrices (..., 3, 3)."""
    difference = Rotation.from_matrix((np.swapaxes(a, -1, -2) @ b).reshape(-1, 3, 3))
    return np.degrees(difference.magnitude())


def bent(joint: str, turn: Rotation) -> WorldMotion:
    """The skeleton of the walk at rest, with one joint rotated in file axes."""
    motion = read("walk")
    quaternions = np.zeros((1, motion.n_joints, 4))
    quaternions[..., 3] = 1
    quaternions[0, motion.joint(joint)] = turn.as_quat()
    return in_world(
        with_channels(
            replace(motion, values=motion.values[:1]), motion.offsets, motion.offsets[None], quaternions
        )
    )


@pytest.mark.parametrize("degrees", [-80, 35, 120])
@pytest.mark.parametrize(
    ("joint", "end", "bone"),
    [("LeftElbow", "LeftWrist", "l_elbow"), ("RightHip", "RightKnee", "r_hip"), ("Head", "Head_end", "vt3")],
)
def test_a_twist_about_a_link_is_the_bones_twist(joint: str, end: str, bone: str, degrees: float) -> None:
    motion = read("walk")
    link = motion.offsets[motion.joint(end)] / np.linalg.norm(motion.offsets[motion.joint(end)])
    twisted = bent(joint, Rotation.from_rotvec(np.radians(degrees) * link))
    number = SKELETON.bone(bone)
    still = at_rest(motion)
    for mode, expected in (("full", degrees), ("thesis", 0)):
        before = Retargeter.fit(still, SKELETON, mode).pose(still.sample(0.0))[0, number, :3, :3]
        after = Retargeter.fit(twisted, SKELETON, mode).pose(twisted.sample(0.0))[0, number, :3, :3]
        about_bone = Rotation.from_matrix(before.T @ after).as_rotvec(degrees=True)
        np.testing.assert_allclose(about_bone, [0, expected, 0], atol=1e-4)


@pytest.mark.parametrize("stem", ["walk", *STANDING])
def test_bones_rotate_from_rest_as_their_joints_do(stem: str) -> None:
    """Joint rotations by SciPy down the tree; the rest of the bones from the file with all rotations zero.

    Links over several joints are not rigid, and bones rotate further to be parallel: trunks only.
    """
    motion = read(stem)
    world, still = in_world(motion), at_rest(motion)
    rest = Retargeter.fit(still, SKELETON).pose(still.sample(0.0))[0]
    retargeter = Retargeter.fit(world, SKELETON)
    frames = some_frames(motion, 5)
    posed = retargeter.pose(at_frames(world, frames))
    to_world = Rotation.from_matrix(world.frame.world_from_file)
    for name in LIMBS:
        bone, joint = SKELETON.bone(name), retargeter.match.parallel[name][0]
        for number, frame in enumerate(frames):
            turn = (to_world * turned(motion, int(frame), joint) * to_world.inv()).as_matrix()
            assert angle_between(turn @ rest[bone, :3, :3], posed[number, bone, :3, :3]) < 1.0, name


@pytest.mark.parametrize(
    "stem",
    ["walk", *STAND_INS, *if_shared(*(stem for stem in SHARED if stem != "aitviewer_sample"))],
)
def test_elbows_and_knees_bend_about_the_axes_of_the_skeleton(stem: str) -> None:
    """The plane of a bent limb shows the twist of its bones, in any rest pose.

    Knees to 10 degrees; elbows, whose zero is that of the file, to 35; swing alone differs by up to 78.
    """
    motion = read(stem)
    world = in_world(motion)
    posed = Retargeter.fit(world, SKELETON).pose(at_frames(world, some_frames(motion, 400)))
    for upper, lower, axis, most in (
        ("l_shoulder", "l_elbow", [0, 0, -1], 36),
        ("r_shoulder", "r_elbow", [0, 0, 1], 36),
        ("l_hip", "l_knee", [0, 1, 0], 13),
        ("r_hip", "r_knee", [0, 1, 0], 13),
    ):
        u, v = SKELETON.bone(upper), SKELETON.bone(lower)
        bend = np.cross(posed[:, u, :3, 1], posed[:, v, :3, 1])
        own = posed[:, u, :3, :3] @ (WORLD_FROM_BODY @ SKELETON.rest[u, :3, :3]).T @ axis
        across = unit_vectors(np.cross(posed[:, u, :3, 1], np.cross(own, posed[:, u, :3, 1])))
        mean = (unit_vectors(bend) * across).sum(-1) @ np.linalg.norm(bend, axis=-1)
        assert mean / np.linalg.norm(bend, axis=-1).sum() > np.cos(np.radians(most)), upper


def test_a_t_pose_at_rest_leaves_the_skeleton_at_rest() -> None:
    still = at_rest(read("walk"))
    limbs = [SKELETON.bone(name) for name in LIMBS]
    posed = Retargeter.fit(still, SKELETON).pose(still.sample(0.0))[0, limbs, :3, :3]
    at_home = WORLD_FROM_BODY @ SKELETON.rest[limbs, :3, :3]
    assert angle_between(posed, at_home).max() < 17  # H-Anim's upper arms hang a little


def test_root_scale_by_height_by_legs_or_given() -> None:
    world = in_world(read("walk"))
    by_height, by_legs = (Retargeter.fit(world, SKELETON, root_scale=by) for by in ("height", "legs"))
    rest = read("walk").rest_positions() * 0.01
    at = {name: rest[read("walk").joint(name)] for name in ("LeftHip", "LeftKnee", "LeftAnkle")}
    leg = np.linalg.norm(at["LeftHip"] - at["LeftKnee"]) + np.linalg.norm(at["LeftKnee"] - at["LeftAnkle"])
    ours = SKELETON.lengths[[SKELETON.bone("l_hip"), SKELETON.bone("l_knee")]].sum()
    assert by_legs.scale == pytest.approx(ours / leg, rel=1e-6)
    assert by_height.scale == pytest.approx(by_legs.scale, rel=0.2)
    assert Retargeter.fit(world, SKELETON, root_scale=0.5).scale == 0.5
    for wrong in ("hight", -1.0, float("nan")):
        with pytest.raises(MotionError, match="root scale"):
            Retargeter.fit(world, SKELETON, root_scale=wrong)  # type: ignore[arg-type]


# Clips


def test_start_end_and_speed_select_the_played_part() -> None:
    plain = in_world(read("walk"), placement=Placement(anchor="file"))
    part = replace(plain, start=0.5, end=1.25, speed=2.0)
    assert part.duration == pytest.approx(0.375)
    for frame in (0.5, 6.5, 40.5):  # amid frames, where positions go straight
        time = frame / 120
        expected = plain.sample_with_velocities(0.5 + 2 * time)
        got = part.sample_with_velocities(time)
        # the floor is that of the played part
        np.testing.assert_allclose(got.positions[..., :2], expected.positions[..., :2], atol=1e-9)
        assert got.linear is not None and expected.linear is not None
        assert got.angular is not None and expected.angular is not None
        np.testing.assert_allclose(got.linear, 2 * expected.linear, atol=2e-3)
        np.testing.assert_allclose(got.angular, 2 * expected.angular, atol=2e-2)
    last = part.sample(100.0).positions
    np.testing.assert_allclose(last[..., :2], plain.sample(1.25).positions[..., :2], atol=1e-9)


def test_a_motion_at_speed_zero_is_static() -> None:
    still = replace(in_world(read("walk"), "repeat"), speed=0.0).sample_with_velocities([0.0, 5.0])
    assert still.linear is not None
    np.testing.assert_array_equal(still.positions[0], still.positions[1])
    np.testing.assert_array_equal(still.linear, 0)


@pytest.mark.parametrize("loop", ["repeat", "continue"])
def test_blended_cycles_have_no_jump(loop: Any) -> None:
    """A clip that ends within a stride and starts in another pose."""
    motion = read("walk")
    cut = replace(in_world(motion, loop), start=0.1, end=1.37)
    smooth = replace(cut, blend=0.3)
    assert smooth.cycle_length == pytest.approx(cut.cycle_length - 0.3)

    def largest_step(world: WorldMotion) -> float:
        around = world.duration * np.array([1, 2])[:, None] + np.array([-1e-6, 1e-6])
        positions = world.sample(around.ravel()).positions.reshape(2, 2, -1, 3)
        return float(np.abs(positions[:, 1] - positions[:, 0]).max())

    assert largest_step(cut) > 0.1
    assert largest_step(smooth) < 1e-4
    # after the fade, and in the whole first round, it is the file's own pose
    for time in (0.05, 0.31, 0.9):
        np.testing.assert_allclose(smooth.sample(time).positions, cut.sample(time).positions, atol=1e-9)
    speeds = smooth.sample_with_velocities(np.linspace(0, 3, 301)).linear
    assert speeds is not None
    if loop == "continue":
        assert np.linalg.norm(speeds, axis=-1).max() < 9


def test_a_blended_walk_keeps_walking_around_its_circle() -> None:
    """Over a whole cycle of the walk, which is closed, blending changes nearly nothing."""
    world = in_world(read("walk"), "continue")
    faded = replace(world, blend=0.2)
    speed = np.linalg.norm(np.diff(faded.sample(np.linspace(0, 7, 200)).positions[:, 0], axis=0), axis=-1)
    assert speed.max() < 1.6 * speed.min()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"start": -1.0}, "start is -1"),
        ({"start": 9.0}, "outside the motion's 0 to 2 s"),
        ({"start": 1.0, "end": 0.5}, "must come after start"),
        ({"end": 0.0}, "must come after start"),
        ({"end": 5e-324}, "at least 0.001 s after start"),
        ({"start": 0.5, "end": 0.5001}, "at least 0.001 s after start"),
        ({"speed": -1.0}, "speed must be"),
        ({"speed": float("nan")}, "speed must be"),
        ({"blend": 1.5}, "blend"),
    ],
)
def test_contradicting_start_end_and_blend_are_errors(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(MotionError, match=message):
        replace(in_world(read("walk"), "repeat"), **wrong)  # type: ignore[arg-type]


# Mirrored


def swapped(name: str) -> str:
    return name.replace("Left", "?").replace("Right", "Left").replace("?", "Right")


@pytest.mark.parametrize("loop", ["none", "continue"])
def test_a_mirrored_motion_is_the_reflection_with_swapped_sides(loop: Any) -> None:
    placement = Placement((1.0, -2.0), 0.7)
    world = in_world(read("walk"), loop, placement)
    order = [world.names.index(swapped(name)) for name in world.names]
    times = [0.0, 0.33, 1.9, 4.2]
    plain, mirrored = (
        world.sample_with_velocities(times),
        replace(world, mirror=True).sample_with_velocities(times),
    )
    ahead = Rotation.from_euler("z", 0.7).as_matrix()
    plane = ahead @ np.diag([1.0, -1, 1]) @ ahead.T
    expected = (plain.positions[:, order] - [1, -2, 0]) @ plane + [1, -2, 0]
    np.testing.assert_allclose(mirrored.positions, expected, atol=1e-9)
    turns = Rotation.from_quat(plain.rotations[:, order].reshape(-1, 4)).as_matrix()
    got = Rotation.from_quat(mirrored.rotations.reshape(-1, 4)).as_matrix()
    # rotations count from a body at rest that faces +x, also in the mirror
    np.testing.assert_allclose(got, plane @ turns @ np.diag([1.0, -1, 1]), atol=1e-9)
    assert mirrored.angular is not None and plain.angular is not None
    np.testing.assert_allclose(mirrored.angular, -plain.angular[:, order] @ plane, atol=1e-6)


def test_heading_turns_a_mirrored_motion_as_a_whole() -> None:
    ahead, turned = (
        replace(in_world(read("walk"), "none", Placement((0.0, 0.0), yaw)), mirror=True).sample([0.4])
        for yaw in (0.0, 0.7)
    )
    turn = Rotation.from_euler("z", 0.7)
    np.testing.assert_allclose(turned.positions[0], turn.apply(ahead.positions[0]), atol=1e-9)
    between = (turn * Rotation.from_quat(ahead.rotations[0])).inv() * Rotation.from_quat(turned.rotations[0])
    np.testing.assert_allclose(between.magnitude(), 0.0, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(yaw=st.floats(-3, 3), x=st.floats(-5, 5), y=st.floats(-5, 5), time=st.floats(0, 6))
def test_mirrored_twice_is_the_same(yaw: float, x: float, y: float, time: float) -> None:
    world = in_world(read("walk"), "continue", Placement((x, y), yaw))
    positions, turns = (
        world.sample(time).positions,
        Rotation.from_quat(world.sample(time).rotations[0]).as_matrix(),
    )
    twice = world._mirrored(*world._mirrored(positions, turns[None]))
    np.testing.assert_allclose(twice[0], positions, atol=1e-9)
    np.testing.assert_allclose(twice[1][0], turns, atol=1e-9)


def test_a_mirrored_body_is_the_body_reflected() -> None:
    """On a skeleton that is symmetric except for its collars: hands and feet to 3 cm."""
    world = in_world(read("walk"), "none")
    plain, mirrored = (
        Retargeter.fit(w, SKELETON).pose(w.sample(0.4)) for w in (world, replace(world, mirror=True))
    )
    for name in ("l_hip", "l_knee", "l_ankle", "r_knee", "l_elbow", "r_wrist"):
        other = ("r" if name[0] == "l" else "l") + name[1:]
        ours, theirs = (posed[0, SKELETON.bone(n), :3, 3] for posed, n in ((mirrored, name), (plain, other)))
        np.testing.assert_allclose(ours, theirs * [1, -1, 1], atol=0.03, err_msg=name)


@pytest.mark.parametrize(
    ("names", "pairs"),
    [
        ("Hips LeftHip RightHip Head", [0, 2, 1, 3]),
        ("pelvis upperleg.R upperleg.L l_knee r_knee", [0, 2, 1, 4, 3]),
        ("root thigh_l thigh_r lShldr rShldr", [0, 2, 1, 4, 3]),
        ("mixamorig:LeftArm mixamorig:RightArm Bip01 L Thigh", [1, 0, 2, 3, 4]),
        ("LeftToe RightFoot", [0, 1]),
        ("Leftovers all", [0, 1]),
    ],
)
def test_opposite_joints_are_found_by_name(names: str, pairs: list[int]) -> None:
    assert opposite_joints(names.split(" "), {}).tolist()[: len(pairs)] == pairs


def test_opposite_joints_are_found_by_role() -> None:
    assert opposite_joints(["a", "b", "c"], {"Hips": 0, "LeftHip": 2, "RightHip": 1}).tolist() == [0, 2, 1]


# Given values instead of detected ones


def test_given_up_and_facing_are_used() -> None:
    motion = read("walk")
    match = match_motion(motion)
    found = detect_file_frame(motion, match)
    assert (found.up, found.facing) == ("y", "z")
    same = detect_file_frame(motion, match, up="y", facing="z")
    np.testing.assert_allclose(same.world_from_file, found.world_from_file, atol=1e-12)
    turned_about = detect_file_frame(motion, match, facing="x")
    np.testing.assert_allclose(turned_about.world_from_file @ [1, 0, 0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(turned_about.world_from_file @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    lying = detect_file_frame(motion, match, up="-z")
    np.testing.assert_allclose(lying.world_from_file @ [0, 0, -1], [0, 0, 1], atol=1e-12)
    for wrong in ({"up": "w"}, {"up": "y", "facing": "-y"}, {"facing": "yz"}):
        with pytest.raises(MotionError, match=r"axis|cannot face"):
            detect_file_frame(motion, match, **wrong)  # type: ignore[arg-type]


# Live sources


def convention(poses: JointPoses, seed: int) -> JointPoses:
    """The same joints, each with constant axes of its own."""
    own = Rotation.random(len(poses.names), random_state=seed).as_matrix()
    turns = Rotation.from_quat(poses.rotations.reshape(-1, 4)).as_matrix().reshape(-1, len(own), 3, 3) @ own
    quaternions = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat().reshape(poses.rotations.shape)
    return JointPoses(poses.names, poses.positions, quaternions)


def without_turns(poses: JointPoses, w: float) -> JointPoses:
    rotations = np.zeros_like(poses.rotations)
    rotations[..., 3] = w
    return JointPoses(poses.names, poses.positions, rotations)


@pytest.mark.parametrize("stem", ["walk", *STANDING])
def test_a_live_source_is_fitted_to_its_first_pose(stem: str) -> None:
    motion = read(stem)
    world = in_world(motion)
    frames = some_frames(motion, 30)
    poses = at_frames(world, frames)
    first = at_frames(world, frames[:1])
    known = Retargeter.fit(world, SKELETON, root_scale="legs")
    live = Retargeter.fit_live(first, known.match, SKELETON)
    ours, theirs = live.pose(poses), known.pose(poses)
    assert live.scale == pytest.approx(known.scale, rel=0.02)
    assert angle_between(ours[..., :3, :3], theirs[..., :3, :3]).max() < 2.0
    lowest = ours[:, [SKELETON.bone("l_ankle"), SKELETON.bone("r_ankle")], 2, 3].min()
    assert -0.1 < lowest < 0.35


@pytest.mark.parametrize("kind", ["own axes", "identity", "unset"])
@real_and_ours
def test_a_source_of_any_convention_has_its_limbs_parallel(stem: str, kind: str) -> None:
    motion = read(stem)
    world = in_world(motion)
    poses = at_frames(world, some_frames(motion, 12))
    if kind == "own axes":
        poses = convention(poses, 3)
    else:
        poses = without_turns(poses, 1.0 if kind == "identity" else 0.0)
    first = JointPoses(poses.names, poses.positions[:1], poses.rotations[:1])
    live = Retargeter.fit_live(first, world.match, SKELETON)
    assert live.positions_only == (kind != "own axes")
    posed = live.pose(poses)
    for bone in LIMBS:
        start, end = live.match.parallel[bone]
        link = unit_vectors(poses.positions[:, end] - poses.positions[:, start])
        cosine = (posed[:, SKELETON.bone(bone), :3, 1] * link).sum(-1)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.1, bone
    hips = [SKELETON.bone("l_hip"), SKELETON.bone("r_hip")]
    across = unit_vectors(np.diff(posed[:, hips][..., :3, 3], axis=1)[:, 0])
    roles = live.match.roles
    theirs = unit_vectors(poses.positions[:, roles["RightHip"]] - poses.positions[:, roles["LeftHip"]])
    assert np.degrees(np.arccos(np.clip((across * theirs).sum(-1), -1, 1))).max() < 15


def test_joints_at_one_place_are_an_error() -> None:
    world = in_world(read("walk"))
    poses = world.sample(0.0)
    with pytest.raises(MotionError, match="legs have no length"):
        Retargeter.fit_live(replace(poses, positions=poses.positions * 0), world.match, SKELETON)


def test_clamped_bones_stay_within_their_limits() -> None:
    """A knee bent in the wrong direction and a head rotated backwards."""
    limits = load_limits().for_skeleton(SKELETON)
    for joint, turn in (("LeftKnee", [-1.2, 0, 0]), ("Head", [0, 2.4, 0])):
        world = bent(joint, Rotation.from_rotvec(turn))
        free, clamped = (Retargeter.fit(world, SKELETON, clamp=clamp) for clamp in (False, True))
        poses = world.sample(0.0)
        assert limits.report(free.apply(poses)[0])
        assert not limits.report(clamped.apply(poses)[0])
        np.testing.assert_allclose(clamped.pose(poses), SKELETON.pose(*clamped.apply(poses)), atol=1e-12)


@pytest.mark.parametrize("mode", ["full", "thesis"])
def test_the_constants_survive_json(mode: RetargetMode) -> None:
    world = in_world(read("walk"))
    retargeter = Retargeter.fit(world, SKELETON, mode)
    again = Retargeter.from_dict(json.loads(json.dumps(retargeter.to_dict())), SKELETON)
    poses = world.sample([0.0, 0.7])
    np.testing.assert_array_equal(again.pose(poses), retargeter.pose(poses))


@pytest.mark.parametrize(
    "broken",
    [
        {"rest": [1, 2]},
        {"scale": "x"},
        {"mode": "half"},
        {"lift": float("nan")},
        {"loose": ["tail"]},
        {"loose": 3},
        {"rest_links": {"l_hip": [1, 2]}},
        {"rest_links": {"l_hip": [1, 2, float("nan")]}},
        {"rest_links": {"tail": [0, 1, 0]}},
    ],
)
def test_broken_constants_are_errors(broken: dict[str, Any]) -> None:
    data = Retargeter.fit(in_world(read("walk")), SKELETON).to_dict()
    with pytest.raises(MotionError, match="not the constants of a retargeter"):
        Retargeter.from_dict({**data, **broken}, SKELETON)
    with pytest.raises(MotionError, match="not the constants of a retargeter"):
        Retargeter.from_dict({}, SKELETON)
