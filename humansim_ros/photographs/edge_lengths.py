"""Distances that keypoints of a person can have from their neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from humansim_ros.humans.loading import load_human
from humansim_ros.keypoints.locator import KeypointLocator
from humansim_ros.keypoints.sets import KeypointSet
from humansim_ros.types import Array, Indices

#: Human whose proportions are the mean ones.
_HUMAN = "adult_man"
#: Shares of the mean length that a bone has in other people.
_BONE = (0.65, 1.45)
#: Greatest share of its length at rest that a distance between parts that bend has.
_BENT = 1.6
#: Sizes of people, as shares of the mean one.
_SIZES = (0.4, 1.3)


@dataclass(frozen=True, eq=False)
class EdgeLengths:
    """Limits of the lengths of the E edges of a keypoint set, in metres, for a person of mean size.

    ``edges``: (E, 2) keypoints. ``lengths``: (E,) at rest. ``least``, ``greatest``: (E,) in any pose.
    """

    edges: Indices
    lengths: Array
    least: Array
    greatest: Array

    def size(self, positions: Array, known: NDArray[np.bool_]) -> float:
        """Size of a person as a share of the mean one, by positions (K, 3) of known (K,) keypoints."""
        rigid = (self.least > 0) & known[self.edges].all(axis=1)
        if not rigid.any():
            return 1.0
        first, second = positions[self.edges[rigid]].transpose(1, 0, 2)
        ratios = np.linalg.norm(first - second, axis=1) / self.lengths[rigid]
        return float(np.clip(np.median(ratios), *_SIZES))

    def neighbours(self, keypoint: int) -> Indices:
        """Keypoints that share an edge with one."""
        rows = self.edges[(self.edges == keypoint).any(axis=1)]
        return np.asarray(rows.sum(axis=1) - keypoint)

    def fits(
        self, keypoint: int, candidates: Array, positions: Array, known: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Whether places of a keypoint are at a possible distance from all its known neighbours.

        Args:
            keypoint: Number of the keypoint.
            candidates: Places (P, 3).
            positions: Positions (K, 3).
            known: (K,) the position is certain.

        Returns:
            (P,); true for all if no neighbour is known.
        """
        size = self.size(positions, known)
        fits = np.ones(len(candidates), bool)
        rows = np.flatnonzero((self.edges == keypoint).any(axis=1))
        for row, neighbour in zip(rows, self.neighbours(keypoint), strict=True):
            if known[neighbour]:
                distances = np.linalg.norm(candidates - positions[neighbour], axis=1) / size
                fits &= (self.least[row] <= distances) & (distances <= self.greatest[row])
        return fits


@cache
def edge_lengths(keypoints: KeypointSet) -> EdgeLengths:
    """Limits of the lengths of the edges of a set: bones are rigid, other edges bend."""
    human = load_human(_HUMAN)
    skeleton = human.skeleton
    joints = skeleton.joint_transforms(skeleton.rest)[:, :3, 3]
    at_rest = KeypointLocator.of(human, keypoints).positions(joints, human.mesh.vertices)
    edges = np.array(keypoints.edges, np.intp).reshape(-1, 2)
    lengths = np.linalg.norm(at_rest[edges[:, 0]] - at_rest[edges[:, 1]], axis=1)
    parent_of = dict(zip(skeleton.joint_names, skeleton.joint_parents, strict=True))
    rigid = np.array(
        [
            keypoints.points[a] == parent_of.get(keypoints.points[b])
            or keypoints.points[b] == parent_of.get(keypoints.points[a])
            for a, b in edges
        ],
        bool,
    )
    least = np.where(rigid, _BONE[0] * lengths, 0.0)
    return EdgeLengths(edges, lengths, least, np.where(rigid, _BONE[1], _BENT) * lengths)
