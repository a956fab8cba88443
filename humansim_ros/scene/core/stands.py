"""Where a person is, for programs that know no joints: a point on the floor and a heading."""

from __future__ import annotations

import numpy as np
import scipy

from humansim_ros.geometry import ObjectPose, Velocity, heading_of_hips
from humansim_ros.motion.body import JointPoses
from humansim_ros.scene.core.human_state import HumanState

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
