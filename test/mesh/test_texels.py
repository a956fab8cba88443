"""Texels of triangles, against a triangle that is rasterised point by point."""

from __future__ import annotations

import numpy as np

from humansim_ros.mesh.texels import rasterise_uv


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
