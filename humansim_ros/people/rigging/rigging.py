"""Automatic rigging: skinning weights from a mesh and a skeleton [thesis §5]."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import angle_between
from humansim_ros.motion.body import Skeleton, side_of
from humansim_ros.people.rigging.heat_weights import heat_weights
from humansim_ros.types import Array

RigRule = Literal["heat", "thesis", "thesis-printed"]
#: Vertices per block of dense matrices of angles.
_BLOCK = 16_384


def rig(mesh: Mesh, skeleton: Skeleton, rule: RigRule = "heat") -> csr_matrix:
    """Compute skinning weights (V, B) of a mesh in the rest pose of a skeleton. Rows sum to one.

    ``rule``:

    - ``heat``: smooth weights of at most four bones (:mod:`humansim_ros.people.rigging.heat_weights`).
    - ``thesis``: a vertex belongs to the bone with the largest angle head-vertex-tail. Bones of the other
      side of the body do not count. Near the head of the bone it is shared with the parent: the weight of the
      bone is ``min(1, 60 / angle)``, where ``angle`` is between (vertex - head) and (tail - head) in degrees.
    - ``thesis-printed``: the same with ``angle / 60``, as the pseudo-code of [thesis §5] has it. It is zero
      for vertices beyond the tail, so that finger tips would follow the forearm. Text and figures of the
      thesis contradict the pseudo-code ("the weight factor is decreased for vertices with larger angle").

    Raises:
        MeshError: The skeleton has no bone on a side of the mesh, or (for ``heat``) lacks bones of a human.

    Example:
        >>> from humansim_ros import load_human
        >>> from humansim_ros.files.reading.assets import resource_path
        >>> child = load_human(resource_path("assets/humans/child.npz"))
        >>> weights = rig(child.mesh, child.skeleton, "thesis")
        >>> weights.shape == (len(child.mesh.vertices), 57)
        True
    """
    general = np.flatnonzero(skeleton.wholes == np.arange(len(skeleton)))
    if len(general) < len(skeleton):
        weights = rig(mesh, skeleton.part(general), rule)
        return csr_matrix(
            (weights.data, general[weights.indices], weights.indptr), (len(mesh.vertices), len(skeleton))
        )
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
    """Bone (V,) with the largest angle head-vertex-tail, and its weight (V,)."""
    angles = _viewing_angles(vertices, skeleton)
    sides = np.array([side_of(name) for name in skeleton.names])
    angles[sides[None, :] * np.sign(vertices[:, :1]) < 0] = -1.0
    best = np.argmax(angles, axis=1)
    if (angles[np.arange(len(vertices)), best] < 0).any():
        raise MeshError("the skeleton has no bone on one side of the mesh")
    head, tail = skeleton.heads[best], skeleton.tails[best]
    angle = np.degrees(angle_between(vertices - head, tail - head))
    return best, np.minimum(1.0, angle / 60.0 if printed else 60.0 / np.maximum(angle, 1e-9))


def _viewing_angles(vertices: Array, skeleton: Skeleton) -> Array:
    """Angles (V, B) head-vertex-tail at the vertices, radians."""
    to_head = skeleton.heads[None] - vertices[:, None]
    to_tail = skeleton.tails[None] - vertices[:, None]
    return angle_between(to_head, to_tail)
