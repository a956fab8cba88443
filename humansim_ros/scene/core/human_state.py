"""State of a human at one stamp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from humansim_ros.motion.body import Rated
from humansim_ros.scene.truth.upright_boxes import UprightBox, upright_box
from humansim_ros.types import Array


@dataclass(frozen=True, repr=False)
class HumanState:
    """State of a human at one stamp, in ``map``, metres.

    Attributes:
        joint_names: J names.
        joints: (J, 4, 4) poses with the axes of the bones (y along the bone).
        linear: (J, 3) velocities in m/s; None if the motion has none.
        angular: (J, 3) angular velocities in rad/s; None if the motion has none.
        vertices: (V, 3) float32 in the order of the mesh.
        size: Scale of the body by keyframes.
        rotations: (J, 4) quaternions xyzw that the rotations of ``joints`` are computed from, as messages
            carry them.
        features: Values next to the joints by name: weights (52,) of a ``face``, offsets (K, 3) of a
            ``swing``. A human without such a feature has no value of it.
    """

    joint_names: tuple[str, ...]
    joints: Array
    linear: Array | None
    angular: Array | None
    vertices: NDArray[np.float32]
    size: float = 1.0
    rotations: Array = field(kw_only=True)
    features: Mapping[str, Rated] = field(default_factory=dict, kw_only=True)

    def __repr__(self) -> str:
        return f"HumanState({len(self.joint_names)} joints, {len(self.vertices)} vertices)"

    @property
    def face(self) -> Rated | None:
        """Weights of the actions of the face; None for a stiff face."""
        return self.features.get("face")

    @property
    def swing(self) -> Rated | None:
        """Swing of loose cloth and hair, metres; None without."""
        return self.features.get("swing")

    @property
    def positions(self) -> Array:
        """(J, 3) joint positions."""
        return self.joints[:, :3, 3]

    @property
    def speed(self) -> float:
        """Speed of the left hip on the floor, m/s; NaN if the motion has no velocities."""
        if self.linear is None:
            return float("nan")
        return float(np.hypot(*self.linear[self.joint_names.index("l_hip"), :2]))

    @property
    def upright_box(self) -> UprightBox:
        """Upright box along the direction that the hips face."""
        return upright_box(self.vertices, self.joint_names, self.positions)
