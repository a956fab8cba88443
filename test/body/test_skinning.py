"""Skinning: linear blending against a plain loop, and properties of both methods.

Rest frames, posed frames and skinned vertices against Blender's armature (test/data/README.md).
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.mesh import normalise_weights
from humansim_ros.motion import Skeleton, hanim_skeleton, skin
from humansim_ros.motion.body.skinning import SKINNERS, DualQuaternion, LinearBlend, make_skinner
from humansim_ros.types import Array

SKELETON = hanim_skeleton()

both_ways = pytest.mark.parametrize("method", SKINNERS)
seeds = given(seed=st.integers(0, 10_000))
quickly = settings(deadline=None, max_examples=30)


def random_body(seed: int, vertices: int = 40) -> tuple[Array, csr_matrix]:
    """Random vertices of a person's size, with weights of one to three bones that do not sum to one."""
    rng = np.random.default_rng(seed)
    dense = np.zeros((vertices, len(SKELETON)))
    for row in dense:
        bones = rng.choice(len(row), rng.integers(1, 4), replace=False)
        row[bones] = rng.uniform(0.05, 2.0, len(bones))
    return rng.uniform(-1, 1, (vertices, 3)), csr_matrix(dense)


def random_transforms(seed: int, bones: int = 22) -> Array:
    out = np.tile(np.eye(4), (bones, 1, 1))
    out[:, :3, :3] = Rotation.random(bones, seed).as_matrix()
    out[:, :3, 3] = np.random.default_rng(seed).normal(size=(bones, 3))
    return out


def random_directions(seed: int, count: int) -> Array:
    directions = np.random.default_rng(seed + 77).normal(size=(count, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def one_by_one(vertices: Array, weights: csr_matrix, transforms: Array) -> Array:
    """[thesis §9.6] as printed: weighted displacements divided by the sum of the weights."""
    out = np.empty_like(vertices)
    for v, vertex in enumerate(vertices):
        total, displacement = 0.0, np.zeros(3)
        for bone in range(weights.shape[1]):
            weight = weights[v, bone]
            turned = Rotation.from_matrix(transforms[bone, :3, :3]).apply(vertex) + transforms[bone, :3, 3]
            displacement += weight * (turned - vertex)
            total += weight
        out[v] = vertex + displacement / total
    return out


@pytest.mark.parametrize("seed", range(3))
def test_skinned_vertices_are_those_of_the_loop(seed: int) -> None:
    vertices, weights = random_body(seed)
    transforms = random_transforms(seed)
    np.testing.assert_allclose(
        skin(vertices, weights, transforms), one_by_one(vertices, weights, transforms), atol=1e-12
    )


@both_ways
def test_a_batch_of_frames_gives_the_same_vertices(method: str) -> None:
    vertices, weights = random_body(4)
    transforms = np.stack([random_transforms(s) for s in range(20)]).reshape(4, 5, 22, 4, 4)
    skinner, normals = make_skinner(method, vertices, weights, np.float64), random_directions(4, 40)
    skinned, turned = skinner(transforms), skinner.directions(transforms, normals)
    assert skinned.shape == turned.shape == (4, 5, 40, 3)
    for index in np.ndindex(4, 5):
        np.testing.assert_allclose(skinned[index], skinner(transforms[index]), atol=1e-14)
        np.testing.assert_allclose(turned[index], skinner.directions(transforms[index], normals), atol=1e-14)


@both_ways
def test_no_frames_give_no_vertices(method: str) -> None:
    vertices, weights = random_body(4)
    skinner = make_skinner(method, vertices, weights)
    for shape in ((0,), (3, 0)):
        assert skinner(np.zeros((*shape, 22, 4, 4))).shape == (*shape, 40, 3)
        assert skinner.directions(np.zeros((*shape, 22, 4, 4)), vertices).shape == (*shape, 40, 3)


@both_ways
def test_rest_gives_rest(method: str) -> None:
    vertices, weights = random_body(1)
    still = np.tile([0.0, 0, 0, 1], (22, 1))
    skinned = skin(vertices, weights, SKELETON.pose(still) @ SKELETON.rest_inverse, method)
    np.testing.assert_allclose(skinned, vertices, atol=1e-12)


@both_ways
@quickly
@seeds
def test_moving_all_bones_moves_the_skin(method: str, seed: int) -> None:
    vertices, weights = random_body(seed, 10)
    transforms, move = random_transforms(seed), random_transforms(seed + 1, 1)[0]
    expected = skin(vertices, weights, transforms, method) @ move[:3, :3].T + move[:3, 3]
    np.testing.assert_allclose(skin(vertices, weights, move @ transforms, method), expected, atol=1e-11)


@both_ways
@quickly
@seeds
def test_scaling_the_body_scales_the_skin(method: str, seed: int) -> None:
    vertices, weights = random_body(seed, 10)
    transforms = random_transforms(seed)
    size = np.diag([*np.full(3, np.random.default_rng(seed).uniform(0.05, 20)), 1])
    expected = skin(vertices, weights, transforms, method) * size[0, 0]
    np.testing.assert_allclose(skin(vertices, weights, size @ transforms, method), expected, atol=1e-11)


@both_ways
@quickly
@seeds
def test_the_mirrored_body_in_the_mirrored_pose_is_the_mirror_image(method: str, seed: int) -> None:
    vertices, weights = random_body(seed, 10)
    transforms, mirror = random_transforms(seed), np.diag([-1.0, 1, 1, 1])
    names = SKELETON.names
    sides = [names.index(re.sub("(?<![a-z])[lr](?=_)", lambda m: "rl"["lr".index(m[0])], n)) for n in names]
    mirrored = skin(vertices * (-1, 1, 1), weights[:, sides], (mirror @ transforms @ mirror)[sides], method)
    np.testing.assert_allclose(mirrored, skin(vertices, weights, transforms, method) * (-1, 1, 1), atol=1e-11)


@both_ways
@quickly
@seeds
def test_vertices_of_one_bone_move_with_it(method: str, seed: int) -> None:
    vertices, transforms = random_body(seed, 22)[0], random_transforms(seed)
    skinned = skin(vertices, csr_matrix(np.diag(np.linspace(0.1, 3, 22))), transforms, method)
    expected = [t[:3, :3] @ v + t[:3, 3] for t, v in zip(transforms, vertices, strict=True)]
    np.testing.assert_allclose(skinned, expected, atol=1e-12)


@both_ways
@quickly
@seeds
def test_directions_rotate_with_the_neighbourhood_of_their_vertex(method: str, seed: int) -> None:
    vertices, weights = random_body(seed, 10)
    normals, transforms = random_directions(seed, 10), random_transforms(seed)
    transforms[:, :3] *= 1.7
    skinner = make_skinner(method, vertices, weights, np.float64)
    beside = skin(vertices + normals, weights, transforms, method) - skinner(transforms)
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    np.testing.assert_allclose(skinner.directions(transforms, normals), beside, atol=1e-9)


@quickly
@given(seed=st.integers(0, 10_000), degrees=st.floats(-179.0, 179.0))
def test_dual_quaternions_keep_the_distance_to_the_joint(seed: int, degrees: float) -> None:
    rng = np.random.default_rng(seed)
    vertices, share, joint = rng.normal(size=(50, 3)), rng.uniform(0, 1, 50), rng.normal(size=3)
    bent = np.tile(np.eye(4), (2, 1, 1))
    bent[1, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * random_directions(seed, 1)[0]).as_matrix()
    bent[:, :3, 3] = joint - bent[:, :3, :3] @ joint
    weights = csr_matrix(np.stack([share, 1 - share], axis=1))
    distance = np.linalg.norm(vertices - joint, axis=1)
    kept = np.linalg.norm(skin(vertices, weights, bent, "dual_quaternion") - joint, axis=1)
    np.testing.assert_allclose(kept, distance, atol=1e-11)
    linear = np.linalg.norm(skin(vertices, weights, bent) - joint, axis=1)
    assert (linear <= distance + 1e-11).all()


def test_a_full_turn_of_a_bone_changes_nothing() -> None:
    """The sign of a quaternion must not matter."""
    vertices, weights = np.array([[0.3, 1.0, 0.2]]), csr_matrix([[0.4, 0.6]])
    for angle in (80.0, 100.0):  # of both bones, the quaternions' signs change at 180
        bent = np.tile(np.eye(4), (2, 1, 1))
        bent[:, :3, :3] = Rotation.from_euler("z", [[angle], [angle + 85]], degrees=True).as_matrix()
        middle = Rotation.from_euler("z", angle + 85 * 0.6, degrees=True).apply(vertices)
        np.testing.assert_allclose(skin(vertices, weights, bent, "dual_quaternion"), middle, atol=0.01)


@quickly
@seeds
def test_normalised_weights_sum_to_one_and_keep_their_ratios(seed: int) -> None:
    _, weights = random_body(seed, 10)
    dense, normal = weights.toarray(), normalise_weights(weights).toarray()
    np.testing.assert_allclose(normal.sum(1), 1, atol=1e-14)
    np.testing.assert_allclose(normal * dense.sum(1, keepdims=True), dense, atol=1e-14)


@both_ways
def test_single_precision_is_accurate_to_a_micrometre(method: str) -> None:
    vertices, weights = random_body(3, 500)
    transforms = random_transforms(3)
    single = make_skinner(method, vertices, weights)(transforms)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, skin(vertices, weights, transforms, method), atol=2e-6)


def test_duplicate_entries_of_weights_add_up() -> None:
    pieces = csr_matrix(
        (np.array([1.0, 1.0, 2.0]), np.array([0, 1, 0]), np.array([0, 3])), shape=(1, 2)
    )  # bone 0 twice
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[0, 0, 3] = 1
    np.testing.assert_allclose(skin(np.zeros((1, 3)), pieces, transforms), [[0.75, 0, 0]])


@both_ways
@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([[1.0, 0.0], [0.0, 0.0]], "vertex 1 follows no bone"),
        ([[1.0, 0.0], [2.0, -1.0]], "vertex 1 is negative"),
        ([[1.0, 0.0], [np.nan, 1.0]], "vertex 1 is negative or not finite"),
        ([[1.0, np.inf], [0.0, 1.0]], "vertex 0 is negative or not finite"),
        ([[1.0, 0.0]], "do not fit 2 vertices and 2 bones"),
        ([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], "do not fit 2 vertices and 2 bones"),
    ],
)
def test_impossible_weights_are_refused(method: str, weights: list[list[float]], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        skin(np.zeros((2, 3)), csr_matrix(weights), np.tile(np.eye(4), (2, 1, 1)), method)


def test_huge_and_tiny_weights_are_valid() -> None:
    for weight in (1e308, 1e-300):
        half = normalise_weights(csr_matrix(np.full((1, 2), weight))).toarray()
        np.testing.assert_allclose(half, [[0.5, 0.5]])


def with_last(matrix: Array) -> Array:
    return np.stack([np.eye(4), matrix])


@both_ways
@pytest.mark.parametrize(
    ("transforms", "message"),
    [
        (np.eye(4), "do not fit 2 bones"),
        (np.tile(np.eye(4), (3, 1, 1)), "do not fit 2 bones"),
        (np.tile(np.eye(3), (2, 1, 1)), "do not fit 2 bones"),
        (with_last(np.full((4, 4), np.nan)), "bone 1 is not finite"),
        (with_last(np.ones((4, 4))), "last row"),
    ],
)
def test_impossible_transforms_are_refused(method: str, transforms: Array, message: str) -> None:
    skinner = make_skinner(method, np.zeros((2, 3)), csr_matrix(np.eye(2)))
    for call in (skinner, lambda given: skinner.directions(given, np.ones((2, 3)))):
        with pytest.raises(MeshError, match=message):
            call(transforms)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, 1.1, 1, 1]), "bone 1 stretches"),
        (np.diag([2.0, 2, 2, 1]), "bone 1 .*has another scale"),
        (np.diag([0.0, 0, 0, 1]), "bone 1 stretches"),
        (np.diag([-1.0, 1, 1, 1]), "bone 1 mirrors.*use linear skinning"),
        (np.eye(4) + np.eye(4, k=1) * [[0.2], [0], [0], [0]], "bone 1 .*shears"),
    ],
)
def test_dual_quaternions_refuse_transforms_that_are_not_rigid(matrix: Array, message: str) -> None:
    skinner = DualQuaternion(np.zeros((2, 3)), csr_matrix(np.eye(2)))
    with pytest.raises(MeshError, match=message):
        skinner(with_last(matrix))


def test_an_unused_bone_may_have_any_scale() -> None:
    vertices, weights = np.ones((2, 3)), csr_matrix([[1.0, 0.0], [1.0, 0.0]])
    skinned = skin(vertices, weights, with_last(np.diag([0.0, 2, 2, 1])), "dual_quaternion")
    np.testing.assert_allclose(skinned, vertices)


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(MeshError, match=r"\(V, 3\)"):
        LinearBlend(np.zeros((2, 2)), csr_matrix(np.eye(2)))
    with pytest.raises(MeshError, match="fit 3 vertices"):
        DualQuaternion(np.zeros((3, 3)), csr_matrix(np.eye(2)))
    with pytest.raises(MeshError, match="directions"):
        LinearBlend(np.zeros((2, 3)), csr_matrix(np.eye(2))).directions(
            with_last(np.eye(4)), np.zeros((1, 3))
        )
    with pytest.raises(MeshError, match="'spherical' is not a skinning method; methods are linear"):
        make_skinner("spherical", np.zeros((2, 3)), csr_matrix(np.eye(2)))


DATA = ROOT / "test" / "data"

with np.load(DATA / "blender_skinning.npz") as _archive:
    BLENDER = {key: _archive[key] for key in _archive}
with np.load(DATA / "blender_bodies.npz") as _archive:
    BODIES = {key: _archive[key] for key in _archive}
#: What Blender computes without and with "Preserve Volume".
BLENDERS_RESULT = {"linear": "skinned", "dual_quaternion": "preserved"}

#: Metres, and radians for directions.
TOLERANCE = 1e-6
#: Blender's float32 turns a bone about itself by up to this, radians, if it is within 10 degrees of -y.
ROLL_OF_BONES_POINTING_DOWN = 2e-5

both_sets = pytest.mark.parametrize("bones", ["straight", "rolled"])


def skeleton(rolls: Array) -> Skeleton:
    return Skeleton(
        names=tuple(BLENDER["names"].tolist()),
        parents=BLENDER["parents"],
        heads=BLENDER["heads"],
        tails=BLENDER["tails"],
        rolls=rolls,
    )


def turn_to_blender(ours: Skeleton, bones: str) -> Array:
    """Rotation vectors (B, 3) in bone space from our rest frames to Blender's."""
    difference = np.swapaxes(ours.rest[:, :3, :3], 1, 2) @ BLENDER[f"{bones}/rest"][:, :3, :3]
    return np.asarray(Rotation.from_matrix(difference).as_rotvec())


def blenders_skeleton(bones: str) -> Skeleton:
    """Our skeleton with the rolls that Blender gave to the bones."""
    rolls = BLENDER[f"{bones}/rolls"]
    return skeleton(rolls + turn_to_blender(skeleton(rolls), bones)[:, 1])


@both_sets
def test_rest_frames_agree_with_blender(bones: str) -> None:
    ours = skeleton(BLENDER[f"{bones}/rolls"])
    np.testing.assert_allclose(ours.rest[:, :3, 3], BLENDER[f"{bones}/rest"][:, :3, 3], atol=TOLERANCE)
    turn = np.abs(turn_to_blender(ours, bones))
    down = ours.rest[:, 1, 1] < -np.cos(np.radians(10))
    assert turn[~down].max() < TOLERANCE
    assert turn[down][:, [0, 2]].max() < TOLERANCE
    assert turn[down][:, 1].max() < ROLL_OF_BONES_POINTING_DOWN


@both_sets
def test_posed_frames_agree_with_blender(bones: str) -> None:
    posed = blenders_skeleton(bones).pose(BLENDER[f"{bones}/rotations"].astype(float))
    np.testing.assert_allclose(posed, BLENDER[f"{bones}/posed"], atol=TOLERANCE)


@both_sets
def test_skinned_vertices_agree_with_blender(bones: str) -> None:
    ours = blenders_skeleton(bones)
    transforms = ours.pose(BLENDER[f"{bones}/rotations"].astype(float)) @ np.linalg.inv(ours.rest)
    skinned = skin(BLENDER["vertices"].astype(float), csr_matrix(BLENDER["weights"]), transforms)
    assert np.linalg.norm(skinned - BLENDER[f"{bones}/skinned"], axis=-1).max() < TOLERANCE


@pytest.mark.parametrize("method", BLENDERS_RESULT)
@pytest.mark.parametrize("body", ["man", "artist", "straight", "rolled"])
def test_both_skinning_methods_agree_with_blender(body: str, method: str) -> None:
    data = BODIES if f"{body}/rest" in BODIES else BLENDER
    vertices = data.get(f"{body}/sample_vertices", BLENDER["vertices"]).astype(float)
    weights = csr_matrix(data.get(f"{body}/sample_weights", BLENDER["weights"]))
    transforms = data[f"{body}/posed"] @ np.linalg.inv(data[f"{body}/rest"].astype(float))
    skinned = skin(vertices, weights, transforms, method)
    off = np.linalg.norm(skinned - data[f"{body}/{BLENDERS_RESULT[method]}"], axis=-1)
    assert off.max() < TOLERANCE


def test_the_two_methods_differ_in_blender() -> None:
    for body in ("man", "artist"):
        apart = np.linalg.norm(BODIES[f"{body}/skinned"] - BODIES[f"{body}/preserved"], axis=-1)
        assert apart.max() > 0.01


def test_some_weights_do_not_sum_to_one() -> None:
    sums = BLENDER["weights"].sum(axis=1)
    assert sums.min() < 0.5
    assert sums.max() > 1.5


def test_the_general_skeleton_is_the_one_that_blender_was_given() -> None:
    ours = hanim_skeleton()
    order = [ours.names.index(name) for name in BLENDER["names"]]
    assert len(ours.names) == len(order) == 22
    np.testing.assert_array_equal(ours.heads[order], BLENDER["heads"])
    np.testing.assert_array_equal(ours.tails[order], BLENDER["tails"])
    np.testing.assert_array_equal(ours.rolls[order], BLENDER["straight/rolls"])
    parents = [ours.names[ours.parents[bone]] if ours.parents[bone] >= 0 else None for bone in order]
    expected = [BLENDER["names"][parent] if parent >= 0 else None for parent in BLENDER["parents"]]
    assert parents == expected
