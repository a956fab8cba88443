"""Joint tables, and the joints of a motion that drive bones."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import ROOT, SHARED_DATA, if_shared
from stand_ins import ALL, motion_path

from humansim_ros.errors import MotionError
from humansim_ros.files.reading.assets import resource_path
from humansim_ros.motion import hanim_skeleton, read_bvh
from humansim_ros.motion.matching.by_name import ancestors, loose_keys, match_names, match_table, plain_name
from humansim_ros.motion.matching.joint_tables import (
    JointTable,
    built_in_tables,
    load_table,
    right_name,
)

LIMBS = ("l_hip", "l_knee", "l_shoulder", "l_elbow", "r_hip", "r_knee", "r_shoulder", "r_elbow")


def table(name: str) -> JointTable:
    return next(t for t in built_in_tables() if t.name == name)


def edited(tmp_path: Path, **changes: object) -> Path:
    """The Biovision table with some of its parts replaced, as a user would write it."""
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(table("biovision").model_dump(mode="json") | {"name": "mine"} | changes))
    return path


def test_built_in_tables_pass_the_checks_of_files() -> None:
    files = sorted(resource_path("config/joint_names").glob("*.yaml"))
    assert built_in_tables() == tuple(load_table(file) for file in files)


def test_every_built_in_table_has_a_driver_for_every_bone() -> None:
    for one in built_in_tables():
        assert {*one.parallel, *one.difference} == set(hanim_skeleton().names), one.name
        assert not set(one.parallel) & set(one.difference), one.name


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        *((name, each.table) for name, each in ALL.items()),
        *if_shared(
            ("bvhio_example", "biovision"),
            ("mocapbank_bvhpython", "xsens"),
            ("aitviewer_sample", "xsens"),
            ("mixamo_freebvh", "mixamo"),
            ("bvhtoolbox_walk01", "humanik"),
            ("animdraw_rokoko_jesse_dance", "rokoko"),
            ("pybvh_cmu_12_01_walk", "cmu"),
            ("animdraw_cmu1_jumping_jacks", "cmu_max"),
            ("assimp_Boxing_Toes", "biovision"),
            ("pybvh_test1", "humanik"),
            ("makehuman_walk1", "makehuman"),
            ("makehuman_tpose", "makehuman"),
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
def test_motions_match_their_table(stem: str, expected: str) -> None:
    motion = read_bvh(motion_path(stem))
    match = match_names(motion.joint_names)
    assert match.table == expected
    assert match.complete
    assert match.missing == ()


#: Motion files that must match by names, and files that must not.
PEOPLE = set(
    """aitviewer_sample animdraw_cmu1_jumping_jacks animdraw_rokoko_jesse_dance assimp_Boxing_Toes
    bandai_bow_normal_001 bvhio_example bvhtoolbox_walk01 chenzhike_result griebel_Example1 loadbvh_test
    makehuman_tpose makehuman_walk1 mixamo_freebvh mocapbank_bvhpython pybvh_cmu_12_01_walk pybvh_test1
    rmginner_A1_Stand""".split()  # noqa: SIM905
)
NOT_PEOPLE = {"fairmotion_sinusoidal", "firepal_vr", "pybvh_rotation_first_root"}


@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
@pytest.mark.parametrize(
    "stem", [*ALL, *if_shared(*sorted(path.stem for path in (SHARED_DATA / "bvh").glob("*.bvh")))]
)
def test_limbs_run_from_parent_to_child_in_every_matched_file(stem: str) -> None:
    """A clavicle matched as an upper arm, or left as right, would break the chain."""
    try:
        motion = read_bvh(motion_path(stem))
        match = match_names(motion.joint_names)
    except MotionError:
        assert stem not in {*ALL, *PEOPLE}
        return
    assert stem not in NOT_PEOPLE
    for bone in LIMBS:
        start, above = match.parallel[bone]
        links = 0
        while above != start and links < 3:  # with bones for twist between them
            above, links = int(motion.parents[above]), links + 1
        assert above == start, bone
    for lower, upper in (("knee", "hip"), ("elbow", "shoulder")):
        for side in "lr":
            assert match.parallel[f"{side}_{lower}"][0] == match.parallel[f"{side}_{upper}"][1]
    for side, words in (("l", ("left", ".l", "_l")), ("r", ("right", ".r", "_r"))):
        for bone in LIMBS:
            if bone.startswith(side):
                name = motion.joint_names[match.parallel[bone][0]].lower()
                assert name.startswith(side) or any(word in name for word in words)


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
def test_namespaces_are_removed(joint: str, plain: str) -> None:
    assert plain_name(joint) == plain


def test_an_end_role_is_the_end_site_of_the_joint_of_that_role() -> None:
    names = ["Hips", "Head", "Head_end", "LeftHand", "LeftHand_end"]
    match = match_table(table("biovision"), names)
    assert match.parallel["vt3"] == (1, 2)
    assert match.parallel["l_wrist"] == (3, 4)
    assert "l_elbow" in match.missing


def test_without_a_fitting_table_the_error_names_missing_bones_and_roles() -> None:
    names = ["Hips", "Chest", "Neck", "LeftHip", "LeftKnee", "LeftAnkle", "tail1", "tail2"]
    with pytest.raises(MotionError) as caught:
        match_names(names, path="cat.bvh")
    message = str(caught.value)
    assert message.startswith("cat.bvh: ")
    assert "no joint table fits" in message
    assert "Hips, Chest, Neck" in message
    for bone in ("l_shoulder", "r_hip", "r_knee"):
        assert bone in message


def test_a_named_table_is_used_even_if_another_fits_better() -> None:
    names = [names[0] for names in table("biovision").joints.values()]
    with pytest.raises(MotionError, match="'cmu'"):
        match_names(names, "cmu")
    assert match_names(names).table == "biovision"


def test_a_users_table_is_read_from_a_file(tmp_path: Path) -> None:
    joints = {role: [f"my{role}"] for role in table("biovision").joints}
    match = match_names([f"my{role}" for role in joints], edited(tmp_path, joints=joints))
    assert match.table == "mine"
    assert match.complete


def test_an_unknown_table_is_an_error_that_lists_the_tables() -> None:
    with pytest.raises(MotionError, match=r"no joint table and no YAML file 'vicon'.*biovision.*cmu.*mixamo"):
        match_names(["Hips"], "vicon")


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
def test_a_wrong_table_is_an_error_with_file_and_reason(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    path = edited(tmp_path, **changes)
    with pytest.raises(MotionError, match=message) as caught:
        load_table(path)
    assert caught.value.path == str(path)


@pytest.mark.parametrize("text", ["joints: [", "", "- a\n- b\n", "7", "\0"])
def test_a_file_that_is_not_a_table_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.yaml").write_text(text)
    with pytest.raises(MotionError, match=r"t\.yaml"):
        load_table(tmp_path / "t.yaml")


# Families: joint names and kinship as the programs and datasets have them, `child<parent` where it is not the
# joint before; right sides are spelt as the left ones.

FAMILIES = {
    "lafan1": "Hips LeftUpLeg LeftLeg LeftFoot LeftToe Spine<Hips Spine1 Spine2 Neck Head "
    "LeftShoulder<Spine2 LeftArm LeftForeArm LeftHand",
    "bandai_namco": "joint_Root Hips Spine Chest Neck Head Shoulder_L<Chest UpperArm_L LowerArm_L Hand_L "
    "UpperLeg_L<Hips LowerLeg_L Foot_L Toes_L",
    "100style": "Hips Chest Chest2 Chest3 Chest4 Neck Head LeftCollar<Chest4 LeftShoulder LeftElbow "
    "LeftWrist LeftHip<Hips LeftKnee LeftAnkle LeftToe",
    "mvn": "Pelvis L5 L3 T12 T8 Neck Head LeftShoulder<T8 LeftUpperArm LeftForeArm LeftHand "
    "LeftUpperLeg<Pelvis LeftLowerLeg LeftFoot LeftToe",
    "perception_neuron": "Hips LeftUpLeg LeftLeg LeftFoot Spine<Hips Spine1 Spine2 Spine3 Neck Head "
    "LeftShoulder<Spine3 LeftArm LeftForeArm LeftHand LeftHandThumb1 LeftInHandMiddle<LeftHand",
    "optitrack": "Hip Ab Chest Neck Head LShoulder<Chest LUArm LFArm LHand LThigh<Hip LShin LFoot LToe",
    "cmu_daz": "hip abdomen chest neck head lCollar<chest lShldr lForeArm lHand lButtock<hip lThigh lShin "
    "lFoot",
    "hanim": "HumanoidRoot sacroiliac l_hip l_knee l_ankle vl5<HumanoidRoot vt4 vc7 skullbase "
    "l_sternoclavicular<vt4 l_shoulder l_elbow l_wrist",
    "hanim 2": "humanoid_root sacroiliac l_hip l_knee l_talocrural vl5<humanoid_root vt4 vc7 skullbase "
    "l_sternoclavicular<vt4 l_acromioclavicular l_shoulder l_elbow l_radiocarpal",
    "biped": "Bip01 Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Neck Bip01_Head "
    "Bip01_L_Clavicle<Bip01_Neck Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand "
    "Bip01_L_Thigh<Bip01_Pelvis Bip01_L_Calf Bip01_L_Foot",
    "unreal": "root pelvis spine_01 spine_02 spine_03 neck_01 head clavicle_l<spine_03 upperarm_l "
    "lowerarm_l hand_l thigh_l<pelvis calf_l foot_l ball_l",
    "unity": "hips spine chest upperChest neck head leftShoulder<upperChest leftUpperArm leftLowerArm "
    "leftHand leftUpperLeg<hips leftLowerLeg leftFoot leftToes",
    "smpl": "Pelvis L_Hip L_Knee L_Ankle L_Foot Spine1<Pelvis Spine2 Spine3 Neck Head L_Collar<Spine3 "
    "L_Shoulder L_Elbow L_Wrist L_Hand",
    "rokoko": "Hips Spine1 Spine2 Spine3 Spine4 Neck Head LeftShoulder<Spine4 LeftArm LeftForeArm "
    "LeftHand LeftThigh<Hips LeftShin LeftFoot LeftToe",
    "azure_kinect": "PELVIS SPINE_NAVAL SPINE_CHEST NECK HEAD CLAVICLE_LEFT<SPINE_CHEST SHOULDER_LEFT "
    "ELBOW_LEFT WRIST_LEFT HAND_LEFT HANDTIP_LEFT THUMB_LEFT<WRIST_LEFT HIP_LEFT<PELVIS KNEE_LEFT ANKLE_LEFT "
    "FOOT_LEFT NOSE<HEAD EYE_LEFT<HEAD EAR_LEFT<HEAD",
    "azure_kinect 2": "SpineBase SpineMid SpineShoulder Neck Head ShoulderLeft<SpineShoulder ElbowLeft "
    "WristLeft "
    "HandLeft HandTipLeft HipLeft<SpineBase KneeLeft AnkleLeft FootLeft",
    "mocopi": "root torso_1 torso_2 torso_3 torso_4 torso_5 torso_6 torso_7 neck_1 neck_2 head "
    "l_shoulder<torso_7 l_up_arm l_low_arm l_hand l_up_leg<root l_low_leg l_foot l_toes",
    "cmu_asf": "hip lhipjoint lfemur ltibia lfoot ltoes lowerback<hip upperback thorax lowerneck "
    "upperneck head "
    "lclavicle<thorax lhumerus lradius lwrist lhand lfingers lthumb<lwrist",
    "mocapnet": "hip abdomen chest neck neck1 head __jaw jaw special04 oris02 oris01 tongue00<jaw "
    "tongue01 tongue02 "
    "levator02.l<__jaw eye.l<head lCollar<chest lShldr lForeArm lHand __metacarpal1.l metacarpal1.l "
    "finger2-1.l "
    "finger2-2.l metacarpal2.l<lHand finger3-1.l finger3-2.l lButtock<hip lThigh lShin lFoot toe1-1.L "
    "toe2-1.L<lFoot",
    "mocapnet 2": "hip abdomen chest neck head lefteye lcollar<chest lshoulder lelbow lhand lthumb1 "
    "lhip<hip lknee lfoot",
    "humanik 2": "Hips Spine Spine1 Spine2 Neck Head L_Shoulder<Spine2 L_Arm L_ForeArm L_Hand "
    "L_UpLeg<Hips L_Leg "
    "L_Foot L_ToeBase",
    "common": "my_Pelvis_x my_Torso_x my_UpperChest_x my_Neck_x my_Head_x my_clavicle.L_x<my_UpperChest_x "
    "my_bicep.L_x my_forearm.L_x my_hand.L_x my_thigh.L_x<my_Pelvis_x my_shin.L_x my_foot.L_x",
    "mixamo": "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck "
    "mixamorig:Head mixamorig:HeadTop_End mixamorig:LeftShoulder<mixamorig:Spine2 "
    "mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand "
    "mixamorig:LeftUpLeg<mixamorig:Hips mixamorig:LeftLeg mixamorig:LeftFoot "
    "mixamorig:LeftToeBase",
}
#: The joint of the left upper arm, and the joint of the shin, in each.
ARM_AND_SHIN = {
    "lafan1": "LeftArm LeftLeg", "bandai_namco": "UpperArm_L LowerLeg_L", "100style": "LeftShoulder LeftKnee",
    "mvn": "LeftUpperArm LeftLowerLeg", "perception_neuron": "LeftArm LeftLeg", "optitrack": "LUArm LShin",
    "cmu_daz": "lShldr lShin", "hanim": "l_shoulder l_knee", "hanim 2": "l_shoulder l_knee",
    "biped": "Bip01_L_UpperArm Bip01_L_Calf", "unreal": "upperarm_l calf_l",
    "unity": "leftUpperArm leftLowerLeg", "smpl": "L_Shoulder L_Knee", "rokoko": "LeftArm LeftShin",
    "mixamo": "mixamorig:LeftArm mixamorig:LeftLeg", "azure_kinect": "SHOULDER_LEFT KNEE_LEFT",
    "azure_kinect 2": "ShoulderLeft KneeLeft", "mocopi": "l_up_arm l_low_leg", "cmu_asf": "lhumerus ltibia",
    "mocapnet": "lShldr lShin", "mocapnet 2": "lshoulder lknee", "humanik 2": "L_Arm L_Leg",
    "common": "my_bicep.L_x my_shin.L_x",
}  # fmt: skip


#: Left joints whose side is a small first letter.
SMALL = {"lhipjoint", "lfemur", "ltibia", "lfoot", "ltoes", "lclavicle", "lhumerus", "lradius",
         "lwrist", "lhand",
         "lfingers", "lthumb", "lcollar", "lshoulder", "lelbow", "lthumb1", "lhip", "lknee"}  # fmt: skip


def mirrored(name: str) -> str | None:
    """Name of the joint on the right side."""
    return f"r{name[1:]}" if name in SMALL else right_name(name)


def skeleton_of(family: str) -> tuple[list[str], np.ndarray]:
    """Names and parents (J,), both sides."""
    names, parents = [], []
    words = FAMILIES[family].split()
    for word in words + [w for w in words if mirrored(w.split("<")[0])]:
        name, _, parent = word.partition("<")
        if name in names:  # its right side
            name = mirrored(name)
            before = next(n for n in words if mirrored(n.split("<")[0]) == name).partition("<")[2]
            parent = mirrored(before) or before if before else ""
            if not parent:
                left = parents[
                    names.index(next(n.split("<")[0] for n in words if mirrored(n.split("<")[0]) == name))
                ]
                parent = mirrored(names[left]) or names[left]
        names.append(name)
        parents.append(names.index(parent) if parent else len(names) - 2)
    return names, np.array(parents)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_is_matched_by_names_and_hierarchy(family: str) -> None:
    names, parents = skeleton_of(family)
    for kin in (parents, None):
        match = match_names(names, parents=kin)
        assert match.complete
        if family != "100style":  # as Xsens, whose suit it was
            assert match.table == family.split()[0]
        arm, shin = (names.index(name) for name in ARM_AND_SHIN[family].split())
        assert match.parallel["l_shoulder"][0] == arm
        assert match.parallel["l_knee"][0] == shin
        for bone, (start, end) in match.parallel.items():
            twin = {"l": "r", "r": "l"}[bone[0]] + bone[1:] if bone[1] == "_" else None
            if twin is not None and bone[0] == "l":
                pair = tuple(names.index(mirrored(names[j]) or "") for j in (start, end))
                assert match.parallel[twin] == pair


def test_joints_that_contradict_the_hierarchy_do_not_match() -> None:
    """LeftShoulder with LeftArm below it is the clavicle; with LeftElbow below it, the upper arm."""
    limbs = ["Shoulder", "Elbow", "Wrist"], ["Hip", "Knee", "Ankle"]
    names = ["Hips", "Chest", "Neck", "Head"]
    names += [f"{side}{part}" for limb in limbs for side in ("Left", "Right") for part in limb]
    right = np.array([-1, 0, 1, 2, 1, 4, 5, 1, 7, 8, 0, 10, 11, 0, 13, 14])
    assert match_names(names, parents=right).complete
    wrong = right.copy()
    wrong[names.index("LeftElbow")] = names.index("RightShoulder")
    with pytest.raises(MotionError, match=r"l_elbow|l_shoulder"):
        match_names(names, parents=wrong)
    assert match_names(names).complete  # names alone cannot know


def test_a_cycle_of_parents_is_refused_with_its_joints() -> None:
    names, parents = skeleton_of("lafan1")
    hips, chest, head = (names.index(name) for name in ("Hips", "Spine", "Head"))
    parents[hips] = head  # the whole body is in or below the cycle
    assert names.index("LeftFoot") not in ancestors(chest, parents)
    with pytest.raises(
        MotionError, match=r"the joints Hips, Head, Neck, Spine2, Spine1 and 1 more are their own ancestors"
    ):
        match_names(names, parents=parents)
    assert match_names(names).complete


@pytest.mark.parametrize(
    ("spelling", "change"),
    [
        ("a common beginning", lambda name: f"Armature_{name}"),
        ("a common end", lambda name: f"{name}_dup"),
        ("both", lambda name: f"man|{name}.x"),
        ("the side in front", lambda name: re.sub("^(Left|Right)", lambda m: f"{m[1][0]}_", name)),
        (
            "the side behind",
            lambda name: re.sub("^(Left|Right)(.*)", lambda m: f"{m[2]}.{m[1][0].lower()}", name),
        ),
        ("a small letter", lambda name: re.sub("^(Left|Right)", lambda m: m[1][0].lower(), name).lower()),
    ],
)
def test_spellings_of_sides_and_common_parts_do_not_matter(
    spelling: str, change: Callable[[str], str]
) -> None:
    for family in ("lafan1", "mvn", "100style"):
        names, parents = skeleton_of(family)
        expected, got = (
            match_names(names, parents=parents),
            match_names([change(n) for n in names], parents=parents),
        )
        limbs = [role for role in expected.roles if role.startswith(("Left", "Right"))]
        assert {r: got.roles.get(r) for r in limbs} == {r: expected.roles[r] for r in limbs}, (
            family,
            got.table,
        )
        assert got.by == "names"


def test_a_letter_without_its_other_side_is_no_side() -> None:
    assert loose_keys(("leg", "lleg", "rleg", "lower", "Left_arm", "Right_arm")) == [
        "leg", "left leg", "right leg", "lower", "left arm", "right arm"]  # fmt: skip


def test_the_page_of_motions_lists_every_table() -> None:
    page = (ROOT / "docs" / "motion.md").read_text().split("### Joint tables")[1].split("\n## ")[0]
    assert set(re.findall(r"^\| (.*?) \|", page, re.MULTILINE)) >= {"`mixamo`"}
    listed = {
        name
        for row in re.findall(r"^\| (`.*?`) \|", page, re.MULTILINE)
        for name in re.findall("`(.*?)`", row)
    }
    assert listed == {table.name for table in built_in_tables()}
