"""The soft shadow that a body leaves on the floor under it (a picture's cue, not a light simulation)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.mesh import Mesh

_CELLS = 64
#: Metres above the floor at which a surface's shadow has faded to 1/e.
_FADE = 0.22
_STRENGTH = 0.62


@dataclass(frozen=True)
class ContactShadow:
    """Darkness on the floor: ``darkness`` (64, 64) uint8, 255 is black, rows along y from ``corner`` (x, y),
    ``side`` metres.
    """

    corner: tuple[float, float]
    side: float
    darkness: NDArray[np.uint8]


def vertex_areas(mesh: Mesh) -> NDArray[np.float32]:
    """(V,) surface area that each vertex stands for at rest, square metres."""
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(mesh.triangles.ravel(), np.repeat(area, 3), len(mesh.vertices)).astype(np.float32)


def contact_shadow(vertices: NDArray[np.float32], areas: NDArray[np.float32]) -> ContactShadow:
    """Shadow of a body (V, 3) on the floor z = 0: its surface seen from below, fading with height, blurred."""
    low, high = vertices[:, :2].min(0) - 0.35, vertices[:, :2].max(0) + 0.35
    side = float((high - low).max())
    cell = side / _CELLS
    x, y = ((vertices[:, :2] - low) / cell).astype(np.intp).T
    amount = areas * np.exp(-np.maximum(vertices[:, 2], 0) / _FADE)
    grid = np.bincount(y * _CELLS + x, amount, _CELLS * _CELLS).reshape(_CELLS, _CELLS)
    # a closed surface covers each cell at least twice, from below and from above
    coverage = np.minimum(grid / (2 * cell * cell), 1.0).astype(np.float32)
    near = cv2.GaussianBlur(coverage, (0, 0), 0.03 / cell)
    wide = cv2.GaussianBlur(coverage, (0, 0), 0.11 / cell)
    darkness = _STRENGTH * np.clip(0.55 * near + 0.9 * wide, 0, 1)
    return ContactShadow((float(low[0]), float(low[1])), side, np.rint(255 * darkness).astype(np.uint8))
