"""Rotations against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from humansim_ros.geometry import (
    WORLD_FROM_BODY,
    cross,
    cross_products,
    fit_similarity,
    from_y_axis,
    invert_rigid,
    lengths_of,
    matrix_to_quaternion,
    moved,
    quaternion_to_matrix,
    rotate,
    rotation_vector_to_matrix,
    slerp,
    transform,
    unit_vectors,
)
from humansim_ros.types import Array

modest = settings(deadline=None, max_examples=60)
#: Half turns about any axis are in here: the components may be zero.
quaternions = (
    arrays(float, 4, elements=st.floats(-1, 1).map(lambda x: 0.0 if abs(x) < 1e-9 else x))
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: q / np.linalg.norm(q))
)
directions = (
    arrays(float, 3, elements=st.floats(-1, 1))
    .filter(lambda v: np.linalg.norm(v) > 1e-3)
    .map(lambda v: v / np.linalg.norm(v))
)


def angle(a: Array, b: Array) -> float:
    """Angle between the rotations of two quaternions, by SciPy."""
    return float((Rotation.from_quat(a) * Rotation.from_quat(b).inv()).magnitude())


@modest
@given(quaternions)
def test_matrix_of_a_quaternion_is_scipys(q: Array) -> None:
    np.testing.assert_allclose(quaternion_to_matrix(q), Rotation.from_quat(q).as_matrix(), atol=1e-14)


@modest
@given(quaternions)
@example(np.array([1.0, 0, 0, 0]))
@example(np.array([0, 0.6, 0.8, 0]))
def test_quaternion_of_a_matrix_is_scipys(q: Array) -> None:
    ours = matrix_to_quaternion(Rotation.from_quat(q).as_matrix())
    assert angle(ours, q) < 1e-12
    assert ours[3] >= 0
    assert np.linalg.norm(ours) == pytest.approx(1, abs=1e-14)


@modest
@given(arrays(float, 3, elements=st.floats(-10, 10)))
@example(np.zeros(3))
@example(np.array([0, 1e-9, 0]))
@example(np.array([np.pi, 0, 0]))
def test_matrix_of_a_rotation_vector_is_scipys(vector: Array) -> None:
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_vector_to_matrix(vector), expected, atol=1e-13)


def test_poses_move_at_constant_velocity_in_the_world() -> None:
    """Many small rotations by SciPy equal one rotation for the whole time."""
    rng = np.random.default_rng(3)
    poses = transform(Rotation.random(6, 4).as_matrix(), rng.normal(size=(6, 3))).reshape(2, 3, 4, 4)
    linear, angular = rng.normal(size=(2, 2, 3, 3)) * 3
    later = moved(poses, linear, angular, -0.2)
    for index in np.ndindex(2, 3):
        turned, step = (
            Rotation.from_matrix(poses[index][:3, :3]),
            Rotation.from_rotvec(angular[index] * -0.002),
        )
        for _ in range(100):
            turned = step * turned
        np.testing.assert_allclose(later[index][:3, :3], turned.as_matrix(), atol=1e-12)
        np.testing.assert_allclose(later[index][:3, 3], poses[index][:3, 3] - 0.2 * linear[index], atol=1e-12)
        np.testing.assert_array_equal(later[index][3], [0, 0, 0, 1])


def test_conversions_keep_leading_axes() -> None:
    q = Rotation.random(24, 3).as_quat().reshape(2, 3, 4, 4)
    matrices = quaternion_to_matrix(q)
    for index in np.ndindex(2, 3, 4):
        np.testing.assert_allclose(matrices[index], Rotation.from_quat(q[index]).as_matrix(), atol=1e-14)
        assert angle(matrix_to_quaternion(matrices)[index], q[index]) < 1e-12


@modest
@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp_is_scipys(start: Array, end: Array, fraction: float) -> None:
    if angle(start, end) > np.pi - 1e-6:
        return  # both ways round are shortest
    expected = Slerp([0, 1], Rotation.from_quat([start, end]))(fraction)
    ours = slerp(start, end, np.array(fraction))
    assert angle(ours, expected.as_quat()) < 1e-7


def test_slerp_between_q_and_minus_q_is_constant() -> None:
    q = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_quat()
    assert angle(slerp(q, -q, np.array(0.5)), q) < 1e-12


@modest
@given(directions)
@example(np.array([0.0, 1.0, 0.0]))
@example(np.array([0.0, -1.0, 0.0]))
def test_from_y_axis_turns_y_onto_the_direction_by_the_smallest_angle(direction: Array) -> None:
    turn = Rotation.from_quat(from_y_axis(direction))
    np.testing.assert_allclose(turn.apply([0, 1, 0]), direction, atol=1e-7)
    between = np.arctan2(np.linalg.norm(np.cross([0, 1, 0], direction)), direction[1])
    assert turn.magnitude() == pytest.approx(between, abs=1e-7)


@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-9, 1e-7, 1e-6, 1e-3])
@pytest.mark.parametrize("about", [0.0, 1.0, 2.5])
def test_from_y_axis_is_a_rotation_near_the_opposite_direction(tilt: float, about: float) -> None:
    direction = np.array([np.sin(tilt) * np.cos(about), -np.cos(tilt), np.sin(tilt) * np.sin(about)])
    q = from_y_axis(direction)
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(q).apply([0, 1, 0]), direction, atol=2e-7)


def test_body_axes_in_the_world() -> None:
    """Left of the body is +y, up is +z, forward is +x (REP-103)."""
    left, up, forward = WORLD_FROM_BODY.T
    np.testing.assert_array_equal(left, [0, 1, 0])
    np.testing.assert_array_equal(up, [0, 0, 1])
    np.testing.assert_array_equal(forward, [1, 0, 0])
    assert np.linalg.det(WORLD_FROM_BODY) == 1


def test_inverse_of_rigid_transforms_is_numpys() -> None:
    rng = np.random.default_rng(5)
    matrices = transform(Rotation.random(6, 5).as_matrix(), rng.normal(size=(6, 3))).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(invert_rigid(matrices), np.linalg.inv(matrices), atol=1e-14)


def test_vectors_are_rotated_normalised_and_crossed() -> None:
    random = np.random.default_rng(0)
    turns, (a, b) = Rotation.random(5, random_state=0), random.normal(size=(2, 5, 3))
    np.testing.assert_allclose(rotate(turns.as_matrix(), a), turns.apply(a), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(unit_vectors(a), axis=1), 1.0)
    np.testing.assert_array_equal(unit_vectors(np.zeros((2, 3))), np.zeros((2, 3)))
    np.testing.assert_allclose(cross(a.T, b.T).T, np.cross(a, b), atol=1e-12)


@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 4, 3), (0, 3)])
def test_cross_products_and_lengths_have_the_bits_of_numpy(shape: tuple[int, ...]) -> None:
    """Recorded motions and their hashes depend on them."""
    for scale in (1.0, 1e-8, 1e8):
        a, b = scale * np.random.default_rng(3).normal(size=(2, *shape))
        np.testing.assert_array_equal(cross_products(a, b), np.cross(a, b), strict=True)
        np.testing.assert_array_equal(lengths_of(a), np.linalg.norm(a, axis=-1))


@pytest.mark.parametrize("depth", [1.0, 0.0], ids=["in space", "in a plane"])
def test_a_similarity_is_found_in_weighted_and_mirrored_points(depth: float) -> None:
    """SciPy finds the same rotation; exact pairs give the similarity that made them."""
    random = np.random.default_rng(1)
    source = random.normal(size=(4, 7, 3)) * [1, 1, depth]
    turns, shift = Rotation.random(4, random_state=2), random.normal(size=(4, 3))
    exact = 1.7 * np.einsum("nij,nkj->nki", turns.as_matrix(), source) + shift[:, None]
    scale, rotation, translation = fit_similarity(source, exact)
    np.testing.assert_allclose(scale, 1.7)
    np.testing.assert_allclose(rotation, turns.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(translation, shift, atol=1e-12)
    weights, other = random.uniform(0, 1, (4, 7)), random.normal(size=(4, 7, 3)) * [1, 1, -1]
    _, rotation, translation = fit_similarity(source, other, weights, scale=1.0)
    for row in range(4):
        middle, goal = (np.average(points[row], 0, weights[row]) for points in (source, other))
        expected, _ = Rotation.align_vectors(other[row] - goal, source[row] - middle, weights[row])
        np.testing.assert_allclose(rotation[row], expected.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(translation[row], goal - expected.apply(middle), atol=1e-9)
