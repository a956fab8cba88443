"""Contact shadows: a dark patch on the floor under a body. It is a visual cue, not a light simulation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

#: Cells along a side of a shadow.
CELLS = 64
#: Metres around the body that the shadow covers.
_MARGIN = 0.35
#: Height in metres at which the shadow of a surface has faded to 1/e.
_FADE = 0.22
#: Height in metres above which a surface has no shadow. It would be 1 % there.
REACH = 1.0
_STRENGTH = 0.62


@dataclass(frozen=True)
class ContactShadow:
    """A shadow on the floor.

    ``corner``: lowest x and y, metres. ``side``: length of a side, metres. ``darkness``: (64, 64) uint8, 255
    is black, rows along y.
    """

    corner: tuple[float, float]
    side: float
    darkness: NDArray[np.uint8]

    @property
    def corners(self) -> NDArray[np.float32]:
        """(4, 3) corners of the square on the floor."""
        (x, y), s = self.corner, self.side
        return np.array([(x, y, 0), (x + s, y, 0), (x, y + s, 0), (x + s, y + s, 0)], dtype=np.float32)


def contact_shadow(points: NDArray[np.float32], areas: NDArray[np.float32]) -> ContactShadow:
    """Compute the shadow of a body on the floor z = 0: its surface from below, faded with height, blurred.

    ``points``: (3, V) points on the surface. ``areas``: (V,) surface area of each, square metres.
    """
    low, high = points[:2].min(axis=1) - _MARGIN, points[:2].max(axis=1) + _MARGIN
    side = float((high - low).max())
    cell = side / CELLS
    below = np.flatnonzero(points[2] < REACH)
    x, y = ((points[:2, below] - low[:, None]) / np.float32(cell)).astype(np.intp)
    amount = areas[below] * np.exp(-np.maximum(points[2, below], 0) / np.float32(_FADE))
    grid = np.bincount(y * CELLS + x, amount, CELLS * CELLS).reshape(CELLS, CELLS)
    # a closed surface covers each cell at least twice
    coverage = np.minimum(grid / (2 * cell * cell), 1.0).astype(np.float32)
    near = cv2.GaussianBlur(coverage, (0, 0), 0.03 / cell)
    wide = cv2.GaussianBlur(coverage, (0, 0), 0.11 / cell)
    darkness = _STRENGTH * np.clip(0.55 * near + 0.9 * wide, 0, 1)
    return ContactShadow((float(low[0]), float(low[1])), side, np.rint(255 * darkness).astype(np.uint8))
