"""Contact shadows: their corners enclose all that is dark, and no more than the neighbouring cells."""

from __future__ import annotations

import numpy as np

from humansim_ros.render.contact_shadow import CELLS, ContactShadow


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
