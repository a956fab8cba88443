"""Rays against embree at frozen instants, and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from humansim_ros.cameras.scanner.casting import Hits, MovingTriangles, Poses, RayIndex, Shot
from humansim_ros.cameras.scanner.models import Rays, oscillating, raster, rosette, spinning
from humansim_ros.types import Array

IDENTITY = np.array([[0.0, 0.0, 0.0, 1.0]])
#: Patterns of one sweep.
PATTERNS = {
    "spinning": spinning(10.0, (-15.0, 1.0, -5.0, 7.0, 15.0), 240, firing=4e-4, channel=2e-5).rays(0),
    "whole sphere": spinning(10.0, tuple(np.linspace(-90, 90, 31).tolist()), 120).rays(0),
    "many rows": spinning(10.0, tuple(np.linspace(-40, 40, 300).tolist()), 20).rays(0),
    "raster": raster(10.0, tuple(np.linspace(20, -20, 40).tolist()), 60, [(170.0, -170.0)]).rays(0),
    "rosette": rosette(10.0, 20_000, 70.0, (121.0, -77.0)).rays(3),
    "oscillating": oscillating(10.0, 20_000, (-7.0, 52.0), 17.31, 199.7, 4).rays(5),
}


def scene(random: np.random.Generator, count: int = 60) -> tuple[Array, NDArray[np.int32]]:
    """Triangles of all sizes around the origin, some far above and below it."""
    sizes = np.exp(random.uniform(np.log(0.02), np.log(6.0), (count, 1, 1)))
    center = random.normal(size=(count, 1, 3))
    center *= random.uniform(0.8, 9.0, (count, 1, 1)) / np.linalg.norm(center, axis=2, keepdims=True)
    corners = center + sizes * random.normal(size=(count, 3, 3))
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def shot(rays: Rays, poses: Poses) -> Shot:
    shares = rays.times / (rays.times.max() + 1)
    return Shot(rays.directions, shares, poses, rays.index(slice(0, len(rays))))


def embree(origins: Array, vectors: Array, vertices: Array, triangles: NDArray[np.int32]) -> Array:
    """Distances by embree's triangle, and computed here in double precision."""
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    found = mesh.ray.intersects_first(origins, vectors)
    a, b, c = (vertices[triangles[found][:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.einsum("ij,ij->i", a - origins, normal) / np.einsum("ij,ij->i", vectors, normal)
    return np.where(found < 0, np.inf, distance)


def agree(mine: Array, theirs: Array, most: int) -> None:
    """Equal but for a few rays that pass a triangle's edge by less than single precision."""
    same = np.isclose(mine, theirs, rtol=2e-5, atol=1e-5) | (np.isinf(mine) & np.isinf(theirs))
    assert (~same).sum() <= most
    assert np.isfinite(theirs).mean() > 0.1


@pytest.mark.parametrize("name", PATTERNS)
def test_rays_meet_what_embree_says(name: str) -> None:
    rays, random = PATTERNS[name], np.random.default_rng(5)
    for _ in range(3):
        vertices, triangles = scene(random)
        position, turn = random.normal(size=3), random.normal(size=4)
        here = Poses(position[None], (turn / np.linalg.norm(turn))[None])
        hits = Hits.none(len(rays))
        shot(rays, here).cast([MovingTriangles(0, triangles, vertices, vertices)], hits)
        vectors = here.to_map(rays.directions)
        origins = np.broadcast_to(position, vectors.shape)
        agree(hits.ranges, embree(origins, vectors, vertices.astype(float), triangles), 4)


def test_moving_triangles_are_met_where_they_are_when_the_ray_is_fired() -> None:
    random = np.random.default_rng(8)
    start, triangles = scene(random)
    end = (start + random.normal(scale=0.3, size=start.shape)).astype(np.float32)
    rays = spinning(10.0, (-20.0, -4.0, 3.0, 25.0), 40).rays(0)
    here = Poses(np.zeros((1, 3)), IDENTITY)
    hits, each = Hits.none(len(rays)), shot(rays, here)
    each.cast([MovingTriangles(0, triangles, start, end)], hits)
    theirs = []
    for share in np.unique(each.shares):
        chosen = each.shares == share
        frozen = start + share * (end.astype(float) - start)
        vectors = rays.directions[chosen]
        theirs.append(embree(np.zeros_like(vectors), vectors, frozen, triangles))
    agree(hits.ranges, np.concatenate(theirs), 2)


def test_a_moving_scanner_meets_what_it_would_meet_if_it_stood_at_each_pose() -> None:
    random = np.random.default_rng(9)
    start, triangles = scene(random)
    end = (start + random.normal(scale=0.1, size=start.shape)).astype(np.float32)
    rays = spinning(10.0, (-20.0, -4.0, 3.0, 25.0), 60).rays(0)
    shares = rays.times / (rays.times.max() + 1)

    def poses(share: Array) -> Poses:
        half = 0.4 * share**2
        turns = np.stack([0.3 * np.sin(half), np.zeros_like(half), np.sin(half), np.cos(half)], axis=-1)
        return Poses(
            np.stack([share, -0.4 * share**2, 0.2 * share], axis=-1),
            turns / np.linalg.norm(turns, axis=1, keepdims=True),
        )

    each = poses(shares)
    hits = Hits.none(len(rays))
    shot(rays, each).cast([MovingTriangles(0, triangles, start, end)], hits)
    vectors = each.to_map(rays.directions)
    theirs = np.empty(len(rays))
    for share in np.unique(shares):
        chosen = shares == share
        frozen = start + share * (end.astype(float) - start)
        theirs[chosen] = embree(each.positions[chosen], vectors[chosen], frozen, triangles)
    agree(hits.ranges, theirs, 3)


def test_distance_of_a_wall_that_comes_nearer() -> None:
    corners = np.array([(5, -50, -50), (5, 50, -50), (5, 50, 50), (5, -50, 50)], np.float32)
    end = (corners - np.array([1, 0, 0])).astype(np.float32)
    triangles = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    rays = spinning(20.0, (-10.0, 0.0, 10.0), 181, (45.0, -45.0)).rays(0)
    here, hits = Poses(np.zeros((1, 3)), IDENTITY), Hits.none(len(rays))
    each = shot(rays, here)
    each.cast([MovingTriangles(0, triangles, corners, end)], hits)
    np.testing.assert_allclose(hits.ranges, (5 - each.shares) / rays.directions[:, 0], rtol=1e-9)
    np.testing.assert_allclose(hits.cosines, rays.directions[:, 0], rtol=1e-9)


def test_the_nearest_of_two_surfaces_is_met_in_either_order() -> None:
    near = np.array([(2, -9, -9), (2, 9, -9), (2, 0, 9)], np.float32)
    triangles, rays = np.array([(0, 1, 2)], np.int32), spinning(10.0, (0.0,), 9, (10.0, -10.0)).rays(0)
    here = Poses(np.zeros((1, 3)), IDENTITY)
    surfaces = [MovingTriangles(4, triangles, near, near), MovingTriangles(7, triangles, 2 * near, 2 * near)]
    for order in (surfaces, surfaces[::-1]):
        hits = Hits.none(len(rays))
        shot(rays, here).cast(order, hits)
        assert (hits.surfaces == 4).all()


def test_no_rays_have_no_pairs() -> None:
    index = RayIndex(np.zeros((0, 3)))
    hits = Hits.none(0)
    here = Poses(np.zeros((1, 3)), IDENTITY)
    triangle = np.eye(3, dtype=np.float32)
    Shot(np.zeros((0, 3)), np.zeros(0), here, index).cast(
        [MovingTriangles(0, np.array([[0, 1, 2]], np.int32), triangle, triangle)], hits
    )
