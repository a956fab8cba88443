"""Joint rotations estimated from joint positions, for sources that send positions only."""

from __future__ import annotations

import numpy as np

from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.motion.joint_poses import JointPoses
from humansim_ros.rotations import from_y_axis, quaternion_to_matrix, rotate, unit_vectors
from humansim_ros.types import Array

#: Rotations that differ by less than this angle (radians) over joints and time are constant.
_CONSTANT_ANGLE = 1e-6


def has_rotations(poses: JointPoses) -> bool:
    """Whether a source measures joint rotations: not if all are zero or all are the same."""
    rotations = poses.rotations
    if not (np.linalg.norm(rotations, axis=-1) > 0.5).all():
        return False
    cosine = np.abs((rotations * rotations[:1, :1]).sum(-1))
    return bool((cosine < np.cos(_CONSTANT_ANGLE / 2) - 1e-12).any())


def rotations_from_positions(poses: JointPoses, match: JointMatch) -> Array:
    """Joint rotations (N, J, 3, 3) from rest: joints of the trunk follow the shoulders, others the hips.

    Feet follow their shins.
    """
    roles, points = match.roles, poses.positions

    def at(role: str) -> Array:
        return points[:, roles[role]]

    hips = (at("LeftHip") + at("RightHip")) / 2
    top = next((role for role in ("Neck", "Head", "LeftShoulder") if role in roles), "Hips")
    has_shoulders = {"LeftShoulder", "RightShoulder"} <= {*roles}
    chest = (at("LeftShoulder") + at("RightShoulder")) / 2 if has_shoulders else at(top)
    pelvis = _body_rotation(at("LeftHip") - at("RightHip"), chest - hips)
    rotations = np.repeat(pelvis[:, None], points.shape[1], axis=1)
    if has_shoulders:
        trunk = _body_rotation(at("LeftShoulder") - at("RightShoulder"), chest - hips)
        for bone, joint in match.difference.items():
            if bone in ("vl5", "vt3") or "sternoclavicular" in bone:
                rotations[:, joint] = trunk
    # a foot takes the shortest rotation of its shin from straight down
    for side, bone in (("Left", "l_ankle"), ("Right", "r_ankle")):
        if bone in match.difference and {f"{side}Knee", f"{side}Ankle"} <= {*roles}:
            shin = at(f"{side}Ankle") - at(f"{side}Knee")
            in_pelvis = unit_vectors(rotate(np.swapaxes(pelvis, -1, -2), -shin))
            up = quaternion_to_matrix(from_y_axis(in_pelvis[:, [1, 2, 0]]))
            order = np.eye(3)[[1, 2, 0]]
            rotations[:, match.difference[bone]] = pelvis @ order.T @ up @ order
    return rotations


def _body_rotation(left: Array, up: Array) -> Array:
    """Rotations (N, 3, 3) of a body (x forward, y left, z up) with left and nearly up along these (N, 3)."""
    y = unit_vectors(left)
    x = unit_vectors(np.cross(y, up))
    return np.stack([x, y, np.cross(x, y)], axis=-1)
