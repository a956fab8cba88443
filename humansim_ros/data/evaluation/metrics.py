"""Errors of poses and of the detection of people, as publications report them.

Most functions take the true and the estimated poses of M matches: (M, C, 3) for C joints, metres, NaN for an
absent joint. docs/evaluation.md defines each metric and names its source.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.evaluation.joint_names import LimbEnd
from humansim_ros.geometry import fit_similarity
from humansim_ros.types import Array, Indices

#: Thresholds of the AUC [Mehta 2017]: 0 to 150 mm in steps of 5 mm.
AUC_THRESHOLDS: Array = np.linspace(0.0, 0.15, 31)
#: Smallest number of joints that a similarity can be fitted to.
_LEAST_JOINTS = 3


def joint_errors(truth: Array, estimate: Array) -> Array:
    """Distances (M, C) between true and estimated joints (M, C, 3). NaN where either joint is absent."""
    return np.linalg.norm(estimate - truth, axis=2)


def mean_error(errors: Array) -> float | None:
    """MPJPE: mean of all errors that are not NaN; None if there are none."""
    found = np.isfinite(errors)
    return float(errors[found].mean()) if found.any() else None


def procrustes_aligned(truth: Array, estimate: Array) -> Array:
    """Estimated poses (M, C, 3), each moved, rotated and scaled so that it fits the true pose best, without
    reflections. The fit has least squares over the joints that both poses have [Umeyama 1991]. NaN where both
    poses have fewer than three common joints."""
    both = np.asarray(np.isfinite(truth + estimate).all(axis=2))
    enough = both.sum(axis=1) >= _LEAST_JOINTS
    known = both[enough, :, None]
    own, goal = (np.where(known, poses[enough], 0.0) for poses in (estimate, truth))
    scale, rotation, translation = fit_similarity(own, goal, known[..., 0])
    aligned = np.full_like(estimate, np.nan)
    turned = estimate[enough] @ np.swapaxes(rotation, 1, 2)
    aligned[enough] = scale[:, None, None] * turned + translation[:, None]
    return aligned


def pck(errors: Array, threshold: float, missing: int = 0) -> float | None:
    """Percentage of correct keypoints, as a share: errors up to a threshold among all joints of the truth.

    Args:
        errors: Distances of joints, metres. NaN where the truth lacks the joint, inf where only the estimate
            lacks the joint.
        threshold: Largest error of a correct joint, metres.
        missing: Number of joints of people who were not found. They count as wrong.
    """
    total = int((~np.isnan(errors)).sum()) + missing
    return float((errors <= threshold).sum()) / total if total else None


def auc(errors: Array, missing: int = 0) -> float | None:
    """Area under the curve of PCK over :data:`AUC_THRESHOLDS`, as a share."""
    shares = [share for t in AUC_THRESHOLDS if (share := pck(errors, float(t), missing)) is not None]
    return float(np.mean(shares)) if shares else None


def correct_parts(
    truth: Array, estimate: Array, limbs: Sequence[tuple[LimbEnd, LimbEnd]]
) -> NDArray[np.int8]:
    """Whether each limb of each pose (M, L) counts as correct for PCP: 1 correct, 0 wrong, -1 not in the
    truth.

    A limb is correct if the mean distance of its ends is at most half its length [Belagiannis 2014].

    Args:
        truth: (M, C, 3) metres.
        estimate: (M, C, 3) metres.
        limbs: Joints at the ends of L limbs.
    """

    def ends_of(poses: Array) -> Array:
        ends = [poses[:, list(joints)].mean(axis=1) for limb in limbs for joints in limb]
        return np.array(ends).reshape(len(limbs), 2, len(poses), 3)

    ends = ends_of(truth)
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=2)
    error = np.linalg.norm(ends_of(estimate) - ends, axis=3).mean(axis=1)
    with np.errstate(invalid="ignore"):
        correct = error <= 0.5 * length
    return np.where(np.isnan(length), -1, correct).astype(np.int8).T


@dataclass(frozen=True)
class Detections:
    """All estimated people of all frames, for the average precision of Panoptic.

    Attributes:
        scores: (N,) confidence of each estimated person. If the estimate has no scores, its order counts.
        distances: (N,) mean joint distance to the nearest person of the truth. inf if there is none.
        nearest: (N,) number of this nearest person. Numbers are unique over all frames.
        total: Number of people in the truth of all frames.
    """

    scores: Array
    distances: Array
    nearest: Indices
    total: int

    def _hits(self, threshold: float) -> NDArray[np.bool_]:
        """Sort detections by falling score. Returns whether each is the first within the threshold for its
        person."""
        order = np.argsort(-self.scores, kind="stable")
        near = self.distances[order] < threshold
        hits = np.zeros(len(order), dtype=bool)
        # np.unique gives the first place of each person among the detections that are near enough
        _, first = np.unique(self.nearest[order][near], return_index=True)
        hits[np.flatnonzero(near)[first]] = True
        return hits

    def average_precision(self, threshold: float) -> float | None:
        """Average precision (AP) for a distance threshold in metres, as in VoxelPose [Tu 2020]; None without
        people.

        Detections are sorted by score. A detection is correct if it is nearer to its person than the
        threshold, and the first one for this person. AP is the area below the curve of precision over recall,
        smoothed so that it never rises.
        """
        if not self.total:
            return None
        hits = self._hits(threshold)
        found = np.cumsum(hits)
        precision = found / np.arange(1, len(hits) + 1)
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        return float(envelope[hits].sum() / self.total)

    def recall(self, threshold: float) -> float | None:
        """Share of people with an estimate nearer than a distance in metres; None if there are no people."""
        return float(self._hits(threshold).sum()) / self.total if self.total else None


def velocity_errors(times: Array, truth: Array, estimate: Array) -> Array:
    """Errors (N - 1, C) of the velocities between neighbouring poses of one person, m/s.

    Args:
        times: (N,) seconds.
        truth: (N, C, 3) metres.
        estimate: (N, C, 3) metres.
    """
    step = np.diff(times)[:, None, None]
    return np.linalg.norm(np.diff(estimate - truth, axis=0) / step, axis=2)


def acceleration_errors(times: Array, truth: Array, estimate: Array) -> Array:
    """Errors (N - 2, C) of the accelerations of one person at poses with neighbours on both sides, m/s².

    Args:
        times: (N,) seconds.
        truth: (N, C, 3) metres.
        estimate: (N, C, 3) metres.
    """
    step = np.diff(times)[:, None, None]
    velocity = np.diff(estimate - truth, axis=0) / step
    return np.linalg.norm(2 * np.diff(velocity, axis=0) / (step[1:] + step[:-1]), axis=2)


def runs(times: NDArray[np.int64], most: float) -> Sequence[slice]:
    """Divide increasing times into runs without a gap of more than ``most`` nanoseconds. Returns their
    slices."""
    breaks = [0, *(np.flatnonzero(np.diff(times) > most) + 1).tolist(), len(times)]
    return [slice(a, b) for a, b in pairwise(breaks) if b > a]
