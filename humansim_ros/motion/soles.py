"""Positions of toes and heels of the posed skeleton."""

from __future__ import annotations

import numpy as np

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.types import Array

#: Distance of the heel behind the ankle, metres.
_HEEL = 0.04


def sole_points(skeleton: Skeleton, posed: Array) -> Array:
    """World positions (..., 2, 2, 3) of toe and heel of the left and the right foot; at rest at height 0."""
    points = []
    for name in ("l_ankle", "r_ankle"):
        bone = skeleton.bone(name)
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        for point in ((tail[0], 0.0, tail[2]), (head[0], 0.0, head[2] - _HEEL)):
            offset = skeleton.rest_inverse[bone] @ np.array([*point, 1.0])
            points.append((posed[..., bone, :, :] @ offset)[..., :3])
    stacked = np.stack(points, axis=-2)
    return stacked.reshape(*stacked.shape[:-2], 2, 2, 3)


def sole_heights(skeleton: Skeleton, posed: Array) -> Array:
    """World heights (..., 4) of toes and heels of both feet."""
    heights = sole_points(skeleton, posed)[..., 2]
    return heights.reshape(*heights.shape[:-2], 4)
