"""Cloth that hangs free: a shirt spans what is under the bust and between the breasts instead of clinging."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy import sparse

from humansim_ros.humans.makehuman.outline import Outline, around, averaging, drawn_taut, neighbours
from humansim_ros.humans.makehuman.skeleton import Bones
from humansim_ros.humans.makehuman.surface import BodySurface, ramp
from humansim_ros.types import Array

_ROUNDS = 400
#: Metres: cloth follows hollows that are less deep, and spans those that are deeper.
_CLINGS, _SPANS = 0.022, 0.040


class Trunk(Protocol):
    """What is asked of a tailor."""

    @property
    def bones(self) -> Bones: ...

    @property
    def shoulder_y(self) -> float: ...

    def above_belt(self, p: Array) -> Array: ...


def hang(mesh: BodySurface, trunk: Trunk, vertices: Array) -> Array:
    """Steps (V, 3) from `vertices` (V, 3), this body in the T pose, to a shirt that is taut over it.

    Exactly zero for bodies without hollows that are deeper than cloth follows.
    """
    bones = [trunk.bones.index(name) for name in ("HumanoidRoot", "sacroiliac", "vl5")]
    on_trunk = (mesh.weights[:, bones].sum(axis=1) > 0.9) & (mesh.part == 0)
    top = trunk.shoulder_y - 0.025
    loose = ramp(trunk.above_belt(vertices), 0.0, 0.06) * ramp(vertices[:, 1], top, top - 0.06)
    loose = np.where(on_trunk, loose, 0.0)
    rows = np.flatnonzero(loose > 0)
    faces = mesh.faces[on_trunk[mesh.faces].all(axis=1)]
    axis = float((vertices[rows, 2].min() + vertices[rows, 2].max()) / 2)
    outline = Outline.of(vertices, faces, axis)
    graph = neighbours(faces, len(vertices))
    mean = averaging(graph)
    cloth = drawn_taut(vertices, mean, loose, outline, _ROUNDS)

    below, above = around(vertices[rows], axis)[1], around(cloth[rows], axis)[1]
    hollow: Array = np.zeros(len(vertices))
    hollow[rows] = np.maximum(above - outline.at(cloth[rows]), outline.at(vertices[rows]) - below)
    # a hollow is more than one vertex
    hollow = _most(graph, -_most(graph, -hollow))
    share = ramp(hollow, _CLINGS, _SPANS)
    for _ in range(6):  # what is taut takes its neighbours along
        share = np.maximum(share, 0.97 * _most(graph, share))
    for _ in range(8):
        share[rows] = 0.5 * share[rows] + 0.5 * (mean @ share)[rows]
    return np.where(loose > 0, share, 0.0)[:, None] * (cloth - vertices)


def _most(graph: sparse.csr_matrix, values: Array) -> Array:
    """(V,) the largest value of a vertex and its neighbours."""
    most = values.copy()
    np.maximum.at(most, np.repeat(np.arange(len(values)), np.diff(graph.indptr)), values[graph.indices])
    return most
