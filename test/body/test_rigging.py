"""The rigging rule of the thesis against a plain loop; heat weights against weights by artists."""

from __future__ import annotations

import math
import re
from functools import cache

import numpy as np
import pytest
from conftest import ROOT, if_shared
from mesh_files import mesh_path
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.load import read_mesh
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.motion import Skeleton, hanim_skeleton, read_bvh, skin
from humansim_ros.motion.body.skeleton import side_of
from humansim_ros.motion.body.skinning import dominant_bones, triangle_parts, without_details
from humansim_ros.motion.matching.by_name import match_names
from humansim_ros.motion.matching.file_frame import detect_file_frame
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import WorldMotion
from humansim_ros.people import fit_skeleton, fit_to_skeleton, rig
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human
from humansim_ros.people.rigging import heat_weights as heat
from humansim_ros.people.rigging.fitting import RigRule
from humansim_ros.types import Array

SKELETON = hanim_skeleton()
BOTH = pytest.mark.parametrize("rule", ["thesis", "thesis-printed"])


def cloud(vertices: Array) -> Mesh:
    return Mesh(np.asarray(vertices, dtype=float), np.array([[0, 1, 2, -1]], dtype=np.int32))


def person_like(seed: int, count: int = 150) -> Array:
    """Random points near the bones."""
    rng = np.random.default_rng(seed)
    bone = rng.integers(0, len(SKELETON), count)
    along = rng.uniform(-0.2, 1.2, (count, 1))
    return SKELETON.heads[bone] * (1 - along) + SKELETON.tails[bone] * along + rng.normal(0, 0.06, (count, 3))


def degrees_between(a: Array, b: Array) -> float:
    """Angle of two vectors from the sides of their triangle (Kahan's formula)."""
    x, y = a / math.sqrt(a @ a), b / math.sqrt(b @ b)
    return math.degrees(2 * math.atan2(math.dist(x, y), math.dist(x, -y)))


def slowly(vertex: Array, rule: RigRule) -> dict[str, float]:
    """[thesis §5] for one vertex: {bone: weight}."""
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


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("name", ["own_male_T_dm.obj", *if_shared("mh2007_male_T_dm.obj")])
def test_weights_of_a_body_are_those_of_the_rule(name: str, rule: RigRule) -> None:
    mesh = fit_to_skeleton(read_mesh(mesh_path(name)), SKELETON)
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


def test_finger_tips_follow_the_hand_in_the_text_and_the_forearm_in_the_pseudo_code() -> None:
    """Text and pseudo-code of the thesis contradict each other; the default follows the text."""
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


def test_a_part_is_the_bone_with_the_largest_weight_at_the_corners() -> None:
    weights = csr_matrix([[0.9, 0.1, 0], [0, 0.6, 0.4], [0, 0.6, 0.4], [0.4, 0, 0.6]])
    assert dominant_bones(weights).tolist() == [0, 1, 1, 2]
    assert triangle_parts(np.array([[0, 1, 2], [0, 1, 3], [3, 3, 3]]), weights).tolist() == [1, 0, 2]


def test_the_heaviest_bones_of_large_meshes_are_those_of_scipy() -> None:
    rng = np.random.default_rng(4)
    # few different weights, so that many rows have two largest ones; more rows than a block
    weights = csr_matrix(rng.integers(0, 3, (40_000, 5)) / 2)
    assert np.array_equal(dominant_bones(weights), np.asarray(weights.argmax(axis=1)).ravel())


def walking_error(rule: RigRule) -> Array:
    """Distances (frames, V) in metres between vertices with weights of a rule and of the artists."""
    man = load_human(ROOT / "assets" / "humans" / "adult_man.npz")
    motion = read_bvh(ROOT / "assets" / "motions" / "walk.bvh")
    match = match_names(motion.joint_names)
    world = WorldMotion(motion, match, detect_file_frame(motion, match), loop="none")
    rotations, root = Retargeter.fit(world, man.skeleton).apply(world.sample(np.linspace(0, 1.9, 5)))
    transforms = man.skeleton.pose(rotations, root) @ man.skeleton.rest_inverse
    ours = skin(man.mesh.vertices, rig(man.mesh, man.skeleton, rule), transforms)
    return np.linalg.norm(ours - skin(man.mesh.vertices, man.weights, transforms), axis=-1)


def test_a_walking_man_is_within_millimetres_of_the_artists() -> None:
    assert walking_error("thesis").mean() < 0.005


def test_the_printed_rule_is_less_accurate() -> None:
    assert walking_error("thesis-printed").mean() > 2 * walking_error("thesis").mean()


# --- heat


PEOPLE = tuple(sorted(path.stem for path in (ROOT / "assets" / "humans").glob("*.npz")))


@cache
def person(name: str) -> Human:
    return load_human(ROOT / "assets" / "humans" / f"{name}.npz")


@cache
def heated(name: str) -> csr_matrix:
    return rig(person(name).mesh, person(name).skeleton)


def bones(skeleton: Skeleton, *joints: str) -> list[int]:
    return [b for b, name in enumerate(skeleton.names) if name.endswith(joints) and "_to_" not in name]


@pytest.mark.daily("child", "slim_old_woman")
@pytest.mark.slow
@pytest.mark.parametrize("name", PEOPLE)
def test_heat_gives_at_most_four_bones_that_sum_to_one(name: str) -> None:
    weights = heated(name)
    np.testing.assert_allclose(np.asarray(weights.sum(1)).ravel(), 1, atol=1e-12)
    assert weights.min() >= 0
    assert np.diff(weights.indptr).max() <= 4


@pytest.mark.daily("child", "slim_old_woman")
@pytest.mark.slow
@pytest.mark.parametrize("name", PEOPLE)
def test_heat_does_not_leak(name: str) -> None:
    """Not from an arm to the trunk, between the legs, or from limbs to the head."""
    human, weights = person(name), heated(name).toarray()
    artist, skeleton = human.weights.toarray(), human.skeleton
    arms = bones(skeleton, "_shoulder", "_elbow", "_wrist")
    trunk = artist[:, bones(skeleton, "Root", "sacroiliac", "vl5")].sum(1) > 0.99
    assert weights[trunk][:, arms].mean() * len(arms) < 0.01
    for own, other in (("l", "r"), ("r", "l")):
        leg, others = (bones(skeleton, f"{s}_hip", f"{s}_knee", f"{s}_ankle") for s in (own, other))
        on_leg = artist[:, leg].sum(1) > 0.99
        assert weights[on_leg][:, others].sum(1).max() < 0.35
        assert weights[on_leg][:, others].sum(1).mean() < 0.001
        # no weight well across the middle
        side = 1 if own == "l" else -1
        far = human.mesh.vertices[:, 0] * side < -0.06
        right = [b for b, n in enumerate(skeleton.names) if n.startswith(f"{own}_")]
        np.testing.assert_array_equal(weights[far][:, right], 0)
    head = artist[:, skeleton.bone("vt3")] > 0.99
    limbs = bones(skeleton, "_shoulder", "_elbow", "_wrist", "_hip", "_knee", "_ankle")
    np.testing.assert_array_equal(weights[head][:, limbs], 0)


@pytest.mark.daily("child", "slim_old_woman")
@pytest.mark.slow
@pytest.mark.parametrize("name", PEOPLE)
def test_heat_is_nearer_to_the_artists_than_the_thesis(name: str) -> None:
    human = person(name)
    theirs = without_details(human.weights, human.skeleton)
    off = [
        float(np.abs(rig(human.mesh, human.skeleton, rule) - theirs).sum()) / len(human.mesh.vertices) / 2
        for rule in ("heat", "thesis")
    ]
    assert off[0] < 0.12
    assert off[0] < 0.75 * off[1]


def test_heat_walks_nearer_to_the_artists_than_the_thesis() -> None:
    heat, thesis = walking_error("heat"), walking_error("thesis")
    assert heat.mean() < 0.65 * thesis.mean()
    assert heat.max() < 0.6 * thesis.max()


def test_heat_is_smooth() -> None:
    """Skin tears where weights jump along an edge."""
    human = person("adult_woman")
    edges = human.mesh.triangles[:, :2]
    jump = [
        np.abs((w[edges[:, 0]] - w[edges[:, 1]]).toarray()).sum(1)
        for w in (heated(human.name), thesis_of(human))
    ]
    assert np.quantile(jump[0], 0.999) < 0.8
    assert np.quantile(jump[0], 0.999) < 0.6 * np.quantile(jump[1], 0.999)


def thesis_of(human: Human) -> csr_matrix:
    return rig(human.mesh, human.skeleton, "thesis")


def mirrored_name(bone: str) -> str:
    """Name of the bone of the other side."""
    return re.sub(
        r"(^|_)([lr])_", lambda found: f"{found[1]}{'r' if found[2] == 'l' else 'l'}_", bone, count=1
    )


def test_heat_mirrors_with_the_body() -> None:
    human = person("child")
    skeleton, vertices = human.skeleton, human.mesh.vertices
    away, mirrored = cKDTree(vertices).query(vertices * [-1, 1, 1])
    other = [skeleton.bone(mirrored_name(n)) if side_of(n) else b for b, n in enumerate(skeleton.names)]
    weights = heated("child").toarray()
    unlike = np.abs(weights - weights[mirrored][:, other]).sum(1)[away < 1e-4]
    assert unlike.mean() < 0.005


def changed(human: Human, kind: str) -> Mesh:
    """The same surface with the defects that exporters produce."""
    mesh = human.mesh
    triangles, count = mesh.triangles, len(mesh.vertices)
    rest = np.full((len(triangles), 1), -1, np.int32)
    plain = np.hstack([triangles, rest]).astype(np.int32)
    if kind == "torn into triangles":
        alone = np.hstack([np.arange(triangles.size).reshape(-1, 3), rest]).astype(np.int32)
        return Mesh(mesh.vertices[triangles].reshape(-1, 3), alone)
    if kind == "turned inside out":
        return Mesh(mesh.vertices, np.hstack([triangles[:, ::-1], rest]).astype(np.int32))
    if kind == "open":
        return Mesh(mesh.vertices, plain[np.random.default_rng(0).random(len(plain)) > 0.05])
    if kind == "with faces of no area":
        flat = np.array([[0, 0, 5, -1], [7, 7, 7, -1], [1, 2, 1, -1]], dtype=np.int32)
        return Mesh(mesh.vertices, np.vstack([plain, flat]))
    if kind == "non-manifold":
        return Mesh(mesh.vertices, np.vstack([plain, plain[:500], plain[200:300, [1, 0, 2, 3]]]))
    # a button on the chest, a vertex that no face uses
    assert kind == "with pieces"
    button = np.array([[0.02, 1.25, 0.2], [0.03, 1.25, 0.2], [0.02, 1.26, 0.2], [0.0, 1.0, 3.0]])
    return Mesh(
        np.vstack([mesh.vertices, button]),
        np.vstack([plain, [[count, count + 1, count + 2, -1]]]).astype(np.int32),
    )


@pytest.mark.daily("with faces of no area")
@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "torn into triangles",
        "turned inside out",
        "open",
        "with faces of no area",
        "non-manifold",
        "with pieces",
    ],
)
@pytest.mark.filterwarnings("error")
def test_heat_accepts_defective_meshes(kind: str) -> None:
    human = person("adult_man")
    mesh = changed(human, kind)
    weights = rig(mesh, human.skeleton, "heat")
    np.testing.assert_allclose(np.asarray(weights.sum(1)).ravel(), 1, atol=1e-12)
    expected = heated("adult_man")
    own = weights[: len(human.mesh.vertices)]
    if kind == "torn into triangles":
        expected, own = expected[human.mesh.triangles.ravel()], weights
    off = np.asarray(np.abs(own - expected).sum(1)).ravel() / 2
    assert np.quantile(off, 0.95) < (0.15 if kind == "open" else 0.05)
    if kind == "with pieces":
        button = weights[len(human.mesh.vertices) :].toarray()
        np.testing.assert_allclose(button[:3] - button[0], 0, atol=1e-12)
        assert button[0, human.skeleton.bone("vl5")] > 0.8


def test_heat_uses_a_coarser_surface_for_many_vertices(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    human, fine = person("slim_old_woman"), heated("slim_old_woman")
    monkeypatch.setattr(heat, "_MAX_POINTS", 5000)
    coarse = rig(human.mesh, human.skeleton)
    off = np.asarray(np.abs(coarse - fine).sum(1)).ravel() / 2
    assert 0 < off.mean() < 0.03
    assert np.diff(coarse.indptr).max() <= 4
    np.testing.assert_allclose(np.asarray(coarse.sum(1)).ravel(), 1, atol=1e-6)


def test_both_solvers_give_the_same_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    human, direct = person("child"), heated("child")
    monkeypatch.setattr(heat, "_MANY", -1)
    off = np.abs(rig(human.mesh, human.skeleton) - direct)
    assert off.max() < 1e-3


@pytest.mark.parametrize("name", ["own_female_A_dm.obj", *if_shared("mh2007_female_A_dm.obj")])
def test_arms_do_not_move_a_belly_beside_them(name: str) -> None:
    """In an A pose the forearm is in front of the flank, with air between them."""
    mesh, skeleton = fit_skeleton(read_mesh(mesh_path(name)))
    weights = rig(mesh, skeleton).toarray()
    height, aside = mesh.vertices[:, 1], np.abs(mesh.vertices[:, 0])
    belly = (height > 0.95) & (height < 1.2) & (aside < 0.16)
    assert belly.sum() > 300
    assert weights[belly][:, bones(skeleton, "_shoulder", "_elbow", "_wrist")].max() < 0.05


@pytest.mark.parametrize("extent", [[0.0, 1, 1], [1.0, 0, 1], [1.0, 1, 0], [0.0, 0, 0], [1e7, 1, 1]])
def test_heat_on_other_meshes_gives_weights_or_an_error(extent: list[float]) -> None:
    vertices = np.random.default_rng(0).uniform(-1, 1, (90, 3)) * extent
    mesh = Mesh(vertices, np.column_stack([np.arange(90).reshape(30, 3), np.full(30, -1)]).astype(np.int32))
    try:
        weights = rig(mesh, SKELETON)
    except MeshError:
        assert extent[1] == 0 or max(extent) > 1e3
    else:
        np.testing.assert_allclose(np.asarray(weights.sum(1)).ravel(), 1, atol=1e-12)


def test_other_skeletons_are_refused() -> None:
    stick = Skeleton(("stick",), np.array([-1]), np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1))
    with pytest.raises(MeshError, match="no bone 'l_hip'"):
        rig(cloud(person_like(3)), stick)
