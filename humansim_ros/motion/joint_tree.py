"""Joint trees of motions: link lengths, longest chains, and pairs of similar branches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from humansim_ros.motion.kinematics import Motion

#: Two branches are a pair if their lengths differ by at most this share.
_PAIR_TOLERANCE = 0.12
#: Standard deviation of the length of a bone, as a share of it.
_BONE_VARIATION = 0.01


@dataclass(frozen=True)
class BranchPair:
    """Two similar branches of a joint: their first joints, and the length of the longer."""

    joint: int
    branches: tuple[int, int]
    length: float
    symmetry: float


class JointTree:
    """Joint tree of a motion, with link lengths and the longest chain below each joint."""

    def __init__(self, motion: Motion) -> None:
        self.names = motion.joint_names
        self.parents = motion.parents
        count = motion.n_joints
        frames = np.unique(np.linspace(0, motion.n_frames - 1, 5).astype(int))
        self.links = np.median(np.linalg.norm(motion.local_translations(frames), axis=-1), axis=0)
        self.links[self.parents < 0] = 0.0
        self.points = motion.world_positions(np.unique(np.linspace(0, motion.n_frames - 1, 60).astype(int)))
        self.children: list[list[int]] = [[] for _ in range(count)]
        for joint in range(count - 1, -1, -1):
            if self.parents[joint] >= 0:
                self.children[int(self.parents[joint])].insert(0, joint)
        #: Longest way from a joint's parent through the joint to a leaf.
        self.reach = self.links.copy()
        self.next = np.full(count, -1)
        for joint in range(count - 1, -1, -1):  # children come after parents
            if self.children[joint]:
                farthest = max(self.children[joint], key=lambda child: self.reach[child])
                self.reach[joint] += self.reach[farthest]
                self.next[joint] = farthest
        self.size = float(self.reach.max(initial=0.0))

    def stiffness(self, a: int, b: int) -> float:
        """1 where the distance of two joints is constant, as along a bone; less where a joint bends."""
        if int(self.parents[b]) == a:
            return 1.0
        distance = np.linalg.norm(self.points[:, a] - self.points[:, b], axis=-1)
        return float(np.exp(-0.5 * (distance.std() / max(distance.mean(), 1e-9) / _BONE_VARIATION) ** 2))

    def chain(self, joint: int) -> list[int]:
        """Longest chain of a branch, from its first joint to the leaf."""
        out = [joint]
        while self.next[out[-1]] >= 0:
            out.append(int(self.next[out[-1]]))
        return out

    def path(self, joint: int) -> list[int]:
        """A joint and its ancestors, upwards."""
        out = [joint]
        while self.parents[out[-1]] >= 0:
            out.append(int(self.parents[out[-1]]))
        return out

    def pairs(self) -> list[BranchPair]:
        """All pairs of similar long branches of one joint, or of joints without length between them."""
        pairs = []
        for joint in range(len(self.parents)):
            branches = [child for child in self._branches(joint) if self.reach[child] > 0.15 * self.size]
            for a, b in combinations(branches, 2):
                longer, shorter = sorted((self.reach[a], self.reach[b]), reverse=True)
                if shorter > (1 - _PAIR_TOLERANCE) * longer:
                    pairs.append(BranchPair(joint, (a, b), float(longer), float(shorter / longer)))
        return pairs

    def _branches(self, joint: int) -> Iterator[int]:
        """Children; of a child without length also its children, which start at the same place."""
        for child in self.children[joint]:
            yield child
            if self.links[child] < 1e-3 * self.size and len(self.children[child]) > 1:
                yield from self.children[child]
