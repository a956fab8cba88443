"""Actions of the face of MakeHuman's base mesh: 52 targets (CC0) with the names of Apple's ARKit."""

from __future__ import annotations

import numpy as np

from humansim_ros.motion.body import ACTIONS
from humansim_ros.people.makehuman.data import METRES, MakeHumanData, VertexIndices
from humansim_ros.types import Array

#: Prefix of the names of actions that turn the eyes. Bones turn the eyeballs, so these shapes move only the
#: lids.
_LOOK = "eyeLook"


def face_offsets(source: MakeHumanData, rows: VertexIndices) -> Array:
    """Offsets (V, 3 S) in metres of the S actions at vertices ``rows`` (V,) of the base mesh, in the A pose.

    Raises MeshError if a target is missing.
    """
    groups = source.base.vertex_groups
    eyes = np.concatenate([groups["helper-l-eye"], groups["helper-r-eye"]])
    place = np.full(len(source.base.vertices), -1)
    place[rows] = np.arange(len(rows))
    offsets = np.zeros((len(rows), len(ACTIONS), 3))
    for number, name in enumerate(ACTIONS):
        moved, steps = source.face_action(name)
        used = place[moved] >= 0
        if name.startswith(_LOOK):
            used &= ~np.isin(moved, eyes)
        offsets[place[moved[used]], number] = METRES * steps[used]
    return offsets.reshape(len(rows), -1)


def unskin_offsets(offsets: Array, weights: Array, motion: Array) -> Array:
    """Convert offsets (V, 3 S) in the A pose to offsets (V, S, 3) in the T pose.

    Args:
        offsets: (V, 3 S) metres.
        weights: (V, B).
        motion: Transforms (B, 4, 4) of the bones, as for ``skeleton.unskin``.
    """
    out = offsets.reshape(len(offsets), -1, 3).copy()
    rows = np.flatnonzero(out.any(axis=(1, 2)))
    back = np.einsum("nb,bij->nij", weights[rows], np.linalg.inv(motion)[:, :3, :3])
    out[rows] = np.swapaxes(np.linalg.solve(back, np.swapaxes(out[rows], 1, 2)), 1, 2)
    return out
