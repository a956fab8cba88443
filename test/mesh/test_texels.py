"""Texels of triangles, against a triangle that is rasterised point by point; divided triangles."""

from __future__ import annotations

import numpy as np
import trimesh

from humansim_ros.files.mesh.normals import rasterise_uv, subdivide
from humansim_ros.people import load_human


def test_each_texel_has_the_triangle_at_its_centre() -> None:
    rng = np.random.default_rng(3)
    uv, triangles = rng.uniform(-0.1, 1.1, (60, 2)), rng.integers(0, 60, (40, 3))
    size = 32
    found = rasterise_uv(uv, triangles, size)
    owner = np.full((size, size), -1)
    owner[found.row, found.column] = found.triangle
    for row in range(size):
        for column in range(size):
            point = np.array([(column + 0.5) / size, 1 - (row + 0.5) / size])
            inside = -1
            for number, (a, b, c) in enumerate(uv[triangles]):
                edges = np.column_stack([b - a, c - a])
                if abs(np.linalg.det(edges)) > 1e-12:
                    s, t = np.linalg.solve(edges, point - a)
                    inside = number if min(s, t, 1 - s - t) >= 0 else inside
            assert owner[row, column] == inside
    places = found.mix(uv, triangles)
    np.testing.assert_allclose(places[:, 0], (found.column + 0.5) / size, atol=1e-9)
    np.testing.assert_allclose(places[:, 1], 1 - (found.row + 0.5) / size, atol=1e-9)
    assert len(rasterise_uv(uv, triangles[:0], size).row) == 0


def test_a_divided_mesh_is_the_same_surface_in_any_pose() -> None:
    mesh = load_human("child").mesh
    posed = np.random.default_rng(0).normal(size=mesh.vertices.shape)
    finer, (divided_pose,), owner = subdivide(mesh, [posed], 2)
    assert len(finer.triangles) == 16 * len(mesh.triangles) == len(owner)

    def areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        a, b, c = points[triangles].transpose(1, 0, 2)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1)

    for points, fine in ((mesh.vertices, finer.vertices), (posed, divided_pose)):
        divided = areas(fine, finer.triangles)
        np.testing.assert_allclose(np.bincount(owner, divided), areas(points, mesh.triangles), atol=1e-12)
    assert mesh.uv is not None and finer.uv is not None
    assert mesh.uv_triangles is not None and finer.uv_triangles is not None
    flat = [np.pad(uv, ((0, 0), (0, 1))) for uv in (mesh.uv, finer.uv)]
    divided = areas(flat[1], finer.uv_triangles)
    np.testing.assert_allclose(np.bincount(owner, divided), areas(flat[0], mesh.uv_triangles), atol=1e-12)


def test_a_closed_mesh_stays_closed() -> None:
    mesh = load_human("adult_man").mesh
    finer, _, _ = subdivide(mesh, [], 1)
    before, after = (trimesh.Trimesh(each.vertices, each.triangles, process=False) for each in (mesh, finer))
    assert before.is_watertight == after.is_watertight
    assert before.euler_number == after.euler_number
    assert subdivide(mesh, [], 0)[0].vertices is mesh.vertices
