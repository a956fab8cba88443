"""Hips, shoulders, trunk and thighs of the body follow those of the file, whatever its OFFSETs are."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace

import motion_files as files
import numpy as np
import pytest
from conftest import SHARED_DATA, shared_motions
from motion_files import StandIn, an_l, one_axis, random_axes, stand_in
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimWarning
from humansim_ros.motion import Motion, Skeleton, hanim_skeleton, read_bvh
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.motion.matching.by_shape import match_motion
from humansim_ros.motion.matching.file_frame import detect_file_frame
from humansim_ros.motion.pose.retarget import Retargeter, RetargetMode, trunk_turns
from humansim_ros.motion.pose.world_motion import WorldMotion
from humansim_ros.types import Array

SKELETON = hanim_skeleton()
#: Files of a chain, of a head with two hands, of six joints, and of a dog.
NO_PERSONS = ("fairmotion_sinusoidal", "firepal_vr", "pybvh_rotation_first_root", "dog_D1_010")
PERSONS = shared_motions(*NO_PERSONS)
MOTIONS: dict[str, Mapping[str, Rotation]] = {
    "walk": files.walk(40),
    "walk to the side": files.walk(40, heading=35),
    "bow": files.bow(70, 40),
    "raised arms": files.raise_arms(40),
    "stands": files.arms_down(),
}


def in_world(motion: Motion) -> WorldMotion:
    match = match_motion(motion)
    return WorldMotion(motion, match, detect_file_frame(motion, match), loop="none")


def lines(at: Callable[[str], Array]) -> dict[str, Array]:
    """Directions (N, 3) of hips, shoulders, trunk and thighs from the positions of joints."""
    hips = (at("LeftHip") + at("RightHip")) / 2
    vectors = {
        "hips": at("LeftHip") - at("RightHip"),
        "shoulders": at("LeftShoulder") - at("RightShoulder"),
        "trunk": (at("LeftShoulder") + at("RightShoulder")) / 2 - hips,
        "left thigh": at("LeftKnee") - at("LeftHip"),
        "right thigh": at("RightKnee") - at("RightHip"),
    }
    return {name: line / np.linalg.norm(line, axis=-1, keepdims=True) for name, line in vectors.items()}


def lines_of_joints(poses: JointPoses, roles: Mapping[str, int]) -> dict[str, Array]:
    return lines(lambda role: poses.positions[:, roles[role]])


def lines_of_body(posed: Array) -> dict[str, Array]:
    def head(role: str) -> Array:
        bone = role.replace("Left", "l_").replace("Right", "r_").lower()
        return posed[:, SKELETON.bone(bone), :3, 3]

    return lines(head)


def differences(posed: Array, poses: JointPoses, roles: Mapping[str, int]) -> dict[str, float]:
    """Median angle (degrees) between each line of the body and that of the joints."""
    ours, theirs = lines_of_body(posed), lines_of_joints(poses, roles)
    cosines = {name: np.clip((ours[name] * theirs[name]).sum(-1), -1, 1) for name in ours}
    return {name: float(np.median(np.degrees(np.arccos(cosine)))) for name, cosine in cosines.items()}


def body_differences(motion: Motion) -> dict[str, float]:
    world = in_world(motion)
    poses = world.sample(world.frame_times[:: motion.n_frames // 400 + 1])
    return differences(Retargeter.fit(world, SKELETON).pose(poses), poses, world.match.roles)


@pytest.mark.parametrize("stem", PERSONS)
def test_the_body_has_the_lines_of_every_real_person(stem: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)
        found = body_differences(read_bvh(SHARED_DATA / "bvh" / f"{stem}.bvh"))
    assert max(found.values()) < 15, found


@pytest.mark.daily("lafan1-one_axis-walk", "bandai_namco-random_axes-raised arms")
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("axes", [None, one_axis, an_l, random_axes])
@pytest.mark.parametrize("family", ["mixamo", "lafan1", "cmu", "bandai_namco"])
def test_the_body_has_the_lines_of_a_person_in_any_axes(
    family: str, axes: Callable[[StandIn], Array] | None, motion: str
) -> None:
    person = stand_in(family)
    found = body_differences(person.motion(MOTIONS[motion], axes=None if axes is None else axes(person)))
    assert max(found.values()) < 5, found


# OFFSETs as rest pose


@pytest.mark.parametrize(
    ("axes", "stands"), [(None, True), (one_axis, False), (an_l, False), (random_axes, False)]
)
def test_offsets_are_a_rest_pose_where_trunk_and_legs_are_those_of_a_standing_person(
    axes: Callable[[StandIn], Array] | None, stands: bool
) -> None:
    person = stand_in("humanik")
    motion = person.motion(files.walk(20), axes=None if axes is None else axes(person))
    assert in_world(motion).frame.offsets_stand is stands


@pytest.mark.parametrize("role", ["HeadTop", "LeftKnee"])
def test_a_large_head_and_legs_apart_are_a_rest_pose(role: str) -> None:
    """A cartoon figure, and CMU's skeletons, whose thighs point 20 degrees to the sides."""
    person = stand_in("cmu")
    if role == "LeftKnee":
        person = person.moved(role, 42 * np.array([np.sin(0.35), -np.cos(0.35), 0]))
    else:
        person = replace(person, ends={**person.ends, person.joint("Head"): (0.0, 70.0, -10.0)})
    assert in_world(person.motion(files.walk(20))).frame.offsets_stand


@pytest.mark.parametrize("family", ["mixamo", "biovision"])
@pytest.mark.parametrize("degrees", [-30, -20, 20, 30])
def test_a_rest_pose_that_leans_is_taken_over_by_the_body(family: str, degrees: float) -> None:
    person = stand_in(family)
    lean = Rotation.from_euler("x", degrees, degrees=True)
    for role in ("Spine", "Chest", "Neck", "LeftCollar"):
        person = person.moved(role, lean.apply(person.offsets[person.joint(role)]))
    motion = person.motion(files.walk(40))
    assert in_world(motion).frame.offsets_stand
    found = body_differences(motion)
    assert max(found.values()) < 15, found


def deep_bend(axis: str, most: float = 150.0, frames: int = 30) -> dict[str, Rotation]:
    """The spine bends by ``most`` degrees below the chest, and the chest bends back."""
    bend = most * np.sin(files.phases(frames, 0.5)) ** 2
    return {
        **files.arms_down(frames),
        "Spine": files.turns(axis, bend),
        "Chest": files.turns(axis, -0.6 * bend),
        "LeftHip": files.turns("x", -0.4 * bend),
    }


@pytest.mark.parametrize("degrees", [150, -110])
@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("family", ["mixamo", "biovision"])
def test_the_trunk_follows_deep_bends_in_every_frame(family: str, axis: str, degrees: float) -> None:
    world = in_world(stand_in(family).motion(deep_bend(axis, degrees)))
    poses = world.sample(world.frame_times)
    ours = lines_of_body(Retargeter.fit(world, SKELETON).pose(poses))
    theirs = lines_of_joints(poses, world.match.roles)
    for name, line in ours.items():
        cosine = (line * theirs[name]).sum(-1)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 15, name


def test_the_spine_moves_steadily_into_a_deep_bend() -> None:
    frames = 400
    posed = retargeted(stand_in("mixamo").motion(deep_bend("z", frames=frames)))
    numbers = [SKELETON.bone(bone) for bone in ("sacroiliac", "vl5")]
    turns = np.swapaxes(posed[:-1, numbers, :3, :3], -1, -2) @ posed[1:, numbers, :3, :3]
    step = np.degrees(Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude())
    assert step.max() < 2 * np.pi * 150 / frames


def test_a_bone_without_a_joint_follows_the_spine_into_a_deep_bend() -> None:
    chest = SKELETON.bone("vl5")
    place = SKELETON.tails[[chest]] + [0, 0, 0.1]
    skeleton = Skeleton(
        (*SKELETON.names, "tie"),
        np.append(SKELETON.parents, chest),
        np.vstack([SKELETON.heads, place]),
        np.vstack([SKELETON.tails, place - [0, 0.3, 0]]),
        np.append(SKELETON.rolls, 0.0),
    )
    world = in_world(stand_in("mixamo").motion(deep_bend("z")))
    posed = Retargeter.fit(world, skeleton).pose(world.sample(world.frame_times))
    in_chest = np.linalg.inv(posed[:, chest]) @ posed[:, -1]
    np.testing.assert_allclose(in_chest, np.broadcast_to(in_chest[0], in_chest.shape), atol=1e-9)


def test_one_pose_has_the_same_trunk_as_many() -> None:
    world = in_world(stand_in("mixamo").motion(deep_bend("z")))
    retargeter = Retargeter.fit(world, SKELETON)
    times = world.frame_times
    together = retargeter.pose(world.sample(times))
    for frame in (0, 14):
        alone = retargeter.pose(world.sample(times[[frame]]))
        np.testing.assert_allclose(alone[0], together[frame], atol=1e-12)


@pytest.mark.parametrize("length", [1.0, 0.05, 0.0])
def test_the_spine_turns_until_the_trunk_is_within_the_tolerance(length: float) -> None:
    """Random trunks; a spine that is too short for its task does not break."""
    random = np.random.default_rng(3)
    rest, spines, goals = random.normal(size=(3, 200, 3)) * np.array([0.1, length, 1.0])[:, None, None]
    turns = trunk_turns(rest + spines, spines, goals)
    assert np.isfinite(turns).all()
    turned = rest + np.einsum("nij,nj->ni", turns, spines)
    a, b = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (turned, goals))
    angles = np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))
    long_enough = np.linalg.norm(spines, axis=1) > 1.01 * np.linalg.norm(rest, axis=1)
    assert (angles[long_enough] < 13.01).all()
    assert length < 1 or long_enough.sum() > 150


def test_without_a_rest_pose_a_bow_is_not_taken_for_standing() -> None:
    """The person stands for a tenth of the time, on tiptoe, and bows with flat feet."""
    person = stand_in("bandai_namco")
    bend = np.concatenate([np.zeros(6), np.full(54, 1.0)])
    turns = {
        role: Rotation.from_rotvec(turn.as_rotvec()[[30]] * bend[:, None])
        for role, turn in files.bow(70).items()
    }
    tiptoe = {f"{side}Ankle": files.turns("x", 25 * (1 - bend)) for side in ("Left", "Right")}
    arms = files.arms_down(60)
    found = body_differences(person.motion({**turns, **tiptoe, **arms}, axes=one_axis(person)))
    assert max(found.values()) < 8, found


def test_hips_are_not_snapped_to_the_axes_of_the_file() -> None:
    person = stand_in("lafan1")
    world = in_world(person.motion(files.walk(40, heading=12), axes=one_axis(person)))
    # the person faces +x, not a file axis 12 degrees beside it
    hips = lines_of_joints(world.sample(world.frame_times), world.match.roles)["hips"]
    assert np.degrees(np.arctan2(hips[:, 0], hips[:, 1])).mean() == pytest.approx(0, abs=3)


# Collars


def rise_of_collars(posed: Array, side: str) -> Array:
    """Elevation (N,) of a collar over its elevation at rest, in the axes of the chest, degrees."""
    chest = SKELETON.bone("vl5")
    turn = posed[:, chest, :3, :3] @ SKELETON.rest[chest, :3, :3].T
    bone, shoulder = (SKELETON.bone(f"{side}_{name}") for name in ("sternoclavicular", "shoulder"))
    collar = np.einsum("nji,nj->ni", turn, posed[:, shoulder, :3, 3] - posed[:, bone, :3, 3])
    at_rest = SKELETON.heads[shoulder] - SKELETON.heads[bone]
    elevations = [np.degrees(np.arctan2(v[..., 1], np.abs(v[..., 0]))) for v in (collar, at_rest)]
    return np.asarray(elevations[0] - elevations[1])


def retargeted(motion: Motion, mode: RetargetMode = "full") -> Array:
    world = in_world(motion)
    return Retargeter.fit(world, SKELETON, mode).pose(world.sample(world.frame_times))


@pytest.mark.parametrize("family", ["cmu", "mixamo", "smpl", "biovision"])
@pytest.mark.parametrize("degrees", [-10, 0, 25])
def test_collars_that_rise_in_the_offsets_do_not_shrug_the_shoulders(family: str, degrees: float) -> None:
    posed = retargeted(stand_in(family).with_raised_collars(degrees).motion(files.walk(40)))
    for side in "lr":
        np.testing.assert_allclose(rise_of_collars(posed, side), 0, atol=1)


@pytest.mark.parametrize("axes", [None, one_axis])
@pytest.mark.parametrize("family", ["cmu", "mixamo"])
def test_raised_arms_raise_the_collars(family: str, axes: Callable[[StandIn], Array] | None) -> None:
    person = stand_in(family).with_raised_collars(20)
    motion = person.motion(files.raise_arms(40, collar=25), axes=None if axes is None else axes(person))
    for side in "lr":
        rise = rise_of_collars(retargeted(motion), side)
        np.testing.assert_allclose(rise[[0, 20]], [0, 25], atol=3)


def test_in_mode_thesis_collars_are_parallel_to_their_links() -> None:
    world = in_world(stand_in("cmu").with_raised_collars(25).motion(files.walk(10)))
    poses = world.sample(world.frame_times)
    posed = Retargeter.fit(world, SKELETON, "thesis").pose(poses)
    start, end = world.match.parallel["l_sternoclavicular"]
    link = poses.positions[:, end] - poses.positions[:, start]
    along = posed[:, SKELETON.bone("l_sternoclavicular"), :3, 1]
    np.testing.assert_allclose(along, link / np.linalg.norm(link, axis=-1, keepdims=True), atol=1e-7)


# Rotations that do not describe the body


def largest_difference(a: Array, b: Array, bones: tuple[str, ...]) -> float:
    """Largest angle (degrees) between the rotations of bones in two bodies (N, B, 4, 4)."""
    numbers = [SKELETON.bone(bone) for bone in bones]
    ours, theirs = (Rotation.from_matrix(p[:, numbers, :3, :3].reshape(-1, 3, 3)) for p in (a, b))
    return float(np.degrees((ours.inv() * theirs).magnitude()).max())


def wrong_hips(turns: Mapping[str, Rotation]) -> Motion:
    person, rotations = files.wrong_hips(stand_in("mixamo"), turns)
    return person.motion(rotations)


@pytest.mark.parametrize("motion", ["walk", "walk to the side", "raised arms"])
def test_the_pelvis_follows_the_hip_joints_where_the_hips_rotate_on_their_own(motion: str) -> None:
    right, wrong = stand_in("mixamo").motion(MOTIONS[motion]), wrong_hips(MOTIONS[motion])
    trunk = ("HumanoidRoot", "HumanoidRoot_to_l_hip", "sacroiliac", "vl5", "l_hip", "r_knee", "l_shoulder")
    assert largest_difference(retargeted(wrong), retargeted(right), trunk) < 12
    assert max(body_differences(wrong).values()) < 5


def test_hips_that_rotate_on_their_own_for_a_third_of_the_time_are_not_used() -> None:
    person, turns = files.wrong_hips(stand_in("mixamo"), files.walk(60), degrees=0)
    right, wrong = turns["Hips"], files.wrong_hips(stand_in("mixamo"), files.walk(60))[1]["Hips"]
    turn = np.where((np.arange(60) < 20)[:, None], wrong.as_rotvec(), right.as_rotvec())
    hips = Rotation.from_rotvec(turn)
    undone = {name: hips.inv() * right * turns[name] for name in person.names if name.endswith("_virtual")}
    posed = retargeted(person.motion({**turns, "Hips": hips, **undone}))
    expected = retargeted(stand_in("mixamo").motion(files.walk(60)))
    assert largest_difference(posed, expected, ("HumanoidRoot", "sacroiliac", "vl5")) < 12


def test_the_chest_follows_the_shoulders_where_it_rotates_on_its_own() -> None:
    """Additional joints above collars and neck undo the rotation of the chest."""
    person, frames = stand_in("humanik"), 40
    wrong = files.turns("y", 70 * np.sin(files.phases(frames)))
    turns = {**files.walk(frames)}
    turns["Chest"] = wrong * (right := turns["Chest"])
    for role in ("LeftCollar", "RightCollar", "Neck"):
        name = f"{role}_virtual"
        person = person.with_joint_above(role, name)
        turns[name] = (wrong * right).inv() * right
    found = body_differences(person.motion(turns))
    assert max(found.values()) < 5, found
    expected = retargeted(stand_in("humanik").motion(files.walk(frames)))
    assert largest_difference(retargeted(person.motion(turns)), expected, ("HumanoidRoot", "vl5")) < 12


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("axes", [None, one_axis])
def test_the_rotations_of_ordinary_joints_are_used(
    axes: Callable[[StandIn], Array] | None, motion: str
) -> None:
    person = stand_in("mixamo")
    world = in_world(person.motion(MOTIONS[motion], axes=None if axes is None else axes(person)))
    assert Retargeter.fit(world, SKELETON).loose == ()


def test_the_legend_has_all_that_the_body_needs() -> None:
    """Hips that rotate on their own, raised collars, OFFSETs along one axis: all by way of JSON."""
    person, turns = files.wrong_hips(stand_in("mixamo").with_raised_collars(20), files.walk(30))
    world = in_world(person.motion(turns, axes=one_axis(person)))
    retargeter = Retargeter.fit(world, SKELETON)
    again = Retargeter.from_dict(json.loads(json.dumps(retargeter.to_dict())), SKELETON)
    poses = world.sample([0.0, 0.7])
    np.testing.assert_array_equal(again.pose(poses), retargeter.pose(poses))
    assert again.loose == retargeter.loose != ()


# Live sources


def without_rotations(poses: JointPoses) -> JointPoses:
    return JointPoses(poses.names, poses.positions, np.zeros_like(poses.rotations))


def in_own_axes(poses: JointPoses) -> JointPoses:
    """The same joints, each with constant axes of its own."""
    own = Rotation.random(len(poses.names), random_state=5).as_matrix()
    turns = Rotation.from_quat(poses.rotations.reshape(-1, 4)).as_matrix().reshape(-1, len(own), 3, 3) @ own
    quaternions = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat().reshape(poses.rotations.shape)
    return JointPoses(poses.names, poses.positions, quaternions)


SOURCES = {"rest pose": lambda poses: poses, "own axes": in_own_axes, "positions": without_rotations}


@pytest.mark.parametrize("source", SOURCES)
def test_a_live_source_does_not_shrug_and_raises_its_collars(source: str) -> None:
    world = in_world(stand_in("smpl").with_raised_collars(25).motion(files.raise_arms(40, collar=25)))
    poses = SOURCES[source](world.sample(world.frame_times))
    first = JointPoses(poses.names, poses.positions[:1], poses.rotations[:1])
    posed = Retargeter.fit_live(first, world.match, SKELETON).pose(poses)
    for side in "lr":
        np.testing.assert_allclose(rise_of_collars(posed, side)[[0, 20]], [0, 25], atol=4)


@pytest.mark.parametrize("source", SOURCES)
def test_the_pelvis_of_a_live_source_follows_the_hip_joints(source: str) -> None:
    world = in_world(wrong_hips(files.walk(40)))
    poses = SOURCES[source](world.sample(world.frame_times))
    posed = Retargeter.fit_live(poses, world.match, SKELETON).pose(poses)
    found = differences(posed, poses, world.match.roles)
    assert max(found.values()) < 5, found
