"""Contact shadows: their corners enclose all that is dark, and no more than the neighbouring cells."""

from __future__ import annotations

import numpy as np
import pytest
from render_scenes import quad, renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import Body, RendererName
from humansim_ros.render.device.mesh_buffers import CELLS, ContactShadow


def test_corners_enclose_the_dark_cells_as_they_are_interpolated() -> None:
    darkness = np.zeros((CELLS, CELLS), np.uint8)
    darkness[10:13, 40] = 200  # rows along y
    shadow = ContactShadow((1.0, -2.0), 6.4, darkness)
    # cells of 0.1 m, whose centers are at 0.05 m; a cell reaches to the centers beside it
    low, high = shadow.corners.min(axis=0), shadow.corners.max(axis=0)
    np.testing.assert_allclose(low[:2], [1 + 3.95, -2 + 0.95], atol=1e-5)
    np.testing.assert_allclose(high[:2], [1 + 4.15, -2 + 1.35], atol=1e-5)
    darkness[0, 0] = darkness[-1, -1] = 1
    whole = ContactShadow((1.0, -2.0), 6.4, darkness).corners
    np.testing.assert_allclose(whole.min(axis=0)[:2], [1.0, -2.0], atol=1e-5)
    np.testing.assert_allclose(whole.max(axis=0)[:2], [7.4, 4.4], atol=1e-5)


def test_a_square_without_shadow_has_no_size_in_the_image() -> None:
    corners = ContactShadow((0.0, 0.0), 1.0, np.zeros((CELLS, CELLS), np.uint8)).corners
    assert np.ptp(corners, axis=0).max() < 1 / CELLS


@pytest.mark.nightly
def test_both_renderers_draw_the_shadow_at_the_same_place() -> None:
    """Of a long box; from above, beside the box."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh = Mesh(signs * (0.5, 0.1, 0.05) + (0.3, -0.2, 0.06), np.array(faces, np.int32))
    parts = np.zeros(len(mesh.triangles), np.uint8)
    body = Body(mesh, mesh.vertices.astype(np.float32), parts, 0, "object")
    floor = quad([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)])
    camera = Camera.look_at((0.3, -0.2, 2.5), (0.3, -0.2, 0), (160, 120), 1.0, up=(0, 1, 0))

    def shadow(name: RendererName) -> np.ndarray:
        with renderer_or_skip([floor], name=name) as renderer:
            empty, view = (renderer.render(bodies, camera, ("rgb", "depth")) for bodies in ([], [body]))
        darker = empty.rgb[..., 1].astype(float) - view.rgb[..., 1]
        return np.where(view.depth > 2.49, darker, 0.0)  # on the floor

    own, other = shadow("moderngl"), shadow("pyrender")
    assert own.max() > 20
    assert np.corrcoef(own.ravel(), other.ravel())[0, 1] > 0.98
