"""Automatic rigging: which bones a vertex follows (thesis S3, chapter 5)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.body.heat_weights import heat_weights
from humansim_ros.body.skeleton import Skeleton, side_of
from humansim_ros.errors import MeshError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.rotations import angle_between
from humansim_ros.types import Array

RigRule = Literal["heat", "thesis", "thesis-printed"]
#: Vertices whose angles to all bones are computed at once.
_BLOCK = 16_384


def rig(mesh: Mesh, skeleton: Skeleton, rule: RigRule = "heat") -> csr_matrix:
    """Skinning weights (V, B) of a mesh that stands in the skeleton's rest pose; rows sum to one.

    ``rule``: ``heat`` lets warmth of the bones spread over the skin, smoothly, over at most four bones
    (:mod:`humansim_ros.body.heat_weights`). ``thesis``: a vertex goes to the bone that it sees under
    the largest angle head-vertex-tail; bones on the other side of the body do not count; near the bone's head
    it is shared with the parent. The share is where the thesis disagrees with itself. Its pseudo-code gives
    the bone ``angle / 60`` of the vertex, with the angle between (vertex - head) and (tail - head): zero for
    a vertex out along the bone, so that finger tips would follow the forearm. Its text says the opposite
    ("the weight factor is decreased for vertices with larger angle"), and its figures agree with the text:
    ``thesis`` gives ``min(1, 60 / angle)``, and ``thesis-printed`` follows the pseudo-code to the letter.

    Raises MeshError if the skeleton has no bone for a side of the mesh, or for ``heat`` no human's bones.
    """
    if rule == "heat":
        return heat_weights(mesh, skeleton)
    blocks = [
        _by_angle(mesh.vertices[start : start + _BLOCK], skeleton, rule == "thesis-printed")
        for start in range(0, len(mesh.vertices), _BLOCK)
    ]
    best, weight = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    parent = skeleton.parents[best]
    weight = np.where(parent < 0, 1.0, weight)
    rows = np.arange(len(best))
    data = np.concatenate([weight, 1.0 - weight])
    columns = np.concatenate([best, np.maximum(parent, 0)])
    shape = (len(best), len(skeleton))
    weights = csr_matrix((data, (np.concatenate([rows, rows]), columns)), shape=shape)
    weights.eliminate_zeros()
    return weights


def _by_angle(vertices: Array, skeleton: Skeleton, printed: bool) -> tuple[NDArray[np.intp], Array]:
    """The bone (V,) that each vertex sees under the largest angle, and its weight (V,)."""
    angles = _angle_seen(vertices, skeleton)
    sides = np.array([side_of(name) for name in skeleton.names])
    angles[sides[None, :] * np.sign(vertices[:, :1]) < 0] = -1.0
    best = np.argmax(angles, axis=1)
    if (angles[np.arange(len(vertices)), best] < 0).any():
        raise MeshError("the skeleton has no bone on one side of the mesh")
    head, tail = skeleton.heads[best], skeleton.tails[best]
    angle = np.degrees(angle_between(vertices - head, tail - head))
    return best, np.minimum(1.0, angle / 60.0 if printed else 60.0 / np.maximum(angle, 1e-9))


def dominant_bones(weights: csr_matrix) -> NDArray[np.intp]:
    """(V,) the bone each vertex follows most."""
    return np.asarray(weights.argmax(axis=1)).ravel().astype(np.intp)


def triangle_parts(triangles: NDArray[np.integer], weights: csr_matrix) -> NDArray[np.uint8]:
    """(N,) the bone each triangle follows most, by the sum of its corners' weights: its body part label less
    one.
    """
    total = weights[triangles[:, 0]] + weights[triangles[:, 1]] + weights[triangles[:, 2]]
    return np.asarray(total.argmax(axis=1)).ravel().astype(np.uint8)


def _angle_seen(vertices: Array, skeleton: Skeleton) -> Array:
    """(V, B) angle head-vertex-tail at the vertex, radians."""
    to_head = skeleton.heads[None] - vertices[:, None]
    to_tail = skeleton.tails[None] - vertices[:, None]
    return angle_between(to_head, to_tail)
