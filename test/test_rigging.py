"""The thesis rigging rule against the rule written out slowly, and against an artist's weights."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from scipy.sparse import csr_matrix

from humansim_ros.body import Human, Mesh, Skeleton, fit_to_skeleton, hanim_skeleton, read_mesh, rig, skin
from humansim_ros.body.rigging import RigRule, dominant_bones, triangle_parts
from humansim_ros.errors import MeshError
from humansim_ros.motion import read_bvh
from humansim_ros.motion.joint_names import find_match
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.motion.world import WorldMotion, understand
from humansim_ros.rotations import Array

SKELETON = hanim_skeleton()
BOTH = pytest.mark.parametrize("rule", ["thesis", "thesis-printed"])


def cloud(vertices: Array) -> Mesh:
    return Mesh(np.asarray(vertices, dtype=float), np.array([[0, 1, 2, -1]], dtype=np.int32))


def person_like(seed: int, count: int = 150) -> Array:
    """Points about the bones, a hand's breadth around."""
    rng = np.random.default_rng(seed)
    bone = rng.integers(0, len(SKELETON), count)
    along = rng.uniform(-0.2, 1.2, (count, 1))
    return SKELETON.heads[bone] * (1 - along) + SKELETON.tails[bone] * along + rng.normal(0, 0.06, (count, 3))


def degrees_between(a: Array, b: Array) -> float:
    """The angle of two vectors, from the sides of their triangle (Kahan)."""
    x, y = a / math.sqrt(a @ a), b / math.sqrt(b @ b)
    return math.degrees(2 * math.atan2(math.dist(x, y), math.dist(x, -y)))


def slowly(vertex: Array, rule: RigRule) -> dict[str, float]:
    """Chapter 5, one vertex at a time: {bone: weight}."""
    largest, best = -1.0, ""
    for name, head, tail in zip(SKELETON.names, SKELETON.heads, SKELETON.tails, strict=True):
        left = name.startswith("l_") or "_l_" in name
        right = name.startswith("r_") or "_r_" in name
        if (left and vertex[0] < 0) or (right and vertex[0] > 0):
            continue
        angle = degrees_between(head - vertex, tail - vertex)
        if angle > largest:
            largest, best = angle, name
    bone = SKELETON.names.index(best)
    beside = degrees_between(vertex - SKELETON.heads[bone], SKELETON.tails[bone] - SKELETON.heads[bone])
    weight = min(1.0, beside / 60) if rule == "thesis-printed" else 1.0 if beside <= 60 else 60 / beside
    if SKELETON.parents[bone] < 0 or weight == 1:
        return {best: 1.0}
    return {best: weight, SKELETON.names[SKELETON.parents[bone]]: 1 - weight}


@BOTH
def test_weights_are_those_of_the_rule(rule: RigRule) -> None:
    vertices = person_like(0)
    weights = rig(cloud(vertices), SKELETON, rule)
    shared = 0
    for vertex, row in zip(vertices, weights.toarray(), strict=True):
        expected = slowly(vertex, rule)
        ours = {SKELETON.names[b]: row[b] for b in np.flatnonzero(row)}
        assert ours == pytest.approx(expected, abs=1e-6)
        shared += len(expected) == 2
    assert shared > 10


@BOTH
def test_weights_of_a_real_body_are_those_of_the_rule(shared_data: Path, rule: RigRule) -> None:
    mesh = fit_to_skeleton(read_mesh(shared_data / "mesh" / "mh2007_male_T_dm.obj"), SKELETON)
    weights = rig(mesh, SKELETON, rule)
    for vertex in range(0, len(mesh.vertices), 97):
        row = weights[vertex].toarray()[0]
        ours = {SKELETON.names[b]: row[b] for b in np.flatnonzero(row)}
        assert ours == pytest.approx(slowly(mesh.vertices[vertex], rule), abs=1e-6)


@BOTH
def test_weights_sum_to_one_over_at_most_two_bones(rule: RigRule) -> None:
    weights = rig(cloud(person_like(1, 3000)), SKELETON, rule)
    np.testing.assert_allclose(np.asarray(weights.sum(1)).ravel(), 1, atol=1e-12)
    assert weights.min() >= 0
    assert np.diff(weights.indptr).max() == 2


def test_sides_are_never_mixed() -> None:
    vertices = person_like(2, 3000)
    weights = rig(cloud(vertices), SKELETON, "thesis").toarray()
    for side, other in ((vertices[:, 0] > 0, "r"), (vertices[:, 0] < 0, "l")):
        bones = [b for b, n in enumerate(SKELETON.names) if n.startswith(f"{other}_") or f"_{other}_" in n]
        np.testing.assert_array_equal(weights[side][:, bones], 0)


def test_finger_tips_follow_the_hand_by_the_text_and_the_forearm_by_the_print() -> None:
    """The disagreement of the thesis with itself that the default decides for the text."""
    wrist = SKELETON.bone("l_wrist")
    tip = SKELETON.tails[wrist] + [-0.01, 0.008, 0]
    vertices = np.array([tip, tip, tip])
    text = rig(cloud(vertices), SKELETON, "thesis").toarray()[0]
    printed = rig(cloud(vertices), SKELETON, "thesis-printed").toarray()[0]
    assert text[wrist] == 1
    assert printed[SKELETON.bone("l_elbow")] > 0.95


def test_a_skeleton_without_a_side_is_refused() -> None:
    left = [b for b, n in enumerate(SKELETON.names) if n == "l_hip"]
    one_leg = Skeleton(
        ("l_hip",), np.array([-1]), SKELETON.heads[left], SKELETON.tails[left], SKELETON.rolls[left]
    )
    with pytest.raises(MeshError, match="no bone on one side"):
        rig(cloud(-np.eye(3)), one_leg, "thesis")


def test_a_part_is_the_bone_that_its_corners_follow_most() -> None:
    weights = csr_matrix([[0.9, 0.1, 0], [0, 0.6, 0.4], [0, 0.6, 0.4], [0.4, 0, 0.6]])
    assert dominant_bones(weights).tolist() == [0, 1, 1, 2]
    assert triangle_parts(np.array([[0, 1, 2], [0, 1, 3], [3, 3, 3]]), weights).tolist() == [1, 0, 2]


def walking_error(rule: RigRule) -> Array:
    """Metres between each vertex of the man skinned by a rule and by the artist, (frames, V)."""
    man = Human.load(ROOT / "assets" / "humans" / "adult_man.npz")
    motion = read_bvh(ROOT / "assets" / "motions" / "walk.bvh")
    match = find_match(motion.joint_names)
    world = WorldMotion(motion, match, understand(motion, match), loop="none")
    rotations, root = Retargeter.fit(world, man.skeleton).apply(world.sample(np.linspace(0, 1.9, 5)))
    transforms = man.skeleton.pose(rotations, root) @ man.skeleton.rest_inverse
    ours = skin(man.mesh.vertices, rig(man.mesh, man.skeleton, rule), transforms)
    return np.linalg.norm(ours - skin(man.mesh.vertices, man.weights, transforms), axis=-1)


def test_a_walking_man_is_within_millimetres_of_the_artists() -> None:
    assert walking_error("thesis").mean() < 0.005


def test_the_printed_rule_is_farther_off() -> None:
    assert walking_error("thesis-printed").mean() > 2 * walking_error("thesis").mean()
