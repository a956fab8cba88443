"""A skinned mesh as files hold it: surface, joints and weights (data only)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.mesh.mesh import Mesh
from humansim_ros.motion.kinematics import Motion
from humansim_ros.types import Array


@dataclass(frozen=True)
class SkinnedMesh:
    """A skinned figure in the space of its file, as it was bound to its skeleton.

    ``joint_names``: J names. ``parents``: (J,), parents first, -1 for a root. ``joints``: (J, 3).
    ``weights``: (V, J), rows sum to one.
    """

    name: str
    mesh: Mesh
    joint_names: tuple[str, ...]
    parents: NDArray[np.intp]
    joints: Array
    weights: csr_matrix

    def at_rest(self) -> Motion:
        """The skeleton as a motion of one frame in which nothing turns."""
        offsets = self.joints - np.where((self.parents < 0)[:, None], 0.0, self.joints[self.parents])
        none: tuple[tuple[str, ...], ...] = ((),) * len(self.joint_names)
        return Motion(self.joint_names, self.parents, offsets, none, np.zeros((1, 0)), 1.0)
