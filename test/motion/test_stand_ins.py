"""Generated motion files have the poses and the oddities that other tests need."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from motion_files import Array, StandIn, an_l, one_axis, random_axes, stand_in, walk, wrong_hips
from scipy.spatial.transform import Rotation
from stand_ins import ALL


@pytest.mark.parametrize("axes", [None, one_axis, an_l, random_axes])
@pytest.mark.parametrize("family", ["mixamo", "cmu", "lafan1", "smpl"])
def test_joints_are_where_forward_kinematics_puts_them_in_any_axes(
    family: str, axes: Callable[[StandIn], Array] | None
) -> None:
    person, turns = stand_in(family), walk(10, heading=40)
    motion = person.motion(turns, axes=None if axes is None else axes(person))
    named = [motion.joint(name) for name in person.names]
    for frame in (0, 7):
        expected = person.positions(turns)[frame, : len(named)]
        np.testing.assert_allclose(motion.world_positions()[frame, named], expected, atol=1e-4)


def test_offsets_along_one_axis_are_no_pose() -> None:
    person = stand_in("lafan1")
    offsets = person.motion(walk(3), axes=one_axis(person)).offsets
    limbs = [person.joint(role) for role in ("LeftKnee", "LeftAnkle", "RightElbow", "RightWrist", "Chest")]
    along = offsets[[person.motion(walk(1)).joint(person.names[limb]) for limb in limbs]]
    assert (along[:, 0] > 10).all()
    np.testing.assert_allclose(along[:, 1:], 0, atol=1e-6)


def test_wrong_hips_move_no_joint() -> None:
    right = stand_in("mixamo")
    wrong, rotations = wrong_hips(right, walk(20))
    expected, got = right.motion(walk(20)), wrong.motion(rotations)
    places = [[m.joint(name) for name in right.names] for m in (expected, got)]
    np.testing.assert_allclose(
        got.world_positions()[:, places[1]], expected.world_positions()[:, places[0]], atol=1e-4
    )
    hips = (expected.world_transforms()[:, 0, :3, :3], got.world_transforms()[:, 0, :3, :3])
    between = Rotation.from_matrix(hips[0]).inv() * Rotation.from_matrix(hips[1])
    assert np.degrees(between.magnitude()).max() > 60


def test_collars_rise_at_rest_and_shoulders_stay() -> None:
    plain, raised = stand_in("cmu"), stand_in("cmu").with_raised_collars(25)
    collar, shoulder = (raised.offsets[raised.joint(f"Left{part}")] for part in ("Collar", "Shoulder"))
    assert np.degrees(np.arctan2(shoulder[1], shoulder[0])) == pytest.approx(25)
    both = [p.offsets[p.joint("LeftCollar")] + p.offsets[p.joint("LeftShoulder")] for p in (plain, raised)]
    np.testing.assert_allclose(both[0], both[1])
    assert collar[0] == plain.offsets[plain.joint("LeftCollar"), 0]


def test_each_program_writes_the_same_walk_in_its_own_way() -> None:
    """Files differ in unit, axes and layout; joints of the same role are at the same place of the person."""
    texts = {name: each.text() for name, each in ALL.items()}
    assert len({text.partition("MOTION")[0] for text in texts.values()}) == len(texts)
    assert "\r\n" in texts["own_xsens"] and "\r" not in texts["own_mixamo"]
    assert "Frames: 120\n" in texts["own_more_rows"] and "Frames: 121\n" in texts["own_mixamo"]
    assert "e+0" in texts["own_humanik"] and "e+0" not in texts["own_mixamo"]
    centimetres = ALL["own_more_rows"].positions()[:, ALL["own_more_rows"].names.index("LeftKnee")]
    for name, each in ALL.items():
        knee = each.positions()[:, each.person.joint("LeftKnee")] * each.style.unit
        knee = knee if each.style.up == "y" else knee[:, [0, 2, 1]] * [1, 1, -1]
        np.testing.assert_allclose(knee, centimetres, atol=1e-9, err_msg=name)
