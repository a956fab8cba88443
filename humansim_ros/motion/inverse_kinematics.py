"""Two-bone inverse kinematics of a leg."""

from __future__ import annotations

import numpy as np

from humansim_ros.rotations import rotate, unit_vectors
from humansim_ros.types import Array

#: Largest share of its length to which a leg is straightened, unless it was straighter before.
STRAIGHTEST = 0.9995
#: A leg whose ankle is nearer to the hip than this share of its length is not corrected.
_FOLDED = 0.25


def two_bone(hip: Array, knee: Array, ankle: Array, goal: Array) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) of thigh and shin that bring the ankle to a goal, or as near as the leg reaches.

    The plane in which the leg bends takes the shortest rotation of the line from hip to ankle.

    Args:
        hip: Positions (N, 3).
        knee: Positions (N, 3).
        ankle: Positions (N, 3).
        goal: Target positions of the ankle (N, 3).
    """
    thigh, shin = np.linalg.norm(knee - hip, axis=-1), np.linalg.norm(ankle - knee, axis=-1)
    before, after = unit_vectors(ankle - hip), unit_vectors(goal - hip)
    reach = np.linalg.norm(ankle - hip, axis=-1)
    longest = np.maximum(reach, STRAIGHTEST * (thigh + shin))
    distance = np.clip(np.linalg.norm(goal - hip, axis=-1), 1.001 * np.abs(thigh - shin) + 1e-9, longest)
    bend = _perpendicular(knee - hip, before)
    straight = np.linalg.norm(bend, axis=-1, keepdims=True) < 1e-9
    bend = unit_vectors(np.where(straight, _perpendicular(np.array([1.0, 0.1, 0.0]), before), bend))
    new_bend = rotate(_shortest_rotations(before, after), bend)
    along = (thigh**2 - shin**2 + distance**2) / (2 * distance)
    across = np.sqrt(np.maximum(thigh**2 - along**2, 0.0))
    new_knee = hip + along[:, None] * after + across[:, None] * new_bend
    new_ankle = hip + distance[:, None] * after
    normal, new_normal = (
        np.asarray(np.cross(line, side), dtype=float) for line, side in ((before, bend), (after, new_bend))
    )
    return (
        _bone_frame(new_knee - hip, new_normal) @ np.swapaxes(_bone_frame(knee - hip, normal), -1, -2),
        _bone_frame(new_ankle - new_knee, new_normal)
        @ np.swapaxes(_bone_frame(ankle - knee, normal), -1, -2),
    )


def correction_share(hip: Array, knee: Array, ankle: Array) -> Array:
    """Share (N, 1) of a correction that a leg takes; 0 for a folded leg, whose knee would swing far."""
    leg = np.linalg.norm(knee - hip, axis=-1) + np.linalg.norm(ankle - knee, axis=-1)
    share = (np.linalg.norm(ankle - hip, axis=-1) / leg - _FOLDED) / _FOLDED
    share = np.clip(share, 0.0, 1.0)[:, None]
    return np.asarray(share * share * (3 - 2 * share))


def _perpendicular(vectors: Array, direction: Array) -> Array:
    """Component of vectors (N, 3) perpendicular to unit vectors (N, 3)."""
    return np.asarray(vectors - (vectors * direction).sum(-1, keepdims=True) * direction)


def _shortest_rotations(a: Array, b: Array) -> Array:
    """Shortest rotations (N, 3, 3) from unit vectors a to b (N, 3) that are not opposite."""
    v, c = np.cross(a, b), (a * b).sum(-1)
    skew = np.zeros((len(a), 3, 3))
    skew[:, [2, 0, 1], [1, 2, 0]] = v
    skew[:, [1, 2, 0], [2, 0, 1]] = -v
    return np.asarray(np.eye(3) + skew + skew @ skew / np.maximum(1 + c, 1e-9)[:, None, None])


def _bone_frame(along: Array, normal: Array) -> Array:
    """Rotations (N, 3, 3) with the first axis along a bone and the second on its hinge."""
    x = unit_vectors(along)
    return np.stack([x, normal, np.cross(x, normal)], axis=-1)
