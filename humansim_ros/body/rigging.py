"""Automatic rigging: which bones a vertex follows (thesis S3, chapter 5)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.body.heat import heat_weights
from humansim_ros.body.mesh import Mesh
from humansim_ros.body.skeleton import Skeleton, side_of
from humansim_ros.errors import MeshError
from humansim_ros.rotations import Array, angle_between

RigRule = Literal["heat", "thesis", "thesis-printed"]


def rig(mesh: Mesh, skeleton: Skeleton, rule: RigRule = "heat") -> csr_matrix:
    """Skinning weights (V, B) of a mesh that stands in the skeleton's rest pose; rows sum to one.

    A vertex goes to the bone that it sees under the largest angle head-vertex-tail; bones on the other side
    of the body do not count; near the bone's head it is shared with the parent. The share is where the thesis
    disagrees with itself. Its pseudo-code gives the bone ``angle / 60`` of the vertex, with the angle between
    (vertex - head) and (tail - head): zero for a vertex out along the bone, so that finger tips would follow
    the forearm. Its text says the opposite ("the weight factor is decreased for vertices with larger angle"),
    and its figures agree with the text.

    ``rule``: ``thesis`` follows the text: weight ``min(1, 60 / angle)``; ``thesis-printed`` the pseudo-code
    to the letter; ``heat`` is another way altogether (:func:`humansim_ros.body.heat.heat_weights`). Raises
    MeshError if the skeleton has no bone for a side of the mesh.
    """
    if rule == "heat":
        return heat_weights(mesh, skeleton)
    vertices = mesh.vertices
    angles = _angle_seen(vertices, skeleton)
    sides = np.array([side_of(name) for name in skeleton.names])
    other_side = sides[None, :] * np.sign(vertices[:, :1]) < 0
    angles[other_side] = -1.0
    best = np.argmax(angles, axis=1)
    if (angles[np.arange(len(vertices)), best] < 0).any():
        raise MeshError("the skeleton has no bone on one side of the mesh")

    head, tail = skeleton.heads[best], skeleton.tails[best]
    angle = np.degrees(angle_between(vertices - head, tail - head))
    weight = np.minimum(1.0, angle / 60.0 if rule == "thesis-printed" else 60.0 / np.maximum(angle, 1e-9))
    parent = skeleton.parents[best]
    weight = np.where(parent < 0, 1.0, weight)
    rows = np.arange(len(vertices))
    data = np.concatenate([weight, 1.0 - weight])
    columns = np.concatenate([best, np.maximum(parent, 0)])
    shape = (len(vertices), len(skeleton))
    weights = csr_matrix((data, (np.concatenate([rows, rows]), columns)), shape=shape)
    weights.eliminate_zeros()
    return weights


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
