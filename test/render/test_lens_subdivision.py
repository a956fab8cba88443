"""Triangles that are divided for a lens: they cover the surface, stay connected, and bend as it does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from opencv_support import opencv_pixels

from humansim_ros.cameras import Camera
from humansim_ros.render.device.lens_tessellation import (
    TOLERANCE,
    VISIBLE,
    LensView,
    TriangleEdges,
    divide_edges,
    divide_triangles,
)

LENSES = {
    "plumb_bob": ((-0.361976, 0.110510, 0.001014, 0.000505, 0.0), "plumb_bob"),
    "rational": ((0.189544, -0.018229, -0.00063, 0.000054, -0.000212, 0.543582, -0.027892, 0.0), None),
    "equidistant": ((-0.013, 0.021, -0.0031, 0.0004), "equidistant"),
}


def areas(points: NDArray[np.float64], triangles: NDArray[np.intp]) -> NDArray[np.float64]:
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)[:, 2] / 2


def test_pieces_of_a_triangle_cover_it_once_and_meet_its_neighbours() -> None:
    corners = np.array([[0.0, 0, 0], [7, 1, 0], [3, 5, 0]])
    whole = areas(corners, np.array([[0, 1, 2]]))[0]
    numbers = (1, 2, 3, 4, 8)
    for pieces in np.stack(np.meshgrid(numbers, numbers, numbers), axis=-1).reshape(-1, 3):
        edges = TriangleEdges(np.array([[0, 1], [1, 2], [0, 2]]), np.array([[0, 1, 2]]))
        points, triangles, sources = divide_triangles(corners, np.array([[0, 1, 2]]), edges, pieces)
        assert (areas(points, triangles) > 1e-9).all(), pieces
        np.testing.assert_allclose(areas(points, triangles).sum(), whole)
        assert not sources.any() and set(triangles.ravel()) == set(range(len(points)))
        sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        ends, count = np.unique(sides, axis=0, return_counts=True)
        # inner sides belong to two triangles, and those on the border divide it as asked
        assert (count <= 2).all() and np.count_nonzero(count == 1) == pieces.sum(), pieces
        length = np.linalg.norm(np.diff(points[ends[count == 1]], axis=1)[:, 0], axis=1)
        expected = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1) / pieces
        np.testing.assert_allclose(np.sort(length), np.sort(np.repeat(expected, pieces)))


def test_a_closed_surface_stays_closed() -> None:
    ball = trimesh.creation.icosphere(2)
    corners = np.asarray(ball.faces, np.intp)
    edges = TriangleEdges.of(corners, len(ball.vertices))
    pieces = np.random.default_rng(5).integers(1, 9, len(edges.ends))
    points, triangles, sources = divide_triangles(np.asarray(ball.vertices), corners, edges, pieces)
    divided = trimesh.Trimesh(points, triangles, process=False)
    assert divided.is_watertight and divided.is_winding_consistent
    np.testing.assert_allclose(divided.volume, ball.volume)
    np.testing.assert_allclose(np.bincount(sources, divided.area_faces), ball.area_faces)


def test_neighbours_compute_the_same_points() -> None:
    a, b = np.random.default_rng(6).normal(size=(2, 200, 3)).astype(np.float32)
    pieces = np.arange(200) % 31 + 1
    starts, ends, edge = divide_edges(a, b, pieces)
    other = divide_edges(b, a, pieces)
    for number in range(200):
        own = edge == number
        np.testing.assert_array_equal(starts[own], other[1][own][::-1])
        np.testing.assert_array_equal(ends[own], other[0][own][::-1])
    np.testing.assert_array_equal(starts[edge != np.roll(edge, 1)], a)


@pytest.mark.parametrize(("tolerance", "checked"), [(VISIBLE, False), (TOLERANCE, False), (TOLERANCE, True)])
@pytest.mark.parametrize("name", LENSES)
def test_edges_in_the_image_are_straight(name: str, tolerance: float, checked: bool) -> None:
    """Their middles are compared with OpenCV's projection."""
    coefficients, model = LENSES[name]
    straight = Camera.look_at((2.3, 1.6, 1.4), (0, 0, 0.9), (640, 480), 1.0)
    camera = replace(straight, distortion=coefficients, model=model)
    box = trimesh.creation.box((7, 6, 3))
    box.apply_translation((0, 0, 1.5))
    mesh = LensView(camera).tessellate(box.vertices, np.asarray(box.faces, np.intp), tolerance, checked)
    ends = TriangleEdges.of(mesh.triangles, len(mesh.attributes)).ends
    a, b = (mesh.attributes[column] for column in ends.T)
    middle = (a + b) / 2
    seen = np.all([np.isfinite(camera.project(points)[0]).all(axis=1) for points in (a, b, middle)], axis=0)
    a, b, middle = a[seen], b[seen], middle[seen]
    drawn = sum(opencv_pixels(camera, p) * camera.to_optical(p)[:, 2:] for p in (a, b)) / (
        2 * camera.to_optical(middle)[:, 2:]
    )
    pixels = opencv_pixels(camera, middle)
    inside = ((pixels > 0) & (pixels < camera.size)).all(axis=1)
    error = np.linalg.norm(drawn - pixels, axis=1)[inside]
    assert len(error) > 1000
    assert error.mean() < 0.5 * tolerance and np.percentile(error, 97) < tolerance, error.mean()
    assert np.percentile(error, 99.9) < 2.5 * tolerance and error.max() < 8 * tolerance, error.max()
    if checked:
        assert np.percentile(error, 99.9) < tolerance and error.max() < 2 * tolerance, error.max()
