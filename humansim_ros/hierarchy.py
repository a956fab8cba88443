"""Levels of joint and bone trees, to compute with arrays for each level."""

from __future__ import annotations

import numpy as np

from humansim_ros.types import Indices


def levels(parents: Indices) -> tuple[Indices, ...]:
    """Nodes of a tree by depth, roots first. ``parents``: (N,), parents first, -1 for a root."""
    depth = np.zeros(len(parents), dtype=np.intp)
    for node, parent in enumerate(parents):
        depth[node] = 0 if parent < 0 else depth[parent] + 1
    order = np.argsort(depth, kind="stable")
    return tuple(np.split(order, np.flatnonzero(np.diff(depth[order])) + 1))
