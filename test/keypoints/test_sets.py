"""Tables of keypoint sets: numbers of keypoints as their fields publish them."""

from __future__ import annotations

import re

import numpy as np
import pytest

from humansim_ros.errors import KeypointError
from humansim_ros.files.reading import read_table
from humansim_ros.motion.body.skeleton import JOINT_NAMES, SMPL, side_of
from humansim_ros.people import KEYPOINT_SETS, keypoint_set
from humansim_ros.people.keypoints.locator import MIXES, skin_points
from humansim_ros.people.keypoints.sets import KeypointSet

COCO, BODY_25 = (tuple(read_table("joints")[name]) for name in ("coco", "body_25"))
#: Numbers of some keypoints in the publications of each set, far apart in its order.
PUBLISHED = {
    "coco17": (17, {0: "nose", 5: "left_shoulder", 10: "right_wrist", 16: "right_ankle"}),
    "halpe26": (
        26,
        {4: "right_ear", 17: "head", 18: "neck", 19: "hip", 21: "right_big_toe", 25: "right_heel"},
    ),
    "body25": (25, {1: "Neck", 4: "RWrist", 8: "MidHip", 15: "REye", 19: "LBigToe", 24: "RHeel"}),
    "h36m17": (17, {0: "Hip", 3: "RFoot", 7: "Spine", 10: "Head", 11: "LShoulder", 16: "RWrist"}),
    "panoptic19": (19, {0: "Neck", 2: "BodyCenter", 5: "lWrist", 9: "rShoulder", 15: "lEye", 18: "rEar"}),
    "smpl24": (24, {0: "pelvis", 6: "spine2", 12: "neck", 15: "head", 18: "left_elbow", 23: "right_hand"}),
    "mediapipe33": (
        33,
        {4: "right_eye_inner", 9: "mouth_left", 17: "left_pinky", 22: "right_thumb", 30: "right_heel"},
    ),
    "left_hand21": (
        21,
        {0: "left_hand_root", 4: "left_thumb4", 5: "left_forefinger1", 20: "left_pinky_finger4"},
    ),
    "right_hand21": (21, {0: "right_hand_root", 9: "right_middle_finger1", 13: "right_ring_finger1"}),
    "face68": (68, {0: "face-0", 67: "face-67"}),
    "face70": (70, {68: "face-68", 69: "face-69"}),
    "face468": (468, {0: "mesh-0", 467: "mesh-467"}),
    "wholebody133": (
        133,
        {17: "left_big_toe", 22: "right_heel", 23: "face-0", 91: "left_hand_root", 112: "right_hand_root"},
    ),
    "halpe136": (
        136,
        {17: "head", 25: "right_heel", 26: "face-0", 94: "left_hand_root", 135: "right_pinky_finger4"},
    ),
    "openpose137": (
        137,
        {1: "Neck", 24: "RHeel", 25: "face-0", 94: "face-69", 95: "left_hand_root", 116: "right_hand_root"},
    ),
    "plug_in_gait": (39, {0: "LFHD", 4: "C7", 8: "RBAK", 22: "RFIN", 25: "LPSI", 38: "RTOE"}),
}
#: Constants of the object keypoint similarity, from pycocotools (kpt_oks_sigmas) and from HALPE's evaluation.
COCO_SIGMAS = np.array(
    [0.26, 0.25, 0.25, 0.35, 0.35, 0.79, 0.79, 0.72, 0.72, 0.62, 0.62, 1.07, 1.07, 0.87, 0.87, 0.89, 0.89]
)
#: Some constants of COCO-WholeBody: a toe, ends of the jaw line, tip of the nose, root and tips of fingers.
WHOLE_BODY_SIGMAS = {20: 0.092, 23: 0.042, 31: 0.020, 53: 0.007, 91: 0.029, 92: 0.022, 116: 0.047, 132: 0.031}
#: Points of the face by their numbers in 300-W: ends of the jaw, chin, brows, nose, eyes, mouth.
FACE = {
    0: "right_jaw_1",
    8: "chin",
    16: "left_jaw_1",
    17: "right_brow_5",
    21: "right_brow_1",
    22: "left_brow_1",
    26: "left_brow_5",
    27: "nasion",
    30: "nose",
    33: "nose_base",
    35: "left_nose_wing",
    36: "right_eye_outer",
    39: "right_eye_inner",
    42: "left_eye_inner",
    45: "left_eye_outer",
    37: "right_upper_lid_outer",
    47: "left_lower_lid_inner",
    48: "right_mouth",
    51: "upper_lip",
    54: "left_mouth",
    57: "lower_lip",
    60: "right_mouth_inner",
    62: "upper_lip_inner",
    64: "left_mouth_inner",
    66: "lower_lip_inner",
}
HALPE_SIGMAS = (0.026, 0.026, 0.066, 0.079, 0.079, 0.079, 0.079, 0.079, 0.079)


@pytest.mark.parametrize("name", PUBLISHED)
def test_keypoints_have_the_numbers_of_their_field(name: str) -> None:
    keypoints = keypoint_set(name)
    count, numbers = PUBLISHED[name]
    assert len(keypoints) == len(set(keypoints.names)) == count
    assert {number: keypoints.names[number] for number in numbers} == numbers
    assert PUBLISHED.keys() == KEYPOINT_SETS.keys()


def test_names_agree_with_those_of_the_skeleton_table() -> None:
    for name, names in (("coco17", COCO), ("body25", BODY_25), ("smpl24", SMPL)):
        assert keypoint_set(name).names == names


def test_sigmas_are_the_published_ones() -> None:
    np.testing.assert_allclose(keypoint_set("coco17").sigmas or (), COCO_SIGMAS / 10)
    np.testing.assert_allclose(keypoint_set("halpe26").sigmas or (), [*COCO_SIGMAS / 10, *HALPE_SIGMAS])
    whole = keypoint_set("wholebody133").sigmas or ()
    np.testing.assert_allclose(whole[:17], COCO_SIGMAS / 10)
    assert {number: whole[number] for number in WHOLE_BODY_SIGMAS} == WHOLE_BODY_SIGMAS
    assert whole[91:112] == whole[112:]
    halpe = keypoint_set("halpe136").sigmas or ()
    assert halpe[17:26] == (0.08, 0.08, 0.08, 0.089, 0.089, 0.089, 0.089, 0.089, 0.089)
    assert set(halpe[26:]) == {0.015} and halpe[:17] == keypoint_set("coco17").sigmas
    assert {name for name, row in KEYPOINT_SETS.items() if row.sigmas is not None} == {
        *("coco17", "halpe26", "wholebody133", "halpe136")
    }


@pytest.mark.parametrize("name", ["face68", "face70", "wholebody133", "halpe136", "openpose137"])
def test_points_of_the_face_have_the_numbers_of_300_w(name: str) -> None:
    keypoints = keypoint_set(name)
    assert {n: keypoints.points[keypoints.index(f"face-{n}")] for n in FACE} == FACE
    start = keypoints.index("face-0")
    assert keypoints.parts["face"] == tuple(range(start, start + 68))


def test_points_of_the_face_mesh_have_the_numbers_of_mediapipe() -> None:
    keypoints = keypoint_set("face468")
    points = {33: "right_eye_outer", 263: "left_eye_outer", 133: "right_eye_inner", 61: "right_mouth"}
    points |= {291: "left_mouth", 13: "upper_lip_inner", 14: "lower_lip_inner", 4: "face_mesh_4"}
    assert {number: keypoints.points[number] for number in points} == points
    # known pairs of mirror images, and points in the middle
    for right, left in (
        (33, 263),
        (127, 356),
        (70, 300),
        (58, 288),
        (93, 323),
        (98, 327),
        (4, 4),
        (152, 152),
    ):
        assert keypoints.mirrored[right] == left
    assert sum(partner == number for number, partner in enumerate(keypoints.mirrored)) == 28
    assert not keypoints.has_body and not keypoint_set("face70").has_body and keypoint_set("coco17").has_body


def test_fingers_are_joints_and_tips_of_both_hands() -> None:
    for name in ("left_hand21", "right_hand21"):
        side, keypoints = name[0], keypoint_set(name)
        fingers = ("thumb", "index", "middle", "ring", "pinky")
        joints = [f"{side}_{finger}{end}" for finger in fingers for end in ("1", "2", "3", "3_end")]
        assert keypoints.points == (f"{side}_wrist", *joints)
        assert [len(part) for part in keypoints.parts.values()] == [21]


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_keypoint_is_a_known_point_of_its_side_and_connected(name: str) -> None:
    keypoints = keypoint_set(name)
    joints = {joint.name for joint in JOINT_NAMES}
    for keypoint, point in zip(keypoints.names, keypoints.points, strict=True):
        assert (point in joints) + (point in MIXES) + (point in skin_points()) == 1, point
        lower = keypoint.lower()
        side = 1 if "left" in lower else -1 if "right" in lower else 0
        if not side and point not in joints and name in ("body25", "h36m17", "plug_in_gait", "panoptic19"):
            side = {"l": 1, "r": -1}.get(lower[0], 0)
        actual = 1 if point.startswith("left") else -1 if point.startswith("right") else side_of(point)
        if side:
            assert actual == side, keypoint
    # nose and wrists of whole bodies are points of the body, and of face and hands
    twice = {"nose", "l_wrist", "r_wrist"} if keypoints.parts.keys() >= {"face", "left_hand"} else set()
    pupils = {keypoints.index(each) for each in ("face-68", "face-69") if each in keypoints.names}
    twice |= {"left_eye", "right_eye"} if twice and pupils else set()
    assert len(set(keypoints.points)) == len(keypoints) - len(twice)
    # of a mesh of the face only the contours are drawn
    drawn = {number for edge in keypoints.edges for number in edge}
    alone = len(keypoints) - 134 if name == "face468" else len(pupils)
    assert len(drawn) == len(keypoints) - alone and not drawn & pupils
    assert all(first != second for first, second in keypoints.edges)
    assert "http" in keypoints.source


def test_markers_of_the_two_sides_differ_as_in_plug_in_gait() -> None:
    point = dict(zip(keypoint_set("plug_in_gait").names, keypoint_set("plug_in_gait").points, strict=True))
    thirds = {
        name: point[name].rpartition("_")[2] for name in point if name[1:] in ("UPA", "FRM", "THI", "TIB")
    }
    assert {name for name, third in thirds.items() if third == "upper"} == {"LUPA", "RFRM", "RTHI", "RTIB"}
    assert len(thirds) == 8


def test_an_unknown_set_or_keypoint_is_an_error_with_the_nearest_name() -> None:
    with pytest.raises(
        KeypointError, match=r"no keypoint set 'coco'; did you mean 'coco17'\? There are coco17, halpe26"
    ):
        keypoint_set("coco")
    with pytest.raises(KeypointError, match="coco17 has no keypoint 'left_eyes'; did you mean 'left_eye'"):
        keypoint_set("coco17").index("left_eyes")
    assert keypoint_set("coco17").index("left_eye") == 1


@pytest.mark.parametrize("keypoints", KEYPOINT_SETS.values(), ids=str)
def test_the_mirror_image_of_a_keypoint_is_that_of_the_other_side(keypoints: KeypointSet) -> None:
    order = np.array(keypoints.mirrored)
    np.testing.assert_array_equal(order[order], np.arange(len(keypoints)))
    for number, name in enumerate(keypoints.names):
        point = keypoints.points[number]
        if order[number] != number and name.startswith(("face-", "mesh-")):
            assert keypoints.points[order[number]] == re.sub(
                "left|right", lambda side: {"left": "right", "right": "left"}[side.group()], point
            )
        elif order[number] != number:
            sides = {name[:1].lower(), keypoints.names[order[number]][:1].lower()}
            assert sides == {"l", "r"} or {name, keypoints.names[order[number]]} == {
                "mouth_left",
                "mouth_right",
            }
        else:
            one_sided = point == "right_scapula" or keypoints.name.endswith("hand21")
            assert one_sided or not re.match("left_|right_|l_|r_", point)
