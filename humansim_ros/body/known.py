"""Joints of MakeHuman bodies, recognised by their topology."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.landmarks import joint_file
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array

#: Number of vertices of the skin of MakeHuman's base mesh; eyes, clothes and helpers follow.
SKIN_VERTICES = 13380


def known_joints(mesh: Mesh) -> dict[str, Array] | None:
    """Joint centres (3,) in the space of the mesh, or None if the mesh is not a MakeHuman body.

    Keys are the bone whose head the joint is, and ``<bone>_end`` for leaves. A mesh is a MakeHuman body if
    its first 13380 vertices have the faces of MakeHuman (eyes, clothes and helpers may follow). Each joint is
    a weighted mean of skin vertices around it, valid for every shape and every pose of the limbs
    (tools/assets/fit_joint_places.py).
    """
    if not is_makehuman(mesh):
        return None
    table: dict[str, Any] = joint_file()["makehuman"]
    return {
        name: np.asarray(ring["shares"]) @ mesh.vertices[ring["vertices"]] / sum(ring["shares"])
        for name, ring in table["joints"].items()
    }


def is_makehuman(mesh: Mesh) -> bool:
    """Whether the first vertices and their faces are those of MakeHuman's skin."""
    table: dict[str, Any] = joint_file()["makehuman"]
    if len(mesh.vertices) < SKIN_VERTICES:
        return False
    body = mesh.faces[(mesh.faces < SKIN_VERTICES).all(axis=1)]
    return bool(len(body) == table["quads"] and body.min() >= 0 and topology(body) == table["faces"])


def topology(faces: NDArray[np.integer]) -> str:
    """Digest of quads (F, 4), independent of their order and of their first corners."""
    start = np.argmin(faces, axis=1)
    order = (start[:, None] + np.arange(4)) % 4
    turned = np.take_along_axis(faces, order, axis=1).astype("<i4")
    turned = turned[np.lexsort(turned.T[::-1])]
    return hashlib.sha256(np.ascontiguousarray(turned).tobytes()).hexdigest()
