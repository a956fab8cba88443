"""Shirts that span hollows, under and between the breasts, instead of following the skin."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy import sparse

from humansim_ros.humans.makehuman.outline import Outline, around, mean_matrix, neighbours, shrink_onto
from humansim_ros.humans.makehuman.skeleton import Bones
from humansim_ros.humans.makehuman.surface import BodySurface, ramp
from humansim_ros.types import Array

_ROUNDS = 400
#: Depths in metres: cloth follows hollows up to the first, and spans hollows from the second.
_FOLLOWS, _SPANS = 0.022, 0.040


class Trunk(Protocol):
    """Measurements of the trunk."""

    @property
    def bones(self) -> Bones:
        """Bones of the body."""

    @property
    def shoulder_y(self) -> float:
        """Height of the shoulder joints."""

    def above_belt(self, p: Array) -> Array:
        """Signed distance (N,) above the belt."""


def taut_shirt(mesh: BodySurface, trunk: Trunk, vertices: Array) -> Array:
    """Offsets (V, 3) from ``vertices`` (V, 3), this body in the T pose, to a taut shirt.

    Zero for bodies without hollows deeper than ``_FOLLOWS``.
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
    mean = mean_matrix(graph)
    cloth = shrink_onto(vertices, mean, loose, outline, _ROUNDS)

    below, above = around(vertices[rows], axis)[1], around(cloth[rows], axis)[1]
    hollow: Array = np.zeros(len(vertices))
    hollow[rows] = np.maximum(above - outline.at(cloth[rows]), outline.at(vertices[rows]) - below)
    # remove hollows of one vertex
    hollow = _neighbour_maximum(graph, -_neighbour_maximum(graph, -hollow))
    share = ramp(hollow, _FOLLOWS, _SPANS)
    for _ in range(6):  # extend to neighbours
        share = np.maximum(share, 0.97 * _neighbour_maximum(graph, share))
    for _ in range(8):
        share[rows] = 0.5 * share[rows] + 0.5 * (mean @ share)[rows]
    return np.where(loose > 0, share, 0.0)[:, None] * (cloth - vertices)


def _neighbour_maximum(graph: sparse.csr_matrix, values: Array) -> Array:
    """Largest value (V,) of each vertex and its neighbours."""
    largest = values.copy()
    np.maximum.at(largest, np.repeat(np.arange(len(values)), np.diff(graph.indptr)), values[graph.indices])
    return largest
