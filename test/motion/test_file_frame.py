"""The up axis of a file is known though the person lies, crawls or stands on the hands."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import motion_files as files
import numpy as np
import pytest
from conftest import ROOT
from motion_files import Rotations, StandIn, one_axis, stand_in, turns
from scipy.spatial.transform import Rotation

from humansim_ros.motion import Motion, read_motion
from humansim_ros.motion.body.kinematics import motion_of_rotations
from humansim_ros.motion.matching.by_shape import match_motion
from humansim_ros.motion.matching.file_frame import FileFrame, detect_file_frame
from humansim_ros.motion.pose.reports import describe_motion
from humansim_ros.types import Array

FRAMES = 60
PERSON = stand_in("mixamo")
WAVE = np.sin(files.phases(FRAMES, 2))


def on_both_sides(axis: str, degrees: Array, *parts: str, mirrored: bool = False) -> dict[str, Rotation]:
    other = -degrees if mirrored else degrees
    rows = [(f"Left{part}", degrees) for part in parts] + [(f"Right{part}", other) for part in parts]
    return {role: turns(axis, angle) for role, angle in rows}


def constant(degrees: float) -> Array:
    return np.full(FRAMES, degrees)


ARMS_UP = on_both_sides("z", 80 + 10 * WAVE, "Shoulder", mirrored=True)
#: In a file with y up; the person never stands.
ON_THE_FLOOR: dict[str, Rotations] = {
    "lies on the back": {"Hips": turns("x", -88 + 2 * WAVE), **files.arms_down(FRAMES)},
    "lies on the side": {"Hips": turns("z", 87 + 3 * WAVE), "LeftHip": turns("x", 20 * WAVE)},
    "does a handstand": {"Hips": turns("z", 178 + 4 * WAVE), **ARMS_UP},
    "crawls": {
        "Hips": turns("x", constant(80)),
        **on_both_sides("x", -75 + 15 * WAVE, "Hip"),
        **on_both_sides("x", constant(90), "Knee"),
        **on_both_sides("y", -80 + 15 * WAVE, "Shoulder", mirrored=True),
    },
    "spins on the back": {
        "Hips": turns("y", 20 * WAVE) * turns("x", constant(-90)),
        **on_both_sides("x", -60 + 30 * WAVE, "Hip"),
    },
    "swims": {"Hips": turns("x", 90 + 5 * WAVE), **ARMS_UP, **on_both_sides("x", 15 * WAVE, "Hip")},
    "bends backwards on the elbows": {
        "Hips": turns("x", constant(-60)),
        "Spine": turns("x", constant(-60)),
        "Chest": turns("x", -50 + 10 * WAVE),
        **on_both_sides("x", constant(60), "Hip"),
    },
}
STANDING: dict[str, Rotations] = {
    "walks": files.walk(FRAMES),
    "bows": files.bow(80, FRAMES),
    "raises the arms": files.raise_arms(FRAMES),
}
UPRIGHT = Rotation.identity()
Z_UP = Rotation.from_euler("x", 90, degrees=True)
Y_DOWN = Rotation.from_euler("x", 180, degrees=True)


def path(person: StandIn, rotations: Rotations, name: str) -> Array:
    """Translation (F, 3) of the root, in the axes of the T pose: the lowest joint is on the floor."""
    root = np.zeros((FRAMES, 3))
    if name in ("walks", "crawls", "swims"):
        root[:, 2] = np.linspace(0, 600, FRAMES)
    lowest = person.positions(rotations, root)[..., 1].min(1)
    root[:, 1] -= lowest.max() if name in ("walks", "swims") else lowest
    return root


def raised(person: StandIn, rotations: Rotations, root: Array, turn: Rotation) -> tuple[Rotations, Array]:
    """The motion turned as a whole by its root, so that the OFFSETs lie in the axes of the file."""
    at = turn.apply(person.offsets[0] + root) - person.offsets[0]
    return {**rotations, "Hips": turn * rotations.get("Hips", turns("x", constant(0)))}, at


def turned(person: StandIn, rotations: Rotations, root: Array, turn: Rotation) -> Motion:
    """The motion in a file with other axes, OFFSETs included."""
    ends = {joint: tuple(turn.apply(end).tolist()) for joint, end in person.ends.items()}
    person = replace(person, offsets=turn.apply(person.offsets), ends=ends)
    local = {role: turn * rotation * turn.inv() for role, rotation in rotations.items()}
    return person.motion(local, turn.apply(root))


def frame_of(motion: Motion) -> FileFrame:
    return detect_file_frame(motion, match_motion(motion))


@pytest.mark.parametrize("turn", [UPRIGHT, Z_UP], ids=["y up", "z up"])
@pytest.mark.parametrize("name", ON_THE_FLOOR)
def test_a_person_on_the_floor_does_not_hide_the_up_axis_of_the_offsets(name: str, turn: Rotation) -> None:
    rotations = ON_THE_FLOOR[name]
    frame = frame_of(turned(PERSON, rotations, path(PERSON, rotations, name), turn))
    assert frame.up == ("z" if turn is Z_UP else "y")
    np.testing.assert_allclose(frame.rest_from_body, turn.as_matrix(), atol=1e-6)


@pytest.mark.parametrize("name", ON_THE_FLOOR)
def test_a_file_without_positions_has_the_up_axis_of_its_offsets(name: str) -> None:
    frame = frame_of(PERSON.motion(ON_THE_FLOOR[name]))
    # nothing tells a person who only lies along z from one who stands in a file with z up
    certain = name not in ("lies on the back", "crawls", "swims")
    assert frame.up == "y" or not certain


def standing_first(rotations: Rotations) -> dict[str, Rotation]:
    """A motion whose first frames stand in the T pose."""
    out = {}
    for role, rotation in rotations.items():
        vectors = rotation.as_rotvec()
        vectors[:4] = 0
        out[role] = Rotation.from_rotvec(vectors)
    return out


@pytest.mark.parametrize("name", ON_THE_FLOOR)
def test_frame_0_has_the_up_axis_where_the_offsets_are_no_rest_pose(name: str) -> None:
    rotations = standing_first(ON_THE_FLOOR[name])
    frame = frame_of(PERSON.motion(rotations, path(PERSON, rotations, name), one_axis(PERSON)))
    assert frame.up == "y"
    assert not frame.offsets_stand


def test_someone_who_crawls_from_the_first_frame_on_does_so_on_the_floor() -> None:
    rotations = ON_THE_FLOOR["crawls"]
    frame = frame_of(PERSON.motion(rotations, path(PERSON, rotations, "crawls"), one_axis(PERSON)))
    assert (frame.up, frame.confidence) == ("y", 0.5)


@pytest.mark.parametrize(("turn", "up"), [(Z_UP, "z"), (Y_DOWN, "-y")])
@pytest.mark.parametrize("name", STANDING)
def test_a_root_that_raises_lying_offsets_has_the_up_axis(name: str, turn: Rotation, up: str) -> None:
    rotations = STANDING[name]
    frame = frame_of(PERSON.motion(*raised(PERSON, rotations, path(PERSON, rotations, name), turn)))
    assert (frame.up, frame.confidence, frame.warning) == (up, 1.0, None)


def test_a_t_pose_that_its_root_raises_tells_the_up_axis_of_floor_work() -> None:
    rotations = standing_first(ON_THE_FLOOR["spins on the back"])
    root = path(PERSON, rotations, "spins")
    assert frame_of(PERSON.motion(*raised(PERSON, rotations, root, Z_UP))).up == "z"


@pytest.mark.daily("walks-rest pose-bandai_namco", "raises the arms-one axis-bandai_namco")
@pytest.mark.parametrize("family", ["mixamo", "lafan1", "cmu", "bandai_namco"])
@pytest.mark.parametrize("axes", ["rest pose", "one axis"])
@pytest.mark.parametrize("name", STANDING)
def test_nobody_is_warned_of_a_person_who_stands(family: str, axes: str, name: str) -> None:
    person, rotations = stand_in(family), STANDING[name]
    joint_axes = one_axis(person) if axes == "one axis" else None
    frame = frame_of(person.motion(rotations, path(person, rotations, name), joint_axes))
    assert (frame.up, frame.confidence, frame.warning) == ("y", 1.0, None)


@pytest.mark.daily("walks-rest pose-turn1--z-z", "bows-one axis-turn2-x-y or z")
@pytest.mark.parametrize(
    ("turn", "up", "instead"),
    [
        (Y_DOWN, "-y", "y"),
        (Rotation.from_euler("x", -90, degrees=True), "-z", "z"),
        (Rotation.from_euler("z", -90, degrees=True), "x", "y or z"),
        (Rotation.from_euler("z", 90, degrees=True), "-x", "y or z"),
    ],
)
@pytest.mark.parametrize("axes", ["rest pose", "one axis"])
@pytest.mark.parametrize("name", STANDING)
def test_a_file_that_stands_upside_down_or_along_x_is_in_doubt(
    name: str, axes: str, turn: Rotation, up: str, instead: str
) -> None:
    rotations = STANDING[name]
    root = path(PERSON, rotations, name)
    if axes == "rest pose":
        motion = turned(PERSON, rotations, root, turn)
    else:
        motion = PERSON.motion(*raised(PERSON, rotations, root, turn), one_axis(PERSON))
    frame = frame_of(motion)
    assert (frame.up, frame.confidence) == (up, 0.5)
    assert f"give the axis (up: {instead})" in str(frame.warning)


def test_a_head_below_the_hips_in_most_frames_is_in_doubt() -> None:
    """Someone bends down all the time; or the arms were taken for legs."""
    rotations = {"Hips": turns("x", constant(110)), **on_both_sides("x", constant(-110), "Hip")}
    frame = frame_of(PERSON.motion(rotations, path(PERSON, rotations, "bends")))
    assert (frame.up, frame.confidence) == ("y", 0.5)
    assert "in only 0% of the frames. y is taken as up" in str(frame.warning)
    few = {role: turn[:25] for role, turn in rotations.items()}
    most = {role: Rotation.concatenate([turn, *[UPRIGHT] * 35]) for role, turn in few.items()}
    assert frame_of(PERSON.motion(most, path(PERSON, most, "bends"))).warning is None


#: Real files of people who stand and walk; others contradict themselves.
REAL = (
    *("adakri_run", "aitviewer_sample", "animdraw_cmu1_jumping_jacks", "animdraw_rokoko_jesse_dance"),
    *("assimp_Boxing_Toes", "bandai_bow_normal_001", "bvhio_example", "bvhtoolbox_walk01"),
    *("chenzhike_result", "coda02_woman", "griebel_Example1", "loadbvh_test", "makehuman_tpose"),
    *("makehuman_walk1", "mixamo_freebvh", "mocapbank_bvhpython", "pybvh_cmu_12_01_walk", "pybvh_test1"),
    *("rmginner_A1_Stand", "tomboudard_walkSit"),
)


@pytest.mark.daily("adakri_run", "loadbvh_test")
@pytest.mark.parametrize("name", REAL)
def test_nobody_is_warned_of_real_files(shared_data: Path, name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frame = frame_of(read_motion(shared_data / "bvh" / f"{name}.bvh"))
    assert (frame.confidence, frame.warning) == (1.0, None)


@pytest.mark.parametrize("name", [path.stem for path in sorted((ROOT / "assets" / "motions").glob("*.bvh"))])
def test_nobody_is_warned_of_built_in_motions(name: str) -> None:
    assert frame_of(read_motion(name)).warning is None


def test_a_contradiction_lowers_the_confidence_and_is_explained() -> None:
    rotations = ON_THE_FLOOR["lies on the side"]
    motion = PERSON.motion(rotations, path(PERSON, rotations, "lies on the side"))
    info = describe_motion(motion)
    assert (info["up"], info["confidence"]) == ("y", 0.5)
    (warning,) = [text for text in info["warnings"] if "contradict" in text]
    assert "along y in the OFFSETs, along -x on average" in warning
    assert "give the axis (up: -x)" in warning


def test_a_given_up_axis_is_taken_without_a_warning() -> None:
    rotations: Mapping[str, Rotation] = ON_THE_FLOOR["lies on the side"]
    motion = PERSON.motion(rotations, path(PERSON, rotations, "lies on the side"))
    match = match_motion(motion)
    for up in ("y", "-x"):
        frame = detect_file_frame(motion, match, up=up)
        assert (frame.up, frame.confidence, frame.warning) == (up, 1.0, None)


def test_a_person_who_lies_in_all_frames_is_in_doubt() -> None:
    wave = read_motion("wave")
    few = np.arange(0, wave.n_frames, 8)
    poses = Rotation.from_quat(wave.local_rotations(few).reshape(-1, 4)).as_matrix()
    poses = poses.reshape(len(few), -1, 3, 3)
    poses[:, 0] = Rotation.from_euler("x", -90, degrees=True).as_matrix() @ poses[:, 0]
    z_up = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    root = np.tile(z_up @ [0.0, 25.0, 0.0], (len(few), 1))
    motion = motion_of_rotations(
        wave.joint_names,
        wave.parents,
        wave.offsets @ z_up.T,
        z_up @ poses @ z_up.T,
        {0: root},
        8 * wave.frame_time,
    )
    frame = detect_file_frame(motion, match_motion(motion))
    assert frame.confidence == 0.5
