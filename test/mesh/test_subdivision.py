"""Triangles that are divided into four: the same surface, in every pose."""

from __future__ import annotations

import numpy as np
import trimesh

from humansim_ros.humans import load_human
from humansim_ros.mesh.texels import subdivide


def test_a_divided_mesh_is_the_same_surface_in_any_pose() -> None:
    mesh = load_human("child").mesh
    finer = subdivide(mesh, 2)
    assert len(finer.mesh.triangles) == 16 * len(mesh.triangles) == len(finer.owner)
    posed = np.random.default_rng(0).normal(size=mesh.vertices.shape)

    def areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        a, b, c = points[triangles].transpose(1, 0, 2)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1)

    for points in (mesh.vertices, posed):
        divided = areas(finer.points(points), finer.mesh.triangles)
        np.testing.assert_allclose(
            np.bincount(finer.owner, divided), areas(points, mesh.triangles), atol=1e-12
        )
    np.testing.assert_allclose(finer.points(mesh.vertices), finer.mesh.vertices)
    assert mesh.uv is not None and finer.mesh.uv is not None
    assert mesh.uv_triangles is not None and finer.mesh.uv_triangles is not None
    flat = [np.pad(uv, ((0, 0), (0, 1))) for uv in (mesh.uv, finer.mesh.uv)]
    divided = areas(flat[1], finer.mesh.uv_triangles)
    np.testing.assert_allclose(
        np.bincount(finer.owner, divided), areas(flat[0], mesh.uv_triangles), atol=1e-12
    )


def test_a_closed_mesh_stays_closed() -> None:
    mesh = load_human("adult_man").mesh
    finer = subdivide(mesh, 1)
    before, after = (
        trimesh.Trimesh(each.vertices, each.triangles, process=False) for each in (mesh, finer.mesh)
    )
    assert before.is_watertight == after.is_watertight
    assert before.euler_number == after.euler_number
    assert subdivide(mesh, 0).mesh.vertices is mesh.vertices
