"""Hands at rest are relaxed: fingers half bent and closed, in the built-in humans and in the method.

Finger bones bend them to a fist and to a flat hand.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import trimesh
from assets.pack_makehuman import finger_shares
from conftest import ROOT
from scipy.spatial.transform import Rotation

from humansim_ros.files.reading.assets import built_in_names
from humansim_ros.motion.body.skeleton import FINGERS, Skeleton, finger_bones
from humansim_ros.motion.body.skinning import dominant_bones
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human
from humansim_ros.people.makehuman.skeleton import relax_hands, relaxed_fingers
from humansim_ros.types import Array


@pytest.mark.parametrize("name", built_in_names("humans"))
@pytest.mark.parametrize("side", ["l", "r"])
def test_the_fingers_of_each_built_in_human_are_half_bent(name: str, side: str) -> None:
    """In T pose with the palm down. Straight fingers would reach the end of the bone."""
    human = load_human(ROOT / "assets" / "humans" / f"{name}.npz")
    bone = human.skeleton.bone(f"{side}_wrist")
    wrist, length = (
        human.skeleton.heads[bone],
        np.ptp([human.skeleton.heads[bone], human.skeleton.tails[bone]], 0).max(),
    )
    out = (human.mesh.vertices - wrist) * [1.0 if side == "l" else -1.0, 1.0, 1.0] / length
    hand = out[out[:, 0] > 0.2]
    assert 0.65 < hand[:, 0].max() < 0.9
    tips = hand[hand[:, 0] > 0.6]
    assert -0.6 < tips[:, 1].min() < -0.2  # below the palm, and no fist


def straight_hand() -> tuple[dict[str, Array], dict[str, list[tuple[int, float]]], Array]:
    """Landmarks, weights and vertices of two hands: palms down, a vertex at each joint and each tip."""
    points: dict[str, Array] = {}
    weights: dict[str, list[tuple[int, float]]] = {}
    vertices = [np.zeros(3)]
    for side, out in (("l", 1.0), ("r", -1.0)):
        points[f"joint-{side}-hand"] = np.array([0.6 * out, 1.4, 0.0])
        for finger in range(1, 6):
            base = (
                np.array([0.70, 1.4, 0.04 - 0.02 * (finger - 2)])
                if finger > 1
                else np.array([0.63, 1.39, 0.05])
            )
            along = (
                np.array([0.03, 0, 0.004 * (3 - finger)]) if finger > 1 else np.array([0.02, -0.005, 0.02])
            )
            for joint in range(4):
                place = (base + joint * along) * [out, 1, 1]
                points[f"joint-{side}-finger-{finger}-{joint + 1}"] = place
                vertices.append(place)
                if joint:
                    weights[f"finger{finger}-{joint}.{side.upper()}"] = [(len(vertices) - 1, 1.0)]
    return points, weights, np.array(vertices)


def test_fingers_bend_to_the_palm_by_the_angles_of_a_hand_at_rest() -> None:
    points, weights, vertices = straight_hand()
    transforms, _ = relaxed_fingers(points)
    shares = finger_shares(weights, len(vertices))
    moved = relax_hands(shares, vertices, transforms)
    left, right = moved[1:21].reshape(5, 4, 3), moved[21:].reshape(5, 4, 3)
    np.testing.assert_allclose(right, left * [-1, 1, 1], atol=1e-9)
    before = vertices[1:21].reshape(5, 4, 3)
    np.testing.assert_allclose(left[:, 0], before[:, 0])  # the knuckles stay
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(left, axis=1), axis=2), np.linalg.norm(np.diff(before, axis=1), axis=2)
    )
    for finger in range(1, 5):
        steps = np.diff(left[finger], axis=0)
        drops = np.degrees(np.arcsin(-steps[:, 1] / np.linalg.norm(steps, axis=1)))
        assert 15 < drops[0] < 35
        assert (np.diff(drops) > 10).all()  # each joint bends further down
        assert 55 < drops[2] < 90
    assert (np.diff(left[1:, 3, 1]) < 0).all()  # the little finger is bent most
    # closed: fingertips are nearer to each other than the fingers were spread
    assert np.ptp(left[1:, 3, 2]) < np.ptp(before[1:, 3, 2])


def test_the_hinges_of_the_fingers_are_across_them_and_positive_angles_bend_them_to_the_palm() -> None:
    points, _, _ = straight_hand()
    transforms, hinges = relaxed_fingers(points)
    assert set(transforms) == set(hinges) == {*finger_bones("l"), *finger_bones("r")}
    for name, hinge in hinges.items():
        side, number, joint = name[0], FINGERS.index(name[2:-1]) + 1, int(name[-1])
        start, end = (points[f"joint-{side}-finger-{number}-{joint + step}"] for step in (0, 1))
        along = transforms[name][:3, :3] @ (end - start)
        assert abs(hinge @ along) < 1e-9
        bent = np.cross(hinge, along)  # the direction in which the bone turns
        # across the palm and to its side, of the thumb; down and back to the wrist, of the others
        assert bent[1] < 0 or bent @ np.array([1.0 if side == "l" else -1.0, 0, 0]) < 0


# fist and flat hand of the built-in humans


def flexion_at_rest(skeleton: Skeleton, bone: str) -> float:
    """Degrees by which a bone is bent at rest against the one above, about its x axis."""
    number = skeleton.bone(bone)
    across, along = skeleton.rest[number, :3, 0], skeleton.rest[number, :3, 1]
    above = skeleton.rest[skeleton.parents[number], :3, 1]
    return float(np.degrees(np.arctan2(np.cross(above, along) @ across, above @ along)))


#: Degrees of the three joints of each finger. The ball of the thumb is in the way of a bent index finger.
FLAT = dict.fromkeys(FINGERS[1:], (0.0, 0.0, 0.0))
FIST = {"index": (70, 80, 20), "middle": (80, 86, 20), "ring": (77, 85, 20), "pinky": (72, 80, 20)}


def hands(human: Human, angles: Mapping[str, tuple[float, float, float]]) -> tuple[Array, dict[str, Array]]:
    """Vertices, and positions of joints, with the joints of the fingers at these degrees."""
    skeleton = human.skeleton
    rotations = np.tile([0.0, 0, 0, 1], (len(skeleton), 1))
    for side in "lr":
        for bone in finger_bones(side)[3:]:
            degrees = angles[bone[2:-1]][int(bone[-1]) - 1] - flexion_at_rest(skeleton, bone)
            rotations[skeleton.bone(bone)] = Rotation.from_euler("x", degrees, degrees=True).as_quat()
    posed = skeleton.pose(rotations)
    joints = skeleton.joint_transforms(posed)[:, :3, 3]
    return human.pose(posed).astype(float), dict(zip(skeleton.joint_names, joints, strict=True))


@pytest.fixture(scope="module", params=built_in_names("humans"))
def human(request: pytest.FixtureRequest) -> Human:
    return load_human(ROOT / "assets" / "humans" / f"{request.param}.npz")


def closed(palm: trimesh.Trimesh) -> Array:
    """Triangles (N, 3, 3) of the palm with lids over the roots of the fingers and over the wrist."""
    first, counts = np.unique(palm.edges_sorted, axis=0, return_index=True, return_counts=True)[1:]
    border = palm.edges[first[counts == 1]]
    lids = []
    for loop in trimesh.graph.connected_components(border):
        edges = border[np.isin(border[:, 0], loop)]
        middle = np.tile(palm.vertices[loop].mean(axis=0), (len(edges), 1))
        lids.append(np.stack([palm.vertices[edges[:, 1]], palm.vertices[edges[:, 0]], middle], axis=1))
    return np.concatenate([palm.triangles, *lids])


def depths(palm: trimesh.Trimesh, points: Array) -> tuple[Array, Array]:
    """Distances (N,) of points from the surface of the palm, and depths (N,) below it, 0 outside."""
    count = len(palm.triangles)
    pairs = np.tile(palm.triangles, (len(points), 1, 1)), np.repeat(points, count, axis=0)
    near = trimesh.triangles.closest_point(*pairs).reshape(len(points), count, 3)
    distance = np.linalg.norm(near - points[:, None], axis=2).min(axis=1)
    # solid angles of the triangles: their sum is 4 pi inside [Van Oosterom 1983]
    corners = closed(palm)[None] - points[:, None, None]
    length = np.linalg.norm(corners, axis=3)
    a, b, c = np.moveaxis(corners, 2, 0)
    triple = np.einsum("nti,nti->nt", a, np.cross(b, c))
    below = length.prod(axis=2)
    for one, two, other in ((a, b, 2), (b, c, 0), (c, a, 1)):
        below += (one * two).sum(axis=2) * length[:, :, other]
    inside = np.arctan2(triple, below).sum(axis=1) > np.pi
    return distance, np.where(inside, distance, 0.0)


@pytest.mark.parametrize("side", ["l", "r"])
def test_a_fist_has_the_finger_tips_at_the_palm_and_not_in_it(human: Human, side: str) -> None:
    vertices, joints = hands(human, FIST)
    skeleton = human.skeleton
    own = human.mesh.triangles[human.triangle_parts == 1 + skeleton.bone(f"{side}_wrist")]
    palm = trimesh.Trimesh(vertices, own, process=False)
    scale = float(np.ptp(human.mesh.vertices[:, 1])) / 1.75
    tips = np.array([joints[f"{side}_{finger}3_end"] for finger in FINGERS[1:]])
    assert depths(palm, tips)[0].max() < 0.016 * scale
    outer = [skeleton.bone(bone) for bone in finger_bones(side)[3:] if bone[-1] != "1"]
    skin = np.flatnonzero(np.isin(dominant_bones(human.weights), outer))
    assert depths(palm, vertices[skin])[1].max() < 0.003


@pytest.mark.parametrize("side", ["l", "r"])
def test_a_flat_hand_is_flat(human: Human, side: str) -> None:
    _, joints = hands(human, FLAT)
    wrist, end = joints[f"{side}_wrist"], joints[f"{side}_wrist_end"]
    for finger in FINGERS[1:]:
        chain = np.array([joints[f"{side}_{finger}{joint}"] for joint in ("1", "2", "3", "3_end")])
        steps = np.diff(chain, axis=0) / np.linalg.norm(np.diff(chain, axis=0), axis=1, keepdims=True)
        assert (steps[:-1] * steps[1:]).sum(axis=1).min() > np.cos(np.radians(8))  # straight
        assert np.abs(steps[:, 1]).max() < np.sin(np.radians(8))  # level, as the palm
    # the straight middle finger ends where the hand does
    assert np.linalg.norm(joints[f"{side}_middle3_end"] - end) < 0.15 * np.linalg.norm(end - wrist)


def test_both_hands_close_in_the_same_way(human: Human) -> None:
    for angles in (FLAT, FIST):
        _, joints = hands(human, angles)
        for bone in finger_bones("l"):
            mirrored = joints[bone.replace("l_", "r_", 1)] * [-1, 1, 1]
            np.testing.assert_allclose(joints[bone], mirrored, atol=2e-4)
