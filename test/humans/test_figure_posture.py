"""Skinned figures of any rig move with chest and head as upright as at rest, and arms as our own bodies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import SHARED_DATA, if_shared
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros import load_human, read_motion
from humansim_ros.files.mesh.load import read_mesh_or_figure
from humansim_ros.files.mesh.mesh import Mesh, SkinnedMesh, padded
from humansim_ros.geometry import angle_between, unit_vectors
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.motion.matching.by_name import match_names
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import WorldMotion, to_world
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.figure import to_body_space

Array = NDArray[np.float64]
#: Joint -> its parent and position: metres, y up, facing +z.
Rig = dict[str, tuple[str, tuple[float, float, float]]]
#: Most degrees by which chest and head may turn up or down.
MOST = 10.0


def limbs(names: Mapping[str, str], chest: str, hips: str, shoulder: float = 1.43) -> Rig:
    """Both arms in T pose and both legs. ``names``: role -> name of the joint, with :func:`spelled` sides."""
    places = {
        "collar": (chest, (0.03, shoulder + 0.01, -0.03)),
        "arm": ("collar", (0.19, shoulder, -0.03)),
        "elbow": ("arm", (0.45, shoulder, -0.04)),
        "wrist": ("elbow", (0.69, shoulder, -0.03)),
        "hip": (hips, (0.09, 0.92, 0.0)),
        "knee": ("hip", (0.09, 0.5, 0.01)),
        "ankle": ("knee", (0.09, 0.09, -0.03)),
        "toe": ("ankle", (0.09, 0.02, 0.1)),
    }
    rig: Rig = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for role, (parent, (x, y, z)) in places.items():
            if role not in names:
                continue
            while parent in places and parent not in names:
                parent = places[parent][0]
            name, above = (spelled(names[each], side) if each in names else each for each in (role, parent))
            rig[name] = (above, (sign * x, y, z))
    return rig


def spelled(name: str, side: str) -> str:
    """A name with a side: ``%s`` l or r, ``%S`` L or R, ``%side`` left or right, ``%Side`` Left or Right."""
    for mark, text in (("%Side", side.title()), ("%side", side), ("%s", side[0]), ("%S", side[0].upper())):
        name = name.replace(mark, text)
    return name


MIXAMO = {
    "collar": "%SideShoulder",
    "arm": "%SideArm",
    "elbow": "%SideForeArm",
    "wrist": "%SideHand",
    "hip": "%SideUpLeg",
    "knee": "%SideLeg",
    "ankle": "%SideFoot",
    "toe": "%SideToeBase",
}
KAYKIT = {
    "arm": "upperarm.%s",
    "elbow": "lowerarm.%s",
    "wrist": "hand.%s",
    "hip": "upperleg.%s",
    "knee": "lowerleg.%s",
    "ankle": "foot.%s",
    "toe": "toes.%s",
}
VRM = {
    "collar": "%sideShoulder",
    "arm": "%sideUpperArm",
    "elbow": "%sideLowerArm",
    "wrist": "%sideHand",
    "hip": "%sideUpperLeg",
    "knee": "%sideLowerLeg",
    "ankle": "%sideFoot",
    "toe": "%sideToes",
}
BIOVISION = {
    "collar": "%SideCollar",
    "arm": "%SideShoulder",
    "elbow": "%SideElbow",
    "wrist": "%SideWrist",
    "hip": "%SideHip",
    "knee": "%SideKnee",
    "ankle": "%SideAnkle",
}
TRUNK: Rig = {
    "Hips": ("", (0.0, 0.97, 0.0)),
    "Spine": ("Hips", (0.0, 1.08, 0.01)),
    "Spine1": ("Spine", (0.0, 1.2, 0.0)),
    "Spine2": ("Spine1", (0.0, 1.32, -0.02)),
    "Neck": ("Spine2", (0.0, 1.48, -0.035)),
    "Head": ("Neck", (0.0, 1.58, 0.0)),
}
TOP: Rig = {"HeadTop_End": ("Head", (0.0, 1.8, 0.03))}
EYES: Rig = {"LeftEye": ("Head", (0.03, 1.67, 0.09)), "RightEye": ("Head", (-0.03, 1.67, 0.09))}
HAIR: Rig = {
    "Hair_1": ("Head", (0.0, 1.72, -0.08)),
    "Hair_2": ("Hair_1", (0.0, 1.6, -0.15)),
    "Hair_3": ("Hair_2", (0.0, 1.4, -0.17)),
}
HAT: Rig = {"Hat": ("Head", (0.0, 1.76, 0.05)), "HatTip": ("Hat", (0.0, 1.82, 0.25))}
HOOD: Rig = {"Hood": ("Spine2", (0.0, 1.45, -0.12)), "HoodTip": ("Hood", (0.0, 1.35, -0.2))}
CAPE: Rig = {"Cape": ("Spine2", (0.0, 1.4, -0.15)), "CapeEnd": ("Cape", (0.0, 0.6, -0.3))}
BELT: Rig = {"Belt": ("Hips", (0.0, 0.98, 0.14)), "Pouch": ("Spine", (0.12, 1.0, 0.1))}
NECKS: Rig = {
    "Neck1": ("Neck", (0.0, 1.52, -0.03)),
    "Neck2": ("Neck1", (0.0, 1.55, -0.01)),
    "Head": ("Neck2", (0.0, 1.58, 0.0)),
}
#: The neck leans forward by 27 degrees, and the chest back by 12, as in many figures of games.
LEANING: Rig = {
    "Spine2": ("Spine1", (0.0, 1.3, 0.0)),
    "Neck": ("Spine2", (0.0, 1.46, -0.035)),
    "Head": ("Neck", (0.0, 1.54, 0.005)),
}
SPINES: Rig = {
    "Spine3": ("Spine2", (0.0, 1.37, -0.03)),
    "Spine4": ("Spine3", (0.0, 1.42, -0.03)),
    "Neck": ("Spine4", (0.0, 1.48, -0.035)),
}


def prefixed(rig: Rig, prefix: str) -> Rig:
    return {prefix + name: (prefix + parent if parent else "", at) for name, (parent, at) in rig.items()}


def mixamo(*more: Rig) -> Rig:
    trunk = {name: place for part in (TRUNK, *more) for name, place in part.items()}
    rig = {**trunk, **limbs(MIXAMO, "Spine2", "Hips")}

    def depth(name: str) -> int:
        return 1 + depth(rig[name][0]) if rig[name][0] else 0

    return {name: rig[name] for name in sorted(rig, key=depth)}  # parents first


RIGS: dict[str, Rig] = {
    "mixamo": prefixed(mixamo(TOP), "mixamorig:"),
    "ready_player_me": mixamo(TOP, EYES),
    "eyes": mixamo(EYES),
    "hair": mixamo(HAIR),
    "hat": mixamo(HAT, EYES),
    "hood_and_cape": mixamo(HOOD, CAPE, HAIR),
    "belt": mixamo(BELT, TOP),
    "more_necks": mixamo(NECKS, EYES),
    "more_spines": mixamo(SPINES, HOOD),
    "leaning_neck": mixamo(LEANING, HAT),
    "kaykit": {
        "root": ("", (0.0, 0.0, 0.0)),
        "hips": ("root", (0.0, 0.97, 0.0)),
        "spine": ("hips", (0.0, 1.02, 0.0)),
        "chest": ("spine", (0.0, 1.2, 0.0)),
        "head": ("chest", (0.0, 1.45, 0.0)),
        "helmet": ("head", (0.0, 1.9, -0.2)),
        **limbs(KAYKIT, "chest", "hips", 1.35),
    },
    "vrm": {
        "hips": ("", (0.0, 0.97, 0.0)),
        "spine": ("hips", (0.0, 1.08, 0.01)),
        "chest": ("spine", (0.0, 1.2, 0.0)),
        "upperChest": ("chest", (0.0, 1.32, -0.02)),
        "neck": ("upperChest", (0.0, 1.48, -0.035)),
        "head": ("neck", (0.0, 1.58, 0.0)),
        "leftEye": ("head", (0.03, 1.67, 0.09)),
        "rightEye": ("head", (-0.03, 1.67, 0.09)),
        "J_Sec_Hair1_01": ("head", (0.0, 1.72, 0.08)),
        "J_Sec_Hair2_01": ("J_Sec_Hair1_01", (0.0, 1.66, 0.14)),
        **limbs(VRM, "upperChest", "hips"),
    },
    "biovision": {
        "Hips": ("", (0.0, 0.97, 0.0)),
        "Chest": ("Hips", (0.0, 1.12, 0.0)),
        "Neck": ("Chest", (0.0, 1.48, -0.035)),
        "Head": ("Neck", (0.0, 1.58, 0.0)),
        "Ponytail": ("Head", (0.0, 1.7, -0.12)),
        **limbs(BIOVISION, "Chest", "Hips"),
    },
}


def family(trunk: str, names: str, *more: Rig, above: str = "", arms_at: str = "") -> Rig:
    """Rig of a program: bones of trunk and head from below, and of the left limbs in the order of MIXAMO.

    ``above``: roots over the hips. ``arms_at``: bone that has the arms; the chest if empty.
    """
    rig: Rig = {}
    parent = ""
    for name in above.split():
        rig[name], parent = (parent, (0.0, 0.0, 0.0)), name
    bones = trunk.split()
    heights = [0.97, *np.linspace(1.08, 1.32, len(bones) - 3).tolist(), 1.48, 1.58]
    for name, height in zip(bones, heights, strict=True):
        rig[name], parent = (parent, (0.0, height, -0.035 if height == 1.48 else 0.0)), name
    spelling = {role: name for role, name in zip(MIXAMO, names.split(), strict=True) if name != "-"}
    rig |= limbs(spelling, arms_at or bones[-3], bones[0])
    return {name: place for part in (rig, *more) for name, place in part.items()}


#: Rigs whose names have tables of their own.
FAMILIES = {
    "unreal": family(
        "pelvis spine_01 spine_02 spine_03 spine_04 spine_05 neck_01 head",
        "clavicle_%s upperarm_%s lowerarm_%s hand_%s thigh_%s calf_%s foot_%s ball_%s",
        {"upperarm_twist_01_l": ("upperarm_l", (0.3, 1.43, -0.03)), "ik_foot_l": ("root", (0.09, 0.09, 0))},
        {"FACIAL_C_FacialRoot": ("head", (0, 1.6, 0.02)), "FACIAL_L_Eye": ("head", (0.03, 1.66, 0.08))},
        above="root",
    ),
    "unity": family(
        "J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head",
        "J_Bip_%S_Shoulder J_Bip_%S_UpperArm J_Bip_%S_LowerArm J_Bip_%S_Hand "
        "J_Bip_%S_UpperLeg J_Bip_%S_LowerLeg J_Bip_%S_Foot J_Bip_%S_ToeBase",
        {
            "J_Sec_Hair1_01": ("J_Bip_C_Head", (0, 1.7, -0.1)),
            "J_Sec_Hair1_02": ("J_Sec_Hair1_01", (0, 1, -0.1)),
        },
        above="Root",
    ),
    "rigify": family(
        "DEF-spine DEF-spine.001 DEF-spine.002 DEF-spine.003 DEF-spine.004 DEF-spine.006",
        "DEF-shoulder.%S DEF-upper_arm.%S DEF-forearm.%S DEF-hand.%S "
        "DEF-thigh.%S DEF-shin.%S DEF-foot.%S DEF-toe.%S",
        {"DEF-breast.L": ("DEF-spine.003", (0.1, 1.3, 0.1)), "DEF-pelvis.L": ("DEF-spine", (0.05, 1.0, 0.1))},
    ),
    "daz": family(
        "pelvis abdomenLower abdomenUpper chestLower chestUpper neckLower head",
        "%sCollar %sShldrBend %sForearmBend %sHand %sThighBend %sShin %sFoot %sToe",
        {"upperFaceRig": ("head", (0, 1.68, 0.05)), "lBrowInner": ("upperFaceRig", (0.01, 1.7, 0.09))},
        above="Genesis8Male hip",
    ),
    "reallusion": family(
        "CC_Base_Hip CC_Base_Waist CC_Base_Spine01 CC_Base_Spine02 CC_Base_NeckTwist01 CC_Base_Head",
        "CC_Base_%S_Clavicle CC_Base_%S_Upperarm CC_Base_%S_Forearm CC_Base_%S_Hand "
        "CC_Base_%S_Thigh CC_Base_%S_Calf CC_Base_%S_Foot CC_Base_%S_ToeBase",
        {
            "CC_Base_JawRoot": ("CC_Base_Head", (0, 1.61, 0.03)),
            "CC_Base_L_Eye": ("CC_Base_Head", (0.03, 1.66, 0)),
        },
        above="RL_BoneRoot",
    ),
    "biped": family(
        "Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Spine2 Bip01_Neck Bip01_Head",
        "Bip01_%S_Clavicle Bip01_%S_UpperArm Bip01_%S_Forearm Bip01_%S_Hand "
        "Bip01_%S_Thigh Bip01_%S_Calf Bip01_%S_Foot Bip01_%S_Toe0",
        {"Bip01_Ponytail1": ("Bip01_Head", (0, 1.7, -0.12))},
        above="Bip01",
        arms_at="Bip01_Neck",
    ),
    "advanced_skeleton": family(
        "Root_M Spine1_M Chest_M Neck_M Head_M",
        "Scapula_%S Shoulder_%S Elbow_%S Wrist_%S Hip_%S Knee_%S Ankle_%S Toes_%S",
        {"HeadEnd_M": ("Head_M", (0, 1.8, 0)), "Eye_L": ("Head_M", (0.03, 1.66, 0.08))},
    ),
    "arkit": family(
        "hips_joint spine_1_joint spine_2_joint spine_7_joint neck_1_joint head_joint",
        "%side_shoulder_1_joint %side_arm_joint %side_forearm_joint %side_hand_joint "
        "%side_upLeg_joint %side_leg_joint %side_foot_joint %side_toes_joint",
        {"jaw_joint": ("head_joint", (0, 1.6, 0.05))},
        above="root",
    ),
    "second_life": family(
        "mPelvis mTorso mChest mNeck mHead",
        "mCollar%Side mShoulder%Side mElbow%Side mWrist%Side mHip%Side mKnee%Side mAnkle%Side mFoot%Side",
        {"mSkull": ("mHead", (0, 1.75, 0)), "mEyeLeft": ("mHead", (0.03, 1.66, 0.08))},
    ),
    "mmd": family(
        "下半身 上半身 上半身2 首 頭",
        "肩.%S 腕.%S ひじ.%S 手首.%S 足.%S ひざ.%S 足首.%S つま先.%S",
        {"両目": ("頭", (0, 1.75, 0)), "足IK.L": ("センター", (0.09, 0.09, 0))},
        above="センター",
    ),
    # feet are children of the root, moved by inverse kinematics
    "quaternius": family(
        "Hips Abdomen Torso Neck Head",
        "Shoulder.%S UpperArm.%S LowerArm.%S Palm.%S UpperLeg.%S LowerLeg.%S - -",
        *(
            {
                f"LowerLeg.{side}_end": (f"LowerLeg.{side}", (sign * 0.09, 0.09, -0.03)),
                f"Foot.{side}": ("Bone", (sign * 0.09, 0.09, -0.03)),
                f"Foot.{side}_end": (f"Foot.{side}", (sign * 0.09, 0.02, 0.1)),
                f"PoleTarget.{side}": ("Bone", (sign * 0.09, 0.5, 0.6)),
            }
            for side, sign in (("L", 1), ("R", -1))
        ),
        above="Bone",
    ),
}
RIGS |= FAMILIES
# names that no table has: matched by the shape of the skeleton
RIGS["numbers"] = {
    f"joint_{number}": (f"joint_{list(RIGS['eyes']).index(parent)}" if parent else "", at)
    for number, (parent, at) in enumerate(RIGS["eyes"].values())
}
#: Joints that turn at rest: degrees about x, y and z on the left side.
RESTS: dict[str, dict[str, tuple[float, float, float]]] = {
    "T": {},
    "A": {"arm": (0, 0, -50)},
    "bent": {"spine": (15, 5, 4), "arm": (0, 0, -60)},
    "posed": {"arm": (20, -15, -65), "elbow": (0, -25, 0), "hip": (-6, 4, 3), "knee": (12, 0, 0)},
}


def figure(name: str, rest: str) -> SkinnedMesh:
    """Skinned mesh of a rig in a rest pose: a box along each link, and a larger box as the head."""
    rig, size = RIGS[name], 0.2 if name == "kaykit" else 0.11
    names = tuple(rig)
    parents = np.array([names.index(parent) if parent else -1 for parent, _ in rig.values()])
    places = np.array([place for _, place in rig.values()])
    posed, turns = np.zeros_like(places), [Rotation.identity()] * len(names)
    for joint, parent in enumerate(parents):
        above = turns[parent] if parent >= 0 else Rotation.identity()
        offset = places[joint] - (places[parent] if parent >= 0 else 0.0)
        posed[joint] = (posed[parent] if parent >= 0 else 0.0) + above.apply(offset)
        turns[joint] = above * turn_of(places, parents, joint, RESTS[rest])
    vertices, triangles, weights = [], [], []
    box = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    head = head_of(names)
    for joint, parent in enumerate(parents):
        parts = [(joint, posed[joint] + size * (box + np.array([0.0, 1.0, 0.2])))] if joint == head else []
        if parent >= 0 and parent != head:
            middle = (posed[joint] + posed[parent]) / 2
            half = np.abs(posed[joint] - posed[parent]) / 2 + 0.03
            parts.append((parent, middle + half * box))
        if joint not in parents and joint != head:
            parts.append((joint, posed[joint] + 0.04 * box))
        for owner, corners in parts:
            base = 8 * len(vertices)
            for a, b, c, d in quads:
                triangles += [(base + a, base + b, base + c), (base + a, base + c, base + d)]
            vertices.append(corners)
            share = np.zeros((8, len(names)))
            share[:, owner] = 1.0
            weights.append(share)
    mesh = Mesh(np.concatenate(vertices), padded(np.array(triangles)))
    return SkinnedMesh("rig", mesh, names, parents, posed, csr_matrix(np.concatenate(weights)))


def head_of(names: tuple[str, ...]) -> int:
    """Joint of the head: `joint_5` where joints have numbers."""
    ends = ("head", "joint_5", "head_m", "head_joint", "spine.006", "頭")
    return next(n for n, name in enumerate(names) if name.lower().endswith(ends))


def turn_of(
    places: Array, parents: NDArray[np.intp], joint: int, rest: Mapping[str, tuple[float, float, float]]
) -> Rotation:
    """Rotation of a joint at rest, found by where the joint is in T pose."""
    x, y, _ = places[joint]
    if abs(x) < 0.01 and 1.19 < y < 1.21:
        return Rotation.from_euler("xyz", rest.get("spine", (0, 0, 0)), degrees=True)
    role = {
        (0.19, True): "arm",
        (0.45, True): "elbow",
        (0.09, True): "hip" if y > 0.9 else "knee" if y > 0.4 else "",
    }.get((round(abs(float(x)), 2), True), "")
    angles = np.array(rest.get(role, (0, 0, 0)), dtype=float)
    if x < 0:
        angles *= [1, -1, -1]
    return Rotation.from_euler("xyz", angles, degrees=True)


@cache
def wave() -> WorldMotion:
    motion = read_motion("wave")
    few = replace(motion, values=motion.values[::8], frame_time=8 * motion.frame_time)
    return to_world(few)


def tilts(skinned: SkinnedMesh) -> dict[str, Array]:
    """Degrees by which chest and head look up in each frame of ``wave``, compared with rest."""
    _, skeleton, _ = to_body_space(skinned)
    poses = wave().sample(np.linspace(0.0, wave().cycle_length, 20))
    posed = Retargeter.fit(wave(), skeleton).pose(poses)
    tilts = {}
    for bone in ("vl5", "vt3"):
        number = skeleton.bone(bone)
        forward = posed[:, number, :3, :3] @ (skeleton.rest[number, :3, :3].T @ [0.0, 0.0, 1.0])
        tilts[bone] = np.degrees(np.arcsin(forward[:, 2]))  # z is up in map
    return tilts


@pytest.mark.daily("*-T", "*-bent")
@pytest.mark.parametrize("rest", RESTS)
@pytest.mark.parametrize("rig", RIGS)
def test_chest_and_head_of_any_rig_look_forward_as_at_rest(rig: str, rest: str) -> None:
    for bone, degrees in tilts(figure(rig, rest)).items():
        assert np.abs(degrees).max() < MOST, bone


def forearms(skeleton: Skeleton, posed: Array) -> Array:
    """Unit vectors (2, F, 3) from the elbows to the wrists in poses (F, B, 4, 4)."""
    ends = [
        [posed[:, skeleton.bone(f"{side}_{part}"), :3, 3] for part in ("elbow", "wrist")] for side in "lr"
    ]
    return np.stack([unit_vectors(wrist - elbow) for elbow, wrist in ends])


@cache
def bends() -> tuple[WorldMotion, Array, Array]:
    """The built-in run; forearms (2, F, 3) and bends of the elbows (2, F), degrees, of our own body in it."""
    motion = to_world(read_motion("run"))
    skeleton = load_human("adult_man").skeleton
    posed = Retargeter.fit(motion, skeleton).pose(motion.sample(np.linspace(0.0, motion.cycle_length, 12)))
    own = forearms(skeleton, posed)
    heads = [
        [posed[:, skeleton.bone(f"{side}_{part}"), :3, 3] for part in ("shoulder", "elbow")] for side in "lr"
    ]
    upper = np.stack([unit_vectors(elbow - shoulder) for shoulder, elbow in heads])
    return motion, own, np.degrees(angle_between(own, upper))


def forearm_errors(skinned: SkinnedMesh) -> tuple[float, float]:
    """Most degrees between the forearms of a figure, by bones and by skin, and our own in the same motion."""
    motion, own, _ = bends()
    mesh, skeleton, weights = to_body_space(skinned)
    posed = Retargeter.fit(motion, skeleton).pose(motion.sample(np.linspace(0.0, motion.cycle_length, 12)))
    human = Human("figure", mesh, skeleton, weights)
    vertices = np.stack([human.pose(frame) for frame in posed])
    skin = []
    for side in "lr":
        elbow = skeleton.bone(f"{side}_elbow")
        middle = vertices[:, np.asarray(weights.argmax(axis=1)).ravel() == elbow].mean(1)
        skin.append(unit_vectors(middle - posed[:, elbow, :3, 3]))
    bones, flesh = (angle_between(found, own) for found in (forearms(skeleton, posed), np.stack(skin)))
    return float(np.degrees(bones.max())), float(np.degrees(flesh.max()))


def test_the_run_bends_both_elbows() -> None:
    _, _, bend = bends()
    assert bend.max(1).min() > 60


@pytest.mark.daily("*-T", "*-posed")
@pytest.mark.parametrize("rest", RESTS)
@pytest.mark.parametrize("rig", RIGS)
def test_forearms_of_any_rig_point_as_ours_do(rig: str, rest: str) -> None:
    assert max(forearm_errors(figure(rig, rest))) < MOST


@pytest.mark.parametrize("name", if_shared("rpm_6505ad3b.glb", "CesiumMan.glb", "RiggedFigure.gltf"))
def test_forearms_of_shared_figures_point_as_ours_do(name: str) -> None:
    skinned = read_mesh_or_figure(SHARED_DATA / "mesh" / name)
    assert isinstance(skinned, SkinnedMesh)
    assert forearm_errors(skinned)[0] < MOST  # few vertices that also follow the upper arm are no direction


@pytest.mark.parametrize("rig", FAMILIES)
def test_rigs_of_programs_match_their_own_table(rig: str) -> None:
    skinned = figure(rig, "T")
    match = match_names(skinned.joint_names, parents=skinned.parents)
    assert match.table == rig
    leg = FAMILIES[rig]
    below = {"LeftKnee": "LeftHip", "RightElbow": "RightShoulder"}
    for lower, upper in below.items():
        names = [skinned.joint_names[match.roles[role]] for role in (lower, upper)]
        assert leg[names[0]][0] == names[1]


def test_feet_that_are_children_of_the_root_follow_the_shins() -> None:
    skinned = figure("quaternius", "T")
    _, skeleton, weights = to_body_space(skinned)
    poses = to_world(read_motion("walk")).sample(np.linspace(0.0, 1.0, 9))
    posed = Retargeter.fit(to_world(read_motion("walk")), skeleton).pose(poses)
    ankle, knee = (skeleton.bone(name) for name in ("l_ankle", "l_knee"))
    shins = np.linalg.norm(posed[:, ankle, :3, 3] - posed[:, knee, :3, 3], axis=1)
    assert np.ptp(posed[:, ankle, 0, 3]) > 0.3  # a step
    np.testing.assert_allclose(shins, 0.41, atol=0.01)
    assert weights[:, ankle].nnz > 0


@pytest.mark.parametrize("name", if_shared("rpm_6505ad3b.glb", "CesiumMan.glb", "RiggedFigure.gltf"))
def test_chest_and_head_of_shared_figures_look_forward_as_at_rest(name: str) -> None:
    skinned = read_mesh_or_figure(SHARED_DATA / "mesh" / name)
    assert isinstance(skinned, SkinnedMesh)
    for bone, degrees in tilts(skinned).items():
        assert np.abs(degrees).max() < MOST, bone


@pytest.mark.parametrize("rig", ["hat", "kaykit", "hair", "vrm"])
def test_the_head_ends_at_the_top_of_its_own_skin(rig: str) -> None:
    skinned = figure(rig, "T")
    mesh, skeleton, _ = to_body_space(skinned)
    own = skinned.weights[:, [head_of(skinned.joint_names)]].toarray()[:, 0] == 1
    tail = skeleton.tails[skeleton.bone("vt3")]
    assert tail[1] == pytest.approx(mesh.vertices[own, 1].max(), abs=0.01)
    assert abs(tail[0]) < 0.01


def test_the_ends_of_a_hand_with_fingers_and_of_a_head_with_eyes_are_their_tips() -> None:
    """The built-in child as a figure of another program, whose names and bones are its own."""
    child = load_human("child")
    skeleton = child.skeleton
    renamed = {name: f"x{number}" for number, name in enumerate(skeleton.names[22:])}
    names = tuple(renamed.get(name, name) for name in skeleton.names)
    joints = SkinnedMesh("child", child.mesh, names, skeleton.parents, skeleton.heads, child.weights)
    mesh, found, _ = to_body_space(joints)
    assert set(skeleton.joint_names[57:62]) <= set(found.joint_names)
    for side, out in (("l", 1.0), ("r", -1.0)):
        wrist = found.bone(f"{side}_wrist")
        hand = mesh.vertices[mesh.vertices[:, 0] * out > found.heads[wrist][0] * out]
        tip = (hand[:, 0] * out).max()
        assert abs(found.tails[wrist][0] * out - tip) < 0.015
        assert f"{side}_wrist_end" in found.joint_names
    assert abs(found.tails[found.bone("vt3")][1] - mesh.vertices[:, 1].max()) < 0.03
