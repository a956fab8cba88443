"""Keypoints lie where anatomy says, on the built-in humans."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from humansim_ros import Human, load_human
from humansim_ros.cli.human import built_in_humans
from humansim_ros.motion.body.skeleton import finger_bones, hanim_skeleton
from humansim_ros.motion.body.skinning import without_details
from humansim_ros.people import KEYPOINT_SETS, KeypointLocator, keypoint_set
from humansim_ros.types import Array

PEOPLE = built_in_humans()
#: Heights from the soles to the crown, from below, by set; where a set has both sides, of the left one.
HEIGHTS = {
    "coco17": "left_ankle left_knee left_hip left_shoulder nose left_eye",
    "halpe26": "left_big_toe left_heel left_ankle left_knee hip neck nose left_eye head",
    "body25": "LBigToe LHeel LAnkle LKnee MidHip Neck Nose LEye",
    "h36m17": "LFoot LKnee Hip Spine Thorax Neck/Nose Head",
    "panoptic19": "lAnkle lKnee BodyCenter Neck Nose lEye",
    "smpl24": "left_foot left_ankle left_knee left_hip pelvis spine1 spine2 spine3 left_shoulder neck head",
    "mediapipe33": "left_foot_index left_heel left_ankle left_knee left_hip left_shoulder nose left_eye",
    "face68": "face-8 face-57 face-54 face-51 face-33 face-30 face-28 face-45 face-44 face-24",
    "face70": "face-8 face-57 face-54 face-51 face-33 face-30 face-69 face-44 face-24",
    "face468": "mesh-152 mesh-17 mesh-14 mesh-0 mesh-2 mesh-4 mesh-197 mesh-263 mesh-9 mesh-10",
    "wholebody133": "left_ankle left_knee left_hip left_shoulder face-8 face-66 face-62 face-30 face-42",
    "halpe136": "left_big_toe left_ankle left_knee neck face-8 face-57 nose face-27 face-22 head",
    "openpose137": "LHeel LAnkle LKnee MidHip Neck face-8 face-57 Nose face-69 face-24",
    # palms face down, the little finger is the lowest of the bent fingers
    "left_hand21": "left_pinky_finger4 left_pinky_finger2 left_pinky_finger1",
    "right_hand21": "right_pinky_finger4 right_pinky_finger2 right_pinky_finger1",
    "plug_in_gait": "LTOE LANK LTIB LKNE LTHI LASI T10 STRN CLAV C7 LFHD",
}


@cache
def person(body: str) -> Human:
    return load_human(body)


@cache
def skin_of(body: str) -> trimesh.Trimesh:
    mesh = person(body).mesh
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)


def rest_joints(human: Human) -> Array:
    """Joints (J, 3) of a human at rest."""
    return np.asarray(human.skeleton.joint_transforms(human.skeleton.rest)[:, :3, 3])


def located(human: Human, name: str) -> dict[str, Array]:
    """Keypoints (3,) of a set by name on a human at rest: y up, facing +z, +x is the person's left."""
    keypoints = keypoint_set(name)
    positions = KeypointLocator.of(human, keypoints).positions(rest_joints(human), human.mesh.vertices)
    return dict(zip(keypoints.names, positions, strict=True))


@pytest.mark.parametrize("body", PEOPLE)
def test_faces_have_their_parts_in_the_right_places(body: str) -> None:
    at = located(person(body), "mediapipe33")
    # from the ears at the back to the nose in front
    assert at["nose"][2] > at["mouth_left"][2] > at["left_eye_inner"][2] > at["left_ear"][2] + 0.04
    assert at["left_eye"][1] > at["nose"][1] + 0.015
    assert at["mouth_left"][1] < at["nose"][1] - 0.015
    assert abs(at["nose"][0]) < 0.002
    assert at["left_eye_outer"][0] > at["left_eye"][0] > at["left_eye_inner"][0] > at["right_eye_inner"][0]
    assert 0.045 < at["left_eye"][0] - at["right_eye"][0] < 0.075  # distance of the pupils of people
    # hair covers the ears of the adult woman
    assert 0.12 < at["left_ear"][0] - at["right_ear"][0] < (0.18 if body == "adult_woman" else 0.16)


@pytest.mark.parametrize("body", PEOPLE)
def test_hands_and_feet_have_their_parts_in_the_right_places(body: str) -> None:
    human = person(body)
    at, foot = located(human, "mediapipe33"), located(human, "halpe26")
    # in the T pose palms face down: the thumb is in front, the little finger behind
    assert at["left_thumb"][2] > at["left_index"][2] > at["left_pinky"][2] + 0.04
    assert at["left_index"][0] > at["left_thumb"][0] > at["left_wrist"][0]
    marks = located(human, "plug_in_gait")
    assert marks["LWRA"][2] > at["left_wrist"][2] + 0.01 > at["left_wrist"][2] - 0.01 > marks["LWRB"][2]
    # the big toe is in the middle and in front, the heel behind the ankle
    assert foot["left_big_toe"][0] < foot["left_ankle"][0] < foot["left_small_toe"][0]
    assert foot["left_big_toe"][2] > foot["left_small_toe"][2] > marks["LTOE"][2] > foot["left_ankle"][2]
    assert foot["left_heel"][2] < foot["left_ankle"][2] - 0.025
    skin = human.mesh.vertices
    assert foot["left_big_toe"][2] > skin[skin[:, 1] < 0.06][:, 2].max() - 0.012
    length = foot["left_big_toe"][2] - foot["left_heel"][2]
    assert 0.135 < length / np.ptp(skin[:, 1]) < 0.17  # feet are 15 % of the height


@pytest.mark.parametrize("body", PEOPLE)
def test_landmarks_of_the_face_are_where_people_mark_them(body: str) -> None:
    at = {int(name[5:]): point for name, point in located(person(body), "face68").items()}
    x, y, z = (np.array([at[number][axis] for number in range(68)]) for axis in range(3))
    # a jaw goes from the right ear over the chin to the left ear, without turning back
    assert (np.diff(x[:17]) > 0).all()
    assert (np.diff(y[:9]) < 0.001).all()
    assert (np.diff(z[:9]) > -0.004).all()
    gaps = np.linalg.norm(np.diff([at[number] for number in range(17)], axis=0), axis=1)
    assert gaps.max() < 2.5 * gaps.min()
    # lids above and below a line between the corners of an eye, brows above them
    for corners, upper, lower, brow in (
        ((36, 39), (37, 38), (40, 41), 19),
        ((42, 45), (43, 44), (46, 47), 24),
    ):
        line = y[list(corners)].mean()
        assert y[list(upper)].min() > line > y[list(lower)].max()
        assert y[brow] > y[list(upper)].max() + 0.01
    # outer lips around the inner ones, which meet in a closed mouth
    assert y[51] > y[62] >= y[66] > y[57]
    assert x[48] < x[60] < x[62] < x[64] < x[54]
    assert np.linalg.norm(at[62] - at[66]) < 0.005
    # eyes of people are 20 to 35 mm wide, mouths 40 to 60 mm, noses 20 to 45 mm [Farkas 1994]
    scale = float(np.ptp(person(body).mesh.vertices[:, 1])) / 1.75
    assert 0.020 < x[45] - x[42] < 0.036
    assert 0.034 < (x[54] - x[48]) / scale**0.5 < 0.062
    assert 0.020 < (x[35] - x[31]) / scale**0.5 < 0.046


@pytest.mark.parametrize("body", PEOPLE)
def test_the_face_mesh_covers_the_face_between_its_landmarks(body: str) -> None:
    mesh, marks = (np.array(list(located(person(body), name).values())) for name in ("face468", "face68"))
    unit = np.linalg.norm(marks[45] - marks[36])
    # the outline of the mesh is around all other points, seen from the front
    oval = [10, 297, 284, 389, 454, 361, 397, 379, 400, 152, 176, 150, 172, 132, 234, 162, 54, 67]
    assert np.linalg.norm(mesh[[98, 327]] - marks[[31, 35]], axis=1).max() < 0.12 * unit
    assert np.linalg.norm(mesh[[105, 334]] - marks[[19, 24]], axis=1).max() < 0.15 * unit
    assert np.linalg.norm(mesh[4] - marks[30]) < 0.1 * unit
    angles = np.unwrap(np.arctan2(*(mesh[oval] - mesh[168])[:, [0, 1]].T))
    assert (np.diff(angles) > 0).all() and np.ptp(angles) > 1.7 * np.pi
    assert np.abs(mesh[:, 0]).max() < np.abs(mesh[oval, 0]).max() + 0.1 * unit
    # upper and lower lip move apart
    human = person(body)
    assert human.shapes is not None
    locator = KeypointLocator.of(human, keypoint_set("face468"))
    posed = human.pose(human.skeleton.rest, {"jawOpen": 0.6})
    moved = locator.positions(rest_joints(human), posed) - mesh
    upper, lower = [82, 13, 312, 81, 80, 38, 268], [87, 14, 317, 178, 88, 86, 316]
    assert (moved[upper, 1] > -0.004).all() and (moved[lower, 1] < -0.008).all()


@pytest.mark.parametrize("body", PEOPLE)
@pytest.mark.parametrize("side", ["left", "right"])
def test_points_of_a_hand_follow_its_fingers(side: str, body: str) -> None:
    at = np.array(list(located(person(body), f"{side}_hand21").values()))
    lengths = np.linalg.norm(np.diff(at.reshape(-1, 3)[1:].reshape(5, 4, 3), axis=1), axis=-1)
    assert (lengths > 0.010).all()
    assert (lengths < 0.065).all()
    assert lengths[1:].sum(axis=1).argmax() == 1  # the middle finger is the longest
    # fingers point away from the wrist, side by side from the index finger in front
    out = 1 if side == "left" else -1
    assert (out * (at[[5, 9, 13, 17], 0] - at[0, 0]) > 0.04).all()
    assert (np.diff(at[[5, 9, 13, 17], 2]) < 0).all()


def test_a_body_without_fingers_has_no_keypoints_of_fingers() -> None:
    """They are NaN and not certain, and its wrists and face are there."""
    human = person("adult_man")
    skeleton = hanim_skeleton()
    weights = without_details(human.weights, human.skeleton)[:, : len(skeleton)]
    bare = replace(human, skeleton=skeleton, weights=weights)
    keypoints = keypoint_set("wholebody133")
    locator = KeypointLocator.of(bare, keypoints)
    positions = locator.positions(rest_joints(bare), bare.mesh.vertices)
    fingers = [*range(92, 112), *range(113, 133)]
    assert np.isnan(positions[fingers]).all()
    assert not locator.certain[fingers].any()
    others = np.delete(np.arange(133), fingers)
    assert np.isfinite(positions[others]).all()
    assert locator.certain[others].all()


@pytest.mark.parametrize("body", PEOPLE)
def test_markers_of_the_trunk_are_in_front_or_behind(body: str) -> None:
    at = located(person(body), "plug_in_gait")
    hips = located(person(body), "h36m17")
    for front, back in (("CLAV", "C7"), ("STRN", "T10"), ("LASI", "LPSI"), ("LFHD", "LBHD")):
        assert at[front][2] > at[back][2] + 0.08, (front, back)
    assert at["RBAK"][0] < -0.04
    assert at["RBAK"][2] < at["C7"][2] + 0.05
    # the hip joint is below, behind and (nearly) beside the front of the pelvis [Bell 1990]
    height = np.ptp(person(body).mesh.vertices[:, 1])
    assert 0.03 < (at["LASI"][1] - hips["LHip"][1]) / height < 0.07
    assert at["LASI"][2] > hips["LHip"][2] + 0.03
    for marker, joint in (("LKNE", "LKnee"), ("LANK", "LFoot"), ("LELB", "LElbow")):
        assert np.linalg.norm(at[marker] - hips[joint]) < 0.1 * height / 1.7


@pytest.mark.parametrize("body", PEOPLE)
@pytest.mark.parametrize("name", KEYPOINT_SETS)
def test_heights_are_in_the_order_of_the_body(name: str, body: str) -> None:
    at = located(person(body), name)
    order = HEIGHTS[name].split()
    heights = [float(at[keypoint][1]) for keypoint in order]
    assert heights == sorted(heights), dict(zip(order, heights, strict=True))
    stature = float(np.ptp(person(body).mesh.vertices[:, 1]))
    assert heights[0] >= 0
    assert heights[-1] <= stature + 1e-6


@pytest.mark.daily("smpl24-tall_heavy_man", "halpe26-adult_woman")
@pytest.mark.parametrize("body", PEOPLE)
@pytest.mark.parametrize("name", KEYPOINT_SETS)
def test_points_of_the_skin_are_on_it_and_joints_inside(name: str, body: str) -> None:
    human, keypoints = person(body), keypoint_set(name)
    locator = KeypointLocator.of(human, keypoints)
    positions = locator.positions(rest_joints(human), human.mesh.vertices)
    surface = skin_of(body)
    on_skin = positions[locator.on_surface]
    if len(on_skin):
        triangles = surface.triangles_center
        nearest = cKDTree(triangles).query(on_skin, k=40)[1]  # triangles of lips are small
        planes = np.einsum(
            "nkj,nkj->nk", on_skin[:, None] - surface.triangles[nearest, 0], surface.face_normals[nearest]
        )
        assert np.abs(planes).min(axis=1).max() < 1e-6
        assert np.linalg.norm(triangles[nearest[:, 0]] - on_skin, axis=1).max() < 0.02
    # the ends of the skeleton may be on the skin
    ends = np.array([point.endswith("_end") for point in keypoints.points])
    inner = positions[~locator.on_surface & ~ends]
    assert surface.contains(inner).all()
    depth = cKDTree(human.mesh.vertices).query(inner)[0]
    # fingers are 1.3 cm thick
    least = 0.0015 if keypoints.parts.keys() & {"left_hand", "right_hand"} else 0.003
    assert depth.min(initial=1) > least * np.ptp(human.mesh.vertices[:, 1])
    assert locator.certain.all()


@pytest.mark.parametrize("body", PEOPLE)
@pytest.mark.parametrize("name", KEYPOINT_SETS)
def test_left_is_the_mirror_image_of_right(name: str, body: str) -> None:
    human, keypoints = person(body), keypoint_set(name)
    at = dict(zip(keypoints.points, located(human, name).values(), strict=True))
    pairs = [(point, _other_side(point)) for point in at if point.startswith(("left_", "l_"))]
    pairs = [(left, right) for left, right in pairs if right in at]
    assert len(pairs) > 5 or name.endswith("hand21")
    for left, right in pairs:
        assert at[left][0] > 0.001, left
        np.testing.assert_allclose(at[left] * [-1, 1, 1], at[right], atol=0.003, err_msg=left)


def _other_side(point: str) -> str:
    return point.replace("left_", "right_", 1) if point.startswith("left_") else f"r_{point[2:]}"


def test_keypoints_follow_the_body_in_any_pose() -> None:
    """A turned and moved body has turned and moved keypoints, and skinned ones are on the posed skin."""
    human, keypoints = person("adult_man"), keypoint_set("plug_in_gait")
    locator = KeypointLocator.of(human, keypoints)
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(human.skeleton), 1))
    rotations[human.skeleton.bone("l_elbow")] = [0.0, 0.0, np.sin(0.6), np.cos(0.6)]
    posed = human.skeleton.pose(rotations)
    joints, vertices = human.skeleton.joint_transforms(posed)[:, :3, 3], human.pose(posed)
    bent, straight = (
        locator.positions(joints, vertices),
        locator.positions(rest_joints(human), human.mesh.vertices),
    )
    moved = np.linalg.norm(bent - straight, axis=1)
    arm = [keypoints.index(name) for name in ("LFRM", "LWRA", "LWRB", "LFIN")]
    assert (moved[arm] > 0.05).all()
    others = [number for number in range(len(keypoints)) if number not in (*arm, keypoints.index("LELB"))]
    assert moved[others].max() < 1e-6
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(
        locator.positions(joints @ turn.T + 2, vertices @ turn.T + 2), bent @ turn.T + 2, atol=1e-6
    )


def test_a_locator_is_made_once_for_a_human_and_forgotten_with_it() -> None:
    human, keypoints = replace(load_human("child")), keypoint_set("coco17")
    locator = KeypointLocator.of(human, keypoints)
    assert KeypointLocator.of(human, keypoints) is locator
    key = id(human), keypoints.name
    assert key in KeypointLocator._known
    del human
    assert key not in KeypointLocator._known


def test_skin_between_joints_is_that_of_the_body_parts_between_them() -> None:
    human = person("adult_man")
    parts = {name: number + 1 for number, name in enumerate(human.skeleton.names)}

    def skin(name: str, keypoint: str) -> set[str]:
        keypoints = keypoint_set(name)
        row = KeypointLocator.of(human, keypoints).surfaces[keypoints.index(keypoint)]
        return {part for part, label in parts.items() if row[label]}

    # the chest is in front of the middle of the shoulders, the belly in front of the middle of the hips
    assert {"vl5", "l_shoulder", "r_shoulder"} <= skin("body25", "Neck")
    assert {"HumanoidRoot", "sacroiliac", "l_hip", "r_hip"} <= skin("body25", "MidHip")
    assert skin("coco17", "left_wrist") == {"l_elbow", "l_wrist", *finger_bones("l")}
    assert skin("left_hand21", "left_forefinger2") == {"l_index1", "l_index2"}
    assert skin("coco17", "nose") == {"vt3"}
    assert not {"l_knee", "l_elbow", "vt3"} & skin("body25", "MidHip")
