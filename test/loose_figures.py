"""A human with loose parts, for tests: it is made of a built-in one in no time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from conftest import ROOT

from humansim_ros import Human, load_human
from humansim_ros.motion.body.offsets import CLOTH, HAIR, LooseParts


@cache
def loose_child() -> Human:
    """The child with a strip of its trousers, and of its hair, that swing."""
    child = load_human(ROOT / "assets" / "humans" / "child.npz")
    points, rows = child.mesh.vertices, []
    for low, high, side in ((0.30, 0.60, 1), (1.12, 1.26, -1)):
        strip = (points[:, 1] > low) & (points[:, 1] < high) & (side * points[:, 2] > 0.03)
        rows.append(np.flatnonzero(strip & (np.abs(points[:, 0]) < 0.12)))
    ends = np.array([(part[points[part, 1].argmax()], part[points[part, 1].argmin()]) for part in rows])
    both = np.concatenate(rows)
    nodes = np.repeat([0, 1], [len(part) for part in rows])
    down = np.concatenate(
        [np.ptp(points[part, 1]) - points[part, 1] + points[part, 1].min() for part in rows]
    )
    shares = np.stack([down / down.max(), 0 * down], axis=1).astype(np.float32)
    gather = np.zeros((len(both), 3), np.float32)
    gather[nodes == 0, 2] = -0.02
    loose = LooseParts(
        np.array([CLOTH, HAIR], np.uint8),
        ends.astype(np.int32),
        np.array([(0, 0, 1), (0, 0, -1)], np.float32),
        both.astype(np.int32),
        np.stack([nodes, nodes], axis=1).astype(np.int32),
        *(shares, gather, (points[both, 0] > 0).astype(np.float32)),
    )
    return replace(child, loose=loose)
