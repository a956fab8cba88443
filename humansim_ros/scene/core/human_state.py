"""State of a human at one stamp, and where it stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.geometry import ObjectPose, Velocity, heading_of_hips
from humansim_ros.motion.body import JointPoses, Rated
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


#: Joints from which the heading follows.
HIPS = ("l_hip", "r_hip")


def standing(state: HumanState) -> ObjectPose:
    """Return the place of a person: the point on the floor below the middle of the hips, x ahead of them."""
    left, right = (state.joint_names.index(name) for name in HIPS)
    middle = (state.positions[left] + state.positions[right]) / 2
    across = state.positions[left] - state.positions[right]
    velocity = None
    if state.linear is not None:
        speed = (state.linear[left] + state.linear[right]) / 2
        turning = state.linear[left] - state.linear[right]
        # of the angle of a vector (x, y): (x y' - y x') / (x² + y²)
        length = across[:2] @ across[:2]
        rate = float((across[0] * turning[1] - across[1] * turning[0]) / length) if length > 0 else 0.0
        velocity = Velocity(np.array([*speed[:2], 0.0]), np.array([0.0, 0.0, rate]))
    return ObjectPose.on_floor(middle[0], middle[1], heading_of_hips(across), velocity)


def standing_in(poses: JointPoses, hips: int) -> ObjectPose:
    """As :func:`standing`, of a person with a body that is not computed. ``poses``: joints of the motion at
    one time (N = 1). ``hips``: number of the joint of the hips."""
    x, y, _ = poses.positions[0, hips]
    ahead = scipy.spatial.transform.Rotation.from_quat(poses.rotations[0, hips]).apply([1.0, 0.0, 0.0])
    velocity = None
    if poses.linear is not None and poses.angular is not None:
        change = np.cross(poses.angular[0, hips], ahead)
        flat = max(float(ahead[:2] @ ahead[:2]), 1e-9)  # of somebody who lies on the back
        rate = (ahead[0] * change[1] - ahead[1] * change[0]) / flat
        velocity = Velocity(poses.linear[0, hips] * (1, 1, 0), np.array([0.0, 0.0, rate]))
    return ObjectPose.on_floor(x, y, float(np.arctan2(ahead[1], ahead[0])), velocity)
