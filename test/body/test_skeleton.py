"""The general skeleton against the thesis, and its frames against a chain of plain 4x4 matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MeshError
from humansim_ros.motion import Skeleton, hanim_skeleton
from humansim_ros.types import Array

#: Table 4.1 of CTU-CMP-2007-02, typed in for this test: bone, head, tail, parent.
TABLE = """
HumanoidRoot                0      0.824   0.0277   0       0.921  -0.080    -
sacroiliac                  0      0.921  -0.080    0       1.057  -0.034    HumanoidRoot
vl5                         0      1.057  -0.034    0       1.4583 -0.057    sacroiliac
vt3                         0      1.4583 -0.057    0       1.7504  0        vl5
HumanoidRoot_to_l_hip       0      0.921  -0.080    0.096   0.843  -0.029    HumanoidRoot
l_hip                       0.096  0.843  -0.029    0.065   0.493  -0.011    HumanoidRoot_to_l_hip
l_knee                      0.065  0.493  -0.011    0.069   0.091  -0.054    l_hip
l_ankle                     0.069  0.091  -0.054    0.042   0.012   0.180    l_knee
vl5_to_l_sternoclavicular   0      1.4583 -0.057    0.082   1.4488 -0.0353   vl5
l_sternoclavicular          0.0820 1.4488 -0.0353   0.194   1.434  -0.032    vl5_to_l_sternoclavicular
l_shoulder                  0.194  1.434  -0.032    0.410   1.379  -0.062    l_sternoclavicular
l_elbow                     0.410  1.379  -0.062    0.659   1.393  -0.052    l_shoulder
l_wrist                     0.659  1.393  -0.052    0.840   1.391  -0.042    l_elbow
HumanoidRoot_to_r_hip       0      0.921  -0.080   -0.096   0.843  -0.029    HumanoidRoot
r_hip                      -0.096  0.843  -0.029   -0.065   0.493  -0.011    HumanoidRoot_to_r_hip
r_knee                     -0.065  0.493  -0.011   -0.069   0.091  -0.054    r_hip
r_ankle                    -0.069  0.091  -0.054   -0.042   0.012   0.180    r_knee
vl5_to_r_sternoclavicular   0      1.4583 -0.057   -0.0694  1.4600 -0.0330   vl5
r_sternoclavicular         -0.0694 1.4600 -0.0330  -0.194   1.434  -0.032    vl5_to_r_sternoclavicular
r_shoulder                 -0.194  1.434  -0.032   -0.410   1.379  -0.062    r_sternoclavicular
r_elbow                    -0.410  1.379  -0.062   -0.659   1.393  -0.052    r_shoulder
r_wrist                    -0.659  1.393  -0.052   -0.840   1.391  -0.042    r_elbow
"""
SKELETON = hanim_skeleton()


def rolled(seed: int = 0) -> Skeleton:
    """General skeleton with a roll on each bone."""
    rolls = np.random.default_rng(seed).uniform(-np.pi, np.pi, len(SKELETON))
    return Skeleton(SKELETON.names, SKELETON.parents, SKELETON.heads, SKELETON.tails, rolls)


def chain(skeleton: Skeleton, rotations: Array, root: Array) -> Array:
    """Posed frames by recursion with SciPy: rest frame in the parent, then rotation."""

    def posed(bone: int) -> Array:
        parent = int(skeleton.parents[bone])
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_quat(rotations[bone]).as_matrix()
        if parent < 0:
            return root @ skeleton.rest[bone] @ turn
        return posed(parent) @ np.linalg.solve(skeleton.rest[parent], skeleton.rest[bone]) @ turn

    return np.array([posed(bone) for bone in range(len(skeleton))])


def rigid(seed: int) -> Array:
    out = np.eye(4)
    out[:3, :3] = Rotation.random(None, seed).as_matrix()
    out[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return out


@pytest.mark.parametrize("row", TABLE.strip().splitlines(), ids=lambda row: row.split()[0])
def test_bones_are_those_of_the_thesis(row: str) -> None:
    name, *numbers, parent = row.split()
    bone = SKELETON.bone(name)
    np.testing.assert_array_equal(SKELETON.heads[bone], [float(n) for n in numbers[:3]])
    np.testing.assert_array_equal(SKELETON.tails[bone], [float(n) for n in numbers[3:]])
    number = SKELETON.parents[bone]
    assert (SKELETON.names[number] if number >= 0 else "-") == parent


def test_the_skeleton_has_no_other_bones() -> None:
    assert len(SKELETON) == len(set(SKELETON.names)) == len(TABLE.strip().splitlines()) == 22


def test_every_bone_starts_at_the_tail_of_its_parent() -> None:
    for bone, parent in enumerate(SKELETON.parents):
        if parent >= 0:
            np.testing.assert_array_equal(SKELETON.heads[bone], SKELETON.tails[parent])


@pytest.mark.parametrize("skeleton", [SKELETON, rolled()], ids=["straight", "rolled"])
def test_rest_frames_have_their_origin_at_the_head_and_y_along_the_bone(skeleton: Skeleton) -> None:
    for bone, frame in enumerate(skeleton.rest):
        along = skeleton.tails[bone] - skeleton.heads[bone]
        np.testing.assert_allclose(frame[:3, 3], skeleton.heads[bone], atol=1e-15)
        np.testing.assert_allclose(frame[:3, 1] * np.linalg.norm(along), along, atol=1e-12)
        np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(frame[:3, :3]) == pytest.approx(1)
        np.testing.assert_array_equal(frame[3], [0, 0, 0, 1])


def test_roll_turns_the_frame_about_the_bone() -> None:
    turned = rolled()
    for bone, roll in enumerate(turned.rolls):
        along = SKELETON.rest[bone, :3, 1]
        expected = Rotation.from_rotvec(roll * along).as_matrix() @ SKELETON.rest[bone, :3, :3]
        np.testing.assert_allclose(turned.rest[bone, :3, :3], expected, atol=1e-12)


def test_no_rotation_is_the_rest_pose() -> None:
    still = np.tile([0.0, 0, 0, 1], (22, 1))
    np.testing.assert_allclose(rolled().pose(still), rolled().rest, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_posed_frames_are_a_chain_of_matrices(seed: int) -> None:
    skeleton = rolled(seed)
    rotations, root = Rotation.random(22, seed).as_quat(), rigid(seed)
    np.testing.assert_allclose(skeleton.pose(rotations, root), chain(skeleton, rotations, root), atol=1e-12)
    np.testing.assert_allclose(skeleton.pose(rotations), chain(skeleton, rotations, np.eye(4)), atol=1e-12)


def test_a_batch_of_frames_gives_the_same_poses() -> None:
    rotations = Rotation.random(2 * 3 * 22, 1).as_quat().reshape(2, 3, 22, 4)
    roots = np.array([[rigid(3 * i + j) for j in range(3)] for i in range(2)])
    posed = SKELETON.pose(rotations, roots)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(posed[index], chain(SKELETON, rotations[index], roots[index]), atol=1e-12)


def test_moving_the_root_moves_all_frames() -> None:
    rotations, root, move = Rotation.random(22, 5).as_quat(), rigid(5), rigid(6)
    np.testing.assert_allclose(
        SKELETON.pose(rotations, move @ root), move @ SKELETON.pose(rotations, root), atol=1e-12
    )


def test_bones_stay_connected_and_keep_their_lengths_in_any_pose() -> None:
    posed = SKELETON.pose(Rotation.random(22, 2).as_quat())
    tails = (
        posed[:, :3, 3] + posed[:, :3, 1] * np.linalg.norm(SKELETON.tails - SKELETON.heads, axis=1)[:, None]
    )
    for bone, parent in enumerate(SKELETON.parents):
        if parent >= 0:
            np.testing.assert_allclose(posed[bone, :3, 3], tails[parent], atol=1e-12)


def test_rotating_a_bone_moves_only_its_descendants() -> None:
    still = np.tile([0.0, 0, 0, 1], (22, 1))
    still[SKELETON.bone("l_shoulder")] = Rotation.from_euler("x", 1.0).as_quat()
    moved = np.abs(SKELETON.pose(still) - SKELETON.rest).max((1, 2)) > 1e-9
    assert {name for name, m in zip(SKELETON.names, moved, strict=True) if m} == {
        "l_shoulder",
        "l_elbow",
        "l_wrist",
    }


def test_joints_are_the_heads_and_the_tails_of_the_last_bones() -> None:
    ends = ["vt3_end", "l_ankle_end", "l_wrist_end", "r_ankle_end", "r_wrist_end"]
    assert SKELETON.joint_names == (*SKELETON.names, *ends)
    joints = SKELETON.joint_transforms(SKELETON.rest)
    np.testing.assert_allclose(joints[:22], SKELETON.rest)
    for name, frame in zip(ends, joints[22:], strict=True):
        bone = SKELETON.bone(name.removesuffix("_end"))
        np.testing.assert_allclose(frame[:3, 3], SKELETON.tails[bone], atol=1e-12)
        np.testing.assert_allclose(frame[:3, :3], SKELETON.rest[bone, :3, :3])
        assert SKELETON.joint_bones[SKELETON.joint_names.index(name)] == bone


def two_bones(**changes: object) -> Skeleton:
    good: dict[str, object] = {
        "names": ("a", "b"),
        "parents": np.array([-1, 0]),
        "heads": np.array([[0.0, 0, 0], [0, 1, 0]]),
        "tails": np.array([[0.0, 1, 0], [0, 2, 0]]),
        "rolls": np.zeros(2),
    }
    return Skeleton(**(good | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parents": np.array([1, -1])}, "must come before"),
        ({"parents": np.array([-1, 1])}, "must come before"),
        ({"parents": np.array([-1, -2])}, "must come before"),
        ({"tails": np.array([[0.0, 1, 0], [0, 1, 0]])}, "no length"),
        ({"heads": np.array([[np.nan, 0, 0], [0, 1, 0]])}, "not a finite"),
        ({"rolls": np.array([0, np.inf])}, "not a finite"),
        ({"rolls": np.zeros(3)}, "shapes"),
        ({"names": ()}, "0 bones"),
    ],
)
def test_impossible_skeletons_are_refused(changes: dict[str, object], message: str) -> None:
    two_bones()
    with pytest.raises(MeshError, match=message):
        two_bones(**changes)


def test_unknown_bone_is_named_with_the_known_ones() -> None:
    with pytest.raises(MeshError, match=r"no bone 'c'; there are a, b"):
        two_bones().bone("c")
