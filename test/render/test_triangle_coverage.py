"""Pixels that triangles cover behind others: each triangle rendered alone, and a plain rasteriser."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from render_scenes import renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.errors import RenderError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import Body, GLRenderer

NEAR = Camera.look_at((1.6, 0.4, 0.3), (0, 0.1, 0), (160, 120), np.radians(80))
SKEWED = replace(NEAR, K=NEAR.K + np.array([[0, 3.0, 11.3], [0, 20, -4.6], [0, 0, 0]]))
LENSES = {
    "ideal": SKEWED,
    "plumb_bob": replace(SKEWED, distortion=(-0.25, 0.06, 0.002, -0.001, 0.0)),
    "equidistant": replace(SKEWED, distortion=(-0.013, 0.021, -0.0031, 0.0004), model="equidistant"),
}


@pytest.fixture(scope="module")
def renderer() -> Iterator[GLRenderer]:
    renderer = renderer_or_skip()
    assert isinstance(renderer, GLRenderer)
    with renderer:
        yield renderer


def body_of(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> Body:
    faces = np.hstack([triangles, np.full((len(triangles), 1), -1)]).astype(np.int32)
    mesh = Mesh(np.asarray(vertices, dtype=float), faces)
    return Body(mesh, mesh.vertices.astype(np.float32), np.ones(len(faces), np.uint8), 1, "object")


def nested() -> Body:
    """Two balls, one in the other, partly outside the image, and a wall behind them, twice."""
    outer, inner = (trimesh.creation.icosphere(1, radius) for radius in (0.7, 0.35))
    place = np.array([0, 0.4, 0])
    wall = np.array([(-1, -2, -2), (-1, 2, -2), (-1, 2, 2), (-1, -2, 2)], float)
    vertices = np.concatenate([outer.vertices + place, inner.vertices + place, wall])
    n, first = len(outer.vertices), len(outer.vertices) + len(inner.vertices)
    square = first + np.array([(0, 1, 2), (0, 2, 3), (0, 1, 2), (0, 2, 3)])
    return body_of(vertices, np.concatenate([outer.faces, n + inner.faces, square]))


@pytest.mark.parametrize("lens", LENSES)
def test_coverage_is_that_of_each_triangle_rendered_alone(renderer: GLRenderer, lens: str) -> None:
    body, camera = nested(), LENSES[lens]
    covered = renderer.coverage(body, camera)
    alone = []
    for triangle in body.mesh.triangles:
        one = body_of(body.vertices, triangle[None])
        alone.append(np.count_nonzero(renderer.render([one], camera, ("face",)).face))
    assert covered.tolist() == alone
    assert (np.count_nonzero(covered), covered.max()) > (100, 1000)


def test_triangles_that_nothing_hides_have_equal_counts(renderer: GLRenderer) -> None:
    ball = trimesh.creation.icosphere(4, 0.5)
    body = body_of(ball.vertices, ball.faces)
    for camera in LENSES.values():
        face = renderer.render([body], camera, ("face",)).face
        visible = np.bincount(face.ravel(), minlength=len(ball.faces) + 1)[1:]
        covered = renderer.coverage(body, camera)
        towards = np.einsum("ij,ij->i", ball.face_normals, camera.center - ball.triangles_center)
        assert (visible[towards > 1e-3] == covered[towards > 1e-3]).all()
        hidden = covered[towards < -1e-3]
        assert hidden.sum() > 1000
        assert not visible[towards < -1e-3].any()


def test_coverage_equals_a_plain_rasteriser(renderer: GLRenderer) -> None:
    body = nested()
    covered = renderer.coverage(body, SKEWED)
    projected, depth = SKEWED.project(body.vertices)
    assert depth.min() > 0.1
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    rounding = 1 / 128
    for corners, found in zip(projected[body.mesh.triangles], covered, strict=True):
        distances = []
        turn = np.sign(np.linalg.det([corners[1] - corners[0], corners[2] - corners[0]]))
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            across = (b[0] - a[0]) * (rows - a[1]) - (b[1] - a[1]) * (columns - a[0])
            distances.append(turn * across / np.linalg.norm(b - a))
        inside = np.min(distances, axis=0)
        assert np.count_nonzero(inside > rounding) <= found <= np.count_nonzero(inside > -rounding)


def test_a_body_outside_the_image_covers_nothing(renderer: GLRenderer) -> None:
    ball = trimesh.creation.icosphere(1, 0.2)
    for place in ((3.0, 0.4, 0.3), (0.0, 9.0, 0.0)):
        assert not renderer.coverage(body_of(ball.vertices + place, ball.faces), SKEWED).any()


def test_coverage_leaves_images_as_they_are(renderer: GLRenderer) -> None:
    body = nested()
    before = renderer.render([replace(body)], SKEWED, ("rgb", "face"))
    renderer.coverage(body, SKEWED)
    after = renderer.render([replace(body)], SKEWED, ("rgb", "face"))
    np.testing.assert_array_equal(before.rgb, after.rgb)
    np.testing.assert_array_equal(before.face, after.face)


def test_a_body_that_does_not_fit_its_mesh_is_refused(renderer: GLRenderer) -> None:
    body = nested()
    with pytest.raises(RenderError, match="do not fit a mesh"):
        renderer.coverage(Body(body.mesh, body.vertices[:-1], body.parts, 1), SKEWED)
