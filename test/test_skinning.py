"""Linear blend skinning against a loop over vertices and bones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros.body import hanim_skeleton, skin
from humansim_ros.body.skinning import LinearBlend, normalise_weights
from humansim_ros.errors import MeshError
from humansim_ros.rotations import Array

SKELETON = hanim_skeleton()


def random_body(seed: int, vertices: int = 40) -> tuple[Array, csr_matrix]:
    """Vertices as large as a person and weights of one to three bones that do not sum to one."""
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


def one_by_one(vertices: Array, weights: csr_matrix, transforms: Array) -> Array:
    """Thesis 9.6 to the letter: displacements of a vertex, weighted, by the sum of the weights."""
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


def test_skinning_many_frames_at_once_is_skinning_each() -> None:
    vertices, weights = random_body(4)
    transforms = np.stack([random_transforms(s) for s in range(6)]).reshape(2, 3, 22, 4, 4)
    skinned = skin(vertices, weights, transforms)
    assert skinned.shape == (2, 3, 40, 3)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(
            skinned[index], one_by_one(vertices, weights, transforms[index]), atol=1e-12
        )


def test_rest_gives_rest() -> None:
    vertices, weights = random_body(1)
    still = np.tile([0.0, 0, 0, 1], (22, 1))
    skinned = skin(vertices, weights, SKELETON.pose(still) @ SKELETON.rest_inverse)
    np.testing.assert_allclose(skinned, vertices, atol=1e-12)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_moving_all_bones_moves_the_skin_alike(seed: int) -> None:
    vertices, weights = random_body(seed, 10)
    transforms, move = random_transforms(seed), random_transforms(seed + 1, 1)[0]
    expected = skin(vertices, weights, transforms) @ move[:3, :3].T + move[:3, 3]
    np.testing.assert_allclose(skin(vertices, weights, move @ transforms), expected, atol=1e-11)


def test_normalised_weights_sum_to_one_and_keep_their_ratios() -> None:
    _, weights = random_body(2)
    dense, normal = weights.toarray(), normalise_weights(weights).toarray()
    np.testing.assert_allclose(normal.sum(1), 1, atol=1e-14)
    np.testing.assert_allclose(normal * dense.sum(1, keepdims=True), dense, atol=1e-14)


def test_single_precision_is_right_to_a_thousandth_of_a_millimetre() -> None:
    vertices, weights = random_body(3, 500)
    transforms = random_transforms(3)
    single = LinearBlend(vertices, weights)(transforms)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, skin(vertices, weights, transforms), atol=1e-6)


def test_weights_given_in_pieces_add_up() -> None:
    pieces = csr_matrix(
        (np.array([1.0, 1.0, 2.0]), np.array([0, 1, 0]), np.array([0, 3])), shape=(1, 2)
    )  # bone 0 twice
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[0, 0, 3] = 1
    np.testing.assert_allclose(skin(np.zeros((1, 3)), pieces, transforms), [[0.75, 0, 0]])


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([[1.0, 0.0], [0.0, 0.0]], "vertex 1 follows no bone"),
        ([[1.0, 0.0], [2.0, -1.0]], "negative"),
        ([[1.0, 0.0], [np.nan, 1.0]], "not finite"),
        ([[1.0, 0.0], [np.inf, 1.0]], "not finite"),
        ([[1.0, 0.0]], "do not fit 2 vertices and 2 bones"),
        ([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], "do not fit 2 vertices and 2 bones"),
    ],
)
def test_impossible_weights_are_refused(weights: list[list[float]], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        skin(np.zeros((2, 3)), csr_matrix(weights), np.tile(np.eye(4), (2, 1, 1)))
