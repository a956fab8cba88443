"""Normals and tangents against Blender's, a loop over triangles, and surfaces whose normals are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.normals import SurfaceNormals, SurfaceTangents
from humansim_ros.types import Array

with np.load(ROOT / "test" / "data" / "blender_bodies.npz") as _archive:
    HAND = {key.split("/")[1]: _archive[key] for key in _archive if key.startswith("surface/")}

both_weightings = pytest.mark.parametrize("weighting", ["angle", "area"])

PLATE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
PLATE_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def blob(seed: int) -> tuple[Array, NDArray[np.int64]]:
    ball = trimesh.creation.icosphere(2)
    return ball.vertices * (1 + 0.2 * np.random.default_rng(seed).random((len(ball.vertices), 1))), ball.faces


def test_angle_weighted_normals_agree_with_blender() -> None:
    """Blender's angles, in float32, are off by up to 2e-4 radians on the smallest triangles."""
    normals = SurfaceNormals(HAND["triangles"], len(HAND["vertices"]))(HAND["vertices"].astype(float))
    off = np.linalg.norm(normals[HAND["triangles"]] - HAND["normals"], axis=-1)
    assert off.max() < 5e-4
    assert np.median(off) < 1e-5


def test_area_weighted_normals_are_the_sum_of_the_triangles_around() -> None:
    vertices, triangles = blob(1)
    expected = np.zeros_like(vertices)
    for triangle in triangles:
        a, b, c = vertices[triangle]
        for corner in triangle:
            expected[corner] += np.cross(b - a, c - a)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    normals = SurfaceNormals(triangles, len(vertices), "area")(vertices)
    np.testing.assert_allclose(normals, expected, atol=1e-14)


@both_weightings
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10_000), size=st.floats(1e-3, 1e3))
def test_normals_rotate_with_the_surface(weighting: str, seed: int, size: float) -> None:
    vertices, triangles = blob(seed)
    normals = SurfaceNormals(triangles, len(vertices), weighting)
    turn = Rotation.random(random_state=seed)
    moved = normals(turn.apply(vertices) * size + (0.1, 2, -3))
    np.testing.assert_allclose(moved, turn.apply(normals(vertices)), atol=1e-9)


@both_weightings
def test_a_batch_of_frames_gives_the_same_normals(weighting: str) -> None:
    frames = np.stack([blob(seed)[0] for seed in range(6)]).reshape(2, 3, -1, 3).astype(np.float32)
    normals = SurfaceNormals(blob(0)[1], frames.shape[-2], weighting)
    together = normals(frames)
    assert together.dtype == np.float32
    for index in np.ndindex(2, 3):
        np.testing.assert_array_equal(together[index], normals(frames[index]))
    assert normals(frames[:0]).shape == frames[:0].shape


@both_weightings
def test_without_surface_normals_are_zero(weighting: str) -> None:
    """A vertex of no triangle, and triangles without area."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5], [1, 0, 0]])
    flat = SurfaceNormals(np.array([[0, 1, 2], [1, 4, 2], [0, 0, 0]]), 5, weighting)
    np.testing.assert_array_equal(flat(vertices), np.zeros((5, 3)))


def hand_tangents() -> tuple[SurfaceTangents, Array]:
    """Tangents of Blender's hand, and Blender's normals by vertex."""
    uv, index = np.unique(HAND["uv"].reshape(-1, 2), axis=0, return_inverse=True)
    tangents = SurfaceTangents(HAND["triangles"], uv, index.reshape(-1, 3), len(HAND["vertices"]))
    normals = np.zeros((len(HAND["vertices"]), 3))
    normals[HAND["triangles"].ravel()] = HAND["normals"].reshape(-1, 3)
    return tangents, normals


def test_tangents_agree_with_blender() -> None:
    tangents, normals = hand_tangents()
    ours = tangents(HAND["vertices"].astype(float), normals)[tangents.triangles]
    np.testing.assert_array_equal(ours[..., 3], HAND["tangents"][..., 3])
    assert 0.4 < (ours[..., 3] < 0).mean() < 0.6  # half of the texture is mirrored
    off = np.linalg.norm(ours[..., :3] - HAND["tangents"][..., :3], axis=-1)
    assert (off > 1e-4).sum() == 6  # corners of triangles that only touch in a vertex
    assert off.max() < 0.03


def test_the_tangent_of_a_plate_is_the_direction_of_u() -> None:
    turned = np.array([[0.0, 1], [0, 0], [1, 0], [1, 1]])  # u along +y, v along -x
    tangents = SurfaceTangents(PLATE_TRIANGLES, turned, PLATE_TRIANGLES, 4)
    up = np.tile([0.0, 0, 1], (4, 1))
    np.testing.assert_allclose(tangents(PLATE, up), np.tile([0.0, 1, 0, 1], (4, 1)), atol=1e-12)
    mirrored = SurfaceTangents(PLATE_TRIANGLES, turned * (-1, 1), PLATE_TRIANGLES, 4)
    np.testing.assert_allclose(mirrored(PLATE, up), np.tile([0.0, -1, 0, -1], (4, 1)), atol=1e-12)


def test_tangents_are_perpendicular_to_the_normal_and_rotate_with_the_surface() -> None:
    tangents, normals = hand_tangents()
    turn = Rotation.random(random_state=3)
    rest = HAND["vertices"].astype(float)
    both = tangents(np.stack([rest, turn.apply(rest)]), np.stack([normals, turn.apply(normals)]))
    np.testing.assert_allclose(both[1, :, :3], turn.apply(both[0, :, :3]), atol=1e-6)
    assert np.abs((both[0, :, :3] * normals[tangents.vertex]).sum(axis=-1)).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(both[..., :3], axis=-1), 1, atol=1e-12)


def test_a_texture_without_area_gives_no_tangent() -> None:
    tangents = SurfaceTangents(PLATE_TRIANGLES, np.zeros((4, 2)), PLATE_TRIANGLES, 4)
    np.testing.assert_array_equal(tangents(PLATE, np.tile([0.0, 0, 1], (4, 1)))[:, :3], 0)


def test_arrays_that_do_not_match_are_refused() -> None:
    uv = PLATE[:, :2]
    for triangles, message in (
        (np.array([[0, 1, 4]]), "triangle 0 has an index outside 0..3"),
        (np.array([[0, 1, 2], [0, -1, 2]]), "triangle 1 has"),
        (np.array([[0.0, 1, 2]]), "float64"),
        (np.array([0, 1, 2]), r"\(N, 3\)"),
    ):
        with pytest.raises(MeshError, match=message):
            SurfaceNormals(triangles, 4)
        with pytest.raises(MeshError, match=f"texture {message}" if "triangle" in message else message):
            SurfaceTangents(PLATE_TRIANGLES, uv, triangles, 4)
    with pytest.raises(MeshError, match="1 texture triangles do not fit 2"):
        SurfaceTangents(PLATE_TRIANGLES, uv, PLATE_TRIANGLES[:1], 4)
    with pytest.raises(MeshError, match="does not fit 4 vertices"):
        SurfaceNormals(PLATE_TRIANGLES, 4)(np.zeros((3, 3)))
    with pytest.raises(MeshError, match="do not fit vertices"):
        SurfaceTangents(PLATE_TRIANGLES, uv, PLATE_TRIANGLES, 4)(PLATE, np.zeros((2, 4, 3)))
