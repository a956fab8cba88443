"""Fingers, toes, jaw and eyes of motions: names of many programs, and files whose bends are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import SHARED_DATA, needs_shared_data
from motion_files import StandIn, stand_in
from scipy.spatial.transform import Rotation

from humansim_ros.motion import Motion, Retargeter, read_motion, to_world
from humansim_ros.motion.body.skeleton import DETAIL_BONES, FINGERS, finger_bones
from humansim_ros.motion.matching.by_name import detail_joints, match_names
from humansim_ros.motion.matching.by_shape import match_motion
from humansim_ros.motion.matching.joint_tables import opposite_joints
from humansim_ros.people import load_human
from humansim_ros.types import Array

SKELETON = load_human("adult_man").skeleton
#: Bend of the three joints of each finger, degrees: none of two fingers is equal.
BENDS = {
    "thumb": (5.0, 20.0, 35.0),
    "index": (10.0, 40.0, 25.0),
    "middle": (60.0, 75.0, 30.0),
    "ring": (85.0, 100.0, 60.0),
    "pinky": (0.0, 15.0, 7.0),
}
#: Names of the joints of the left thumb, index and little finger, from the base, in files of programs.
NAMES = {
    "mixamo": "LeftHandThumb1 LeftHandThumb2 LeftHandThumb3 LeftHandIndex1 LeftHandIndex2 LeftHandIndex3 "
    "LeftHandPinky1 LeftHandPinky2 LeftHandPinky3",
    "mixamo with namespace": "mixamorig:LeftHandThumb1 mixamorig:LeftHandThumb2 mixamorig:LeftHandThumb3 "
    "mixamorig:LeftHandIndex1 mixamorig:LeftHandIndex2 mixamorig:LeftHandIndex3 mixamorig:LeftHandPinky1 "
    "mixamorig:LeftHandPinky2 mixamorig:LeftHandPinky3",
    "VRM 1": "leftThumbMetacarpal leftThumbProximal leftThumbDistal leftIndexProximal leftIndexIntermediate "
    "leftIndexDistal leftLittleProximal leftLittleIntermediate leftLittleDistal",
    "VRM 0, Unity": "leftThumbProximal leftThumbIntermediate leftThumbDistal leftIndexProximal "
    "leftIndexIntermediate leftIndexDistal leftLittleProximal leftLittleIntermediate leftLittleDistal",
    "Unreal": "thumb_01_l thumb_02_l thumb_03_l index_01_l index_02_l index_03_l pinky_01_l pinky_02_l "
    "pinky_03_l",
    "Biped": "Bip01 L Finger0|Bip01 L Finger01|Bip01 L Finger02|Bip01 L Finger1|Bip01 L Finger11|"
    "Bip01 L Finger12|Bip01 L Finger4|Bip01 L Finger41|Bip01 L Finger42",
    "Valve": "ValveBiped.Bip01_L_Finger0 ValveBiped.Bip01_L_Finger01 ValveBiped.Bip01_L_Finger02 "
    "ValveBiped.Bip01_L_Finger1 ValveBiped.Bip01_L_Finger11 ValveBiped.Bip01_L_Finger12 "
    "ValveBiped.Bip01_L_Finger4 ValveBiped.Bip01_L_Finger41 ValveBiped.Bip01_L_Finger42",
    "Rigify": "thumb.01.L thumb.02.L thumb.03.L f_index.01.L f_index.02.L f_index.03.L f_pinky.01.L "
    "f_pinky.02.L f_pinky.03.L",
    "Rigify deform": "DEF-thumb.01.L DEF-thumb.02.L DEF-thumb.03.L DEF-f_index.01.L DEF-f_index.02.L "
    "DEF-f_index.03.L DEF-f_pinky.01.L DEF-f_pinky.02.L DEF-f_pinky.03.L",
    "SMPL-X": "left_thumb1 left_thumb2 left_thumb3 left_index1 left_index2 left_index3 left_pinky1 "
    "left_pinky2 left_pinky3",
    "Xsens": "LeftFirstMC LeftFirstPP LeftFirstDP LeftSecondPP LeftSecondMP LeftSecondDP LeftFifthPP "
    "LeftFifthMP LeftFifthDP",
    "Rokoko": "LeftFinger1Metacarpal LeftFinger1Proximal LeftFinger1Distal LeftFinger2Proximal "
    "LeftFinger2Medial LeftFinger2Distal LeftFinger5Proximal LeftFinger5Medial LeftFinger5Distal",
    "MakeHuman": "finger1-1.L finger1-2.L finger1-3.L finger2-1.L finger2-2.L finger2-3.L finger5-1.L "
    "finger5-2.L finger5-3.L",
    "Daz": "lThumb1 lThumb2 lThumb3 lIndex1 lIndex2 lIndex3 lPinky1 lPinky2 lPinky3",
    "OptiTrack": "LThumb1 LThumb2 LThumb3 LIndex1 LIndex2 LIndex3 LPinky1 LPinky2 LPinky3",
    "Character Creator": "CC_Base_L_Thumb1 CC_Base_L_Thumb2 CC_Base_L_Thumb3 CC_Base_L_Index1 "
    "CC_Base_L_Index2 CC_Base_L_Index3 CC_Base_L_Pinky1 CC_Base_L_Pinky2 CC_Base_L_Pinky3",
    "VRoid": "J_Bip_L_Thumb1 J_Bip_L_Thumb2 J_Bip_L_Thumb3 J_Bip_L_Index1 J_Bip_L_Index2 J_Bip_L_Index3 "
    "J_Bip_L_Little1 J_Bip_L_Little2 J_Bip_L_Little3",
    "Second Life": "mHandThumb1Left mHandThumb2Left mHandThumb3Left mHandIndex1Left mHandIndex2Left "
    "mHandIndex3Left mHandPinky1Left mHandPinky2Left mHandPinky3Left",
    "ARKit": "left_handThumbStartJoint left_handThumb_1_joint left_handThumb_2_joint left_handIndex_1_joint "
    "left_handIndex_2_joint left_handIndex_3_joint left_handPinky_1_joint left_handPinky_2_joint "
    "left_handPinky_3_joint",
    "Advanced Skeleton": "ThumbFinger1_L ThumbFinger2_L ThumbFinger3_L IndexFinger1_L IndexFinger2_L "
    "IndexFinger3_L PinkyFinger1_L PinkyFinger2_L PinkyFinger3_L",
    "MikuMikuDance": "左親指０ 左親指１ 左親指２ 左人指１ 左人指２ 左人指３ 左小指１ 左小指２ 左小指３",
    "H-Anim 1": "l_thumb1 l_thumb2 l_thumb3 l_index1 l_index2 l_index3 l_pinky1 l_pinky2 l_pinky3",
    "H-Anim 2, joints": "l_carpometacarpal_1 l_metacarpophalangeal_1 l_carpal_interphalangeal_1 "
    "l_metacarpophalangeal_2 l_carpal_proximal_interphalangeal_2 l_carpal_distal_interphalangeal_2 "
    "l_metacarpophalangeal_5 l_carpal_proximal_interphalangeal_5 l_carpal_distal_interphalangeal_5",
    "H-Anim 2, segments": "l_metacarpal_1 l_carpal_proximal_phalanx_1 l_carpal_distal_phalanx_1 "
    "l_carpal_proximal_phalanx_2 l_carpal_middle_phalanx_2 l_carpal_distal_phalanx_2 "
    "l_carpal_proximal_phalanx_5 l_carpal_middle_phalanx_5 l_carpal_distal_phalanx_5",
    "OpenXR": "left-thumb-metacarpal left-thumb-phalanx-proximal left-thumb-phalanx-distal "
    "left-index-finger-phalanx-proximal left-index-finger-phalanx-intermediate "
    "left-index-finger-phalanx-distal left-pinky-finger-phalanx-proximal "
    "left-pinky-finger-phalanx-intermediate left-pinky-finger-phalanx-distal",
    "small letters": "lefthandthumb1 lefthandthumb2 lefthandthumb3 lefthandindex1 lefthandindex2 "
    "lefthandindex3 lefthandpinky1 lefthandpinky2 lefthandpinky3",
}


def fingered(ends: bool = True) -> StandIn:
    """A person in T pose whose hands have straight fingers with end sites, or without."""
    person = stand_in("mixamo")
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        for number, finger in enumerate(FINGERS):
            above, across = f"{side}Wrist", 3.0 - 1.5 * number
            for joint, length in zip((1, 2, 3), (8.0, 4.0, 2.5), strict=True):
                name = f"{side}Hand{finger.title()}{joint}"
                offset = (sign * length, 0.0, across if joint == 1 else 0.0)
                person = person.with_joint_below(above, name, offset)
                above = name
    if not ends:
        named = {j: end for j, end in person.ends.items() if not person.names[j].endswith("3")}
        person = replace(person, ends=named)
    return person


def bent(person: StandIn, bends: dict[str, tuple[float, float, float]]) -> Motion:
    """A straight first frame, and a second one with fingers bent to the palm, in BVH read again."""
    turns = {}
    for side, sign in (("Left", -1.0), ("Right", 1.0)):  # palms face down
        for finger, angles in bends.items():
            for joint, angle in enumerate(angles, 1):
                turn = Rotation.from_rotvec([[0, 0, 0], [0, 0, sign * np.radians(angle)]])
                turns[f"{side}Hand{finger.title()}{joint}"] = turn
    return person.motion(turns)


def directions(motion: Motion, frame: int) -> dict[str, Array]:
    """Direction (3,) in ``map`` of each finger bone in a frame."""
    world = to_world(motion)
    posed = Retargeter.fit(world, SKELETON).pose(world.sample([frame * motion.frame_time]))[0]
    return {bone: posed[SKELETON.bone(bone), :3, 1] for side in "lr" for bone in finger_bones(side)}


def degrees_between(a: Array, b: Array) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.mark.parametrize("ends", [True, False], ids=["with end sites", "without end sites"])
def test_fingers_of_a_file_bend_all_joints_by_their_angles(ends: bool) -> None:
    motion = bent(fingered(ends), BENDS)
    for side, out in (("l", 1.0), ("r", -1.0)):
        straight, now = directions(motion, 0), directions(motion, 1)
        for finger, angles in BENDS.items():
            total = 0.0
            for joint, angle in enumerate(angles, 1):
                total += np.radians(angle)
                bone = f"{side}_{finger}{joint}"
                # map: x forward, y left, z up
                assert degrees_between(straight[bone], np.array([0.0, out, 0.0])) < 0.1, bone
                expected = np.array([0.0, out * np.cos(total), -np.sin(total)])
                assert degrees_between(now[bone], expected) < 0.1, bone


def test_live_joints_with_fingers_bend_them() -> None:
    world = to_world(bent(fingered(), BENDS))
    poses = world.sample([0.0, world.motion.frame_time])
    fitted = Retargeter.fit_live(poses, match_names(poses.names), SKELETON)
    posed = fitted.pose(poses)
    for bone in (f"{side}_{finger}{joint}" for side in "lr" for finger in FINGERS for joint in (1, 2, 3)):
        start = poses.names.index(_mixamo(bone))
        end = match_motion(world.motion).details[bone][1]
        for pose in (0, 1):
            link = poses.positions[pose, end] - poses.positions[pose, start]
            assert degrees_between(posed[pose, SKELETON.bone(bone), :3, 1], link) < 0.1, bone


def _mixamo(bone: str) -> str:
    side = {"l": "Left", "r": "Right"}[bone[0]]
    return f"{side}Hand{bone[2:-1].title()}{bone[-1]}"


def test_the_mirrored_motion_swaps_the_fingers() -> None:
    motion = bent(fingered(), {"index": (30.0, 40.0, 20.0)})
    left = [motion.joint(f"LeftHandIndex{n}") for n in (1, 2, 3)]
    right = [motion.joint(f"RightHandIndex{n}") for n in (1, 2, 3)]
    pairs = opposite_joints(motion.joint_names, match_motion(motion).roles)
    assert pairs[left].tolist() == right


def test_a_motion_without_fingers_leaves_the_hands_relaxed() -> None:
    world = to_world(read_motion("walk"))
    rotations, _ = Retargeter.fit(world, SKELETON).apply(world.sample([0.3]))
    fingers = [SKELETON.bone(bone) for side in "lr" for bone in finger_bones(side)]
    assert np.abs(rotations[0, fingers] - [0, 0, 0, 1]).max() < 1e-9


@pytest.mark.parametrize("program", NAMES)
def test_names_of_programs_are_joints_of_fingers(program: str) -> None:
    left = NAMES[program].split("|" if "|" in NAMES[program] else None)
    swaps = [("left", "right"), ("Left", "Right"), ("左", "右"), (" L ", " R "), ("_L_", "_R_"), (".L", ".R")]
    swaps += [("_L", "_R"), ("_l", "_r"), ("LThumb", "RThumb"), ("LIndex", "RIndex"), ("LPinky", "RPinky")]
    right = []
    for name in left:
        swap = next(((a, b) for a, b in swaps if a in name), None)
        right.append(f"r{name[1:]}" if swap is None else name.replace(*swap))
    names = ["Hips", "Wrist", *left, "LeftHandRingIK1", "head", *right]
    expected = [
        f"{side}_{finger}{n}" for side in "lr" for finger in ("thumb", "index", "pinky") for n in (1, 2, 3)
    ]
    found = detail_joints(names, {})
    assert {bone: names[start] for bone, (start, _) in found.items()} == dict(
        zip(expected, (*left, *right), strict=True)
    )
    for bone, (_, end) in found.items():
        if not bone.endswith("3"):
            assert end == found[f"{bone[:-1]}{int(bone[-1]) + 1}"][0], bone


@pytest.mark.parametrize(
    "names",
    [
        ["LeftHandIndex1", "LeftHandIndex1_end", "LThumb", "LThumb_end"],  # CMU: the direction of the hand
        ["LeftInHandIndex", "LeftInHandMiddle", "LeftHandIndex", "LeftHandMiddle"],  # in the palm
        ["index1", "index2", "index3"],  # of which hand?
        ["index_ik_l", "index_ctrl_01_l", "index_ctrl_02_l"],
        ["LeftEyelid", "LeftEyebrow", "l_eye_target", "jaw_ctrl", "LeftJaw", "eye", "LeftEye_end"],
        ["toe2-1.L", "toe2-2.L", "toe2-3.L"],
        ["LeftFinger9Proximal", "LeftFinger9Distal"],
    ],
)
def test_other_joints_drive_no_detail(names: list[str]) -> None:
    assert detail_joints(names, {}) == {}


@pytest.mark.parametrize(
    ("name", "bone"),
    [
        *((name, "l_eyeball_joint") for name in (
            "LeftEye", "lEye", "eye.L", "Eye_L", "mEyeLeft", "EyeLeft", "CC_Base_L_Eye", "J_Adj_L_FaceEye",
            "left_eye_smplhf", "左目", "mixamorig:LeftEye", "l_eyeball_joint")),
        *((name, "temporomandibular") for name in (
            "jaw", "Jaw", "CC_Base_JawRoot", "lowerJaw", "temporomandibular")),
    ],
)  # fmt: skip
def test_names_of_jaw_and_eyes(name: str, bone: str) -> None:
    assert detail_joints(["Hips", name], {}) == {bone: (1, 1)}


#: Joints from the wrist out with one that is in the palm, or with an end that another finger seems to have;
#: then those that bend the finger, and where its last segment ends.
CHAINS = {
    "SOMA": ("LeftHandIndex1 LeftHandIndex2 LeftHandIndex3 LeftHandIndex4 LeftHandIndexEnd", "index", 1),
    "SOMA, thumb": ("LeftHandThumb1 LeftHandThumb2 LeftHandThumb3 LeftHandThumbEnd", "thumb", 0),
    "Meta Quest, thumb": ("b_l_thumb0 b_l_thumb1 b_l_thumb2 b_l_thumb3", "thumb", 1),
    "Meta Quest, little finger": ("b_l_pinky0 b_l_pinky1 b_l_pinky2 b_l_pinky3", "pinky", 1),
    "Mixamo": ("LeftHandIndex1 LeftHandIndex2 LeftHandIndex3 LeftHandIndex4", "index", 0),
    "Mixamo of Blender": (
        "LeftHandIndex1 LeftHandIndex2 LeftHandIndex3 LeftHandIndex4 LeftHandIndex4_end", "index", 0),
    "MetaHuman": ("index_metacarpal_l index_01_l index_02_l index_03_l", "index", 1),
    "Rigify": ("palm.01.L f_index.01.L f_index.02.L f_index.03.L", "index", 1),
    "Daz": ("lCarpal1 lIndex1 lIndex2 lIndex3", "index", 1),
    "MakeHuman": ("metacarpal1.L finger2-1.L finger2-2.L finger2-3.L", "index", 1),
    "Biped": ("Bip01 L Finger1|Bip01 L Finger11|Bip01 L Finger12|Bip01 L Finger1Nub", "index", 0),
    "Biped of Blender": (
        "Bip01_L_Finger0 Bip01_L_Finger01 Bip01_L_Finger02 Bip01_L_Finger02_end", "thumb", 0),
    "Rokoko": ("LeftFinger2Metacarpal LeftFinger2Proximal LeftFinger2Medial LeftFinger2Distal LeftFinger2Tip",
               "index", 1),
}  # fmt: skip


@pytest.mark.parametrize("program", CHAINS)
@pytest.mark.parametrize("with_parents", [True, False])
def test_joints_of_the_palm_and_ends_of_other_fingers_bend_no_finger(
    program: str, with_parents: bool
) -> None:
    chain, finger, first = CHAINS[program]
    joints = chain.split("|" if "|" in chain else None)
    # names of Biped's other fingers, whose ends have numbers of other fingers
    others = ["Bip01 L Finger2", "Bip01 L Finger21", "Bip01 L Finger22", "Bip01 L Finger2Nub"]
    names = ["LeftHand", *joints, *(others if "Nub" in chain else [])]
    parents = np.array([-1, *range(len(joints)), 0, *range(len(joints) + 1, len(names) - 1)][: len(names)])
    found = detail_joints(names, {"LeftWrist": 0}, parents if with_parents else None)
    links = {bone: tuple(names[joint] for joint in link) for bone, link in found.items()}
    bent = joints[first : first + 3]
    ends = [*bent[1:], joints[first + 3] if len(joints) > first + 3 else bent[-1]]
    for number, link in enumerate(zip(bent, ends, strict=True), 1):
        assert links[f"l_{finger}{number}"] == link
    assert {bone[:-1] for bone in links} - {"l_middle"} == {f"l_{finger}"}


def test_fingers_out_of_order_or_below_another_joint_do_not_match() -> None:
    names = ["Hips", "Hand", "LeftHandIndex1", "LeftHandIndex2", "Foot"]
    roles = {"LeftWrist": 1}
    right = np.array([-1, 0, 1, 2, 0])
    assert set(detail_joints(names, roles, right)) == {"l_index1", "l_index2"}
    assert detail_joints(names, roles, np.array([-1, 0, 4, 2, 0])) == {}
    assert detail_joints(names, roles, np.array([-1, 0, 1, 1, 0])) == {}


def test_a_toe_bends_the_toes_and_no_more_than_in_the_file() -> None:
    person = stand_in("mixamo")
    turn = Rotation.from_euler("x", [[0], [-30]], degrees=True)
    world = to_world(person.motion({"LeftToe": turn}))
    posed = Retargeter.fit(world, SKELETON).pose(world.sample([0.0, world.motion.frame_time]))
    toes, foot, other = (SKELETON.bone(b) for b in ("l_metatarsal", "l_ankle", "r_metatarsal"))
    change = Rotation.from_matrix(posed[1, toes, :3, :3] @ posed[0, toes, :3, :3].T)
    assert np.degrees(change.magnitude()) == pytest.approx(30.0, abs=1e-6)
    assert np.abs(posed[1, [foot, other], :3, :3] - posed[0, [foot, other], :3, :3]).max() < 1e-9


@needs_shared_data
def test_a_vrm_animation_drives_all_fingers() -> None:
    motion = read_motion(SHARED_DATA / "other" / "test.vrma")
    world = to_world(motion)
    assert {bone for side in "lr" for bone in finger_bones(side)} <= set(world.match.details)
    assert list(world.match.details) == [bone for bone in DETAIL_BONES if bone in world.match.details]
    poses = world.sample(np.linspace(0, world.cycle_length, 5))
    posed = Retargeter.fit(world, SKELETON).pose(poses)
    for bone, (start, end) in world.match.details.items():
        if start != end:
            for pose in range(5):
                link = poses.positions[pose, end] - poses.positions[pose, start]
                assert degrees_between(posed[pose, SKELETON.bone(bone), :3, 1], link) < 0.1, bone
