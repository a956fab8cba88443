"""Bodies whose vertices we know: MakeHuman's, whatever their shape, size and pose."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.landmarks import joint_file
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array


def known_joints(mesh: Mesh) -> dict[str, Array] | None:
    """Joint centres (3,) in the mesh's own space, by the bone whose head they are, and ``<bone>_end`` of the
    leaves; None if the mesh is no MakeHuman body.

    It is one if its first 13380 vertices are joined by MakeHuman's faces (eyes, clothes and helpers may
    follow). Each joint is a combination of skin vertices around it that holds for any shape and any pose of
    the arms and legs (tools/assets/fit_joint_places.py).
    """
    known: dict[str, Any] = joint_file()["makehuman"]
    count: int = known["vertices"]
    if len(mesh.vertices) < count:
        return None
    own = mesh.faces[(mesh.faces < count).all(axis=1)]
    if len(own) != known["quads"] or own.min() < 0 or topology(own) != known["faces"]:
        return None
    return {
        name: np.asarray(ring["shares"]) @ mesh.vertices[ring["vertices"]] / sum(ring["shares"])
        for name, ring in known["joints"].items()
    }


def topology(faces: NDArray[np.integer]) -> str:
    """Digest of quads (F, 4), whichever comes first and wherever each begins."""
    start = np.argmin(faces, axis=1)
    order = (start[:, None] + np.arange(4)) % 4
    turned = np.take_along_axis(faces, order, axis=1).astype("<i4")
    turned = turned[np.lexsort(turned.T[::-1])]
    return hashlib.sha256(np.ascontiguousarray(turned).tobytes()).hexdigest()
