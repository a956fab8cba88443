"""Trees of joints and bones taken level by level, so that arrays and not single joints are computed with."""

from __future__ import annotations

import numpy as np

from humansim_ros.types import Indices


def levels(parents: Indices) -> tuple[Indices, ...]:
    """Indices of a tree's members by depth, roots first. ``parents``: (N,), parents first, -1 for a root."""
    depth = np.zeros(len(parents), dtype=np.intp)
    for member, parent in enumerate(parents):
        depth[member] = 0 if parent < 0 else depth[parent] + 1
    order = np.argsort(depth, kind="stable")
    return tuple(np.split(order, np.flatnonzero(np.diff(depth[order])) + 1))
