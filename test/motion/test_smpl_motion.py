"""Motions of SMPL in .npz files: their joints, their variants, and what is refused."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_files import StandIn, stand_in, walk
from motion_formats import smpl_poses

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.motion import Motion, read_motion, to_world
from humansim_ros.motion.body.skeleton import SMPL_MODELS
from humansim_ros.view.sources.inputs import open_source

#: Parents of SMPL's joints [Loper 2015], and of a hand's below its wrist (SMPL+H, SMPL-X).
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
TURNS, ROOT = walk(12, heading=30), np.linspace([0, 0, 0], [5, 2, 90], 12) * 0.01
RAISED = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
ROLES = {
    "Hips": "pelvis",
    "Spine": "spine1",
    "Chest": "spine3",
    "Neck": "neck",
    "Head": "head",
    **{
        f"{side.title()}{role}": f"{side}_{name}"
        for side in ("left", "right")
        for role, name in (
            *(("Collar", "collar"), ("Shoulder", "shoulder"), ("Elbow", "elbow"), ("Wrist", "wrist")),
            *(("Hip", "hip"), ("Knee", "knee"), ("Ankle", "ankle"), ("Toe", "foot")),
        )
    },
}


def poses(count: int = 24, up: str = "z") -> np.ndarray:
    return smpl_poses(stand_in(ROLES), TURNS, SMPL_MODELS[count], up)


def save(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def amass(tmp_path: Path, count: int = 52, **changes: Any) -> Path:
    arrays: dict[str, Any] = {
        "poses": poses(count),
        "trans": ROOT @ RAISED.T,
        "betas": np.zeros(16),
        "mocap_framerate": np.array(120.0),
        "gender": np.array("neutral"),
        **changes,
    }
    return save(tmp_path / "walk_poses.npz", **{k: v for k, v in arrays.items() if v is not None})


def expected(motion: Motion, names: tuple[str, ...], vectors: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Joint positions (F, 24, 3) by Rodrigues' formula and the tree of SMPL."""
    offsets = motion.offsets[[motion.joint(name) for name in names[:22]]]
    out, turns = np.zeros((len(vectors), 22, 3)), np.zeros((len(vectors), 22, 3, 3))
    for frame, row in enumerate(vectors.reshape(len(vectors), -1, 3)):
        for joint in range(22):
            angle = np.linalg.norm(row[joint])
            x, y, z = row[joint] / angle if angle else np.zeros(3)
            k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            own = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
            parent = PARENTS[joint]
            above = turns[frame, parent] if parent >= 0 else np.eye(3)
            turns[frame, joint] = above @ own
            out[frame, joint] = places[frame] if parent < 0 else out[frame, parent] + above @ offsets[joint]
    return out


@pytest.mark.parametrize("count", SMPL_MODELS)
def test_joints_are_where_rodrigues_formula_puts_them(tmp_path: Path, count: int) -> None:
    names, places = SMPL_MODELS[count], ROOT @ RAISED.T
    motion = read_motion(amass(tmp_path, count))
    assert motion.n_joints == count + 1 and motion.frame_time == pytest.approx(1 / 120)
    joints = [motion.joint(name) for name in names[:22]]
    found = motion.world_positions()[:, joints]
    np.testing.assert_allclose(found, expected(motion, names, poses(count), places), atol=1e-9)


@pytest.mark.parametrize("count", SMPL_MODELS)
def test_all_models_are_matched_by_names_and_stand_upright(tmp_path: Path, count: int) -> None:
    world = to_world(read_motion(amass(tmp_path, count)))
    assert (world.match.table, world.match.by, world.match.confidence) == ("smpl", "names", 1.0)
    assert (world.frame.up, world.frame.unit) == ("z", 1.0) and 1.6 < world.frame.stature < 1.8


def test_the_same_motion_as_bvh_has_the_same_joints(tmp_path: Path) -> None:
    motion = read_motion(amass(tmp_path, 24, poses=poses(24, "y"), trans=ROOT))
    order = [motion.joint(ROLES[role]) for role in stand_in(ROLES).roles]
    person = stand_in(ROLES)
    rest = motion.rest_positions()[order]
    offsets = np.array([rest[j] - (rest[p] if p >= 0 else 0) for j, p in enumerate(person.parents)]) * 100
    same = StandIn(person.names, person.roles, person.parents, offsets, {})
    bvh = same.motion(TURNS, ROOT * 100)
    found = motion.world_positions()[:, order]
    np.testing.assert_allclose(found, bvh.world_positions() * 0.01, atol=1e-5)


PARTS = {
    "AMASS, stage 2": lambda p: {"root_orient": p[:, :3], "pose_body": p[:, 3:66], "pose_hand": p[:, 66:156]},
    "smplx": lambda p: {
        "global_orient": p[:, None, :3],
        "body_pose": p[:, 3:66].reshape(len(p), 21, 3),
        "left_hand_pose": p[:, 66:111],
        "right_hand_pose": p[:, 111:156],
    },
    "joints apart": lambda p: {"poses": p.reshape(len(p), -1, 3)},
    "body alone": lambda p: {"poses": p[:, :66]},
    "single precision": lambda p: {"poses": p.astype(np.float32)},
}


@pytest.mark.parametrize("case", PARTS)
def test_other_arrays_of_the_same_poses_are_the_same_motion(tmp_path: Path, case: str) -> None:
    whole = read_motion(amass(tmp_path))
    changes = {"poses": None, "trans": None, "transl": ROOT @ RAISED.T, **PARTS[case](poses(52))}
    other = read_motion(amass(tmp_path, **changes))
    names = SMPL_MODELS[24][:22]
    places = [motion.world_positions()[:, [motion.joint(n) for n in names]] for motion in (whole, other)]
    np.testing.assert_allclose(*places, atol=1e-5)


def test_what_is_missing_is_assumed_with_a_warning(tmp_path: Path) -> None:
    path = save(tmp_path / "walk.npz", poses=poses())
    with pytest.warns(HumansimWarning) as caught:
        motion = read_motion(path)
    texts = " ".join(str(warning.message) for warning in caught)
    assert "no 'trans': the person stays in place" in texts and "30 frames per second" in texts
    assert motion.frame_time == pytest.approx(1 / 30)


def test_a_shape_that_is_not_used_is_told_with_its_numbers(tmp_path: Path) -> None:
    betas = np.array([1.25, -0.5, *[0.0] * 14])
    with pytest.warns(
        HumansimWarning, match=r"walk_poses\.npz: betas: .*not used.* betas: \[1\.25, -0\.5, 0, "
    ):
        shaped = read_motion(amass(tmp_path, betas=betas))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mean = read_motion(amass(tmp_path))
    np.testing.assert_array_equal(shaped.world_positions(), mean.world_positions())


@pytest.mark.parametrize("size", [0.85, 1.0, 1.15])
def test_the_stature_follows_from_the_steps(tmp_path: Path, size: float) -> None:
    turns = walk(240, heading=30)
    vectors = smpl_poses(stand_in(ROLES), turns, SMPL_MODELS[24])
    still = read_motion(amass(tmp_path, poses=vectors, trans=np.zeros((240, 3)))).world_positions()
    names = read_motion(tmp_path / "walk_poses.npz").joint_names
    feet = size * still[:, [names.index("left_foot"), names.index("right_foot")]]
    # the lower foot stays where it is: the root moves against it
    lower = feet[:, :, 2].argmin(axis=1)[:-1]
    steps = -np.diff(feet, axis=0)[np.arange(239), lower]
    trans = np.concatenate([np.zeros((1, 3)), steps.cumsum(axis=0)])
    with pytest.warns(HumansimWarning, match=r"the stature, \d\.\d\d m, follows from the steps"):
        motion = read_motion(amass(tmp_path, poses=vectors, trans=trans, betas=np.ones(10)))
    shin = np.linalg.norm(motion.offsets[motion.joint("left_ankle")])
    assert shin == pytest.approx(size * np.linalg.norm([0.4, 0.03]), rel=0.01)


def test_single_frames_that_are_not_finite_are_filled(tmp_path: Path) -> None:
    long = np.repeat(poses(), 20, axis=0)
    long[7, 3] = np.nan
    with pytest.warns(HumansimWarning, match=r"walk_poses\.npz: poses: 1 frames are not finite, such as 7"):
        motion = read_motion(amass(tmp_path, poses=long, trans=np.zeros((240, 3))))
    assert np.isfinite(motion.values).all()


def test_parts_that_are_absent_beside_others_are_zero(tmp_path: Path) -> None:
    """Hands with a jaw and without eyes, and a left hand alone, bend each joint by its own rotation."""
    p = poses(52)
    body = {"poses": None, "root_orient": p[:, :3], "pose_body": p[:, 3:66]}
    hands = np.random.default_rng(2).uniform(-0.5, 0.5, (len(p), 90))
    with_jaw = read_motion(amass(tmp_path, **body, pose_hand=hands, pose_jaw=np.full((len(p), 3), 0.1)))
    left = read_motion(amass(tmp_path, **body, left_hand_pose=hands[:, :45].reshape(-1, 15, 3)))
    whole = read_motion(amass(tmp_path, poses=np.concatenate([p[:, :66], hands], axis=1)))
    for side, others in (("left", (with_jaw, left)), ("right", (with_jaw,))):
        names = [f"{side}_{finger}{n}" for finger in ("thumb", "index", "pinky") for n in (1, 2, 3)]
        for other in others:
            found = [
                motion.world_positions()[:, [motion.joint(n) for n in names]] for motion in (other, whole)
            ]
            np.testing.assert_allclose(*found, atol=1e-5)
    flat = read_motion(amass(tmp_path, poses=np.pad(p[:, :66], ((0, 0), (0, 90)))))
    tips = [motion.world_positions()[:, motion.joint("right_index3")] for motion in (left, flat)]
    np.testing.assert_allclose(*tips, atol=1e-5)
    assert {"jaw", "left_eye_smplhf"} <= set(with_jaw.joint_names)


class Pickled:
    pass


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no poses": ({"poses": None}, "it needs 'poses', or 'root_orient' and 'pose_body'"),
    "half": ({"poses": None, "root_orient": np.zeros((5, 3))}, "it needs 'poses'"),
    "no frames": ({"poses": np.zeros((0, 72))}, "poses: poses of 0 frames"),
    "no joints of a model": ({"poses": np.zeros((5, 90))}, "poses of 5 frames with 90 numbers each"),
    "matrices": ({"poses": np.zeros((12, 24, 3, 3))}, "poses: these matrices are no rotations"),
    "one number": ({"poses": np.array(3.0)}, "must be numbers for each frame"),
    "texts": ({"poses": np.full((5, 72), "a")}, "must be numbers for each frame"),
    "pickled": ({"poses": np.array([Pickled()])}, "pickled objects are not read"),
    "nan": ({"poses": np.full((12, 72), np.nan)}, "12 of 12 frames are not finite, the first is 0"),
    "huge": ({"poses": np.full((12, 72), 1e300)}, "frames are not finite"),
    "other length": ({"trans": np.zeros((5, 3))}, "trans: (5, 3) numbers for 12 frames"),
    "rate 0": ({"mocap_framerate": 0}, "frames per second must be a number above 0"),
    "rate nan": ({"mocap_framerate": np.nan}, "frames per second must be a number above 0"),
    "rate text": ({"mocap_framerate": "fast"}, "frames per second must be a number above 0"),
    "components of a hand": (
        {
            "poses": None,
            "global_orient": np.zeros((12, 3)),
            "body_pose": np.zeros((12, 63)),
            "left_hand_pose": np.zeros((12, 3)),
            "right_hand_pose": np.zeros((12, 3)),
        },
        "left_hand_pose: 3 numbers a frame in place of 45. Components of hands (use_pca) need the model",
    ),
    "hands of SMPL and fingers": (
        {
            "poses": None,
            "global_orient": np.zeros((12, 3)),
            "body_pose": np.zeros((12, 69)),
            "pose_hand": np.zeros((12, 90)),
        },
        "body_pose: 69 numbers a frame in place of 63",
    ),
    "parts of different lengths": (
        {"poses": None, "root_orient": np.zeros((5, 3)), "pose_body": np.zeros((6, 63))},
        "parts of different lengths",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_archive_is_refused_with_its_array(tmp_path: Path, case: str) -> None:
    changes, message = BAD[case]
    with pytest.raises(MotionError, match=re.escape(message)):
        read_motion(amass(tmp_path, **changes))


def test_other_and_damaged_archives_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="it needs 'poses'"):
        read_motion(save(tmp_path / "human.npz", vertices=np.zeros((3, 3))))
    path = amass(tmp_path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(MotionError, match="or a damaged one"):
        read_motion(path)


def test_the_page_takes_poses_for_a_motion(tmp_path: Path) -> None:
    opened = open_source(amass(tmp_path))
    assert list(opened.source.people) == ["person"]
    opened.source.close()
