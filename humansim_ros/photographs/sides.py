"""Find views in which a detector has exchanged the left and the right of the person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from humansim_ros.keypoints.sets import KeypointSet
from humansim_ros.photographs.sightlines import Sightlines
from humansim_ros.rotations import unit_vectors
from humansim_ros.types import Array

#: An exchange makes at least this number of points agree, and this share of the paired points of the view.
_POINTS = 2.0
_SHARE = 0.2
#: Divisors of the limits: the noise is not known yet, and seen from the side, left and right are near.
_SCALES = (1, 2, 4)
#: Anatomical points of which the first is in front of the second.
_IN_FRONT = (
    ("nose", "left_ear"),
    ("nose", "right_ear"),
    ("left_big_toe", "left_heel"),
    ("right_big_toe", "right_heel"),
    ("l_foot_ball", "l_ankle"),
    ("r_foot_ball", "r_ankle"),
    ("jugular_notch", "c7"),
    ("left_asis", "left_psis"),
    ("right_asis", "right_psis"),
    ("left_head_front", "left_head_back"),
)
_SHOULDERS = (("l_shoulder", "r_shoulder"), ("left_acromion", "right_acromion"))
_HIPS = (("l_hip", "r_hip"), ("left_asis", "right_asis"))
#: Metres from which the front of the body decides against the majority of the views.
_CERTAIN = 0.1
#: Greatest distance in metres of a point in front from the one behind it.
_FOOT = 0.4


def find_exchanged(
    lines: Sightlines, keypoints: KeypointSet, limits: Array, seed: int = 0
) -> NDArray[np.bool_]:
    """Views (V,) whose left and right are exchanged.

    Left and right of a view are exchanged where more points then agree with those of the other views. If
    that leaves open which views are right, or if all of them agree, the front of the body decides: the nose
    is in front of the ears, the toes are in front of the heels.

    Args:
        lines: Lines of sight of all views.
        keypoints: Set of their points.
        limits: Distances (V,) in pixels from which a point of a view is wrong.
        seed: Seed of the random choice among many pairs of views.
    """
    partners = keypoints.mirrored

    def cost(views: NDArray[np.bool_]) -> tuple[Array, float]:
        found = lines.exchanged(views, partners).candidates(seed)
        costs = np.mean([found.costs(limits / scale) for scale in _SCALES], axis=0)
        return found.supported(costs, limits / 2), float(costs.min(axis=0, initial=len(limits)).sum())

    exchanged = np.zeros(len(lines.cameras), bool)
    # without points whose partner is absent: an exchange must not change which views see a keypoint
    lines = replace(lines, weights=np.where(lines.weights[:, list(partners)] > 0, lines.weights, 0.0))
    paired = np.asarray(partners) != np.arange(len(partners))
    weights = lines.weights[:, paired].sum(axis=1)
    candidates = np.flatnonzero(weights > 0)
    if not len(candidates):
        return exchanged
    positions, present = cost(exchanged)
    while present > _POINTS:
        trials = [exchanged ^ (np.arange(len(exchanged)) == view) for view in candidates]
        results = [cost(trial) for trial in trials]
        best = int(np.argmin([total for _, total in results]))
        if present - results[best][1] < max(_POINTS, _SHARE * weights[candidates[best]]):
            break
        exchanged, (positions, present) = trials[best], results[best]
    side = np.sign(len(candidates) / 2 - exchanged[candidates].sum())
    ahead = front_distance(positions, keypoints)
    if side == 0 or abs(ahead) > _CERTAIN:
        side = np.sign(ahead)
    if side < 0:
        exchanged[candidates] ^= True
    return exchanged


def front_distance(positions: Array, keypoints: KeypointSet) -> float:
    """Metres by which the front of the body is in front of its back, by the names of left and right.

    ``positions``: (K, 3), NaN where unknown. The sum of all distances: negative where left and right are
    exchanged; 0 if the points do not tell, or contradict each other.
    """
    by_point = {
        point: position
        for point, position in zip(keypoints.points, positions, strict=True)
        if np.isfinite(position).all()
    }
    shoulders, hips = (
        next(((by_point[a], by_point[b]) for a, b in options if a in by_point and b in by_point), None)
        for options in (_SHOULDERS, _HIPS)
    )
    steps = [by_point[a] - by_point[b] for a, b in _IN_FRONT if a in by_point and b in by_point]
    if shoulders is None or hips is None:
        return 0.0
    left = shoulders[0] - shoulders[1] + hips[0] - hips[1]
    up = shoulders[0] + shoulders[1] - hips[0] - hips[1]
    front = unit_vectors(np.cross(left, up))
    ahead = [float(step @ front) for step in steps if np.linalg.norm(step) < _FOOT]
    return sum(ahead) if min(ahead, default=0) * max(ahead, default=0) > 0 else 0.0
