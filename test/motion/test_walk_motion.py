"""The built-in walk (tools/assets/make_walk.py): feet do not slide, soles are on the floor, it loops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from numpy.typing import NDArray

from humansim_ros.motion import Motion, read_bvh

Array = NDArray[np.float64]

ASSETS = ROOT / "assets"
CENTIMETRE = 0.01
HEEL_BEHIND_ANKLE = 5.0
#: Turn to the left in each file, degrees.
TURNS = {"walk": 90.0, "walk_straight": 0.0}
SIDES = ("Left", "Right")


@pytest.fixture(params=sorted(TURNS))
def motion(request: pytest.FixtureRequest) -> Motion:
    return read_bvh(ASSETS / "motions" / f"{request.param}.bvh")


def yaw_matrix(degrees: float) -> Array:
    """Rotation to the left in BVH space (y up, facing +z, left is +x)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def carry(motion: Motion) -> tuple[Array, Array]:
    """Rotation and translation from the first frame to the last, by the name of the file."""
    rotation = yaw_matrix(TURNS[Path(motion.path).stem])
    first, last = motion.world_positions(0)[0], motion.world_positions(motion.n_frames - 1)[0]
    return rotation, last - rotation @ first


def two_rounds(motion: Motion) -> Array:
    """World transforms of two cycles, so that they contain every stance in one piece."""
    once = motion.world_transforms()
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = carry(motion)
    return np.concatenate([once[:-1], step @ once])


def sole(motion: Motion, side: str) -> dict[str, Array]:
    """Heel and tip of the sole (F, 3) over two cycles."""
    world = two_rounds(motion)[:, motion.joint(f"{side}Ankle")]
    tip = motion.offsets[motion.joint(f"{side}Ankle_end")] * [1.0, 0.0, 1.0]
    below = np.array([0.0, -world[:, 1, 3].min(), 0.0])
    points = {"heel": below - HEEL_BEHIND_ANKLE * tip / np.linalg.norm(tip), "tip": below + tip}
    return {name: world[:, :3, :3] @ point + world[:, :3, 3] for name, point in points.items()}


def contacts(heights: Array, below: float) -> list[slice]:
    """Runs of frames in which a point is on the floor, without incomplete runs at the ends."""
    on = np.concatenate([[False], heights < below, [False]])
    edges = np.flatnonzero(on[1:] != on[:-1])
    runs = [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if run.start > 0 and run.stop < len(heights)]


def test_joints_have_the_biovision_names(motion: Motion) -> None:
    trunk = {"Hips", "Chest", "Neck", "Head", "Head_end"}
    limbs = ("Collar", "Shoulder", "Elbow", "Wrist", "Wrist_end", "Hip", "Knee", "Ankle", "Ankle_end")
    assert set(motion.joint_names) == trunk | {side + name for side in SIDES for name in limbs}


def test_links_are_as_long_as_the_bones_of_the_default_human(motion: Motion) -> None:
    with np.load(ASSETS / "humans" / "adult_man.npz") as human:
        lengths = np.linalg.norm(human["bone_tails"] - human["bone_heads"], axis=1) / CENTIMETRE
        bones = dict(zip(human["bone_names"].tolist(), lengths, strict=True))
    for side, letter in (("Left", "l"), ("Right", "r")):
        for joint, bone in (("Knee", "hip"), ("Ankle", "knee"), ("Elbow", "shoulder"), ("Wrist", "elbow")):
            link = np.linalg.norm(motion.offsets[motion.joint(side + joint)])
            assert link == pytest.approx(bones[f"{letter}_{bone}"], abs=1e-3)


def test_loop_lasts_two_seconds(motion: Motion) -> None:
    assert motion.n_frames == 121
    assert motion.duration == pytest.approx(2.0, abs=1e-6)


def test_last_frame_continues_the_first(motion: Motion) -> None:
    rotation, translation = carry(motion)
    first, last = motion.world_transforms([0, motion.n_frames - 1])
    assert np.abs(rotation @ first[:, :3, :3] - last[:, :3, :3]).max() < 1e-6
    assert np.abs(first[:, :3, 3] @ rotation.T + translation - last[:, :3, 3]).max() < 1e-6 / CENTIMETRE


def test_four_cycles_of_the_walk_close_a_circle() -> None:
    rotation, translation = carry(read_bvh(ASSETS / "motions" / "walk.bvh"))
    point = np.zeros(3)
    for _ in range(4):
        point = rotation @ point + translation
    assert np.abs(point).max() < 1e-6 / CENTIMETRE


def test_the_end_of_the_loop_is_as_smooth_as_the_rest(motion: Motion) -> None:
    positions = two_rounds(motion)[..., :3, 3] * CENTIMETRE
    acceleration = np.linalg.norm(np.diff(positions, n=2, axis=0), axis=-1).max(1) / motion.frame_time**2
    seam = motion.n_frames - 1
    assert acceleration[seam - 3 : seam + 2].max() <= np.delete(acceleration, range(seam - 3, seam + 2)).max()
    assert acceleration.max() < 80  # m/s², a toe in the swing


def test_speed_is_that_of_a_comfortable_walk(motion: Motion) -> None:
    root = motion.world_positions()[:, 0] * CENTIMETRE
    distance = np.linalg.norm(np.diff(root[:, [0, 2]], axis=0), axis=1).sum()
    assert 1.0 < distance / motion.duration < 1.4


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("part", ["heel", "tip"])
def test_planted_foot_does_not_slide(motion: Motion, side: str, part: str) -> None:
    points = sole(motion, side)[part] * CENTIMETRE
    runs = contacts(points[:, 1], below=0.003)
    # two strides a round; the run that the end of the second round cuts off does not count
    assert len([run for run in runs if run.stop - run.start > 10]) >= 3
    for run in runs:
        steps = points[run][:, None, [0, 2]] - points[run][None, :, [0, 2]]
        assert np.linalg.norm(steps, axis=-1).max() < 0.02


@pytest.mark.parametrize("side", SIDES)
def test_toe_joint_does_not_slide_while_the_heel_rises(motion: Motion, side: str) -> None:
    heel, tip = (sole(motion, side)[part][:, 1] * CENTIMETRE for part in ("heel", "tip"))
    toe = motion.joint(f"{side}Ankle_end")
    positions = two_rounds(motion)[:, toe, :3, 3] * CENTIMETRE
    # the tip of a stiff sole is pressed a few millimetres into the floor until it leaves it
    for run in contacts(np.where(heel > 0.003, tip, np.inf), below=0.0):
        assert np.ptp(positions[run][:, [0, 2]], axis=0).max() < 0.02


def test_no_point_is_below_the_floor(motion: Motion) -> None:
    assert motion.world_positions()[..., 1].min() * CENTIMETRE > 0
    for side in SIDES:
        for points in sole(motion, side).values():
            assert points[:, 1].min() * CENTIMETRE > -0.01


@pytest.mark.parametrize("side", SIDES)
def test_knee_bends_in_the_swing_and_never_locks(motion: Motion, side: str) -> None:
    positions = motion.world_positions()
    hip, knee, ankle = (positions[:, motion.joint(side + name)] for name in ("Hip", "Knee", "Ankle"))
    thigh, shank = knee - hip, ankle - knee
    cosine = np.sum(thigh * shank, -1) / np.linalg.norm(thigh, axis=-1) / np.linalg.norm(shank, axis=-1)
    flexion = np.degrees(np.arccos(cosine))
    assert 2 < flexion.min() < 8
    assert 55 < flexion.max() < 72


def test_pelvis_rises_twice_in_a_stride(motion: Motion) -> None:
    height = motion.world_positions()[:60, 0, 1] * CENTIMETRE
    harmonics = np.abs(np.fft.rfft(height))[1:]
    assert harmonics.argmax() == 1
    assert 0.01 < np.ptp(height) < 0.06
