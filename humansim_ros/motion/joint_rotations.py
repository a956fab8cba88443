"""Joint rotations estimated from joint positions, and joints whose rotations contradict their positions."""

from __future__ import annotations

import numpy as np

from humansim_ros.motion.body_lines import BodyLines
from humansim_ros.motion.bone_drivers import SHORTEST_LINK
from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.motion.joint_poses import JointPoses
from humansim_ros.rotations import (
    WORLD_FROM_BODY,
    angle_between,
    from_y_axis,
    quaternion_to_matrix,
    rotate,
    unit_vectors,
)
from humansim_ros.types import Array

#: Rotations that differ by less than this angle (radians) over joints and time are constant.
_CONSTANT_ANGLE = 1e-6
#: Angles (degrees) between a line and a joint, in the median pose, up to which they rotate together.
_HIPS, _SHOULDERS, _FLEXIBLE = 12.0, 15.0, 25.0
#: Share of the poses in which rigid hips may differ more.
_RIGID_SHARE = 0.1


def has_rotations(poses: JointPoses) -> bool:
    """Whether a source measures joint rotations: not if all are zero or all are the same."""
    rotations = poses.rotations
    if not (np.linalg.norm(rotations, axis=-1) > 0.5).all():
        return False
    cosine = np.abs((rotations * rotations[:1, :1]).sum(-1))
    return bool((cosine < np.cos(_CONSTANT_ANGLE / 2) - 1e-12).any())


def loose_bones(poses: JointPoses, match: JointMatch, standing: bool) -> tuple[str, ...]:
    """Bones whose driving joint does not rotate as the lines between the joints do.

    The rotation of such a joint does not describe the body: for example, that of hips which a neural network
    predicts independently, or of a root that does not move. Rigid hips carry the line between the hip
    joints. Chest and spine carry the line between the shoulders within some degrees, and joints of limbs
    their links.

    Args:
        poses: Joint poses.
        match: Joints that drive bones.
        standing: The rotations count from a rest pose that stands and faces +x.
    """
    roles = match.roles
    back = np.swapaxes(quaternion_to_matrix(poses.rotations), -1, -2)
    lines = BodyLines.of(poses.positions, roles)
    left = np.array([0.0, 1.0, 0.0]) if standing else None

    def deviates(joint: int, line: Array, most: float, rest: Array | None = None, share: float = 0.5) -> bool:
        """Whether a share of lines (N, 3) differs more from their direction at rest, in a joint's axes."""
        known = np.linalg.norm(line, axis=-1) > SHORTEST_LINK
        inside = rotate(back[known, joint], unit_vectors(line[known]))
        if not len(inside):
            return False
        angles = angle_between(inside, inside.mean(0) if rest is None else rest)
        return bool(np.quantile(angles, 1 - share) > np.radians(most))

    joints = set()
    for role, line, most, share in (
        ("Hips", lines.hips, _HIPS, _RIGID_SHARE),
        ("Spine", lines.left, _FLEXIBLE, 0.5),
        ("Chest", lines.shoulders, _SHOULDERS, 0.5),
    ):
        if role in roles and deviates(roles[role], line, most, left, share):
            joints.add(roles[role])
    for side in ("Left", "Right"):
        ankle, toe = roles.get(f"{side}Ankle"), roles.get(f"{side}Toe")
        if ankle is None or toe is None:
            continue
        if deviates(ankle, poses.positions[:, toe] - poses.positions[:, ankle], _FLEXIBLE):
            joints.add(ankle)
    links = {
        bone: (start, poses.positions[:, end] - poses.positions[:, start])
        for bone, (start, end) in match.parallel.items()
    }
    return (
        *(bone for bone, joint in match.difference.items() if joint in joints),
        *(bone for bone, (start, link) in links.items() if deviates(start, link, _FLEXIBLE)),
    )


def line_rotations(poses: JointPoses, match: JointMatch) -> Array:
    """Rotations from rest (N, 4, 3, 3) of pelvis, chest, left foot and right foot, from joint positions.

    The pelvis follows hips and trunk, the chest follows shoulders and trunk, and a foot follows its shin.
    """
    lines = BodyLines.of(poses.positions, match.roles)
    pelvis, chest = (lines.axes(left) @ WORLD_FROM_BODY.T for left in (lines.hips, lines.shoulders))
    feet = []
    for side in ("Left", "Right"):
        knee, ankle = (match.roles.get(f"{side}{part}") for part in ("Knee", "Ankle"))
        if knee is None or ankle is None:
            feet.append(pelvis)
            continue
        # the shortest rotation of the shin from straight down
        shin = poses.positions[:, ankle] - poses.positions[:, knee]
        in_pelvis = unit_vectors(rotate(np.swapaxes(pelvis, -1, -2), -shin))
        up = quaternion_to_matrix(from_y_axis(in_pelvis[:, [1, 2, 0]]))
        feet.append(pelvis @ WORLD_FROM_BODY @ up @ WORLD_FROM_BODY.T)
    return np.stack([pelvis, chest, *feet], axis=1)
