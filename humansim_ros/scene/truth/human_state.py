"""State of a human at one stamp, the place where it stands, and its upright box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from humansim_ros.geometry import ObjectPose, Velocity, heading_of_hips, turn_about_z
from humansim_ros.motion.body import Rated
from humansim_ros.types import Array, Float32Array

#: Joints from which the heading follows.
HIPS = ("l_hip", "r_hip")


@dataclass(frozen=True)
class UprightBox:
    """An upright box, as benchmarks of 3D detection use it: its height is along z of ``map``.

    Attributes:
        center: Centre (3,) in ``map``, metres.
        size: Length from back to front, width from side to side, and height (3,), metres.
        yaw: Angle of the direction ahead, radians from x to y.
    """

    center: Array
    size: Array
    yaw: float

    @property
    def bottom(self) -> Array:
        """Middle (3,) of the lower side in ``map``, metres."""
        return self.center - (0.0, 0.0, self.size[2] / 2)

    @property
    def quaternion(self) -> Array:
        """Rotation (4,) xyzw from the axes of the box (ahead, left, up) to ``map``."""
        return turn_about_z(self.yaw)


def upright_box(vertices: Array | Float32Array, joint_names: Sequence[str], positions: Array) -> UprightBox:
    """Compute the smallest upright box of a body that is aligned with the direction that the hips face.
    ``vertices``: (V, 3) in ``map``, metres. ``joint_names``: names of J joints, with ``l_hip`` and ``r_hip``.
    ``positions``: (J, 3) of the joints in ``map``, metres."""
    left, right = (positions[joint_names.index(name)] for name in HIPS)
    yaw = heading_of_hips(left - right)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    turned = vertices @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    return UprightBox(turn.T @ ((low + high) / 2), high - low, yaw)


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
