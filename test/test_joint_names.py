"""Joint tables: which joint of a motion drives which bone."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from humansim_ros.body import hanim_skeleton
from humansim_ros.errors import MotionError
from humansim_ros.motion import read_bvh
from humansim_ros.motion.joint_names import (
    JointTable,
    built_in_tables,
    find_match,
    load_table,
    match_table,
    plain_name,
)

LIMBS = ("l_hip", "l_knee", "l_shoulder", "l_elbow", "r_hip", "r_knee", "r_shoulder", "r_elbow")


def table(name: str) -> JointTable:
    return next(t for t in built_in_tables() if t.name == name)


def edited(tmp_path: Path, **changes: object) -> Path:
    """The Biovision table with some of its parts replaced, as a user would write it."""
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(table("biovision").model_dump(mode="json") | {"name": "mine"} | changes))
    return path


def test_every_built_in_table_says_something_of_every_bone() -> None:
    for one in built_in_tables():
        assert {*one.parallel, *one.difference} == set(hanim_skeleton().names), one.name
        assert not set(one.parallel) & set(one.difference), one.name


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("bvhio_example", "biovision"),
        ("mocapbank_bvhpython", "biovision"),
        ("aitviewer_sample", "biovision"),
        ("mixamo_freebvh", "mixamo"),
        ("bvhtoolbox_walk01", "mixamo"),
        ("animdraw_rokoko_jesse_dance", "mixamo"),
        ("pybvh_cmu_12_01_walk", "cmu"),
    ],
)
def test_real_motions_find_their_table(shared_data: Path, stem: str, expected: str) -> None:
    motion = read_bvh(shared_data / "bvh" / f"{stem}.bvh")
    match = find_match(motion.joint_names)
    assert match.table == expected
    assert match.complete
    assert match.missing == ()


@pytest.mark.filterwarnings("ignore:.*the rows count")
def test_limbs_run_from_parent_to_child_in_every_matched_file(shared_data: Path) -> None:
    """A clavicle taken for an upper arm, or a left for a right, would break the chain."""
    matched = 0
    for path in sorted((shared_data / "bvh").glob("*.bvh")):
        motion = read_bvh(path)
        try:
            match = find_match(motion.joint_names)
        except MotionError:
            continue
        matched += 1
        for bone in LIMBS:
            start, end = match.parallel[bone]
            assert motion.parents[end] == start, (path.stem, bone)
        for lower, upper in (("knee", "hip"), ("elbow", "shoulder")):
            for side in "lr":
                assert match.parallel[f"{side}_{lower}"][0] == match.parallel[f"{side}_{upper}"][1], path.stem
        for side, word in (("l", "left"), ("r", "right")):
            for bone in LIMBS:
                if bone.startswith(side):
                    assert word in motion.joint_names[match.parallel[bone][0]].lower()
    assert matched >= 9


@pytest.mark.parametrize(
    ("joint", "plain"),
    [
        ("mixamorig:Hips", "Hips"),
        ("mixamorig1:Hips", "Hips"),
        ("mixamorigHips", "Hips"),
        ("Character:Ctrl:Hips", "Hips"),
        ("Hips", "Hips"),
        ("mixamorig", "mixamorig"),
    ],
)
def test_namespaces_are_left_out(joint: str, plain: str) -> None:
    assert plain_name(joint) == plain


def test_an_end_role_is_the_end_site_of_whatever_joint_has_the_role() -> None:
    names = ["Hips", "Head", "Head_end", "LeftHand", "LeftHand_end"]
    match = match_table(table("biovision"), names)
    assert match.parallel["vt3"] == (1, 2)
    assert match.parallel["l_wrist"] == (3, 4)
    assert "l_elbow" in match.missing


def test_no_fitting_table_is_said_with_what_is_lacking() -> None:
    names = ["Hips", "Chest", "Neck", "LeftHip", "LeftKnee", "LeftAnkle", "tail1", "tail2"]
    with pytest.raises(MotionError) as caught:
        find_match(names, path="cat.bvh")
    message = str(caught.value)
    assert message.startswith("cat.bvh: ")
    assert "no joint table fits" in message
    assert "Hips, Chest, Neck" in message
    assert "'biovision'" in message
    for bone in ("l_shoulder", "r_hip", "r_knee"):
        assert bone in message


def test_a_named_table_is_used_even_if_another_fits_better() -> None:
    names = [names[0] for names in table("biovision").joints.values()]
    with pytest.raises(MotionError, match="'cmu'"):
        find_match(names, "cmu")
    assert find_match(names).table == "biovision"


def test_a_users_table_is_read_from_a_file(tmp_path: Path) -> None:
    joints = {role: [f"my{role}"] for role in table("biovision").joints}
    match = find_match([f"my{role}" for role in joints], edited(tmp_path, joints=joints))
    assert match.table == "mine"
    assert match.complete


def test_an_unknown_table_is_answered_with_the_known_ones() -> None:
    with pytest.raises(MotionError, match=r"no joint table 'vicon'.*biovision, cmu, mixamo"):
        find_match(["Hips"], "vicon")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": {"Hips": "Hips"}}, r"joints\.Hips: "),
        ({"joints": {"Hips": ["Hips"]}}, "role 'LeftHip' is missing"),
        ({"parallel": {"l_hipp": ["LeftHip", "LeftKnee"]}}, "no bone 'l_hipp'"),
        ({"parallel": {"l_hip": ["LeftHip", "LeftNee"]}}, "no role 'LeftNee'"),
        ({"difference": {"l_hip": "Foot"}}, "no role 'Foot'"),
        ({"parallel": {"l_hip": ["LeftHip"]}}, r"parallel\.l_hip"),
        ({"paralel": {}}, "paralel"),
    ],
)
def test_a_wrong_table_is_refused_with_file_and_reason(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    path = edited(tmp_path, **changes)
    with pytest.raises(MotionError, match=message) as caught:
        load_table(path)
    assert caught.value.path == str(path)


@pytest.mark.parametrize("text", ["joints: [", "", "- a\n- b\n", "7", "\0"])
def test_a_file_that_is_no_table_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.yaml").write_text(text)
    with pytest.raises(MotionError, match=r"t\.yaml"):
        load_table(tmp_path / "t.yaml")
